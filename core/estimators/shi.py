"""Sample function and peak prominence, after Shi et al. 2025.

Shi et al., "GM-APD lidar reconstruction algorithm with few frames based on sample function", Optics
& Laser Technology 192, 113866. Only the abstract was available. It names the steps: recovery of the
waveform with the sample function, removal of small spikes, local peaks and their prominences, the
largest of which is the echo. Everything else is a reconstruction::

    y_k = Σ_j n_{k+j} sinc(j / w) cos²(π j / 26) / Σ_j …     j from -12 to 12, w = 2 bins
    x_k = median(y_{k-1}, y_k, y_{k+1})
    score_k = x_k - max(lowest on the left, lowest on the right)     where x_k is a local peak

"On the left" extends to the nearest higher sample or the beginning of the gate, and "on the right"
likewise. Beyond its ends the histogram is continued with its end values, since otherwise the
opening of the gate would look like an echo. All steps together take 40 ns per pixel and bin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # loads a submodule when it is first used
from numba import njit

from core.acquisition import Floats
from core.estimators.base import Estimator
from core.inference.likelihood import Conditions
from core.kernels.parallel import COMPILED
from core.parameters import Number, Settings, parameter

HALF_TAPS = 12
"""Bins on either side in the sample function."""


@dataclass(frozen=True)
class ShiParameters(Settings):
    """Settings of the sample function."""

    width_bins: float = parameter(
        2.0,
        Number("w", 1.0, 4.0, unit="bins", merge_power=0, least=0.5, most=12.0),
        "Distance from the centre of the sample function to its first zero; wider smooths more.",
    )


def sample_function(width_bins: float) -> Floats:
    """Sinc with a Hann window, of sum 1; shape (2 * HALF_TAPS + 1,)."""
    j = np.arange(-HALF_TAPS, HALF_TAPS + 1)
    taps = np.sinc(j / width_bins) * np.cos(np.pi * j / (2 * HALF_TAPS + 2)) ** 2
    return np.asarray(taps / taps.sum())


def median_of_three(values: Floats) -> Floats:
    """Median of each bin and its two neighbours; end bins are repeated."""
    left = np.concatenate([values[..., :1], values[..., :-1]], axis=-1)
    right = np.concatenate([values[..., 1:], values[..., -1:]], axis=-1)
    low, high = np.minimum(left, right), np.maximum(left, right)
    return np.clip(values, low, high)


def prominences(values: Floats) -> Floats:
    """Prominence of every local peak, at its middle bin, and 0 elsewhere.

    Local peaks are those of `scipy.signal.find_peaks`: a bin, or several of the same value, between
    two lower ones.

    Parameters
    ----------
    values : ndarray, shape (..., bin)

    Returns
    -------
    ndarray, shape (..., bin)
    """
    rows = np.ascontiguousarray(values).reshape(-1, values.shape[-1])
    found = np.zeros_like(rows)
    _fill_prominences(rows, found)
    return found.reshape(values.shape)


@njit(**COMPILED)
def _fill_lowest(row, step, stack, lowest):  # type: ignore[no-untyped-def]
    """Fill the lowest value from each bin back to the nearest higher one; `step` is 1 or -1.

    The stack holds bins that are higher than all later ones, each with the lowest value between it
    and the one below it on the stack, so that every bin is pushed and popped once.
    """
    n_bins = row.size
    height = 0
    for i in range(n_bins):
        k = i if step > 0 else n_bins - 1 - i
        low = row[k]
        while height > 0 and row[stack[height - 1]] <= row[k]:
            height -= 1
            low = min(low, lowest[stack[height]])
        lowest[k] = low
        stack[height] = k
        height += 1


@njit(**COMPILED)
def _fill_prominences(rows, found):  # type: ignore[no-untyped-def]
    n_bins = rows.shape[1]
    stack = np.empty(n_bins, np.int64)
    left, right = np.empty(n_bins), np.empty(n_bins)
    for r in range(rows.shape[0]):
        row = rows[r]
        _fill_lowest(row, 1, stack, left)
        _fill_lowest(row, -1, stack, right)
        k = 1
        while k < n_bins - 1:
            last = k
            while last < n_bins - 1 and row[last + 1] == row[k]:
                last += 1
            if row[k - 1] < row[k] and last < n_bins - 1 and row[last + 1] < row[k]:
                found[r, (k + last) // 2] = row[k] - max(left[k], right[k])
            k = last + 1


def _curve(histogram: Floats, conditions: Conditions, parameters: ShiParameters) -> Floats:
    """Prominence of the local peaks of the waveform; see the module's docstring."""
    taps = sample_function(parameters.width_bins)
    waveform = scipy.ndimage.correlate1d(histogram, taps, axis=-1, mode="nearest")
    return prominences(median_of_three(waveform))


ESTIMATOR = Estimator(
    "Sample function and prominence (Shi 2025)",
    ShiParameters,
    _curve,
    reconstructed="the abstract of Optics & Laser Technology 192, 113866 (2025)",
)
