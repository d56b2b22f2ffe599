"""Registry of estimators, and the function that calls them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

from core.capture import Capture
from core.checks import require
from core.cost import require_memory
from core.estimators import (
    cfar,
    chi,
    coates,
    image_posterior,
    kde,
    likelihood,
    log_matched_filter,
    matched_filter,
    oracle,
    peak,
    shi,
    tracking,
    unmixing,
    velocity,
)
from core.estimators.base import FALSE_ALARM, Estimator, Provenance, RangeImage
from core.estimators.judging import JUDGES, Judge, judged_by_image, require_judge
from core.estimators.returns import with_returns

__all__ = [
    "ESTIMATORS",
    "FALSE_ALARM",
    "JUDGES",
    "Estimator",
    "Judge",
    "Provenance",
    "RangeImage",
    "estimate",
    "judged_by_image",
    "require_capture",
    "require_judge",
    "settings_of",
    "suitable_method",
    "with_returns",
]

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
    "velocity": velocity.ESTIMATOR,
    "image_posterior": image_posterior.ESTIMATOR,
    "oracle": oracle.ESTIMATOR,
}


def estimate(
    capture: Capture,
    method: str,
    settings: Any = None,
    *,
    false_alarm: float | None = None,
    judged_by: Judge = "pixel",
    returns: int = 1,
    **parameters: Any,
) -> RangeImage:
    """Estimate the range of every pixel of a capture.

    Parameters
    ----------
    capture : Capture
    method : str
        A key of `ESTIMATORS`.
    settings : object, optional
        Settings of the method, of type ``ESTIMATORS[method].parameters``.
    false_alarm : float, optional
        Give a range only where the score exceeds the threshold that this share of echo-free pixels
        exceeds. If None, every pixel with a detection gets one. The methods "kde" and "chi" add
        neighbouring pixels, so that next to surfaces more empty pixels get a range. The methods
        "unmixing" and "image_posterior" ignore it; see their settings ``false_acceptance`` and
        ``pixels``.
    judged_by : {"pixel", "image"}
        What determines the confidence: the counts of the pixel alone, or those of its neighbours,
        too (`judged_by_image`).
    returns : int
        Surfaces of a pixel to look for, at most 4; `RangeImage.returns` holds them if more than 1
        (`with_returns`).
    **parameters
        Settings as single fields, instead of `settings`.

    Returns
    -------
    RangeImage

    Raises
    ------
    ValueError
        If there is no capture, the method or a parameter is unknown, a parameter is out of its
        bounds, the capture lacks data that the method needs, or memory is not sufficient
        (`core.cost`).
    """
    require_capture(capture)
    settings = settings_of(method, settings, **parameters)
    require_judge(judged_by)
    require_memory(capture, method, settings, false_alarm)
    estimator = ESTIMATORS[method]
    made_by = Provenance(
        method, settings, false_alarm, partial(estimator.remark, capture, false_alarm, settings)
    )
    image = replace(estimator(capture, settings, false_alarm), made_by=made_by)
    if judged_by == "image":
        image = judged_by_image(capture, image)
    return image if returns == 1 else with_returns(capture, image, returns)


def suitable_method(capture: Capture) -> str:
    """Return the estimator to begin with: the paper's, unless all photons were counted.

    Then the likelihood finds more surfaces, and ranges them below a bin.
    """
    return "likelihood" if capture.detection == "all" else "tracking"


def require_capture(capture: object) -> None:
    """Raise ``ValueError`` unless an object is a capture; say how to make one."""
    if isinstance(capture, Capture):
        return
    kind, shape = type(capture), getattr(capture, "shape", None)
    name = f"{kind.__module__}.{kind.__qualname__}".removeprefix("builtins.")
    n_bins = shape[-1] if isinstance(shape, tuple) and len(shape) == 3 else "..."
    given = name if shape is None else f"{name} of shape {shape}"
    example = f"core.Capture(counts, core.Acquisition(n_bins={n_bins}, bin_width_s=1e-9))"
    accepted = (
        f"a core.Capture: core.read_capture(path) for a file, or {example} for unsigned counts"
    )
    require("capture", given, False, f"{accepted} of shape (row, col, bin)")


def settings_of(method: str, settings: Any = None, **parameters: Any) -> Any:
    """Return a method's settings from the `settings` or the single fields of `estimate`.

    Raises
    ------
    ValueError
        If the method or a parameter is unknown, or a parameter is out of its bounds.
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
