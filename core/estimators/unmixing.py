"""Unmixing of signal and noise with superpixels, after Rapp & Goyal 2017.

Rapp & Goyal, "A few photons among many: unmixing signal and noise for photon-efficient active
imaging", IEEE Transactions on Computational Imaging 3, 445. Rebuilt from public descriptions, for
binned first photons, in five steps.

**Time.** The rule for clusters wants noise that is uniform in time, and that of a first-photon
detector is not. Time is therefore counted as noise sees it: bin i lasts ``e_i = b A_i``, background
times pulses still armed, and noise is uniform in ``u_k = Σ_{i<k} e_i / Σ_i e_i``. Where there is
noise alone this is the map ``(1 - exp(-b t)) / (1 - exp(-b T))``; behind an echo, where fewer
pulses are armed than that says, it stays right.

**Clusters.** A window of ``2 T_pulse`` is moved along the gate, T_pulse being half the time in
which the middle 68 % of an echo arrive (the standard deviation of a Gaussian one). With c of the n
triggers in a window that is p long in u, and ``q = c / n``, its score is the signed root ::

    ± sqrt( 2 n [ q ln(q / p) + (1 - q) ln((1 - q) / (1 - p)) ] )

of the likelihood ratio to noise, close to a standard normal number where there is noise alone. The
window with the largest is the cluster. It is kept if it is so large that noise would make one like
it, in any of the N windows, with probability below τ_FA: ``N P(Binomial(n, p) >= c) < τ_FA``.

**Superpixels.** A pixel without a cluster takes in its neighbours, 3 x 3, 5 x 5 and so on, until
there is one. A pixel that finds none in the largest superpixel has no target.

**Range.** Within the window's surroundings the echo's delay is that of the best matched filter, the
noise taken away.

**Censoring and smoothing.** The rank-ordered mean of the 8 neighbours is the median of their
clusters' times. An answer further from it than two windows is dropped, unless its cluster is one
that noise would not make anywhere in the whole image. What remains, y, is smoothed to the z that
minimises ``Σ w (z - y)² / 2 + β TV(z)`` (Rudin, Osher & Fatemi 1992), w being what each answer is
known to, ``s² / (c T_pulse²)`` for s of c photons being signal, and 0 where dropped.

Not taken over: the original forms superpixels of neighbours of similar reflectivity only, whose
estimate needs another regularised image. Surfaces before an empty sky gain a rim of up to a
superpixel's reach here; its confidence is low. All of it takes about 200 ns a pixel and bin at an
SBR of 0.05, where three pixels in four want superpixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture
from core.estimators.base import Estimator, conditions_of
from core.estimators.filters import echo_shape
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions, rate_and_n_armed
from core.inference.neighbours import box_sum, neighbours, patches, weighted_median, widened
from core.parameters import Number, check_fields, parameter

_LAGS = 65  # delays tried around a window
_STEPS = 100  # of the smoothing
_AT_ONCE = 2**20  # counts treated together: temporaries of a whole cube may not fit


@dataclass(frozen=True)
class UnmixingParameters:
    """Settings of the unmixing.

    Raises
    ------
    ValueError
        If a value lies outside its bounds.
    """

    false_acceptance: float = parameter(
        0.01,
        Number("τ_FA", 1e-4, 0.5, log=True, least=1e-12, most=1.0),
        "Probability that noise alone makes a cluster which is kept.",
    )
    growth: int = parameter(
        2,
        Number("Growth", 0, 5, whole=True, unit="pixels", least=0, most=16),
        "How far a superpixel may reach from its middle; 2 means 5 × 5 pixels.",
    )
    smoothness: float = parameter(
        1.0,
        Number("β", 0.01, 10.0, log=True, unit="1/bin", least=0.0, most=1e6),
        "Weight of the total variation: large values smooth, 0 leaves answers as they are.",
    )

    def __post_init__(self) -> None:
        check_fields(self)


def spread_bins(pulse: Pulse, acquisition: Acquisition) -> float:
    """``T_pulse`` in bins: half the time in which the middle 68 % of an echo arrive."""
    return 0.5 * (pulse.quantile_s(0.84) - pulse.quantile_s(0.16)) / acquisition.bin_width_s


def window_bins(pulse: Pulse, acquisition: Acquisition) -> int:
    """``2 T_pulse`` in whole bins, at least one and at most the gate."""
    return min(max(1, math.ceil(2 * spread_bins(pulse, acquisition))), acquisition.n_bins)


def window_sums(values: Floats, window: int) -> Floats:
    """Sum over the window that begins at each bin, cut off at the gate's end; shape (..., bin)."""
    until = np.cumsum(values, axis=-1)
    before = until - values
    full = max(values.shape[-1] - window + 1, 0)
    sums = until[..., -1:] - before
    sums[..., :full] = until[..., window - 1 :] - before[..., :full]
    return sums


def exposures(histogram: Floats, background: Floats, n_pulses: int | None) -> Floats:
    """How long each bin lasts as noise sees it, ``e_i = b A_i``; shape (..., bin)."""
    _, armed = rate_and_n_armed(histogram, n_pulses)
    return np.asarray(np.asarray(background)[..., np.newaxis] * armed)


class _Windows(NamedTuple):
    """What the window that begins at each bin holds, each of shape (..., bin)."""

    inside: Floats
    """Triggers, c."""
    length: Floats
    """Length in the time that noise sees, p."""
    score: Floats
    """Signed root of the likelihood ratio to noise."""


def scan(counts: Floats, exposure: Floats, window: int) -> _Windows:
    """Compare every window with what lies outside of it.

    Parameters
    ----------
    counts, exposure : ndarray, shape (..., bin)
    window : int
        In bins.
    """
    inside, total = window_sums(counts, window), counts.sum(axis=-1, keepdims=True)
    lasts = window_sums(exposure, window) / exposure.sum(axis=-1, keepdims=True)
    length = np.clip(lasts, 0.0, 1.0)  # sums round
    share = np.where(total > 0, inside / np.maximum(total, 1.0), length)  # none: as noise has it
    rel_entr = scipy.special.rel_entr
    ratio = total * (rel_entr(share, length) + rel_entr(1 - share, 1 - length))
    score = np.copysign(np.sqrt(2 * np.maximum(ratio, 0.0)), share - length)
    return _Windows(inside, length, score)


class _Ruler(NamedTuple):
    """An echo as the windows meet it."""

    window: int
    """Bins."""
    spread: float
    """``T_pulse`` in bins."""
    lags: Floats
    """Delays tried, in bins from that at which the echo fills the window best."""
    offset: int
    """Bins from that delay to the window's first bin."""
    first: int
    """Bins from the window's first bin to the first one of its surroundings."""
    templates: Floats
    """The echo at each lag in the surroundings, each of norm 1; shape (lag, bin)."""


def _ruler(capture: Capture, flux: FluxModel) -> _Ruler:
    pulse, acquisition = capture.pulse, capture.acquisition
    echo, begin = echo_shape(conditions_of(capture, flux))
    window = window_bins(pulse, acquisition)
    fullest = int(np.argmax(window_sums(echo, window)))
    lags = np.linspace(-window, window, _LAGS)
    # From where the earliest echo begins to where the latest one ends.
    first, n_bins = -fullest - window, echo.size + 2 * window + 1
    templates = pulse.bin_probability(lags - begin + window, n_bins, acquisition.bin_width_s)
    norm = np.linalg.norm(templates, axis=1, keepdims=True)
    templates /= np.maximum(norm, np.finfo(float).tiny)  # 0 where an echo begins after the gate
    spread = spread_bins(pulse, acquisition)
    return _Ruler(window, spread, lags, begin + fullest, first, templates)


class Clusters(NamedTuple):
    """The cluster of each pixel, each of shape (row, col)."""

    delay: Floats
    """Of the surface, in bins; NaN where there is no cluster."""
    score: Floats
    """That of the window; 0 where there is none."""
    chance: Floats
    """Bound on the probability that noise makes one like it."""
    size: Floats
    """Triggers in it, per pixel."""
    precision: Floats
    """One over the delay's variance in bins², per pixel; 0 where there is none."""


def _clusters(counts: Floats, exposure: Floats, ruler: _Ruler, false_acceptance: float) -> Clusters:
    """The clusters of histograms (pixel, bin), each of shape (pixel,)."""
    windows = scan(counts, exposure, ruler.window)
    start = windows.score.argmax(axis=1)[:, np.newaxis]
    size, length, score = (np.take_along_axis(x, start, axis=1)[:, 0] for x in windows)
    total, whole = counts.sum(axis=1), exposure.sum(axis=1)
    chance = np.minimum(counts.shape[1] * binomial_from(size, total, length), 1.0)
    kept = chance < false_acceptance

    noise = _ratio(total - size, (1 - length) * whole)
    delay = start[:, 0] + _delays(counts, exposure, start, noise, ruler)
    signal = np.maximum(size - noise * length * whole, 0.0)
    return Clusters(
        np.where(kept, delay, np.nan),
        np.where(kept, score, 0.0),
        chance,
        size,
        np.where(kept, _ratio(signal**2, size) / ruler.spread**2, 0.0),
    )


def binomial_from(least: Floats, trials: Floats, chance: Floats) -> Floats:
    """Probability of `least` or more successes, all of them whole numbers."""
    betainc = scipy.special.betainc
    tail = betainc(np.maximum(least, 1.0), trials - least + 1, np.clip(chance, 0.0, 1.0))
    return np.where(least > 0, tail, 1.0)


def _delays(
    counts: Floats, exposure: Floats, start: NDArray[np.intp], noise: Floats, ruler: _Ruler
) -> Floats:
    """Delay of the best matched filter, in bins from the window's start; shape (pixel,)."""
    n_bins = counts.shape[1]
    around = start + ruler.first + np.arange(ruler.templates.shape[1])
    within, around = (around >= 0) & (around < n_bins), np.clip(around, 0, n_bins - 1)
    expected = noise[:, np.newaxis] * np.take_along_axis(exposure, around, axis=1)
    excess = np.where(within, np.take_along_axis(counts, around, axis=1) - expected, 0.0)
    # Not a BLAS product, whose order of summation depends on the processor.
    match = np.einsum("pk,lk->pl", excess, ruler.templates)
    return np.asarray(ruler.lags[match.argmax(axis=1)] - ruler.offset)


def _ratio(numerator: Floats, denominator: Floats) -> Floats:
    """0 where there is nothing to divide by."""
    nothing = np.zeros_like(numerator)
    return np.divide(numerator, denominator, out=nothing, where=denominator > 0)


def find_clusters(capture: Capture, flux: FluxModel, parameters: UnmixingParameters) -> Clusters:
    """The cluster of each pixel's smallest superpixel that has one."""
    found = np.zeros((len(Clusters._fields), *capture.shape))
    found[0] = np.nan
    ruler, background, growth = _ruler(capture, flux), flux.typical_background, parameters.growth
    rows, cols, n_bins = capture.cube.shape
    for here in patches((rows, cols, n_bins + _LAGS), _AT_ONCE):
        around, inner = widened(here, growth)  # with the pixels that superpixels reach
        counts = capture.cube[around].astype(float)
        exposure = exposures(counts, background[around], capture.gated_pulses)
        for reach in range(1, 2 * growth + 2, 2):
            waiting = np.isnan(found[0][here]) & (capture.counts[here] > 0)
            if waiting.any():
                seen, lasts = (
                    box_sum(x, reach, "constant")[inner][waiting] for x in (counts, exposure)
                )
                of = _clusters(seen, lasts, ruler, parameters.false_acceptance)
                # A superpixel's answer weighs no more for being shared.
                of = of._replace(size=of.size / reach**2, precision=of.precision / reach**2)
                found[:, *here][:, waiting] = of
    return Clusters(*found)


def censored(clusters: Clusters, window: int, false_acceptance: float) -> NDArray[np.bool_]:
    """Where a cluster is far from the neighbours' and not beyond doubt; shape (row, col)."""
    around, weight = neighbours(clusters.delay, np.nan), neighbours(clusters.size, 0.0)
    rank_ordered = weighted_median(around, np.where(np.isfinite(around), weight, 0.0))
    doubtful = clusters.chance * clusters.chance.size >= false_acceptance
    # A NaN, that of a pixel without neighbours, censors nothing.
    return (np.abs(clusters.delay - rank_ordered) > 2 * window) & doubtful


def smoothed(values: Floats, precision: Floats, smoothness: float) -> Floats:
    """The z that minimises ``Σ w (z - y)² / 2 + β TV(z)``, by Chambolle & Pock's 2011 iteration.

    The total variation is isotropic, ``Σ |∇z|`` with differences to the next row and column.

    Parameters
    ----------
    values : ndarray, shape (row, col)
        y, in bins; finite, also where not known.
    precision : ndarray, shape (row, col)
        w, in 1/bin²; 0 where y is not known.
    smoothness : float
        β, in 1/bin.
    """
    if smoothness == 0:
        return values
    z, ahead = values.copy(), values.copy()
    flow = np.zeros((2, *values.shape))
    step = 1 / math.sqrt(8)  # the gradient's norm is below sqrt(8)
    for _ in range(_STEPS):
        flow[0, :-1] += step * np.diff(ahead, axis=0)
        flow[1, :, :-1] += step * np.diff(ahead, axis=1)
        flow *= smoothness / np.maximum(smoothness, np.hypot(*flow))
        spread = -flow.sum(axis=0)  # the negative divergence
        spread[1:] += flow[0, :-1]
        spread[:, 1:] += flow[1, :, :-1]
        before = z
        z = (z - step * spread + step * precision * values) / (1 + step * precision)
        ahead = 2 * z - before
    return z


def _locate(
    capture: Capture, flux: FluxModel, parameters: UnmixingParameters
) -> tuple[Floats, Floats]:
    """Smoothed delays, and the score of each pixel's cluster."""
    clusters = find_clusters(capture, flux, parameters)
    window = window_bins(capture.pulse, capture.acquisition)
    dropped = censored(clusters, window, parameters.false_acceptance)
    known = np.isfinite(clusters.delay) & ~dropped
    if not known.any():
        return clusters.delay, clusters.score
    transform = scipy.ndimage.distance_transform_edt
    nearest = transform(~known, return_distances=False, return_indices=True)
    precision = np.where(known, clusters.precision, 0.0)
    delay = smoothed(clusters.delay[tuple(nearest)], precision, parameters.smoothness)
    return np.where(np.isfinite(clusters.delay), delay, np.nan), clusters.score


def _curve(histogram: Floats, conditions: Conditions, parameters: UnmixingParameters) -> Floats:
    """Score of the window that begins at each bin, for the pixel alone."""
    exposure = exposures(histogram, conditions.background, conditions.n_pulses)
    window = window_bins(conditions.pulse, conditions.acquisition)
    return scan(histogram, exposure, window).score


ESTIMATOR = Estimator(
    "Unmixing with superpixels (Rapp & Goyal 2017)",
    UnmixingParameters,
    _curve,
    _locate,
    finds_delay=True,
    reconstructed="public descriptions of IEEE Transactions on Computational Imaging 3, 445 (2017)",
    null_side=64,
    undoes_pile_up=True,
    whole_image=True,
)
