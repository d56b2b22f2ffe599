"""Correlation along the bins, as the filters among the estimators share it."""

from __future__ import annotations

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Floats
from core.inference.likelihood import Conditions


def echo_shape(conditions: Conditions) -> tuple[Floats, int]:
    """`Pulse.taps` of an echo that begins with a bin."""
    acquisition = conditions.acquisition
    return conditions.pulse.taps(acquisition.n_bins, acquisition.bin_width_s)


def correlate(values: Floats, taps: Floats, first: int) -> Floats:
    """``Σ_j values[k + first + j] taps[j]`` for each bin k, nothing lying beyond the gate.

    Parameters
    ----------
    values : ndarray, shape (..., bin)
    taps : ndarray, shape (tap,)
    first : int
        Bins from k to the first tap.

    Returns
    -------
    ndarray, shape (..., bin)
    """
    # The library wants a filter around its centre, which lies within it.
    last = first + len(taps) - 1
    half = max(-first, last, 0)
    centred = np.zeros(2 * half + 1)
    centred[half + first : half + last + 1] = taps
    return np.asarray(scipy.ndimage.correlate1d(values, centred, axis=-1, mode="constant"))
