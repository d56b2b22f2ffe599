"""From photon rates to first-photon trigger probabilities, and back."""

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
    """Expected detections in each bin per pulse, were the detector always armed.

    ``λ_k = S p_k(d) + B / n_bins``.

    Parameters
    ----------
    onset_bin : array_like, any shape
        Delay ``d`` of the echo in fractional bins; NaN means no echo.
    signal : array_like, shape of `onset_bin`
        Signal photons per pulse, ``S``.
    background : float
        Background photons per pulse over the whole gate, ``B``.

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
        Sums with `no_trigger_probability` to 1.
    """
    rate = _checked_rate(rate)
    before = np.zeros_like(rate)
    np.cumsum(rate[..., :-1], axis=-1, out=before[..., 1:])
    return np.asarray(np.exp(-before) * -np.expm1(-rate))


def no_trigger_probability(rate: ArrayLike) -> Floats:
    """Probability that a pulse triggers nowhere in the gate, ``exp(-Σ λ)``; shape (...)."""
    return np.asarray(np.exp(-_checked_rate(rate).sum(axis=-1)))


def drawn(
    rate: ArrayLike, n_pulses: int | None, rng: np.random.Generator
) -> NDArray[np.unsignedinteger]:
    """Histograms drawn from rates, shape (..., bin): the multinomial of Eq. 1.

    Parameters
    ----------
    rate : array_like, shape (..., bin)
        As for `trigger_probability`; where `n_pulses` is None, photons expected in each bin.
    n_pulses : int or None
        Pulses sent; where None, counts are Poisson.
    """
    if n_pulses is None:
        return rng.poisson(np.asarray(rate, float)).astype(np.uint32)
    chance = trigger_probability(rate)
    none = np.maximum(1 - chance.sum(axis=-1, keepdims=True), 0)
    counts = rng.multinomial(n_pulses, np.concatenate([chance, none], axis=-1))
    return counts[..., :-1].astype(np.uint16 if n_pulses < 2**16 else np.uint32)


def first_difference(probability: ArrayLike) -> Floats:
    """Change from bin to bin, ``ΔP_k = P_k - P_{k-1}`` (the paper's Eq. 3).

    The first bin has no predecessor; its difference is 0. Shape (..., bin), as given.
    """
    probability = np.asarray(probability, float)
    return np.diff(probability, axis=-1, prepend=probability[..., :1])


def coates_rate(counts: ArrayLike, n_pulses: int) -> Floats:
    """Undo the pile-up: the rate per bin that explains the counts best (Coates 1968).

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
        Infinite where every armed pulse fired (any high rate explains that), NaN behind such a bin
        (no pulse was left to tell).

    Raises
    ------
    ValueError
        If a pixel fired more often than pulses were sent: that is not first-photon data.
    """
    counts = np.asarray(counts).astype(np.int64)
    total = int(counts.sum(axis=-1).max(initial=0))
    require("n_pulses", n_pulses, n_pulses >= total, f"at least {total}, the detections of a pixel")
    armed = n_pulses - (np.cumsum(counts, axis=-1) - counts)
    with np.errstate(divide="ignore", invalid="ignore"):
        # ln(1 + n / (A - n)) keeps its digits where few of the armed pulses fire, and where all do.
        return np.asarray(np.log1p(counts / (armed - counts)))


def _checked_rate(rate: ArrayLike) -> Floats:
    rate = np.asarray(rate, float)
    low = float(rate.min(initial=0.0))
    require("rate", low, low >= 0, "non-negative numbers")
    return rate
