"""Width of the echo, estimated from the counts of a capture alone.

Two photons of the same echo lie within a pulse's width of each other, wherever the surface is; any
other two may lie anywhere in the gate. So the gaps between two photons of the same pixel have a
peak at zero, √2 as wide as the pulse, on a broad floor.

The gaps are counted by the autocorrelation of each pixel's histogram (Fourier transforms, in
blocks, of as many evenly spread pixels as `_MOST_NUMBERS` allows), without the pairs of each photon
with itself. Every photon is weighted by the inverse of the local level of the mean histogram, a
running median over a quarter of the gate: otherwise the decay of first photons under a strong
background would bend the floor. The remaining floor is a straight line. The peak of a Gaussian
pulse on that line, blurred by the bins, is fitted by least squares: first the width of the most
significant peak, then, around it, the width that fits best.

A width is estimated only if its peak is significant: fitted to each of 32 groups of pixels, the
mean number of pairs in the peak is 6 standard errors above zero, and its height is at least 2 % of
the floor, since a floor that is not quite straight might leave a smaller one. Pulses wider than a
tenth of the gate (a twentieth, for a wall at one range) cannot be found. Nothing is estimated from
fewer than 16 bins or 32 pixels, nor from more than 65,536 bins. Of a pulse with a tail, the width
is that of the core.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats, Pulse

_GROUPS = 32
_MOST_NUMBERS = 2**24  # in all transforms together: a tenth of a second
_NUMBERS_A_BLOCK = 2**20
_FEWEST_BINS = 16
_MOST_BINS = 2**16  # above, even one pixel of each group would take long
_NARROWEST_BINS = 0.3  # standard deviation; below, two bins hold nearly all of an echo
_WIDEST_SHARE = 0.1  # of the gate; above, no floor is left
_MOST_WEIGHT = 20.0  # of a photon where there are few
_STANDARD_ERRORS = 6.0
_LOWEST_PEAK = 0.02


def guessed_pulse(cube: NDArray[np.unsignedinteger], bin_width_s: float) -> Pulse:
    """Return a Gaussian of the estimated width, to two digits, else of one bin.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
        Counts.
    bin_width_s : float
        Width of one bin in seconds.

    Returns
    -------
    Pulse
    """
    sigma_bins = guessed_sigma_bins(cube)
    if sigma_bins is None:
        return Pulse.gaussian(bin_width_s)
    return Pulse.gaussian(float(f"{sigma_bins * bin_width_s:.1e}"))


def guessed_sigma_bins(cube: NDArray[np.unsignedinteger]) -> float | None:
    """Return the standard deviation of a Gaussian pulse in bins; None if it cannot be estimated.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
        Counts.

    Returns
    -------
    float or None
    """
    n_bins = cube.shape[2]
    if not _FEWEST_BINS <= n_bins <= _MOST_BINS or cube.shape[0] * cube.shape[1] < _GROUPS:
        return None
    pairs = pairs_by_lag(cube, 3 * n_bins // 4)
    total = pairs.sum(axis=0)
    steps = np.arange(0.0, np.log(_WIDEST_SHARE * n_bins / _NARROWEST_BINS), 0.1)
    rough = _NARROWEST_BINS * np.exp(steps)
    significances = [_fit(total, sigma, _window(sigma, n_bins)).significance for sigma in rough]
    best = rough[np.argmax(significances)]
    window = _window(best, n_bins)
    fine = best * np.exp(np.linspace(-0.5, 0.5, 101))
    fits = [_fit(total, sigma, window) for sigma in fine]
    chosen = int(np.argmin([fit.misfit for fit in fits]))
    sigma_bins, fit = float(fine[chosen]), fits[chosen]
    in_peak = pairs[:, :window] @ fit.peak_weights
    error = in_peak.std(ddof=1) / np.sqrt(_GROUPS)
    is_significant = in_peak.mean() > _STANDARD_ERRORS * error and fit.contrast > _LOWEST_PEAK
    return sigma_bins if is_significant and sigma_bins < _WIDEST_SHARE * n_bins else None


def pairs_by_lag(cube: NDArray[np.unsignedinteger], n_lags: int) -> Floats:
    """Count pairs of photons of the same pixel by their gap in bins, in groups of pixels.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
        Counts.
    n_lags : int
        Gaps from 0 to one below this.

    Returns
    -------
    ndarray, shape (group, lag)
        Sums of the products of both photons' weights.
    """
    n_bins = cube.shape[2]
    size = scipy.fft.next_fast_len(n_bins + n_lags, real=True)
    histograms = cube.reshape(-1, n_bins)
    stride = -(-histograms.shape[0] * size // _MOST_NUMBERS)
    weight = _weights(histograms[::stride].mean(axis=0))
    power = np.zeros((_GROUPS, size // 2 + 1))
    self_pairs = np.zeros(_GROUPS)
    pixels_at_once = max(1, _NUMBERS_A_BLOCK // size)
    for group in range(_GROUPS):
        members = histograms[group * stride :: _GROUPS * stride]
        for first in range(0, members.shape[0], pixels_at_once):
            some = members[first : first + pixels_at_once] * weight
            spectrum = scipy.fft.rfft(some, size, axis=1)
            for part in (spectrum.real, spectrum.imag):
                power[group] += np.einsum("pf,pf->f", part, part)
            self_pairs[group] += (some @ weight).sum(dtype=float)
    pairs = scipy.fft.irfft(power, size, axis=1)[:, :n_lags]
    pairs[:, 0] -= self_pairs
    return np.asarray(pairs)


def _weights(mean: Floats) -> NDArray[np.float32]:
    """Return the weight of a photon in each bin that levels the mean histogram except for peaks."""
    level = scipy.ndimage.median_filter(mean, size=max(3, mean.size // 4), mode="nearest")
    typical = max(float(mean.mean()), np.finfo(float).tiny)
    return np.asarray(typical / np.maximum(level, typical / _MOST_WEIGHT), np.float32)


class _Fit(NamedTuple):
    significance: float
    misfit: float
    contrast: float
    """Height of the peak as a share of the floor below it; infinite where there is no floor."""
    peak_weights: Floats
    """Weight of the pairs of each lag in the number of pairs in the peak, shape (lag,)."""


def _window(sigma_bins: float, n_bins: int) -> int:
    """Return the number of lags that show both a peak and the floor around it."""
    return int(min(np.ceil(12 * sigma_bins) + 12, 3 * n_bins // 4))


def _fit(pairs: Floats, sigma_bins: float, n_lags: int) -> _Fit:
    """Fit a peak and the line of its floor to the pairs of the first lags."""
    found = pairs[:n_lags]
    lag = np.arange(n_lags)
    terms = np.stack([_peak(lag, sigma_bins), np.ones(n_lags), lag / n_lags])
    # Poisson weights, of at least the mean: chance lows would pull the fit down.
    weighted = terms / np.maximum(found, max(found.mean(), 1.0))
    covariance = np.linalg.pinv(weighted @ terms.T)
    solve = covariance @ weighted
    amplitudes = solve @ found
    misfit = float(weighted[1] @ (found - amplitudes @ terms) ** 2)
    floor, height = float(amplitudes[1]), float(amplitudes[0] * terms[0, 0])
    contrast = height / floor if floor > 0 else np.inf
    return _Fit(float(amplitudes[0] / np.sqrt(covariance[0, 0])), misfit, contrast, solve[0])


def _peak(lag: NDArray[np.int64], sigma_bins: float) -> Floats:
    """Return the share of an echo's pairs with a gap of `lag` bins.

    The gap of two photons is √2 as wide as the pulse; that both are rounded to bins blurs it by a
    triangle two bins wide.
    """
    width = np.sqrt(2.0) * sigma_bins

    def integrated_twice(gap: NDArray[np.floating]) -> Floats:
        density = np.exp(-0.5 * (gap / width) ** 2) / np.sqrt(2 * np.pi)
        return np.asarray(gap * scipy.special.ndtr(gap / width) + width * density)

    below, at, above = (integrated_twice(lag + shift) for shift in (-1.0, 0.0, 1.0))
    return np.asarray(below - 2 * at + above)
