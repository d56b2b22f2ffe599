"""Ablation: which parts of a model a scene needs."""

from core.studies.ablation.criterion import EXTENSIONS, TITLES, Requirement
from core.studies.ablation.study import COMPARISON_NOTE, KINDS_NOTE, NOTE, requirements

__all__ = [
    "COMPARISON_NOTE",
    "EXTENSIONS",
    "KINDS_NOTE",
    "NOTE",
    "TITLES",
    "Requirement",
    "requirements",
]
