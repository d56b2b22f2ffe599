"""Titles of the estimators on screen."""

from __future__ import annotations

from core import ESTIMATORS

METHOD_TITLES = {name: estimator.title for name, estimator in ESTIMATORS.items()}


def method_title(name: str) -> str:
    """Return the title of an estimator; a reconstruction is marked as such."""
    return METHOD_TITLES[name] + (" (reconstruction)" if ESTIMATORS[name].reconstructed else "")
