"""Correlation along the bins, shared by estimators that filter the histogram."""

from __future__ import annotations

import numpy as np

from core.acquisition import Floats
from core.inference.likelihood import Conditions
from core.kernels.filters import correlate_rows


def echo_shape(conditions: Conditions) -> tuple[Floats, int]:
    """Return `Pulse.taps` of an echo that begins at the start of a bin."""
    acquisition = conditions.acquisition
    return conditions.pulse.taps(acquisition.n_bins, acquisition.bin_width_s)


def correlate(values: Floats, taps: Floats, first: int | None = None) -> Floats:
    """Compute ``Σ_j values[k + first + j] taps[j]`` for each bin k, with zeros beyond the gate.

    Parameters
    ----------
    values : ndarray, shape (..., bin)
    taps : ndarray, shape (tap,)
    first : int, optional
        Bins from k to the first tap; if None, the middle tap is at k.

    Returns
    -------
    ndarray, shape (..., bin)
    """
    first = -(len(taps) // 2) if first is None else first
    rows = np.ascontiguousarray(values, float).reshape(-1, values.shape[-1])
    rows.setflags(write=False)  # writability is part of a numba type: compile for one
    sums = np.zeros(values.shape)
    correlate_rows(rows, taps.astype(float), first, sums.reshape(rows.shape))
    return sums
