"""Unmixing of signal and noise with superpixels, after Rapp & Goyal 2017.

Rapp & Goyal, "A few photons among many: unmixing signal and noise for photon-efficient active
imaging", IEEE Transactions on Computational Imaging 3, 445. Reconstructed from public descriptions,
for binned first photons, in five steps.

**Time.** The cluster rule assumes noise that is uniform in time, which that of a first-photon
detector is not. Bin i is therefore given the length ``e_i = b A_i``, background times armed pulses,
so that noise is uniform in ``u_k = Σ_{i<k} e_i / Σ_i e_i``. For noise alone this is the map
``(1 - exp(-b t)) / (1 - exp(-b T))``; it also holds after an echo, where fewer pulses are armed.

**Clusters.** A window of ``2 T_pulse`` is moved along the gate. T_pulse is half the time in which
the middle 68 % of an echo arrive (the standard deviation of a Gaussian pulse). With c of the n
triggers in a window of length p in u, and ``q = c / n``, its score is the signed root ::

    ± sqrt( 2 n [ q ln(q / p) + (1 - q) ln((1 - q) / (1 - p)) ] )

of the likelihood ratio to noise, nearly standard normal for noise alone. The window with the
largest score is the cluster. It is kept if the probability that noise forms one like it in any of
the N windows is below τ_FA: ``N P(Binomial(n, p) >= c) < τ_FA``.

**Superpixels.** A pixel without a cluster is pooled with its neighbours, 3 x 3, 5 x 5 and so on,
until there is one.

**Range.** The delay is that of the best matched filter around the window, after subtraction of the
noise.

**Censoring.** The rank-ordered mean of the neighbours is the median of the times of their clusters.
An estimate far away from it is dropped: more than two windows from that of the 8 neighbours, unless
noise would not form its cluster anywhere in the image; or, as published, more than one window from
that of the 24 neighbours. The latter drops more outliers, but also clear echoes of small and of
steep surfaces.

**Filling and smoothing.** A pixel without an estimate takes over that of the nearest one that has
one. The estimates y are then smoothed to the z that minimises ``Σ w (z - y)² / 2 + β TV(z)``
(Rudin, Osher & Fatemi 1992), with the precision w of each, ``s² / (c T_pulse²)`` for s signal
photons of the c in the cluster of its superpixel, and 0 where y was taken over.

Not included: the original forms superpixels only of neighbours of similar reflectivity, whose
estimate needs another regularised image. Here, if empty pixels are allowed, surfaces in front of an
empty sky gain a rim of up to half a superpixel, with low confidence. Everything together takes
about 200 ns per pixel and bin at an SBR of 0.05, where three of four pixels need superpixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture
from core.estimators.base import PIXELS, Estimator, Pixels, conditions_of
from core.estimators.filters import echo_shape
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions, rate_and_n_armed
from core.inference.neighbours import box_sum, neighbours, patches, weighted_median, widened
from core.parameters import Choice, Number, Settings, parameter

_LAGS = 65  # delays tried around a window
_STEPS = 100  # of the smoothing
NUMBERS_AT_ONCE = 2**20  # counts processed together, which bounds temporaries


Neighbours = Literal["8 neighbours", "24 neighbours"]


@dataclass(frozen=True)
class UnmixingParameters(Settings):
    """Settings of the unmixing."""

    false_acceptance: float = parameter(
        0.01,
        Number("τ_FA", 1e-4, 0.5, log=True, least=1e-12, most=1.0),
        "Probability that noise alone forms a cluster that is kept.",
    )
    growth: int = parameter(
        2,
        Number("Growth", 0, 5, whole=True, unit="pixels", least=0, most=16),
        "Largest half-width of a superpixel; 2 means 5 × 5 pixels.",
    )
    smoothness: float = parameter(
        1.0,
        Number("β", 0.01, 10.0, log=True, unit="1/bin", least=0.0, most=1e6),
        "Weight of the total variation: large values smooth, 0 does not.",
    )
    censoring: Neighbours = parameter(
        "8 neighbours",
        Choice("Censoring", get_args(Neighbours)),
        "Neighbours with which an estimate is compared. 8 never drop a clear echo; 24, as "
        "published, drop more outliers, and small or steep surfaces.",
    )
    pixels: Pixels = parameter(
        "estimate every pixel",
        PIXELS,
        "Estimate every pixel: one without a cluster takes over its neighbours' range, as "
        "published. Allow empty pixels: it gets none.",
    )


def spread_bins(pulse: Pulse, acquisition: Acquisition) -> float:
    """Return ``T_pulse`` in bins: half the time in which the middle 68 % of an echo arrive."""
    return 0.5 * (pulse.quantile_s(0.84) - pulse.quantile_s(0.16)) / acquisition.bin_width_s


def window_bins(pulse: Pulse, acquisition: Acquisition) -> int:
    """Return ``2 T_pulse`` in whole bins, at least one and at most the gate."""
    return min(max(1, math.ceil(2 * spread_bins(pulse, acquisition))), acquisition.n_bins)


def window_sums(values: Floats, window: int) -> Floats:
    """Sum over the window that begins at each bin, clipped to the gate; shape (..., bin)."""
    until = np.cumsum(values, axis=-1)
    before = until - values
    full = max(values.shape[-1] - window + 1, 0)
    sums = until[..., -1:] - before
    sums[..., :full] = until[..., window - 1 :] - before[..., :full]
    return sums


def exposures(
    histogram: Floats, background: Floats, n_pulses: int | None, shape: Floats | None = None
) -> Floats:
    """Length of each bin in which noise is uniform, ``e_i = b_i A_i``; shape (..., bin).

    `background` is that of a pixel, and `shape` its `FluxModel.background_shape`.
    """
    _, armed = rate_and_n_armed(histogram, n_pulses)
    if shape is not None:
        armed = armed * shape
    return np.asarray(np.asarray(background)[..., np.newaxis] * armed)


class _Windows(NamedTuple):
    """Content of the window that begins at each bin, each of shape (..., bin)."""

    inside: Floats
    """Triggers, c."""
    length: Floats
    """Length in which noise is uniform, p."""
    score: Floats
    """Signed root of the likelihood ratio to noise."""


def scan(counts: Floats, exposure: Floats, window: int) -> _Windows:
    """Compare every window with the rest of the gate.

    Parameters
    ----------
    counts, exposure : ndarray, shape (..., bin)
    window : int
        In bins.
    """
    inside, total = window_sums(counts, window), counts.sum(axis=-1, keepdims=True)
    lasts = window_sums(exposure, window) / exposure.sum(axis=-1, keepdims=True)
    length = np.clip(lasts, 0.0, 1.0)  # rounding
    share = np.where(total > 0, inside / np.maximum(total, 1.0), length)  # empty: as noise
    rel_entr = scipy.special.rel_entr
    ratio = total * (rel_entr(share, length) + rel_entr(1 - share, 1 - length))
    score = np.copysign(np.sqrt(2 * np.maximum(ratio, 0.0)), share - length)
    return _Windows(inside, length, score)


class _Templates(NamedTuple):
    """Echoes at several delays relative to a window."""

    window: int
    """Bins."""
    spread: float
    """``T_pulse`` in bins."""
    lags: Floats
    """Tried delays, in bins from the one at which the window holds most of the echo."""
    offset: int
    """Bins from that delay to the first bin of the window."""
    first: int
    """Bins from the first bin of the window to that of the templates."""
    shapes: Floats
    """Echo at each lag, of norm 1; shape (lag, bin)."""


def _echo_templates(capture: Capture, flux: FluxModel) -> _Templates:
    pulse, acquisition = capture.pulse, capture.acquisition
    echo, begin = echo_shape(conditions_of(capture, flux))
    window = window_bins(pulse, acquisition)
    fullest = int(np.argmax(window_sums(echo, window)))
    lags = np.linspace(-window, window, _LAGS)
    # From the beginning of the earliest echo to the end of the latest.
    first, n_bins = -fullest - window, echo.size + 2 * window + 1
    shapes = pulse.bin_probability(lags - begin + window, n_bins, acquisition.bin_width_s)
    norm = np.linalg.norm(shapes, axis=1, keepdims=True)
    shapes /= np.maximum(norm, np.finfo(float).tiny)  # 0 if an echo begins after the gate
    spread = spread_bins(pulse, acquisition)
    return _Templates(window, spread, lags, begin + fullest, first, shapes)


class Clusters(NamedTuple):
    """Cluster of each pixel, each of shape (row, col)."""

    delay: Floats
    """Delay of the surface in bins; NaN without a cluster."""
    score: Floats
    """Score of the window; 0 without a cluster."""
    chance: Floats
    """Bound on the probability that noise forms one like it."""
    size: Floats
    """Triggers in it, per pixel."""
    precision: Floats
    """Reciprocal variance of the delay in 1/bin²; 0 without a cluster."""


def _clusters(
    counts: Floats, exposure: Floats, templates: _Templates, false_acceptance: float
) -> Clusters:
    """Find the clusters of histograms (pixel, bin), each of shape (pixel,)."""
    windows = scan(counts, exposure, templates.window)
    start = windows.score.argmax(axis=1)[:, np.newaxis]
    size, length, score = (np.take_along_axis(x, start, axis=1)[:, 0] for x in windows)
    total, whole = counts.sum(axis=1), exposure.sum(axis=1)
    chance = np.minimum(counts.shape[1] * binomial_from(size, total, length), 1.0)
    kept = chance < false_acceptance

    noise = _ratio(total - size, (1 - length) * whole)
    delay = start[:, 0] + _delays(counts, exposure, start, noise, templates)
    signal = np.maximum(size - noise * length * whole, 0.0)
    return Clusters(
        np.where(kept, delay, np.nan),
        np.where(kept, score, 0.0),
        chance,
        size,
        np.where(kept, _ratio(signal**2, size) / templates.spread**2, 0.0),
    )


def binomial_from(least: Floats, trials: Floats, chance: Floats) -> Floats:
    """Probability of `least` or more successes; all arguments are whole numbers."""
    betainc = scipy.special.betainc
    tail = betainc(np.maximum(least, 1.0), trials - least + 1, np.clip(chance, 0.0, 1.0))
    return np.where(least > 0, tail, 1.0)


def _delays(
    counts: Floats,
    exposure: Floats,
    start: NDArray[np.intp],
    noise: Floats,
    templates: _Templates,
) -> Floats:
    """Delay of the best matched filter, in bins from the window, shape (pixel,)."""
    n_bins = counts.shape[1]
    around = start + templates.first + np.arange(templates.shapes.shape[1])
    within, around = (around >= 0) & (around < n_bins), np.clip(around, 0, n_bins - 1)
    expected = noise[:, np.newaxis] * np.take_along_axis(exposure, around, axis=1)
    excess = np.where(within, np.take_along_axis(counts, around, axis=1) - expected, 0.0)
    # A BLAS product would round differently on other processors.
    match = np.einsum("pk,lk->pl", excess, templates.shapes)
    return np.asarray(templates.lags[match.argmax(axis=1)] - templates.offset)


def _ratio(numerator: Floats, denominator: Floats) -> Floats:
    """Divide; 0 where the denominator is not positive."""
    nothing = np.zeros_like(numerator)
    return np.divide(numerator, denominator, out=nothing, where=denominator > 0)


def find_clusters(capture: Capture, flux: FluxModel, parameters: UnmixingParameters) -> Clusters:
    """Find the cluster of the smallest superpixel of each pixel that has one."""
    found = np.zeros((len(Clusters._fields), *capture.shape))
    found[0] = np.nan
    templates, growth = _echo_templates(capture, flux), parameters.growth
    background = flux.typical_background
    rows, cols, n_bins = capture.cube.shape
    for here in patches((rows, cols, n_bins + _LAGS), NUMBERS_AT_ONCE):
        around, inner = widened(here, growth)  # with a margin for superpixels
        counts = capture.cube[around].astype(float)
        exposure = exposures(
            counts, background[around], capture.gated_pulses, flux.background_shape
        )
        for size in range(1, 2 * growth + 2, 2):
            open_pixels = np.isnan(found[0][here]) & (capture.counts[here] > 0)
            if open_pixels.any():
                pooled, lasts = (
                    box_sum(x, size, "constant")[inner][open_pixels] for x in (counts, exposure)
                )
                of = _clusters(pooled, lasts, templates, parameters.false_acceptance)
                of = of._replace(size=of.size / size**2)
                found[:, *here][:, open_pixels] = of
    return Clusters(*found)


def censored(clusters: Clusters, window: int, parameters: UnmixingParameters) -> NDArray[np.bool_]:
    """Find clusters that lie far from those of their neighbours; shape (row, col)."""
    half = 2 if parameters.censoring == "24 neighbours" else 1
    around, weight = neighbours(clusters.delay, half, np.nan), neighbours(clusters.size, half, 0.0)
    rank_ordered = weighted_median(around, np.where(np.isfinite(around), weight, 0.0))
    away = np.abs(clusters.delay - rank_ordered)  # NaN without neighbours, and never too far
    if half == 2:
        return np.asarray(away > window)
    doubtful = clusters.chance * clusters.chance.size >= parameters.false_acceptance
    return np.asarray((away > 2 * window) & doubtful)


def smoothed(values: Floats, precision: Floats, smoothness: float) -> Floats:
    """Minimise ``Σ w (z - y)² / 2 + β TV(z)`` over z (iteration of Chambolle & Pock 2011).

    The total variation is isotropic, ``Σ |∇z|`` with differences to the next row and column.

    Parameters
    ----------
    values : ndarray, shape (row, col)
        y in bins, finite everywhere.
    precision : ndarray, shape (row, col)
        w in 1/bin²; 0 where y is unknown.
    smoothness : float
        β in 1/bin.
    """
    if smoothness == 0:
        return values
    z, ahead = values.copy(), values.copy()
    flow = np.zeros((2, *values.shape))
    step = 1 / math.sqrt(8)  # the norm of the gradient is below sqrt(8)
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
    """Return smoothed delays and the score of each pixel's cluster."""
    clusters = find_clusters(capture, flux, parameters)
    window = window_bins(capture.pulse, capture.acquisition)
    known = np.isfinite(clusters.delay) & ~censored(clusters, window, parameters)
    if not known.any():
        return clusters.delay, clusters.score
    transform = scipy.ndimage.distance_transform_edt
    nearest = transform(~known, return_distances=False, return_indices=True)
    precision = np.where(known, clusters.precision, 0.0)
    delay = smoothed(clusters.delay[tuple(nearest)], precision, parameters.smoothness)
    if parameters.pixels == "allow empty pixels":
        delay = np.where(np.isfinite(clusters.delay), delay, np.nan)
    return delay, clusters.score


def _curve(histogram: Floats, conditions: Conditions, parameters: UnmixingParameters) -> Floats:
    """Return the score of the window that begins at each bin, for a single pixel."""
    exposure = exposures(
        histogram, conditions.background, conditions.n_pulses, conditions.background_shape
    )
    window = window_bins(conditions.pulse, conditions.acquisition)
    return scan(histogram, exposure, window).score


ESTIMATOR = Estimator(
    "Unmixing with superpixels (Rapp & Goyal 2017)",
    UnmixingParameters,
    _curve,
    _locate,
    finds_delay=True,
    reconstructed="public descriptions of IEEE Transactions on Computational Imaging 3, 445 (2017)",
    own_threshold="clusters are kept by τ_FA, superpixels share one, and pixels without one take "
    "over their neighbours' ranges unless empty pixels are allowed",
    undoes_pile_up=True,
    whole_image=True,
    fills=True,
)
