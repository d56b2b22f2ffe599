"""Figures and tables of the paper, reproduced."""

from core.studies.paper import figures

__all__ = [
    "figures",
]
