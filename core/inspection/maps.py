"""Images to navigate a capture by; each found once, NaN where there is nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, once_per_capture
from core.posterior import posterior_of


@once_per_capture
def peak_counts(capture: Capture) -> Floats:
    """Largest count of each pixel, shape (row, col)."""
    largest = capture.blocks.largest.ravel()[: capture.blocks.n_pixels]
    return largest.reshape(capture.shape).astype(float)


@once_per_capture
def share_fired(capture: Capture) -> Floats:
    """Share of each pixel's pulses that fired; NaN where that is not known, shape (row, col)."""
    if capture.armed_pulses is None:
        return np.full(capture.shape, np.nan)
    return capture.counts / capture.armed_pulses


@once_per_capture
def likeliest(capture: Capture) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Bin that the surface is most probably within 3 bins of, and that probability; (row, col)."""
    near = posterior_of(capture).near
    delay = near.argmax(axis=2)
    return delay, np.take_along_axis(near, delay[..., np.newaxis], axis=2)[..., 0]


@once_per_capture
def sbr(capture: Capture) -> Floats:
    """Signal over background of each pixel; NaN where it saw nothing, shape (row, col).

    Of the delay that the posterior holds likeliest: the rate beside its echo is the background's,
    what the echo's bins hold beyond is signal, and counts as far as there is a surface at all.
    """
    posterior, acquisition = posterior_of(capture), capture.acquisition
    n_bins, n_pulses = acquisition.n_bins, capture.armed_pulses
    delay = likeliest(capture)[0]
    echo, first = capture.pulse.taps(n_bins, acquisition.bin_width_s, 0.5)
    begin = np.clip(delay + first, 0, n_bins)
    end = np.clip(begin + echo.size, 0, n_bins)
    until = np.zeros((*capture.shape, n_bins + 1), np.float32)
    np.cumsum(capture.cube, axis=2, out=until[..., 1:])
    before, behind = (
        np.take_along_axis(until, each[..., np.newaxis], axis=2)[..., 0] for each in (begin, end)
    )
    seen = behind - before
    if n_pulses is None:
        total = capture.counts.astype(float)
    else:
        left = np.maximum(n_pulses - np.stack([before, behind, capture.counts]), 0.5)
        seen, total = np.log(left[0] / left[1]), np.log(n_pulses / left[2])
    width = end - begin
    background = np.where(width < n_bins, (total - seen) / np.maximum(n_bins - width, 1), np.nan)
    signal = np.maximum(seen - background * width, 0.0) * posterior.surface
    with np.errstate(divide="ignore", invalid="ignore"):
        found = signal / (background * n_bins)
    return np.where((capture.counts > 0) & np.isfinite(found), found, np.nan)


maps = {"Peak": peak_counts, "Fired": share_fired, "SBR": sbr}
"""By the name that the app gives them; each takes a capture and gives an image (row, col)."""
