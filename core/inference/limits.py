"""What no estimator can beat: the limits that the photons of a pixel set.

Two things go wrong with a range. The echo may be found in the wrong place altogether
(`right_bin_probability`), and where it is found, its place is uncertain by some of its width
(`cramer_rao_bins`). Both are for one pixel on its own, ranged with signal and background known;
an estimator that looks at neighbours, or knows where targets are likely, may do better.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import ArrayLike

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture
from core.checks import require

# The score of the true place, in standard deviations about its mean, where it meets the others'.
SCORES = np.linspace(-5.0, 5.0, 65)

# Scores of places that lie closer than this many spacings are as good as the same.
SAME_PLACE_SPACINGS = 1.5

MOST_PLACES = 32  # rival places computed; each stands for several where a gate holds more
MOST_PAIRS = 128  # different (onset, signal) computed one by one
ROUNDING_OF_SHARES = 1e-12  # of a pulse's photons in a bin, as a difference of its CDF rounds

MOST_ONSETS = 512  # nodes of the interpolation where there are more


def cramer_rao_bins(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Least standard deviation, in bins, of an unbiased estimate of the echo's delay.

    ``1 / sqrt(J)``, the Cramér-Rao bound with ``S`` and ``B`` known, where

    ``J = n_pulses · Σ_k A_k · (∂h_k/∂d)² / (h_k (1 - h_k))``, ``h_k = 1 - exp(-λ_k)`` and
    ``A_k = exp(-Σ_{i<k} λ_i)``, the share of pulses still armed,

    which is ``n_pulses · Σ_k A_k (∂λ_k/∂d)² / (exp(λ_k) - 1)``. It says nothing of echoes found in
    the wrong place. It is a floor that the exact likelihood comes down to with many photons: its
    variance, wrong places apart, was within 3 % of ``1 / J`` with 1500 signal photons at an SBR of
    1, and a third above with 100 at the paper's 0.06.

    Parameters
    ----------
    onset_bin : array_like, any shape
        Delay ``d`` of the echo in fractional bins; NaN means no echo.
    signal : array_like, broadcast with `onset_bin`
        Signal photons per pulse, ``S``.
    background : float
        Background photons per pulse over the whole gate, ``B``.

    Returns
    -------
    ndarray, shape (...)
        Infinite where the photons tell nothing of the delay, NaN where there is no echo.

    Raises
    ------
    ValueError
        If a rate is negative or not finite, or the number of pulses is not known.
    """
    onset, photons = _checked(onset_bin, signal, background)
    information = _information(onset, photons, background, pulse, acquisition)
    information *= _pulses_sent(acquisition)
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(np.isnan(onset), np.nan, 1 / np.sqrt(information)))


def cramer_rao_m(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """`cramer_rao_bins` as a range in metres."""
    bins = cramer_rao_bins(onset_bin, signal, background, pulse, acquisition)
    return np.asarray(bins * acquisition.bin_length_m)


def right_bin_probability(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Probability that the exact likelihood, with known rates, peaks at the echo.

    The score of a place is taken as Gaussian, of mean ``n_pulses Σ A (λ w - s)`` and variance
    ``n_pulses Σ A λ w²``, with ``w = ln(1 + s / b)``, ``s`` the echo expected there, ``A`` the
    pulses still armed (pile-up of the true echo included) and ``λ`` the true rate: ``b + s`` at the
    echo, ``b`` elsewhere. Places are independent every ``1 / (2 Σ p²)`` bins (2.1 for the pulse of
    the paper). The answer is right within one and a half of these (3.2 bins): there lie the echo
    itself and two independent places of noise, and the largest of the three must exceed all others.

    No estimate is right more often than by chance where no signal photon was detected at all. That
    bounds the result, and is the result where there is no background.

    Against 20 000 simulated pixels (gate of 100 bins, ``S`` of 0.1041, onset 53.6, tolerance of 3
    bins) it is

    * with 1000 pulses within 0.005 where it exceeds 0.9, and up to 0.055 too high below;
    * with 300 or 100 pulses within 0.01 where it exceeds 0.95, and up to 0.09 too high below;
    * with 30 pulses up to 0.12 too high, with 10 up to 0.2: nothing is Gaussian about some three
      signal photons or fewer.

    Where an echo alone fires most pulses (``S`` of 1 to 3) it was from 0.07 too low to 0.19 too
    high.

    Parameters
    ----------
    onset_bin : array_like, any shape
        Delay of the echo in fractional bins; NaN means no echo.
    signal : array_like, broadcast with `onset_bin`
        Signal photons per pulse, ``S``.
    background : float
        Background photons per pulse over the whole gate, ``B``.

    Returns
    -------
    ndarray, shape (...)
        NaN where there is no echo. More than 128 different pixels are interpolated between onsets a
        quarter of the spacing apart and signals 25 % apart. That is off by less than 0.01 for the
        pulse of the paper; for one much narrower than a bin, whose probability drops where it meets
        the edge of two bins, by 0.01 on average but by up to 0.16 at such edges.

    Raises
    ------
    ValueError
        If a rate is negative or not finite, or the number of pulses is not known.
    """
    onset, photons = _checked(onset_bin, signal, background)
    # A thousandth of a photon in all pulses is as good as none, and keeps the scores apart.
    photons = np.maximum(photons, 1e-3 / _pulses_sent(acquisition))
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


@dataclass(frozen=True, eq=False)
class Limit:
    """What the photons of each pixel allow, as images (row, col), NaN where there is no target."""

    right_bin_probability: Floats
    cramer_rao_m: Floats


def limit(capture: Capture) -> Limit:
    """The limits of a capture whose truth is known.

    Raises
    ------
    ValueError
        If the capture does not know its ranges, signal, background or number of pulses.
    """
    truth_m, signal, background = capture.truth_range_m, capture.signal, capture.background
    if truth_m is None or signal is None or background is None:
        missing = [
            name
            for name in ("truth_range_m", "signal", "background")
            if getattr(capture, name) is None
        ]
        raise ValueError(
            f"{' and '.join(missing)} = None is not accepted: give a capture with known truth."
        )
    onset = capture.acquisition.range_m_to_bin(truth_m)
    return Limit(
        right_bin_probability(onset, signal, background, capture.pulse, capture.acquisition),
        cramer_rao_m(onset, signal, background, capture.pulse, capture.acquisition),
    )


def best_exposure(
    onset_bin: ArrayLike,
    signal: ArrayLike,
    background: float,
    pulse: Pulse,
    acquisition: Acquisition,
) -> Floats:
    """Attenuation, as a factor on signal and background alike, that tells most of the delay.

    Too much light hides the echo behind background, too little has few photons of either. The
    factor maximises the information ``J`` of `cramer_rao_bins`. At that factor
    `right_bin_probability`, which is flat wherever it comes near 1, was within 0.01 of its own
    maximum. The rule of thumb, one background photon before the echo, comes out wherever the echo
    itself is weak.

    Parameters
    ----------
    onset_bin, signal, background
        As for `cramer_rao_bins`, without attenuation.

    Returns
    -------
    ndarray, shape (...)
        Greater than 0 and at most 1, in steps of 2 %; NaN where there is no echo.

    Raises
    ------
    ValueError
        If a rate is negative or not finite.
    """
    onset, photons = _checked(onset_bin, signal, background)
    # Below 1 / (S + B) every term of J grows with the factor: the best is not there.
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
    require("signal", (low, high), 0 <= low <= high < np.inf, "finite photons, 0 or more")
    require("background", background, 0 <= background < np.inf, "finite photons, 0 or more")
    onset, photons = np.broadcast_arrays(np.asarray(onset_bin, float), photons)
    return onset, photons


def _pulses_sent(acquisition: Acquisition) -> int:
    if acquisition.n_pulses is None:
        raise ValueError("n_pulses = None is not accepted: give the number of pulses sent.")
    return acquisition.n_pulses


def _armed(rate: Floats) -> Floats:
    """Share of pulses still armed at the beginning of each bin, from rates (..., bin)."""
    return np.asarray(np.exp(rate - np.cumsum(rate, axis=-1)))


def _information(
    onset: Floats, signal: Floats, background: float, pulse: Pulse, acquisition: Acquisition
) -> Floats:
    """Fisher information of one pulse on the delay, per square bin; 0 where there is no echo."""
    n_bins, bin_width_s = acquisition.n_bins, acquisition.bin_width_s
    share = pulse.bin_probability(onset, n_bins, bin_width_s)
    rate = signal[..., np.newaxis] * share + background / n_bins
    edges_s = (np.arange(n_bins + 1) - onset[..., np.newaxis]) * bin_width_s
    slope = -signal[..., np.newaxis] * np.diff(pulse.density(edges_s), axis=-1) * bin_width_s
    with np.errstate(over="ignore"):  # a bin that fires every pulse tells nothing
        odds = np.expm1(rate)
    # A share that is rounding has a slope that is none: over next to no background it would tell
    # more of the delay than all other bins.
    seen = (share > ROUNDING_OF_SHARES) & (odds > 0)
    told = np.divide(_armed(rate) * slope**2, odds, out=np.zeros_like(odds), where=seen)
    return np.asarray(told.sum(axis=-1))


def _spacing_bins(pulse: Pulse, acquisition: Acquisition) -> float:
    """Distance in bins of places whose scores are independent, ``1 / (2 Σ p²)``."""
    # Of a pulse that begins anywhere in a bin, in a gate that is long enough to hold it.
    onset = acquisition.n_bins / 2 + np.arange(8) / 8
    share = pulse.bin_probability(onset, 2 * acquisition.n_bins, acquisition.bin_width_s)
    return float(1 / (2 * np.sum(share**2, axis=-1).mean()))


def _score(rate: Floats | float, echo: Floats, background: float) -> tuple[Floats, Floats]:
    """Mean and variance that each bin adds to the score of `echo`, per armed pulse."""
    gain = np.log1p(echo / background)
    return np.asarray(rate * gain - echo), np.asarray(rate * gain**2)


def _right(
    onset: Floats, signal: float, background: float, pulse: Pulse, acquisition: Acquisition
) -> Floats:
    """`right_bin_probability` of onsets (n,) with one signal."""
    n_bins, n_pulses = acquisition.n_bins, _pulses_sent(acquisition)
    spacing = _spacing_bins(pulse, acquisition)
    begin, end = onset - SAME_PLACE_SPACINGS * spacing, onset + SAME_PLACE_SPACINGS * spacing
    echo = signal * pulse.bin_probability(onset, n_bins, acquisition.bin_width_s)
    per_bin = background / n_bins
    armed = _armed(echo + per_bin)

    first = armed * scipy.special.exprel(-echo - per_bin)
    seen = np.vecdot(first, echo)  # by one pulse: a first signal photon
    chance = _overlap(begin, end, 0.0, n_bins) / n_bins
    ceiling = np.asarray(1 - (1 - seen) ** n_pulses * (1 - chance))
    if n_pulses * background < 1e-6:  # not one background photon in a million pixels
        return ceiling

    def moments(rate: Floats | float) -> tuple[Floats, Floats]:
        mean, variance = _score(rate, echo, per_bin)
        return n_pulses * np.vecdot(armed, mean), _root(n_pulses * np.vecdot(armed, variance))

    mean, sd = moments(echo + per_bin)
    score = mean[:, np.newaxis] + sd[:, np.newaxis] * SCORES
    noise_mean, noise_sd = moments(per_bin)
    noise = _standard(score, noise_mean[:, np.newaxis], noise_sd[:, np.newaxis])
    ndtr = scipy.special.ndtr
    below_here = ndtr(SCORES) * ndtr(noise) ** (2 * SAME_PLACE_SPACINGS - 1)

    cells = min(MOST_PLACES, math.ceil(n_bins / spacing))
    edges = np.linspace(0.0, n_bins, cells + 1)
    # Anywhere in each cell: in its middle, a narrow pulse might always meet the edge of a bin.
    place = edges[:-1] + n_bins / cells * (np.arange(cells) * 0.5 * (math.sqrt(5) - 1) % 1)
    rival = signal * pulse.bin_probability(place, n_bins, acquisition.bin_width_s)
    mean, variance = (n_pulses * armed @ each.T for each in _score(per_bin, rival, per_bin))
    here = _overlap(begin[:, np.newaxis], end[:, np.newaxis], edges[:-1], edges[1:])
    rivals = (n_bins / cells - here) / spacing
    standard = _standard(
        score[..., np.newaxis], mean[:, np.newaxis], _root(variance)[:, np.newaxis]
    )
    below_elsewhere = np.exp((scipy.special.log_ndtr(standard) @ rivals[..., np.newaxis])[..., 0])

    middle = (below_elsewhere[:, 1:] + below_elsewhere[:, :-1]) / 2
    return np.asarray(np.minimum(np.vecdot(np.diff(below_here, axis=-1), middle), ceiling))


def _root(variance: Floats) -> Floats:
    # Behind light that fires every pulse no score varies any more.
    return np.asarray(np.sqrt(np.maximum(variance, np.finfo(float).tiny)))


def _standard(score: Floats, mean: Floats, sd: Floats) -> Floats:
    # Beyond, probabilities are 0 and 1.
    return np.asarray(np.clip((score - mean) / sd, -40.0, 40.0))


def _overlap(low: Floats, high: Floats, begin: Floats | float, end: Floats | float) -> Floats:
    """Length common to two intervals."""
    return np.asarray(np.maximum(np.minimum(high, end) - np.maximum(low, begin), 0.0))


def _interpolated(
    onset: Floats, signal: Floats, background: float, pulse: Pulse, acquisition: Acquisition
) -> Floats:
    """`right_bin_probability` of many pixels (n,), between a grid of onsets and signals."""
    first, last = float(onset.min()), float(onset.max())
    quarters = math.ceil(4 * (last - first) / _spacing_bins(pulse, acquisition))
    onsets = np.linspace(first, last, min(1 + quarters, MOST_ONSETS))
    low, high = float(np.log(signal.min())), float(np.log(signal.max()))
    logs = np.linspace(low, high, 1 + math.ceil((high - low) / math.log(1.25)))
    table = np.stack(
        [_right(onsets, math.exp(each), background, pulse, acquisition) for each in logs]
    )
    at = [
        np.interp(np.log(signal), logs, np.arange(logs.size)),
        np.interp(onset, onsets, np.arange(onsets.size)),
    ]
    return np.asarray(scipy.ndimage.map_coordinates(table, at, order=1, mode="nearest"))
