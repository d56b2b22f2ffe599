"""Kernel that adds up what pixels count where they see background alone."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.parallel import SUMMING

_LEAST_SHARE = 1e-6  # probability that no echo is near, below which a bin is left out


@njit(**SUMMING)
def add_echo_free(density, prior, background, counts, n_pulses, echo_window, shape, sums):  # type: ignore[no-untyped-def]
    """Add up counts, counts expected of background relative to its shape, and armed pulses.

    Each bin of a pixel counts with the probability that no echo is near it. `sums` is (3, bin).

    `density` (pixel, level, bin) is the likelihood of levels and delays, of which the first level
    is no echo, `prior` (level, bin) their probability, `background` (pixel, level) in photons per
    pulse over the gate, `counts` (pixel, bin), `n_pulses` 0 if unknown, `shape` (bin,) that of the
    background, and `echo_window` the bins from a delay that an echo may fill, first and end.
    """
    n_pixels, n_levels, n_bins = density.shape
    first, end = echo_window
    near, dimmed = np.empty((2, n_bins))
    near_before, dimmed_before = np.zeros((2, n_bins + 1))
    for pixel in range(n_pixels):
        near[:], dimmed[:] = 0.0, 0.0
        for level in range(1, n_levels):
            photons = background[pixel, level]
            for k in range(n_bins):
                mass = prior[level, k] * density[pixel, level, k]
                near[k] += mass
                dimmed[k] += photons * mass
        for k in range(n_bins):
            near_before[k + 1] = near_before[k] + near[k]
            dimmed_before[k + 1] = dimmed_before[k] + dimmed[k]
        dark = density[pixel, 0, 0] * prior[0].sum()
        total = dark + near_before[n_bins]
        photons = background[pixel, 0] * dark + dimmed_before[n_bins]
        armed = float(n_pulses) if n_pulses > 0 else 1.0
        for k in range(n_bins):
            # Echoes of these delays fill the bin.
            begin, until = max(k + 1 - end, 0), min(k + 1 - first, n_bins)
            alone = total - (near_before[until] - near_before[begin])
            count = float(counts[pixel, k])
            if alone > _LEAST_SHARE * total:
                mean = (photons - (dimmed_before[until] - dimmed_before[begin])) / alone
                rate = max(mean, 0.0) / n_bins * shape[k]
                fires = -math.expm1(-rate) if n_pulses > 0 else rate
                share = alone / total
                sums[0, k] += share * count
                sums[1, k] += share * armed * fires / shape[k]
                sums[2, k] += share * armed
            if n_pulses > 0:
                armed -= count
