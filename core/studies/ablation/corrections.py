"""Effect of an estimator's corrections on its estimates and their time."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

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
from core.studies.statistics import mean_interval
from core.studies.timing import time_ratio


def with_correction(capture: Capture, correction: str) -> Capture:
    """Return the same counts for an estimator that always makes one of `CORRECTIONS`."""
    if correction == "pulse_shape":
        return capture
    flux_prior = detailed_flux_prior_of(capture)
    if correction == "pile_up":
        flux_prior = flux_prior_of(capture)._replace(pile_up=True)
    return replace(capture, flux_prior=flux_prior)


def level_deviation(capture: Capture) -> Difference:
    """Compare the signal levels of 1000 pixels with their mean level."""
    flux_prior = detailed_flux_prior_of(capture)
    share = flux_prior.share[1:] / flux_prior.share[1:].sum()
    pixels = np.maximum(np.round(1000 * share), 1).astype(int)
    return Difference(*(np.repeat(each, pixels) for each in level_differences(flux_prior, capture)))


def delays(capture: Capture, method: str) -> Floats:
    """Return the estimates of a method with default settings in fractional bins (row, col)."""
    estimator = ESTIMATORS[method]
    return estimator.delays(capture, estimator.parameters())[0]


def ranges_m(capture: Capture, method: str) -> Floats:
    """Return the same estimates as ranges, NaN where there are none."""
    return capture.acquisition.bin_to_range_m(delays(capture, method))


def score(range_m: Floats, truth_m: Floats, capture: Capture) -> tuple[float, float]:
    """Return restoration degree within 3 bins and RMSE in metres, over some of the pixels."""
    tolerance_m = TOLERANCE_BINS * capture.acquisition.bin_length_m
    return (
        metrics.restoration_degree(range_m, truth_m, tolerance_m),
        metrics.rmse_m(range_m, truth_m),
    )


def changes(with_it: Floats, without_it: Floats) -> tuple[Interval, Interval]:
    """Return the mean changes of restoration degree and RMSE, from paired scores (n, 2)."""
    rd, rmse_m = (mean_interval(each[np.isfinite(each)]) for each in (with_it - without_it).T)
    return rd, rmse_m


def ranging_ratio(with_it: Capture, without_it: Capture, method: str) -> Interval:
    """Return the ratio of the times to range two captures (their first rows), flux known."""
    one, other = _first_rows(with_it), _first_rows(without_it)
    return time_ratio(partial(delays, one, method), partial(delays, other, method))


def _first_rows(capture: Capture) -> Capture:
    """Return as many rows as are ranged within milliseconds, their flux model computed."""
    rows = max(1, 2**19 // capture.cube[0].size)
    part = replace(
        capture,
        cube=capture.cube[:rows].copy(),
        **capture.images(lambda _: None),
        flux_prior=flux_prior_of(capture),
        groups=None,
    )
    flux_model_of(part)
    return part
