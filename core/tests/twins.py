"""Slow float64 equations that fast kernels are compared with."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def log_likelihood(
    counts: NDArray[np.float64], rate: NDArray[np.float64], n_pulses: int | None
) -> NDArray[np.float64]:
    """Log probability of counts (..., bin), without terms that no rate (..., bin) changes."""
    if n_pulses is None:
        return np.asarray((counts * np.log(rate) - rate).sum(axis=-1))
    unfired = n_pulses - np.cumsum(counts, axis=-1)
    return np.asarray((counts * np.log(-np.expm1(-rate)) - unfired * rate).sum(axis=-1))


def posterior_of_chain(
    evidence: NDArray[np.float64], alike: float, scale_bins: float, slope: float, nothing: float
) -> NDArray[np.float64]:
    """Posterior of the states of pixels in a row, by the sum over all their combinations.

    Parameters
    ----------
    evidence : ndarray, shape (pixel, bin + 1)
        Evidence of a surface in each bin; the last column is that of no surface.
    alike, scale_bins, slope, nothing : float
        ρ, scale of K, g and prior of nothing of `core.kernels.messages`; the prior of the bins is
        uniform.

    Returns
    -------
    ndarray, shape (pixel, bin + 1)
    """
    n_pixels, n_bins = evidence.shape[0], evidence.shape[1] - 1
    whole = int(np.floor(slope))
    at = np.arange(-200, 201)
    kernel = np.exp(-np.abs(at) / scale_bins)
    kernel[kernel < np.exp(-max(1, np.ceil(7 * scale_bins)) / scale_bins) / 2] = 0.0
    kernel /= kernel.sum()
    kernel = (1 - slope + whole) * kernel + (slope - whole) * np.roll(kernel, 1)
    pair = np.full((n_bins + 1, n_bins + 1), 1 - alike)
    for d, e in np.ndindex(n_bins, n_bins):
        pair[d, e] += alike * kernel[200 + e - d - whole] * n_bins / (1 - nothing)
    pair[n_bins, n_bins] += alike / nothing
    joint = evidence[0]
    for each in evidence[1:]:
        joint = joint[..., np.newaxis] * pair * each
    total = joint.sum()
    axes = range(n_pixels)
    return np.stack([joint.sum(axis=tuple(a for a in axes if a != i)) / total for i in axes])


def best_planes(
    delay: NDArray[np.float64],
    windows: NDArray[np.float64],
    half: int,
    spread_bins: float,
    near_pixels: float,
) -> NDArray[np.float64]:
    """Return the planes (3, row, col) that `core.kernels.planes.fill_planes` chooses.

    Parameters
    ----------
    delay : ndarray, shape (row, col)
    windows : ndarray, shape (4, row, col)
        Support of the window around each pixel, and its plane.
    half : int
    spread_bins, near_pixels : float
    """
    rows, cols = delay.shape
    found = np.empty((3, rows, cols))
    for row, col in np.ndindex(rows, cols):
        most = 0.0
        for y, x in np.ndindex(rows, cols):
            if max(abs(row - y), abs(col - x)) > half:
                continue
            support, middle, down, right = windows[:, y, x]
            here = middle + down * (row - y) + right * (col - x)
            distance = np.hypot(row - y, col - x) / near_pixels
            suits = support * np.exp(-(distance**2) / 2)
            suits /= (1 + ((delay[row, col] - here) / spread_bins) ** 2) ** 2
            if suits > most:
                most, found[:, row, col] = suits, (here, down, right)
    return found
