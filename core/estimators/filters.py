"""Correlation along the bins, shared by estimators that filter the histogram."""

from __future__ import annotations

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Floats
from core.inference.likelihood import Conditions


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
    if first is None:
        first = -(len(taps) // 2)
    # SciPy needs a filter that is centred on its middle tap.
    last = first + len(taps) - 1
    half = max(-first, last, 0)
    centred = np.zeros(2 * half + 1)
    centred[half + first : half + last + 1] = taps
    return np.asarray(scipy.ndimage.correlate1d(values, centred, axis=-1, mode="constant"))
