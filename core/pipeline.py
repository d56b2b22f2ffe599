"""Estimate a capture and compare the estimate with its truth."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

from core import metrics
from core.acquisition import Floats
from core.capture import Capture
from core.cost import require_memory
from core.deprecation import renamed
from core.estimators import (
    Judge,
    RangeImage,
    estimate,
    judged_by_image,
    require_capture,
    require_judge,
    settings_of,
)
from core.inference.posterior import posterior_of


@dataclass(frozen=True)
class Run:
    """An estimate of a capture with its error figures and times.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
    figures : dict
        ``rmse_m``, ``mae_m``, ``inlier_rmse_m`` (within 3 bins), ``bias_m``, ``median_error_m``,
        ``coverage``, ``rd_1_bin``, ``rd_2_bins``, ``rd_3_bins``; empty if the capture has no truth.
    flux_time_s : float
        Seconds for what all methods share and the capture caches: flux model and posterior.
    estimate_s : float
        Seconds for the method itself.
    """

    capture: Capture
    image: RangeImage
    figures: dict[str, float]
    flux_time_s: float
    estimate_s: float

    light_s = renamed("flux_time_s")


def run(
    capture: Capture,
    method: str,
    settings: Any = None,
    false_alarm: float | None = None,
    judged_by: Judge = "pixel",
) -> Run:
    """Estimate a capture and compare the estimate with the truth, if known.

    Parameters
    ----------
    capture, method, settings, false_alarm, judged_by
        As for `core.estimate`.

    Returns
    -------
    Run

    Raises
    ------
    ValueError
        As `core.estimate`.
    """
    require_capture(capture)
    require_judge(judged_by)
    settings = settings_of(method, settings)
    require_memory(capture, method, settings, false_alarm)
    started = perf_counter()
    posterior_of(capture)
    flux_done = perf_counter()
    image = estimate(capture, method, settings, false_alarm=false_alarm)
    done = perf_counter()
    if judged_by == "image":
        image = judged_by_image(capture, image)
    truth_m, bin_m = capture.truth_range_m, capture.acquisition.bin_length_m
    figures = {} if truth_m is None else figures_of(image.range_m, truth_m, bin_m)
    return Run(capture, image, figures, flux_done - started, done - flux_done)


def figures_of(range_m: Floats, truth_m: Floats, bin_m: float) -> dict[str, float]:
    """Return the error figures of a `Run`.

    Parameters
    ----------
    range_m, truth_m : ndarray, shape (row, col)
        As `core.metrics` takes them.
    bin_m : float
        Range covered by one bin, in metres.
    """
    ranges = range_m, truth_m
    return {
        "rmse_m": metrics.rmse_m(*ranges),
        "mae_m": metrics.mae_m(*ranges),
        "inlier_rmse_m": metrics.inlier_rmse_m(*ranges, 3 * bin_m),
        "bias_m": metrics.bias_m(*ranges),
        "median_error_m": metrics.median_error_m(*ranges),
        "coverage": metrics.coverage(*ranges),
        "rd_1_bin": metrics.restoration_degree(*ranges, bin_m),
        "rd_2_bins": metrics.restoration_degree(*ranges, 2 * bin_m),
        "rd_3_bins": metrics.restoration_degree(*ranges, 3 * bin_m),
    }
