"""Ablation: which parts of a model a scene needs."""

from core.studies.ablation.criterion import TITLES, Requirement
from core.studies.ablation.study import NOTE, requirements

__all__ = ["NOTE", "TITLES", "Requirement", "requirements"]
