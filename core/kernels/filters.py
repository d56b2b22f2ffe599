"""Kernel that correlates rows with a short filter."""

from __future__ import annotations

from numba import njit

from core.kernels.parallel import COMPILED


@njit(**COMPILED)
def correlate_rows(rows, taps, first, sums):  # type: ignore[no-untyped-def]
    """Add ``Σ_j rows[i, k + first + j] taps[j]`` to each sum (i, k), with zeros beyond a row."""
    n_bins = rows.shape[1]
    for i in range(len(rows)):
        for j in range(taps.size):
            shift = first + j
            begin, end = max(0, -shift), min(n_bins, n_bins - shift)
            if begin >= end:
                continue
            # Slices: the compiler vectorises only indices that it knows to be non-negative.
            met, sum_ = rows[i, begin + shift : end + shift], sums[i, begin:end]
            for k in range(sum_.size):
                sum_[k] += taps[j] * met[k]
