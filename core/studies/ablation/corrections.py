"""What it changes that an estimator takes something into account of a capture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from core import metrics
from core.acquisition import Floats
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.inference.flux import (
    detailed_flux_prior_of,
    flux_model_of,
    flux_prior_of,
    level_differences,
)
from core.inference.posterior import TOLERANCE_BINS
from core.inference.resolution import Difference
from core.metrics import Interval
from core.studies.timing import FEWEST_REPEATS, interleaved, median_interval


def with_correction(capture: Capture, correction: str) -> Capture:
    """The same counts for an estimator that makes one of `CORRECTIONS`, whatever it would spare."""
    if correction == "pulse_shape":
        return capture
    flux_prior = detailed_flux_prior_of(capture)
    if correction == "pile_up":
        flux_prior = flux_prior_of(capture)._replace(pile_up=True)
    return replace(capture, flux_prior=flux_prior)


def levels_apart(capture: Capture) -> Difference:
    """How far each pixel's level of signal lies from the mean level, for 1000 pixels."""
    flux_prior = detailed_flux_prior_of(capture)
    share = flux_prior.share[1:] / flux_prior.share[1:].sum()
    pixels = np.maximum(np.round(1000 * share), 1).astype(int)
    return Difference(*(np.repeat(each, pixels) for each in level_differences(flux_prior, capture)))


def delays(capture: Capture, method: str) -> Floats:
    """A method's answers by its defaults, in fractional bins; shape (row, col)."""
    estimator = ESTIMATORS[method]
    return estimator.delays(capture, estimator.parameters())[0]


def answers_m(capture: Capture, method: str) -> Floats:
    """The same as ranges, NaN where there is none."""
    return capture.acquisition.bin_to_range_m(delays(capture, method))


def score(range_m: Floats, truth_m: Floats, capture: Capture) -> tuple[float, float]:
    """Restoration degree within 3 bins, and RMSE in metres, of answers to some of its pixels."""
    tolerance_m = TOLERANCE_BINS * capture.acquisition.bin_length_m
    return (
        metrics.restoration_degree(range_m, truth_m, tolerance_m),
        metrics.rmse_m(range_m, truth_m),
    )


def changes(with_it: Floats, without_it: Floats) -> tuple[Interval, Interval]:
    """Of restoration degree and of RMSE, from paired scores (repetition, 2)."""
    rd, rmse_m = (with_it - without_it).T
    return student(rd), student(rmse_m)


def student(change: Floats) -> Interval:
    """Mean of paired changes (n,), NaN left out, with Student's 95 % interval."""
    known = change[np.isfinite(change)]
    if known.size < 2:
        return Interval(math.nan, math.nan, math.nan)
    mean = float(np.mean(known))
    half = float(stdtrit(known.size - 1, 0.975) * np.std(known, ddof=1) / math.sqrt(known.size))
    return Interval(mean, mean - half, mean + half)


def ranging_ratio(with_it: Capture, without_it: Capture, method: str) -> Interval:
    """Time of a method on one capture over that on another, on some rows, their light known."""
    one, other = _some_rows(with_it), _some_rows(without_it)
    return time_ratio(lambda: delays(one, method), lambda: delays(other, method))


def _some_rows(capture: Capture) -> Capture:
    """As many as are ranged in some milliseconds."""
    rows = max(1, 2**19 // capture.cube[0].size)
    some = replace(
        capture,
        cube=capture.cube[:rows].copy(),
        truth_range_m=None,
        signal=None,
        flux_prior=flux_prior_of(capture),
    )
    flux_model_of(some)
    return some


def time_ratio(
    one: Callable[[], object], other: Callable[[], object], repeats: int = FEWEST_REPEATS + 3
) -> Interval:
    """Median of the ratio of two times, taken in turn."""
    seconds = interleaved({"one": one, "other": other}, repeats)
    return median_interval(seconds["one"] / seconds["other"])
