"""Correlation along the bins, as the filters among the estimators share it."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import correlate1d

from core.acquisition import Floats
from core.posterior import Conditions

_TAIL = 1e-3  # of an echo's photons, on either side, which a filter leaves out


def echo_shape(conditions: Conditions) -> tuple[Floats, int]:
    """Share of an echo's photons in each bin, and the bins from its delay to the first of them."""
    n_bins, width_s = conditions.acquisition.n_bins, conditions.acquisition.bin_width_s
    pulse = conditions.pulse
    begin = math.floor(max(pulse.quantile_s(_TAIL) / width_s, -n_bins))
    end = math.ceil(min(pulse.quantile_s(1 - _TAIL) / width_s, n_bins))
    return pulse.bin_probability(-begin, max(end - begin, 1), width_s), begin


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
    return np.asarray(correlate1d(values, centred, axis=-1, mode="constant"))
