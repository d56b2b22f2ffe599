"""Limits of a range estimate, set by the photons of a single pixel.

An echo may be found at a wrong delay altogether (`right_bin_probability`), and an echo that is
found has a finite precision (`cramer_rao_bins`). Both are for single pixels with known signal and
background, which is uniform over the gate: the first for the likeliest of delays that are uniform
over the gate, the second for the square of the error of unbiased estimates. Other losses,
neighbours or a prior of the depth may exceed them.

Functions of the delay ``onset_bin`` in fractional bins (array_like of any shape, NaN for no echo)
and the ``signal`` in photons per pulse (broadcast with it) return arrays of the common shape, NaN
for no echo. ``background`` is in photons per pulse over the gate. They raise ``ValueError`` if a
flux is negative or not finite, or if a required number of pulses is unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import ArrayLike

from core.acquisition import Acquisition, Floats, Pulse, pulses_sent
from core.capture import Capture
from core.checks import require

# Nodes of the integral over the score of the true delay, in standard deviations from its mean.
SCORES = np.linspace(-5.0, 5.0, 65)

# Delays within this many spacings of each other have nearly the same score.
SAME_PLACE_SPACINGS = 1.5

STEP_BINS = 0.5  # between the delays from whose scores their correlation is computed

MOST_PLACES = 64  # competing delays; each stands for several in a long gate
MOST_PAIRS = 128  # different (onset, signal) computed without interpolation
ROUNDING_OF_SHARES = 1e-12  # rounding error of the share of a pulse in a bin

MOST_ONSETS = 512  # nodes of the interpolation

_MANY_PULSES, _ERROR_FEW_PULSES = 300, 0.1  # below, the approximation is too high by up to this


def cramer_rao_bins(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Least standard deviation, in bins, of an unbiased estimate of the delay of an echo.

    ``1 / sqrt(J)``, the Cramér-Rao bound with known ``S`` and ``B``, where

    ``J = n_pulses · Σ_k A_k · (∂h_k/∂d)² / (h_k (1 - h_k))``, ``h_k = 1 - exp(-λ_k)`` and
    ``A_k = exp(-Σ_{i<k} λ_i)``, the share of armed pulses,

    which is ``n_pulses · Σ_k A_k (∂λ_k/∂d)² / (exp(λ_k) - 1)``. It does not include echoes found at
    a wrong delay. The exact likelihood approaches it with many photons: its variance, without wrong
    delays, was within 3 % of ``1 / J`` for 1500 signal photons at an SBR of 1, and a third larger
    for 100 at the paper's 0.06.

    Infinite where the photons contain no information on the delay.
    """
    onset, photons = _checked(onset_bin, signal, background)
    information = _information(onset, photons, background, pulse, acquisition)
    information *= pulses_sent(acquisition)
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(np.isnan(onset), np.nan, 1 / np.sqrt(information)))


def cramer_rao_m(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Return `cramer_rao_bins` as a range in metres."""
    bins = cramer_rao_bins(onset_bin, signal, background, pulse, acquisition)
    return np.asarray(bins * acquisition.bin_length_m)


def right_bin_probability(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Probability that the exact likelihood, with known fluxes, has its maximum at the echo.

    The score of a delay is approximated as Gaussian, with mean ``n_pulses Σ A (λ w - s)`` and
    variance ``n_pulses Σ A λ w²``, where ``w = ln(1 + s / b)``, ``s`` is the echo expected at that
    delay, ``A`` the share of armed pulses (with the pile-up of the true echo) and ``λ`` the true
    rate: ``b + s`` at the echo and ``b`` elsewhere. Along the delay it is a random process with the
    correlation of its terms; a score ``z`` standard deviations above the mean is exceeded ``c
    exp(-z² / 2) / Φ(z)`` times per bin, where ``c`` is the number of upcrossings of the mean (Rice
    1945). The estimate is right within 1.5 spacings of ``1 / (2 Σ p²)`` bins (3.2 bins for the
    paper's pulse); the largest score there must exceed all others.

    If no signal photon was detected, an estimate is only right by chance. That bounds the result,
    and is the result without background.

    Compared with 6000 simulated pixels (100 bins, ``S`` of 0.1041, tolerance of 3 bins) it is

    * for 1000 pulses within 0.005 above 0.9 and within 0.015 below;
    * for 300 pulses up to 0.015 too high;
    * for 100 pulses up to 0.07, for 30 up to 0.1 too high: with three signal photons or fewer,
      scores are not Gaussian.

    If the echo alone fires most pulses (``S`` of 1 to 3) it was from 0.07 too low to 0.19 too high.

    More than 128 different pixels are interpolated between onsets a quarter of the spacing apart
    and signals 25 % apart. The error is below 0.01 for the paper's pulse. For one much narrower
    than a bin, whose probability drops at the edge between two bins, it is 0.01 on average and up
    to 0.16 at such edges.
    """
    onset, photons = _checked(onset_bin, signal, background)
    # At least a thousandth of a photon in all pulses, which keeps scores distinct.
    photons = np.maximum(photons, 1e-3 / pulses_sent(acquisition))
    known = np.isfinite(onset)
    probability = np.full(onset.shape, np.nan)
    pairs = np.stack([onset[known], photons[known]])
    different, which = np.unique(pairs, axis=1, return_inverse=True)
    if different.shape[1] <= MOST_PAIRS:
        each = np.empty(different.shape[1])
        for brightness in np.unique(different[1]):
            alike = different[1] == brightness
            each[alike] = _right(different[0, alike], brightness, background, pulse, acquisition)
        probability[known] = each[which]
    else:
        probability[known] = _interpolated(pairs[0], pairs[1], background, pulse, acquisition)
    return probability


ASSUMES = "the likeliest delay of a single pixel with known fluxes, if depths are uniform"
"""Estimate whose probability of success `right_bin_probability` is; other methods may exceed it."""

ACCURACY = (
    "approximated to 0.015; to 0.005 above 0.9 with 1000 pulses or more; up to 0.1 too high with "
    "fewer than 300 pulses, 0.2 if the echo alone fires most pulses"
)
"""Errors of a mean `right_bin_probability`, as found by simulation."""


def approximation_error(probability: ArrayLike, n_pulses: int) -> float:
    """Return the largest simulated error of a mean `right_bin_probability`, for a small signal."""
    if n_pulses < _MANY_PULSES:
        return _ERROR_FEW_PULSES
    is_small = (np.asarray(probability) > 0.9) & (n_pulses >= 1000)
    return float(np.where(is_small, 0.005, 0.015).mean(where=np.isfinite(probability)))


@dataclass(frozen=True, eq=False)
class Limit:
    """Limits of each pixel, of shape (row, col), NaN where there is no target."""

    right_bin_probability: Floats
    cramer_rao_m: Floats


def limit(capture: Capture) -> Limit:
    """Compute the limits of a capture with known truth.

    Raises
    ------
    ValueError
        If its ranges, signal, background or number of pulses are unknown.
    """
    truth_m, signal, background = capture.truth_range_m, capture.signal, capture.background
    if truth_m is None or signal is None or background is None:
        names = ("truth_range_m", "signal", "background")
        missing = " and ".join(name for name in names if getattr(capture, name) is None)
        raise ValueError(f"{missing} = None is not accepted: give a capture with known truth.")
    onset = capture.acquisition.range_m_to_bin(truth_m)
    given = (onset, signal, background, capture.pulse, capture.acquisition)
    return Limit(right_bin_probability(*given), cramer_rao_m(*given))


def best_exposure(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Attenuation of signal and background that gives the most information on the delay.

    With too much flux the background hides the echo, with too little there are few photons. The
    factor, from 0 to 1 in steps of 2 %, maximises the information ``J`` of `cramer_rao_bins`. At
    that factor `right_bin_probability`, which is flat near 1, was within 0.01 of its maximum. For a
    weak echo it gives the rule of thumb of one background photon before the echo.
    """
    onset, photons = _checked(onset_bin, signal, background)
    # Below 1 / (S + B) every term of J increases with the factor.
    brightest = max(1.0, float(photons.max(initial=0.0)) + background)
    factors = np.geomspace(1.0, 1 / brightest, 1 + math.ceil(math.log(brightest) / math.log(1.02)))
    best, most = np.ones(onset.shape), np.full(onset.shape, -np.inf)
    for factor in factors:
        information = _information(onset, photons * factor, background * factor, pulse, acquisition)
        best = np.where(information > most, factor, best)
        most = np.maximum(information, most)
    return np.asarray(np.where(np.isnan(onset), np.nan, best))


def _checked(onset_bin: ArrayLike, signal: ArrayLike, background: float) -> tuple[Floats, Floats]:
    photons = np.asarray(signal, float)
    low, high = float(photons.min(initial=0.0)), float(photons.max(initial=0.0))
    require("signal", (low, high), 0 <= low <= high < np.inf, "finite and non-negative")
    require("background", background, 0 <= background < np.inf, "finite and non-negative")
    onset, photons = np.broadcast_arrays(np.asarray(onset_bin, float), photons)
    return onset, photons


def _armed(rate: Floats) -> Floats:
    """Share of armed pulses at the beginning of each bin, from rates (..., bin)."""
    return np.asarray(np.exp(rate - np.cumsum(rate, axis=-1)))


def _information(
    onset: Floats, signal: Floats, background: float, pulse: Pulse, acquisition: Acquisition
) -> Floats:
    """Fisher information of one pulse on the delay, in 1/bin²; 0 where there is no echo."""
    n_bins, bin_width_s = acquisition.n_bins, acquisition.bin_width_s
    share = pulse.bin_probability(onset, n_bins, bin_width_s)
    rate = signal[..., np.newaxis] * share + background / n_bins
    edges_s = (np.arange(n_bins + 1) - onset[..., np.newaxis]) * bin_width_s
    slope = -signal[..., np.newaxis] * np.diff(pulse.density(edges_s), axis=-1) * bin_width_s
    with np.errstate(over="ignore"):  # a bin that fires every pulse has no information
        odds = np.expm1(rate)
    # The slope of a share that is only rounding error would dominate over a tiny background.
    seen = (share > ROUNDING_OF_SHARES) & (odds > 0)
    terms = np.divide(_armed(rate) * slope**2, odds, out=np.zeros_like(odds), where=seen)
    return np.asarray(terms.sum(axis=-1))


def _spacing_bins(pulse: Pulse, acquisition: Acquisition) -> float:
    """Distance in bins between delays with independent scores, ``1 / (2 Σ p²)``."""
    # Mean over onsets within a bin, in a gate that holds the whole pulse.
    onset = acquisition.n_bins / 2 + np.arange(8) / 8
    share = pulse.bin_probability(onset, 2 * acquisition.n_bins, acquisition.bin_width_s)
    return float(1 / (2 * np.sum(share**2, axis=-1).mean()))


def _score(rate: Floats | float, echo: Floats, background: float) -> tuple[Floats, Floats]:
    """Contribution of each bin to mean and variance of the score of `echo`, per armed pulse."""
    gain = np.log1p(echo / background)
    return np.asarray(rate * gain - echo), np.asarray(rate * gain**2)


def _right(
    onset: Floats, signal: float, background: float, pulse: Pulse, acquisition: Acquisition
) -> Floats:
    """`right_bin_probability` of onsets (n,) with one signal."""
    n_bins, n_pulses = acquisition.n_bins, pulses_sent(acquisition)
    spacing = _spacing_bins(pulse, acquisition)
    begin, end = onset - SAME_PLACE_SPACINGS * spacing, onset + SAME_PLACE_SPACINGS * spacing
    echo = signal * pulse.bin_probability(onset, n_bins, acquisition.bin_width_s)
    per_bin = background / n_bins
    armed = _armed(echo + per_bin)

    first = armed * scipy.special.exprel(-echo - per_bin)
    seen = np.vecdot(first, echo)  # probability that a pulse detects a signal photon
    chance = _overlap(begin, end, 0.0, n_bins) / n_bins
    ceiling = np.asarray(1 - (1 - seen) ** n_pulses * (1 - chance))
    if n_pulses * background < 1e-6:  # less than one background photon in a million pixels
        return ceiling

    def moments(rate: Floats | float) -> tuple[Floats, Floats]:
        mean, variance = _score(rate, echo, per_bin)
        return n_pulses * np.vecdot(armed, mean), _root(n_pulses * np.vecdot(armed, variance))

    mean, sd = moments(echo + per_bin)
    score = mean[:, np.newaxis] + sd[:, np.newaxis] * SCORES
    cells = min(MOST_PLACES, math.ceil(n_bins / spacing))
    edges = np.linspace(0.0, n_bins, cells + 1)
    # Spread within the cells: in all centres, a narrow pulse might always straddle two bins.
    place = edges[:-1] + n_bins / cells * (np.arange(cells) * 0.5 * (math.sqrt(5) - 1) % 1)
    rival, next_rival = (
        signal * pulse.bin_probability(each, n_bins, acquisition.bin_width_s)
        for each in (place, place + STEP_BINS)
    )
    mean, variance = (n_pulses * armed @ each.T for each in _score(per_bin, rival, per_bin))
    crossings = _crossings_per_bin(armed * per_bin, rival, next_rival, per_bin)
    standard = _standard(
        score[..., np.newaxis], mean[:, np.newaxis], _root(variance)[:, np.newaxis]
    )
    here = _overlap(begin[:, np.newaxis], end[:, np.newaxis], edges[:-1], edges[1:])
    away = crossings * (n_bins / cells - here)
    below_elsewhere = np.exp(-(_maximum_rate(standard) @ away[..., np.newaxis])[..., 0])

    noise_mean, noise_sd = moments(per_bin)
    noise = _standard(score, noise_mean[:, np.newaxis], noise_sd[:, np.newaxis])
    cell = np.clip((onset * cells / n_bins).astype(int), 0, cells - 1)
    beside = (2 * SAME_PLACE_SPACINGS - 1) * spacing * crossings[np.arange(onset.size), cell]
    below_beside = np.exp(-beside[:, np.newaxis] * _maximum_rate(noise))
    below_here = scipy.special.ndtr(SCORES) * below_beside
    middle = (below_elsewhere[:, 1:] + below_elsewhere[:, :-1]) / 2
    return np.asarray(np.minimum(np.vecdot(np.diff(below_here, axis=-1), middle), ceiling))


def _maximum_rate(standard: Floats) -> Floats:
    """Rate, per mean crossing, at which a score that is below a level exceeds it."""
    return np.asarray(np.exp(-(standard**2) / 2 - scipy.special.log_ndtr(standard)))


def _crossings_per_bin(rate: Floats, echo: Floats, later: Floats, background: float) -> Floats:
    """Upcrossings of a score per bin at its mean (Rice 1945), shape (onset, place).

    ``√(-ρ'') / 2π``, from the correlation ρ of the scores of echoes `STEP_BINS` apart.

    Parameters
    ----------
    rate : ndarray, shape (onset, bin)
        Detections per pulse without an echo.
    echo, later : ndarray, shape (place, bin)
        Photons of an echo, and of one that is `STEP_BINS` later.
    background : float
        Photons per bin.
    """
    gain, later_gain = np.log1p(echo / background), np.log1p(later / background)
    common = rate @ (gain * later_gain).T
    product = (rate @ (gain**2).T) * (rate @ (later_gain**2).T)
    correlation = np.minimum(common / _root(product), 1.0)
    return np.asarray(np.sqrt(2 * (1 - correlation)) / STEP_BINS / (2 * math.pi))


def _root(variance: Floats) -> Floats:
    # The variance is 0 after a flux that fires every pulse.
    return np.asarray(np.sqrt(np.maximum(variance, np.finfo(float).tiny)))


def _standard(score: Floats, mean: Floats, sd: Floats) -> Floats:
    # Probabilities beyond are 0 and 1.
    return np.asarray(np.clip((score - mean) / sd, -40.0, 40.0))


def _overlap(low: Floats, high: Floats, begin: Floats | float, end: Floats | float) -> Floats:
    """Length common to two intervals."""
    return np.asarray(np.maximum(np.minimum(high, end) - np.maximum(low, begin), 0.0))


def _interpolated(
    onset: Floats, signal: Floats, background: float, pulse: Pulse, acquisition: Acquisition
) -> Floats:
    """Interpolate `right_bin_probability` of many pixels (n,) on a grid of onsets and signals."""
    first, last = float(onset.min()), float(onset.max())
    quarters = math.ceil(4 * (last - first) / _spacing_bins(pulse, acquisition))
    onsets = np.linspace(first, last, min(1 + quarters, MOST_ONSETS))
    low, high = float(np.log(signal.min())), float(np.log(signal.max()))
    logs = np.linspace(low, high, 1 + math.ceil((high - low) / math.log(1.25)))
    rows = [_right(onsets, math.exp(each), background, pulse, acquisition) for each in logs]
    at = [
        np.interp(np.log(signal), logs, np.arange(logs.size)),
        np.interp(onset, onsets, np.arange(onsets.size)),
    ]
    return np.asarray(scipy.ndimage.map_coordinates(np.stack(rows), at, order=1, mode="nearest"))
