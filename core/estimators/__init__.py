"""The registry of estimators, and the one way to call them."""

from __future__ import annotations

from typing import Any

from core.capture import Capture
from core.checks import require
from core.estimators import peak, tracking
from core.estimators.base import Estimator, RangeImage

__all__ = ["ESTIMATORS", "Estimator", "RangeImage", "estimate"]

ESTIMATORS: dict[str, Estimator] = {
    "tracking": tracking.ESTIMATOR,
    "peak": peak.ESTIMATOR,
}


def estimate(capture: Capture, method: str, settings: Any = None, **parameters: Any) -> RangeImage:
    """Range every pixel of a capture.

    Parameters
    ----------
    capture : Capture
    method : str
        A key of `ESTIMATORS`.
    settings : object, optional
        The method's settings as its own dataclass, ``ESTIMATORS[method].parameters``.
    **parameters
        The same, field by field, where `settings` is not given.

    Returns
    -------
    RangeImage

    Raises
    ------
    ValueError
        If the method is unknown, or a parameter is unknown or out of its bounds.
    """
    require("method", method, method in ESTIMATORS, " or ".join(map(repr, ESTIMATORS)))
    estimator = ESTIMATORS[method]
    if settings is None:
        known = estimator.parameters.__dataclass_fields__
        for name, value in parameters.items():
            require(name, value, name in known, f"one of {list(known)}")
        settings = estimator.parameters(**parameters)
    else:
        fits = isinstance(settings, estimator.parameters) and not parameters
        require("settings", settings, fits, f"{estimator.parameters.__name__}, or single fields")
    return estimator(capture, settings)
