"""The paper: its figures and tables beside ours."""

from core.studies.paper import figures

__all__ = [
    "figures",
]
