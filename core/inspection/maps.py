"""Images to navigate a capture by; each found once, NaN where there is nothing."""

from __future__ import annotations

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.posterior import posterior_of
from core.kernels.parallel import PARALLEL, entering


@cached_per_capture
def peak_counts(capture: Capture) -> Floats:
    """Largest count of each pixel, shape (row, col)."""
    largest = capture.blocks.largest.ravel()[: capture.blocks.n_pixels]
    return largest.reshape(capture.shape).astype(float)


@cached_per_capture
def share_fired(capture: Capture) -> Floats:
    """Share of each pixel's pulses that fired; NaN where that is not known, shape (row, col)."""
    if capture.gated_pulses is None:
        return np.full(capture.shape, np.nan)
    return capture.counts / capture.gated_pulses


@cached_per_capture
def likeliest(capture: Capture) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Bin that the surface is most probably within 3 bins of, and that probability; (row, col)."""
    near = posterior_of(capture).tolerance_probability
    delay = near.argmax(axis=2)
    return delay, np.take_along_axis(near, delay[..., np.newaxis], axis=2)[..., 0]


@cached_per_capture
def sbr(capture: Capture) -> Floats:
    """Signal over background of each pixel, shape (row, col); NaN where it saw nothing.

    Of the delay that the posterior holds likeliest: the rate beside its echo is the background's,
    what the echo's bins hold beyond is signal, and counts as far as there is a surface at all.
    Infinite where nothing but the echo was seen.
    """
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    echo, first = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s, 0.5)
    begin = np.clip(likeliest(capture)[0] + first, 0, n_bins)
    end = np.clip(begin + echo.size, 0, n_bins)
    before, inside = np.empty((2, *capture.shape), np.int64)
    with entering(capture.cube.size):
        _count(capture.cube, begin, end, before, inside)
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


@njit(**PARALLEL)
def _count(cube, begin, end, before, inside):  # type: ignore[no-untyped-def]
    """Counts of each pixel before the bin where something begins, and from there to its end."""
    for row in prange(cube.shape[0]):
        for col in range(cube.shape[1]):
            total = 0
            for k in range(begin[row, col]):
                total += cube[row, col, k]
            before[row, col], total = total, 0
            for k in range(begin[row, col], end[row, col]):
                total += cube[row, col, k]
            inside[row, col] = total


maps = {"Peak": peak_counts, "Fired": share_fired, "SBR": sbr}
"""By the name that the app gives them; each takes a capture and gives an image (row, col)."""
