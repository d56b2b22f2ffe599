"""Ablation: which parts of a model a scene needs."""

from core.studies.ablation.criterion import EXTENSIONS, TITLES, Requirement
from core.studies.ablation.study import NOTE, requirements

__all__ = ["EXTENSIONS", "NOTE", "TITLES", "Requirement", "requirements"]
