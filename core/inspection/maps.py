"""Maps for the navigation of a capture, cached; NaN where undefined."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy  # loads a submodule when it is first used
from numba import njit
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.fit import fit_p_values
from core.inference.posterior import TOLERANCE_BINS, posterior_of
from core.inference.returns import MOST_RETURNS, fitted_echoes, least_gain
from core.inspection.surfaces import LIKELY
from core.kernels.parallel import COMPILED, on_threads


@cached_per_capture
def peak_counts(capture: Capture) -> Floats:
    """Largest count of each pixel, shape (row, col)."""
    largest = capture.blocks.largest.ravel()[: capture.blocks.n_pixels]
    return largest.reshape(capture.shape).astype(float)


@cached_per_capture
def share_fired(capture: Capture) -> Floats:
    """Share of pulses that fired in each pixel, shape (row, col); NaN if it is unknown."""
    if capture.gated_pulses is None:
        return np.full(capture.shape, np.nan)
    return capture.counts / capture.gated_pulses


@cached_per_capture
def likeliest(capture: Capture) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Most probable bin of a surface, and the probability of a surface within 3 bins of it.

    Around a clear echo that probability is equal in seven bins, of which this is the middle.
    """
    probability = posterior_of(capture).tolerance_probability
    size = 2 * TOLERANCE_BINS + 1
    sums = scipy.ndimage.uniform_filter1d(probability, size, axis=2, mode="constant")
    delay = sums.argmax(axis=2)
    return delay, np.take_along_axis(probability, delay[..., np.newaxis], axis=2)[..., 0]


@cached_per_capture
def sbr(capture: Capture) -> Floats:
    """Signal over background of each pixel, shape (row, col); NaN without detections.

    For an echo at the most probable delay: the rate outside it is the background, the excess inside
    is the signal, multiplied by the probability of a surface. Infinite without detections outside
    the echo.
    """
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    echo, first = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s, 0.5)
    begin = np.clip(likeliest(capture)[0] + first, 0, n_bins)
    end = np.clip(begin + echo.size, 0, n_bins)
    before, inside = np.empty((2, *capture.shape), np.int64)
    given = capture.cube, begin, end, before, inside
    on_threads(_count, capture.shape[0], capture.cube.size, *given)
    total = capture.counts
    if n_pulses is None:
        echo_photons, all_photons = inside.astype(float), total.astype(float)
    else:
        left = [np.maximum(n_pulses - each, 0.5) for each in (before, before + inside, total)]
        echo_photons, all_photons = np.log(left[0] / left[1]), np.log(n_pulses / left[2])
    width = end - begin
    with np.errstate(divide="ignore", invalid="ignore"):
        background = np.maximum(all_photons - echo_photons, 0.0) / (n_bins - width)
        signal = np.maximum(echo_photons - background * width, 0.0)
        return np.asarray(signal * posterior_of(capture).surface / (background * n_bins))


@cached_per_capture
def number_of_returns(capture: Capture) -> NDArray[np.intp]:
    """Surfaces that each pixel shows by itself, shape (row, col).

    As `core.with_returns` finds them with its default rate of false returns; 0 where a surface is
    less likely than none.
    """
    n_echoes = fitted_echoes(capture, capture.cube, MOST_RETURNS, least_gain(capture)).number
    has_any = posterior_of(capture).surface >= LIKELY
    return np.where(has_any, n_echoes.reshape(capture.shape), 0)


@njit(**COMPILED)
def _count(first, last, cube, begin, end, before, inside):  # type: ignore[no-untyped-def]
    """Count detections of each pixel before the bin `begin`, and from there to `end`."""
    for row in range(first, last):
        for col in range(cube.shape[1]):
            total = 0
            for k in range(begin[row, col]):
                total += cube[row, col, k]
            before[row, col], total = total, 0
            for k in range(begin[row, col], end[row, col]):
                total += cube[row, col, k]
            inside[row, col] = total


maps: dict[str, Callable[[Capture], NDArray[Any]]] = {
    "Peak": peak_counts,
    "Fired": share_fired,
    "SBR": sbr,
    "Returns": number_of_returns,
    "Goodness of fit": fit_p_values,
}
"""Functions from a capture to an image (row, col), by name on screen."""
