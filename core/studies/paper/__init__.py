"""Figures and tables of the paper, reproduced."""

from core.studies.paper import figures, pile_up

__all__ = [
    "figures",
    "pile_up",
]
