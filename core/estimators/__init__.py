"""The registry of estimators, and the one way to call them."""

from __future__ import annotations

from typing import Any

from core.capture import Capture
from core.checks import require
from core.cost import require_memory
from core.estimators import (
    cfar,
    chi,
    coates,
    kde,
    likelihood,
    log_matched_filter,
    matched_filter,
    oracle,
    peak,
    shi,
    tracking,
    unmixing,
)
from core.estimators.base import FALSE_ALARM, Estimator, RangeImage

__all__ = ["ESTIMATORS", "FALSE_ALARM", "Estimator", "RangeImage", "estimate", "settings_of"]

ESTIMATORS: dict[str, Estimator] = {
    "tracking": tracking.ESTIMATOR,
    "peak": peak.ESTIMATOR,
    "matched_filter": matched_filter.ESTIMATOR,
    "log_matched_filter": log_matched_filter.ESTIMATOR,
    "coates": coates.ESTIMATOR,
    "kde": kde.ESTIMATOR,
    "shi": shi.ESTIMATOR,
    "chi": chi.ESTIMATOR,
    "cfar": cfar.ESTIMATOR,
    "unmixing": unmixing.ESTIMATOR,
    "likelihood": likelihood.ESTIMATOR,
    "oracle": oracle.ESTIMATOR,
}


def estimate(
    capture: Capture,
    method: str,
    settings: Any = None,
    *,
    false_alarm: float | None = None,
    **parameters: Any,
) -> RangeImage:
    """Range every pixel of a capture.

    Parameters
    ----------
    capture : Capture
    method : str
        A key of `ESTIMATORS`.
    settings : object, optional
        The method's settings as its own dataclass, ``ESTIMATORS[method].parameters``.
    false_alarm : float, optional
        Answer only where the score exceeds what this share of pixels without an echo would show;
        every pixel that saw a photon is answered where None.
    **parameters
        The same, field by field, where `settings` is not given.

    Returns
    -------
    RangeImage

    Raises
    ------
    ValueError
        If the method is unknown, a parameter is unknown or out of its bounds, the method needs
        what the capture does not know, or more working memory than is free (`core.cost`).
    """
    settings = settings_of(method, settings, **parameters)
    require_memory(capture, method, settings, false_alarm)
    return ESTIMATORS[method](capture, settings, false_alarm)


def settings_of(method: str, settings: Any = None, **parameters: Any) -> Any:
    """A method's settings, from its own dataclass or from single fields, as `estimate` takes them.

    Raises
    ------
    ValueError
        If the method or a parameter is unknown, or one is out of its bounds.
    """
    require("method", method, method in ESTIMATORS, " or ".join(map(repr, ESTIMATORS)))
    kind = ESTIMATORS[method].parameters
    if settings is None:
        known = kind.__dataclass_fields__
        for name, value in parameters.items():
            require(name, value, name in known, f"one of {list(known)}")
        return kind(**parameters)
    fits = isinstance(settings, kind) and not parameters
    require("settings", settings, fits, f"{kind.__name__}, or single fields")
    return settings
