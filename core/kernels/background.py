"""Kernel that adds up what pixels count where they see background alone."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.parallel import SUMMING

_LEAST_SHARE = 1e-6  # probability that no echo is near, below which a bin is left out
_TINY = 1e-300  # probability, instead of 0
_SMALL_RATE = 0.125  # photons per bin, below which eleven terms of a series are exact


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
    # Sums over the delays before each bin, continued beyond the gate: windows are slices of them.
    near_before, dimmed_before = np.zeros((2, n_bins + end - first))
    begin, until = slice(0, n_bins), slice(end - first, n_bins + end - first)
    near, dimmed, alone, armed, fires = np.empty((5, n_bins))
    brightest = shape.max() / n_bins
    for pixel in range(n_pixels):
        near[:], dimmed[:] = 0.0, 0.0
        for level in range(1, n_levels):
            photons = background[pixel, level]
            for k in range(n_bins):
                mass = prior[level, k] * density[pixel, level, k]
                near[k] += mass
                dimmed[k] += photons * mass
        _fill_sums(near, near_before[end:])
        _fill_sums(dimmed, dimmed_before[end:])
        dark = density[pixel, 0, 0] * prior[0].sum()
        total = dark + near_before[-1]
        photons = background[pixel, 0] * dark + dimmed_before[-1]
        left = float(n_pulses) if n_pulses > 0 else 1.0
        for k in range(n_bins):
            armed[k] = left
            left -= counts[pixel, k] if n_pulses > 0 else 0.0
        behind, ahead = near_before[until], near_before[begin]
        for k in range(n_bins):
            alone[k] = total - (behind[k] - ahead[k])
        behind, ahead = dimmed_before[until], dimmed_before[begin]
        for k in range(n_bins):
            mean = (photons - (behind[k] - ahead[k])) / max(alone[k], _TINY)
            is_alone = alone[k] > _LEAST_SHARE * total
            fires[k] = mean / n_bins * shape[k] if is_alone and mean > 0.0 else 0.0
        if n_pulses > 0:
            _fill_firing(background[pixel].max() * brightest < _SMALL_RATE, fires)
        for k in range(n_bins):
            alone[k] = alone[k] / total if alone[k] > _LEAST_SHARE * total else 0.0
        for k in range(n_bins):
            sums[0, k] += alone[k] * counts[pixel, k]
        for k in range(n_bins):
            sums[1, k] += alone[k] * armed[k] * fires[k] / shape[k]
        for k in range(n_bins):
            sums[2, k] += alone[k] * armed[k]


@njit(**SUMMING)
def _fill_sums(numbers, sums):  # type: ignore[no-untyped-def]
    """Fill `sums` with those of the first numbers, and its rest with that of all."""
    total = 0.0
    for k in range(numbers.size):
        total += numbers[k]
        sums[k] = total
    sums[numbers.size :] = total


@njit(**SUMMING)
def _fill_firing(is_small, rate):  # type: ignore[no-untyped-def]
    """Replace rates by ``1 - exp(-rate)``, those below `_SMALL_RATE` to double precision.

    Small ones by the series, which the compiler vectorises.
    """
    if not is_small:
        for k in range(rate.size):
            rate[k] = -math.expm1(-rate[k])
        return
    for k in range(rate.size):
        x = rate[k]
        p = 1.0 - x * (1 / 10) * (1.0 - x * (1 / 11))
        p = 1.0 - x * (1 / 8) * (1.0 - x * (1 / 9) * p)
        p = 1.0 - x * (1 / 6) * (1.0 - x * (1 / 7) * p)
        p = 1.0 - x * (1 / 4) * (1.0 - x * (1 / 5) * p)
        rate[k] = x * (1.0 - x * (1 / 2) * (1.0 - x * (1 / 3) * p))
