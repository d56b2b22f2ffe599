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
    """Return restoration degree within 3 bins and RMSE in metres, over some of the pixels.

    Parameters
    ----------
    range_m : ndarray, shape (return, ...)
        NaN where a pixel has fewer returns.
    truth_m : ndarray, shape (surface, ...)
        NaN where a pixel has fewer surfaces. The restoration degree is the share of surfaces that
        are found (`metrics.surfaces_found`), errors are those of the nearest return.
    capture : Capture
    """
    tolerance_m = TOLERANCE_BINS * capture.acquisition.bin_length_m
    hits, of = metrics.surfaces_found(range_m, truth_m, tolerance_m)
    error_m = metrics.surface_errors_m(range_m, truth_m)
    error_m = error_m[np.isfinite(error_m)]
    return (
        hits / of if of else np.nan,
        float(np.sqrt(np.mean(error_m**2))) if error_m.size else np.nan,
    )


def changes(with_it: Floats, without_it: Floats, gate_m: float) -> tuple[Interval, Interval]:
    """Return the mean changes of restoration degree and RMSE, from paired scores (n, 2).

    Neither interval exceeds what is possible in a gate of this length.
    """
    rd, rmse_m = (
        mean_interval(each[np.isfinite(each)], -most, most)
        for each, most in zip((with_it - without_it).T, (1.0, gate_m), strict=True)
    )
    return rd, rmse_m


def changes_over_rows(
    capture: Capture, with_m: Floats, without_m: Floats
) -> tuple[Interval, Interval]:
    """Return the changes for estimates (return, row, col), paired over the rows of a truth."""
    truth_m = np.asarray(capture.truth_range_m)
    rows = np.flatnonzero(np.isfinite(truth_m).any(axis=1))
    with_it, without_it = (
        np.array([score(range_m[:, row], truth_m[np.newaxis, row], capture) for row in rows])
        for range_m in (with_m, without_m)
    )
    return changes(with_it, without_it, capture.acquisition.gate_length_m)


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
