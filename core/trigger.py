"""Conversion between photon rates and first-photon trigger probabilities."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.checks import require
from core.kernels.parallel import on_threads
from core.kernels.simulate import draw_pulses, fill_probability

# With more pulses numpy's multinomial is faster: its time does not depend on their number.
PULSES_DRAWN_ONE_BY_ONE = 8192

EXPONENTIAL = 16
"""Counts that other kernels process in the time of one exponential."""


def rate_per_bin(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Expected detections per bin and pulse of a detector that is always armed.

    ``λ_k = S p_k(d) + B / n_bins``.

    Parameters
    ----------
    onset_bin : array_like, any shape
        Delay ``d`` of the echo in fractional bins; NaN means no echo.
    signal : array_like, shape of `onset_bin`
        Signal photons per pulse, ``S``.
    background : float
        Background photons per pulse over the whole gate, ``B``.
    pulse : Pulse
    acquisition : Acquisition

    Returns
    -------
    ndarray, shape (..., n_bins)
    """
    share = pulse.bin_probability(onset_bin, acquisition.n_bins, acquisition.bin_width_s)
    echo = np.asarray(signal, float)[..., np.newaxis] * share
    return np.asarray(echo + background / acquisition.n_bins)


def trigger_probability(rate: ArrayLike) -> Floats:
    """Probability that a pulse's *first* photon falls in each bin (the paper's Eq. 1).

    ``P_k = exp(-Σ_{i<k} λ_i) · (1 - exp(-λ_k))``

    Parameters
    ----------
    rate : array_like, shape (..., bin)
        Expected detections per bin and pulse, non-negative.

    Returns
    -------
    ndarray, shape (..., bin)
        Adds up with `no_trigger_probability` to 1.

    Raises
    ------
    ValueError
        If a rate is negative or NaN.
    """
    rate = _checked_rate(rate)
    before = np.zeros_like(rate)
    np.cumsum(rate[..., :-1], axis=-1, out=before[..., 1:])
    return np.asarray(np.exp(-before) * -np.expm1(-rate))


def no_trigger_probability(rate: ArrayLike) -> Floats:
    """Probability that a pulse triggers nowhere in the gate, ``exp(-Σ λ)``; shape (...)."""
    return np.asarray(np.exp(-_checked_rate(rate).sum(axis=-1)))


def draw_counts(
    rate: ArrayLike, n_pulses: int | None, rng: np.random.Generator
) -> NDArray[np.unsignedinteger]:
    """Draw histograms from rates, shape (..., bin): the multinomial of Eq. 1.

    Parameters
    ----------
    rate : array_like, shape (..., bin)
        As for `trigger_probability`; if `n_pulses` is None, expected photons in each bin.
    n_pulses : int or None
        Pulses sent; counts are Poisson if None.
    rng : numpy.random.Generator
    """
    rate = _checked_rate(rate)
    if n_pulses is None:
        return rng.poisson(rate).astype(np.uint32)
    n_bins = rate.shape[-1]
    photons = np.zeros((rate.size // n_bins, n_bins + 1))
    np.cumsum(rate.reshape(-1, n_bins), axis=1, out=photons[:, 1:])
    to_probability(photons)
    return draw_triggers(photons, n_pulses, int(rng.integers(2**63))).reshape(rate.shape)


def to_probability(photons: Floats) -> None:
    """Replace the photons expected before each bin edge (pixel, edge) by the probability of any."""
    on_threads(fill_probability, len(photons), photons.size * EXPONENTIAL, photons)


def draw_triggers(triggered: Floats, n_pulses: int, seed: int) -> NDArray[np.unsignedinteger]:
    """Draw histograms from the probability of a trigger before each bin edge.

    Parameters
    ----------
    triggered : ndarray, shape (pixel, bin + 1)
        From 0 to 1, but for rounding.
    n_pulses : int
    seed : int
        The same seed gives the same counts, for any number of threads.

    Returns
    -------
    ndarray of unsigned int, shape (pixel, bin)
    """
    n_pixels, n_edges = triggered.shape
    cube = np.zeros((n_pixels, n_edges - 1), count_dtype(n_pulses))
    if n_pulses <= PULSES_DRAWN_ONE_BY_ONE:
        add_triggers(triggered, 0, n_pulses, seed, cube)
    else:
        chance = np.clip(np.diff(triggered, axis=-1, append=1.0), 0.0, 1.0)
        cube[:] = np.random.default_rng(seed).multinomial(n_pulses, chance)[:, :-1]
    return cube


def count_dtype(highest: float) -> np.dtype[np.unsignedinteger]:
    """Return the type of a cube whose largest count is `highest`."""
    return np.dtype(np.uint16 if highest < 2**16 else np.uint32)


def add_triggers(
    triggered: Floats, begin: int, end: int, seed: int, cube: NDArray[np.unsignedinteger]
) -> None:
    """Draw the pulses from `begin` to before `end` one by one, and add their counts to `cube`."""
    n_pixels = len(cube)
    given = triggered, begin, end, np.uint64(seed), cube
    on_threads(draw_pulses, n_pixels, n_pixels * (end - begin), *given)


def first_difference(probability: ArrayLike) -> Floats:
    """Change from bin to bin, ``ΔP_k = P_k - P_{k-1}`` (the paper's Eq. 3), shape (..., bin).

    The difference of the first bin is 0.
    """
    probability = np.asarray(probability, float)
    return np.diff(probability, axis=-1, prepend=probability[..., :1])


def coates_rate(counts: ArrayLike, n_pulses: int) -> Floats:
    """Correct pile-up: maximum-likelihood rate of each bin (Coates 1968).

    ``λ̂_k = ln(A_k / (A_k - n_k))`` with ``A_k = n_pulses - Σ_{i<k} n_i`` pulses still armed.

    Parameters
    ----------
    counts : array_like of int, shape (..., bin)
        First-photon histogram.
    n_pulses : int
        Pulses sent.

    Returns
    -------
    ndarray, shape (..., bin)
        Infinite where every armed pulse fired, NaN in later bins, where no pulse is armed.

    Raises
    ------
    ValueError
        If a count is negative, or a pixel fired more often than pulses were sent.
    """
    counts = np.asarray(counts).astype(np.int64)
    least = int(counts.min(initial=0))
    require("counts", least, least >= 0, "non-negative numbers")
    total = int(counts.sum(axis=-1).max(initial=0))
    require("n_pulses", n_pulses, n_pulses >= total, f"at least {total}, the detections of a pixel")
    armed = n_pulses - (np.cumsum(counts, axis=-1) - counts)
    with np.errstate(divide="ignore", invalid="ignore"):
        # ln(1 + n / (A - n)) is accurate if few of the armed pulses fire, and if all do.
        return np.asarray(np.log1p(counts / (armed - counts)))


def _checked_rate(rate: ArrayLike) -> Floats:
    rate = np.asarray(rate, float)
    low = float(rate.min(initial=0.0))
    require("rate", low, low >= 0, "non-negative numbers")
    return rate
