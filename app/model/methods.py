"""The estimators on screen: titles, settings, and the one to begin with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from app.theme import Palette, line_style
from core import ESTIMATORS, Capture
from core.inference import flux_model_of
from core.parameters import spec_of

_MOST_SBR = 0.2  # of the sweeps, but for that of the peak

OTHERS = tuple(name for name in ESTIMATORS if name != "tracking")
"""All estimators but the tracking differentiator, whose settings the state holds by themselves."""

FIRST_METHODS = ("peak", "coates", "likelihood", "tracking", "oracle")
"""Methods that are compared by default; each has a colour of its own."""

METHOD_PLACES = {
    method: place for place, method in enumerate(dict.fromkeys((*FIRST_METHODS, *ESTIMATORS)))
}
"""Place of each method in the sequence of line styles, the same in all plots."""

METHOD_TITLES = {name: estimator.title for name, estimator in ESTIMATORS.items()}


PARAMETER_SYMBOLS = {
    (name, each.name): spec_of(each).symbol
    for name, estimator in ESTIMATORS.items()
    for each in fields(estimator.parameters)
}
"""Symbol of each setting, by method and field."""


def method_title(name: str) -> str:
    """Return the title of an estimator; a reconstruction is marked as such."""
    return METHOD_TITLES[name] + (" (reconstruction)" if ESTIMATORS[name].reconstructed else "")


def method_style(name: str, colors: Palette) -> tuple[str, list[int]]:
    """Return colour and dashes of an estimator's line."""
    return line_style(METHOD_PLACES[name], colors)


def default_settings() -> Mapping[str, Any]:
    """Return the default settings of each of `OTHERS`."""
    return {name: ESTIMATORS[name].parameters() for name in OTHERS}


def doubts_hold(capture: Capture) -> bool:
    """Return whether doubtful settings are those of this kind of data.

    They were measured on simulated first photons in daylight (`python -m core stability`). In a
    capture without much background, other settings find the echoes, too.
    """
    return capture.detection == "first" and flux_model_of(capture).contrast <= _MOST_SBR
