"""Conversion between photon rates and first-photon trigger probabilities."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.checks import require


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
    if n_pulses is None:
        return rng.poisson(np.asarray(rate, float)).astype(np.uint32)
    chance = trigger_probability(rate)
    none = np.maximum(1 - chance.sum(axis=-1, keepdims=True), 0)
    counts = rng.multinomial(n_pulses, np.concatenate([chance, none], axis=-1))
    return counts[..., :-1].astype(np.uint16 if n_pulses < 2**16 else np.uint32)


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
        If a pixel fired more often than pulses were sent.
    """
    counts = np.asarray(counts).astype(np.int64)
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
