"""The path from a capture to an answer and its figures."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

from core import metrics
from core.capture import Capture
from core.cost import require_memory
from core.deprecation import renamed
from core.estimators import RangeImage, estimate, settings_of
from core.inference.posterior import posterior_of


@dataclass(frozen=True)
class Run:
    """One capture ranged by one method.

    Parameters
    ----------
    figures : dict
        ``rmse_m``, ``mae_m``, ``inlier_rmse_m`` (within 3 bins), ``bias_m``, ``median_error_m``,
        ``coverage``, ``rd_1_bin``, ``rd_2_bins``, ``rd_3_bins``; empty where the capture has no
        truth: nothing is shown rather than nonsense.
    flux_time_s : float
        Seconds spent on what all methods share and a capture keeps: its light and its posterior.
    estimate_s : float
        Seconds spent by the method itself.
    """

    capture: Capture
    image: RangeImage
    figures: dict[str, float]
    flux_time_s: float
    estimate_s: float

    light_s = renamed("flux_time_s")


def run(
    capture: Capture, method: str, settings: Any = None, false_alarm: float | None = None
) -> Run:
    """Range a capture and compare the answer with its truth, if it has one.

    Parameters
    ----------
    capture : Capture
    method : str
        A key of `ESTIMATORS`.
    settings : object, optional
        The method's own settings; its defaults where None.
    false_alarm : float, optional
        As `core.estimate` takes it.

    Raises
    ------
    ValueError
        As `core.estimate`.
    """
    settings = settings_of(method, settings)
    require_memory(capture, method, settings, false_alarm)
    started = perf_counter()
    posterior_of(capture)
    lit = perf_counter()
    image = estimate(capture, method, settings, false_alarm=false_alarm)
    done = perf_counter()
    return Run(capture, image, _figures(capture, image), lit - started, done - lit)


def _figures(capture: Capture, image: RangeImage) -> dict[str, float]:
    truth_m = capture.truth_range_m
    if truth_m is None:
        return {}
    bin_m = capture.acquisition.bin_length_m
    return {
        "rmse_m": metrics.rmse_m(image.range_m, truth_m),
        "mae_m": metrics.mae_m(image.range_m, truth_m),
        "inlier_rmse_m": metrics.inlier_rmse_m(image.range_m, truth_m, 3 * bin_m),
        "bias_m": metrics.bias_m(image.range_m, truth_m),
        "median_error_m": metrics.median_error_m(image.range_m, truth_m),
        "coverage": metrics.coverage(image.range_m, truth_m),
        "rd_1_bin": metrics.restoration_degree(image.range_m, truth_m, bin_m),
        "rd_2_bins": metrics.restoration_degree(image.range_m, truth_m, 2 * bin_m),
        "rd_3_bins": metrics.restoration_degree(image.range_m, truth_m, 3 * bin_m),
    }
