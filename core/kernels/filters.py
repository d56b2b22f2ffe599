"""Kernel that correlates rows with a short filter."""

from __future__ import annotations

import numpy as np
from numba import njit

from core.kernels.parallel import COMPILED

_TAPS_AT_ONCE = 4  # per read and write of the sums


@njit(**COMPILED)
def correlate_rows(rows, taps, first, sums):  # type: ignore[no-untyped-def]
    """Add ``Σ_j rows[i, k + first + j] taps[j]`` to each sum (i, k), with zeros beyond a row."""
    n_bins, n_taps = sums.shape[1], -(-taps.size // _TAPS_AT_ONCE) * _TAPS_AT_ONCE
    filled = np.zeros(n_taps)
    filled[: taps.size] = taps
    before, behind = max(0, -first), max(0, first + n_taps)
    padded = np.zeros(before + n_bins + behind)
    for i in range(len(rows)):
        padded[before : before + n_bins] = rows[i]
        for j in range(0, n_taps, _TAPS_AT_ONCE):
            met, sum_ = padded[before + first + j :], sums[i]
            t0, t1, t2, t3 = filled[j], filled[j + 1], filled[j + 2], filled[j + 3]
            for k in range(n_bins):
                # From left to right: taps are added to the sum one after the other.
                more = sum_[k] + t0 * met[k] + t1 * met[k + 1]
                sum_[k] = more + t2 * met[k + 2] + t3 * met[k + 3]
