"""Empirical Bayes posterior of each pixel's delay, from the exact first-photon likelihood.

With background ``b`` and signal ``s_k(d) = S p_k(d)`` photons per pulse in bin ``k``, ``n_k``
detections and ``A_k`` armed pulses, the log likelihood ratio of an echo at delay ``d`` to no echo
is ::

    T(d) = Σ_k [ n_k ln((1 - exp(-b - s_k)) / (1 - exp(-b))) - (A_k - n_k) s_k ]

which is exact for the trigger probabilities of Eq. 1. Where the number of pulses is unknown, or
where a pulse may fire more than once, counts are Poisson: ``ln(1 + s_k / b)`` and ``-s_k``, with
photons per pixel instead of per pulse.

``S`` and ``b`` are unknown. The distribution of signal levels is estimated from a sample of the
capture's pixels (`flux_model_of`: nonparametric maximum likelihood of a mixing distribution,
Kiefer & Wolfowitz 1956, on a grid of levels that includes "no echo"), and so is the distribution
of delays. The posterior averages over the levels. Its mass around an estimate is the probability
that the estimate is right, whichever estimator made it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture, cached_per_capture
from core.inference.neighbours import weighted_median
from core.inference.resolution import FEW, Difference, difference, pile_up
from core.kernels.blocks import LANES, lane_counts, lane_rows
from core.kernels.parallel import COMPILED, PARALLEL, SUMMING, entering
from core.trigger import rate_per_bin, trigger_probability

TOLERANCE_BINS = 3
"""An answer is right within this many bins: the tolerance that reproduces the paper's tables."""


class Conditions(NamedTuple):
    """What is known of histograms (..., bin) besides their counts."""

    acquisition: Acquisition
    pulse: Pulse
    n_pulses: int | None
    """Pulses sent, where counts are first photons; None where that is not known."""
    signal: Floats
    """Signal photons per pulse, (...) or scalar; per histogram where `n_pulses` is None."""
    background: Floats
    """Background photons per pulse over the gate, likewise."""
    contrast: float
    """Signal over background, both as they are on average over the image."""
    pile_up: bool = True
    """`FluxModel.pile_up`."""


@dataclass(frozen=True, eq=False)
class FluxModel:
    """Flux that each pixel may have seen: levels of signal, and how often each occurs.

    Parameters
    ----------
    signal : ndarray, shape (level, row, col)
        Signal photons per pulse; the first level is 0, "no echo".
    background : ndarray, shape (level, row, col)
        Background photons per pulse over the gate, if the signal is of that level.
    share : ndarray, shape (level,)
        Share of the pixels at each level; sums to 1.
    depth : ndarray, shape (bin,)
        How much more often than in others a surface's delay falls in each bin; 1 on average.
    image_contrast : float, optional
        `contrast` of the image that these pixels are a part of; None where they are all of it.
    pile_up : bool
        Whether the pulses show that early photons hide later ones.
    """

    signal: Floats
    background: Floats
    share: Floats
    depth: Floats
    image_contrast: float | None = None
    pile_up: bool = True

    @cached_property
    def typical_signal(self) -> Floats:
        """Mean signal of the pixels that see an echo, shape (row, col)."""
        share = self.share[1:]
        share = share / share.sum() if share.sum() > 0 else np.full(share.size, 1 / share.size)
        return _weighted_sum(share, self.signal[1:])

    @cached_property
    def typical_background(self) -> Floats:
        """Mean background, shape (row, col)."""
        return _weighted_sum(self.share, self.background)

    @property
    def contrast(self) -> float:
        """Signal over background, both on average over the image."""
        if self.image_contrast is not None:
            return self.image_contrast
        return float(self.typical_signal.mean() / self.typical_background.mean())

    def of_pixels(self, pixels: NDArray[np.intp]) -> FluxModel:
        """The light of some pixels, given as flat indices of shape (row, col)."""
        flat = (len(self.share), -1)
        return FluxModel(
            self.signal.reshape(flat)[:, pixels],
            self.background.reshape(flat)[:, pixels],
            self.share,
            self.depth,
            self.contrast,
            self.pile_up,
        )


class FluxPrior(NamedTuple):
    """Flux parameters shared by all pixels of an image; with its counts they give a `FluxModel`."""

    levels: Floats
    """Signal photons per pulse, shape (level,)."""
    share: Floats
    """`FluxModel.share`."""
    depth: Floats
    """`FluxModel.depth`."""
    background: Floats
    """Mean background over the image, per level where the signals are not known yet."""
    own_weight: float
    """Share of a background's deviation from the mean that is no chance."""
    contrast: float | None = None
    """`FluxModel.contrast` of the image."""
    pile_up: bool = True
    """`FluxModel.pile_up`."""

    def with_one_level(self) -> FluxPrior:
        """The same with the mean of all signals for each of them."""
        some = self.share[1:].sum()
        mean = float(self.share[1:] @ self.levels[1:] / some)
        return self._replace(levels=np.array([0.0, mean]), share=np.array([self.share[0], some]))

    def model(self, total: Floats, least_background: float) -> FluxModel:
        """The light of pixels of which the total rates are known, shape (row, col)."""
        shape, levels = (self.levels.size, *total.shape), self.levels[:, np.newaxis, np.newaxis]
        mean = np.broadcast_to(self.background, levels.shape)
        if self.own_weight == 0:  # the same in all pixels: one number a level
            background = np.broadcast_to(np.maximum(mean, least_background), shape)
        else:
            background = np.empty(shape)
            for level, its_mean, filled in zip(levels, mean, background, strict=True):
                own = its_mean + self.own_weight * (total - level - its_mean)
                np.maximum(own, least_background, out=filled)
        return FluxModel(
            np.broadcast_to(levels, shape),
            background,
            self.share,
            self.depth,
            self.contrast,
            self.pile_up,
        )


def _weighted_sum(weights: Floats, images: Floats) -> Floats:
    """``Σ_i weights_i images_i``, added in this order: a BLAS product depends on the processor."""
    total = np.zeros(images.shape[1:])
    for weight, image in zip(weights, images, strict=True):
        total += weight * image
    return total


class Posterior(NamedTuple):
    """What is known of each pixel's delay once its counts are known."""

    tolerance_probability: NDArray[np.float32]
    """Probability that there is a surface, and within `TOLERANCE_BINS` of each bin's beginning;
    shape (row, col, bin)."""
    surface: Floats
    """Probability that there is a surface at all, shape (row, col)."""


LEVELS = 12  # of signal, besides none
SAMPLE = 512  # pixels from which the light is estimated
_SPREAD = 200.0  # the strongest level over the faintest
_STEPS = 100  # of expectation and maximisation
_DEPTH_STEPS = 30
_ALIKE = 0.1  # share of the surfaces of which nothing is learned
_MISSED = 2.0  # log likelihood that faint levels must be worth to be kept
_TOO_FEW = 3  # unfired pulses, of which the logarithm is chance
_RARE = 1e-3  # levels with a smaller share are left out
_SAMPLE_NUMBERS = 2**25  # likelihoods of the sample's levels and delays that are held: 128 MiB
_TABLE_NUMBERS = 2**22  # likelihoods of a block's levels and delays: 16 MiB
_FEWEST_LANES = 2  # a single lane would be summed pairwise by numpy, which rounds differently
_FLUX_NUMBERS = 2**20  # backgrounds of levels and pixels that are laid out at once


@cached_per_capture
def flux_model_of(capture: Capture) -> FluxModel:
    """Signal levels, their shares, and each pixel's background, as the capture itself tells."""
    return flux_prior_of(capture).model(_totals(capture)[0], _least_background(capture))


@cached_per_capture
def flux_prior_of(capture: Capture) -> FluxPrior:
    """What a capture tells of the light that its pixels see, in the cheapest model that will do.

    Pile-up that the pulses hide is taken for none (`core.inference.resolution`). The mean of all
    levels of signal is taken for each of them, where a pixel's pulses do not tell them from it: a
    pixel that cannot tell its level orders delays by any of them much alike.

    That of `Capture.flux_prior` where it is given.
    """
    if capture.flux_prior is not None:
        return capture.flux_prior
    found, n_pulses = detailed_flux_prior_of(capture), capture.gated_pulses
    if n_pulses is not None:
        is_hidden = pile_up(capture.counts / n_pulses, n_pulses).is_hidden
        found = found._replace(pile_up=not is_hidden)
    told = level_differences(found, capture).told
    return found.with_one_level() if found.share[1:] @ told <= FEW else found


def total_rates(capture: Capture) -> Floats:
    """Signal and background of each pixel together, shape (row, col)."""
    return _totals(capture)[0]


def level_likelihoods(
    capture: Capture, pixels: NDArray[np.intp], flux_prior: FluxPrior, steps_per_bin: int
) -> Floats:
    """Log likelihood of each level of signal, delays being as likely as `FluxPrior.depth` says.

    Parameters
    ----------
    capture : Capture
    pixels : ndarray, shape (pixel,)
        Flat indices.
    flux_prior : FluxPrior
    steps_per_bin : int
        Delays tried within each bin.

    Returns
    -------
    ndarray, shape (pixel, level)
        But for what depends on the counts alone.
    """
    some, n_bins, n_pulses = pixels[np.newaxis], capture.cube.shape[2], capture.gated_pulses
    flux = flux_prior.model(_totals(capture)[0].ravel()[some], _least_background(capture))
    cube = capture.cube.reshape(-1, n_bins)[some]
    prepared = _prepare(capture, cube, flux, steps_per_bin)
    evidence = _level_evidence(prepared, prepared.depth[:, np.newaxis])
    b = flux.background[0, 0] / n_bins
    fires = b if n_pulses is None else -np.expm1(-b)
    fired, unfired = np.empty((2, pixels.size))
    for rows in _some_rows(cube[0]):
        counts = cube[0, rows].astype(float)
        left = np.ones_like(counts) if n_pulses is None else n_pulses - np.cumsum(counts, axis=1)
        fired[rows], unfired[rows] = counts.sum(axis=1), left.sum(axis=1)
    return np.asarray(evidence + (fired * np.log(fires) - b * unfired)[:, np.newaxis])


def level_differences(flux_prior: FluxPrior, capture: Capture) -> Difference:
    """How far each level of signal lies from their mean, shape (level - 1,).

    For an echo at the beginning of the gate, where most pulses are armed.
    """
    _, first = capture.pulse.taps(capture.acquisition.n_bins, capture.acquisition.bin_width_s)
    signal = np.concatenate([flux_prior.with_one_level().levels[1:], flux_prior.levels[1:]])
    rate = rate_per_bin(
        np.full(signal.size, max(-first, 0.0)),
        signal,
        max(float(np.mean(flux_prior.background)), _least_background(capture)),
        capture.pulse,
        capture.acquisition,
    )
    model = rate if capture.gated_pulses is None else trigger_probability(rate)
    return difference(model[1:], model[0], capture.gated_pulses)


@cached_per_capture
def detailed_flux_prior_of(capture: Capture) -> FluxPrior:
    """`flux_prior_of` with every level of signal that the pixels together tell.

    The total of a pixel's rates (Coates 1968) is signal and background together. What a level of
    signal leaves of it is background, drawn towards the image's mean background as far as its
    scatter is what chance alone makes (James & Stein 1961, the chance being Greenwood's 1926
    variance): where all pixels see the same background, all are given the same.
    """
    total, chance = _totals(capture)
    flat = capture.cube.reshape(total.size, -1)
    # At random: a regular step could miss what stands in columns.
    drawn = np.random.default_rng(0).permutation(total.size)[:SAMPLE]
    pixels, least = np.sort(drawn)[np.newaxis], _least_background(capture)
    levels = _levels(flat[pixels[0]], capture)
    # While nothing is known, each level is everyone's signal.
    guess = FluxPrior(
        levels,
        share=np.full(levels.size, 1 / levels.size),
        depth=np.ones(flat.shape[1]),
        background=total.mean() - levels[:, np.newaxis, np.newaxis],
        own_weight=_trust(total, chance),
    )
    lit = guess.model(total.ravel()[pixels], least)
    share = _shares(_level_evidence(_prepare(capture, flat[pixels], lit, 1)))
    mean = np.asarray(share @ levels)
    variance = float(share @ (levels - mean) ** 2)
    kept = share > _RARE
    kept[0] = True
    if not kept[1:].any():  # an echo so rare that the sample missed it
        kept[-1], share[-1] = True, _RARE
    found = guess._replace(
        levels=levels[kept],
        share=share[kept] / share[kept].sum(),
        background=total.mean() - mean,
        own_weight=_trust(total, chance + variance),
    )
    # Delays take a table of all levels of the sample: in a long gate, of fewer pixels.
    each = found.share.size * flat.shape[1]
    most = sampled_numbers(found.share.size, flat.shape[1]) // each
    pixels = np.sort(drawn[:most])[np.newaxis]
    lit = found.model(total.ravel()[pixels], least)
    prepared = _prepare(capture, flat[pixels], lit, 1)
    share, depth = _shares_and_depths(_level_densities(prepared), found.share)
    found = found._replace(share=share, depth=depth)
    return found._replace(contrast=found.model(total, least).contrast)


def _least_background(capture: Capture) -> float:
    """Half a count more than nothing: what was never seen may still be there."""
    return 0.5 / (capture.gated_pulses or 1)


def _totals(capture: Capture) -> tuple[Floats, float]:
    """Each pixel's total rate (row, col), and its variance by chance alone.

    Coates' rates add up to ``ln(M / (M - Σ n))`` over the gate, M being the pulses sent, and
    Greenwood's variances to ``1 / (M - Σ n) - 1 / M``. A logarithm of few is too small on average,
    by half its variance: over an image that would be taken for background.
    """
    n_pulses = capture.gated_pulses
    if n_pulses is None:
        return capture.counts.astype(float), float(capture.counts.mean())  # Poisson
    unfired = np.maximum(n_pulses - capture.counts, 0.5)
    variance = 1 / unfired - 1 / n_pulses
    total = np.log(n_pulses / unfired) - variance / 2
    spent = capture.counts > n_pulses - _TOO_FEW
    if spent.any():
        total[spent] = np.maximum(total[spent], _background_of(capture.cube[spent], n_pulses))
    return total, float(variance.mean())


def _background_of(pixels: NDArray[np.unsignedinteger], n_pulses: int) -> Floats:
    """Total rate of the background of pixels (pixel, bin) whose pulses fired, all or nearly all.

    The bins behind the last pulse tell nothing; their rate is taken for the median of the others,
    each counting as often as it has pulses armed: that is the background where it fired the pulses,
    and next to nothing where an echo did. Without them, light that fires every pulse early in the
    gate would be an echo there, beyond all doubt.
    """
    median = np.empty(len(pixels))
    for some in _some_rows(pixels):
        rate, armed = rate_and_n_armed(pixels[some].astype(float), n_pulses)
        median[some] = weighted_median(rate.T, armed.T)
    return median * pixels.shape[1]


def _some_rows(pixels: NDArray[Any]) -> Iterator[slice]:
    """Pixels (pixel, bin) a few at a time, so that temporaries stay small."""
    at_once = max(1, _AT_ONCE // pixels.shape[1])
    for first in range(0, len(pixels), at_once):
        yield slice(first, first + at_once)


def _trust(total: Floats, unrelated: float) -> float:
    """Share of the totals' variance that is no chance, `unrelated` being the variance by chance."""
    scatter = float(total.var())
    own_weight = max(0.0, 1 - unrelated / scatter) if scatter > 0 else 0.0
    return (
        own_weight if own_weight >= 3 * math.sqrt(2 / total.size) else 0.0
    )  # it is known no better


def _levels(pixels: NDArray[np.unsignedinteger], capture: Capture) -> Floats:
    """None, and signals up to that of the strongest echoes among pixels (pixel, bin)."""
    top = _strongest(pixels, capture)
    return np.concatenate([[0.0], np.geomspace(top / _SPREAD, top, LEVELS)])


def _strongest(pixels: NDArray[np.unsignedinteger], capture: Capture) -> float:
    """Signal of the strongest echoes among pixels (pixel, bin), at least one detection."""
    n_bins = pixels.shape[1]
    excess, width = np.empty(len(pixels)), min(capture.echo_bins, n_bins)
    for some in _some_rows(pixels):
        rate, _ = rate_and_n_armed(pixels[some].astype(float), capture.gated_pulses)
        until = np.pad(np.cumsum(rate, axis=1), ((0, 0), (1, 0)))
        inside = (until[:, width:] - until[:, :-width]).max(axis=1)
        excess[some] = inside - until[:, -1] * width / n_bins
    return max(float(np.quantile(excess, 0.999)), 1.0 / (capture.gated_pulses or 1))


def _shares(evidence: Floats) -> Floats:
    """Shares of the levels that make the evidence (pixel, level; logarithms) most likely.

    One pixel more is counted as having no echo: that none was seen is no proof that none occurs.
    The faintest levels cannot be told from no echo, and sharing pixels out among them is arbitrary:
    these are counted as having no echo, as long as the likelihood does not miss the others.
    """
    n_levels = evidence.shape[1]
    likelihood = np.exp(evidence - evidence.max(axis=1, keepdims=True))
    share = np.full(n_levels, 1 / n_levels)
    _learn_shares(likelihood, share)
    least = np.log(likelihood @ share).sum() - _MISSED
    for faintest in range(1, n_levels - 1):
        simpler = share.copy()
        simpler[0], simpler[faintest] = share[0] + share[faintest], 0.0
        mixture = likelihood @ simpler
        if mixture.min() == 0 or np.log(mixture).sum() < least:
            break
        share = simpler
    return share


def _shares_and_depths(density: NDArray[np.float32], share: Floats) -> tuple[Floats, Floats]:
    """Shares of the levels and of the delays that make densities (pixel, level, bin) most likely.

    The first level, no echo, has the same density at all delays. Few steps, from delays that are
    all alike and smoothed each time, and a part of the pixels that stays so: pixels are too few to
    tell a share for each bin.
    """
    n_bins = density.shape[2]
    share, depth = share.copy(), np.full(n_bins, 1 / n_bins)
    _learn_shares_and_depths(density, share, depth)
    return share, depth * n_bins


def _gaussian(sigma: float) -> Floats:
    """Samples up to four sigmas from the centre, which add up to 1."""
    reach = round(4 * sigma)
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return np.asarray(weight / weight.sum())


_SMOOTHING = _gaussian(2.0)  # bins


# All steps in one: between numpy's the interpreter would go from thread to thread a thousand times.


@njit(**SUMMING)
def _learn_shares(likelihood, share):  # type: ignore[no-untyped-def]
    """Expectation and maximisation (Laird 1978) of the shares of levels, in place."""
    n_pixels, n_levels = likelihood.shape
    for _ in range(_STEPS):
        found = np.zeros(n_levels)
        found[0] = 1.0
        for pixel in range(n_pixels):
            mixture = 0.0
            for level in range(n_levels):
                mixture += share[level] * likelihood[pixel, level]
            for level in range(n_levels):
                found[level] += share[level] * likelihood[pixel, level] / mixture
        for level in range(n_levels):
            share[level] = found[level] / (n_pixels + 1)


@njit(**SUMMING)
def _learn_shares_and_depths(density, share, depth):  # type: ignore[no-untyped-def]
    """The same of the shares of levels and of the delays' probabilities, in place."""
    n_pixels, n_levels, n_bins = density.shape
    mass = np.empty(n_levels)
    for _ in range(_DEPTH_STEPS):
        likely = depth.astype(np.float32)
        found, reweighted = np.zeros(n_levels), np.zeros(n_bins, np.float32)
        found[0] = 1.0
        for pixel in range(n_pixels):
            mass[0] = share[0] * density[pixel, 0, 0]
            for level in range(1, n_levels):
                near = np.float32(0.0)
                for k in range(n_bins):
                    near += density[pixel, level, k] * likely[k]
                mass[level] = share[level] * near
            total = mass.sum()
            for level in range(n_levels):
                found[level] += mass[level] / total
            for level in range(1, n_levels):
                weight = np.float32(share[level] / total)
                for k in range(n_bins):
                    reweighted[k] += weight * density[pixel, level, k]
        for level in range(n_levels):
            share[level] = max(found[level] / (n_pixels + 1), 1e-12)  # never quite impossible
        smooth = _smoothed(depth * reweighted)
        whole = smooth.sum()
        if whole == 0:  # all pixels are beyond doubt without an echo
            break
        for k in range(n_bins):
            depth[k] = (1 - _ALIKE) * smooth[k] / whole + _ALIKE / n_bins


@njit(**COMPILED)
def _smoothed(density):  # type: ignore[no-untyped-def]
    """Convolved with a Gaussian of `_SMOOTHING`; beyond its ends a density stays as it is."""
    reach, last = _SMOOTHING.size // 2, density.size - 1
    smooth = np.zeros(density.size)
    for k in range(density.size):
        for j in range(_SMOOTHING.size):
            smooth[k] += _SMOOTHING[j] * density[min(max(k + j - reach, 0), last)]
    return smooth


@cached_per_capture
def posterior_of(capture: Capture) -> Posterior:
    """Where each pixel's surface may be, in the light of `flux_model_of`."""
    n_pixels, n_bins = capture.counts.size, capture.cube.shape[2]
    near, surface = np.empty((n_pixels, n_bins), np.float32), np.empty(n_pixels)
    for pixels, prepared in _groups(capture, flux_model_of(capture), 1):
        for some, density, top, _ in _densities(prepared):
            # What lies before each delay, from so many bins before the gate to so many behind it.
            before = np.zeros((len(top), n_bins + 2 * TOLERANCE_BINS + 1, top.shape[1]), np.float32)
            behind = TOLERANCE_BINS + n_bins
            np.cumsum(density, axis=1, out=before[:, TOLERANCE_BINS + 1 : behind + 1])
            everything = before[:, behind]
            before[:, behind + 1 :] = everything[:, np.newaxis]
            # In units of the larger of the two, so that neither overflows.
            unit = np.maximum(top, prepared.log_share[0])
            seen = np.exp(top - unit) * everything / n_bins
            present = seen / (seen + np.exp(prepared.log_share[0] - unit))
            mass = before[:, 2 * TOLERANCE_BINS : -1] - before[:, :n_bins]
            mass *= (present / everything)[:, np.newaxis].astype(np.float32)
            here = _pixels_of(some, prepared, pixels)
            size = here.stop - here.start
            near[here] = mass.transpose(0, 2, 1).reshape(-1, n_bins)[:size]
            surface[here] = present.ravel()[:size]
    return Posterior(near.reshape(capture.cube.shape), surface.reshape(capture.shape))


def has_posterior(capture: Capture) -> bool:
    """Return whether `posterior_of` has been computed."""
    return posterior_of.is_cached(capture)


def tolerance_probability(capture: Capture, bins: Floats) -> Floats:
    """Probability that the surface lies within `TOLERANCE_BINS` of a delay, shape (row, col).

    Parameters
    ----------
    capture : Capture
    bins : ndarray, shape (row, col)
        Delays in fractional bins, from 0 to n_bins; the probability is 0 where NaN.
    """
    table, found = posterior_of(capture).tolerance_probability, np.empty(bins.size)
    last = table.shape[2] - 1
    for begin in range(0, bins.size, _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        delay = bins.ravel()[some]
        at = np.clip(np.nan_to_num(delay), 0, last)
        below = np.minimum(at.astype(np.intp), max(last - 1, 0))
        above = np.minimum(below + 1, last)
        # By flat indices: those of `numpy.take_along_axis` cost more than all the rest.
        first = np.arange(begin, begin + at.size) * table.shape[2]
        low, high = table.take(first + below), table.take(first + above)
        between = low + (at - below) * (high - low)
        found[some] = np.where(np.isnan(delay), 0.0, np.clip(between, 0.0, 1.0))
    return found.reshape(bins.shape)


def most_likely(capture: Capture, flux: FluxModel, steps_per_bin: int) -> tuple[Floats, Floats]:
    """The delay of the largest posterior density.

    Returns
    -------
    delay_bin : ndarray, shape (row, col)
        In fractional bins, refined between the steps by a parabola through the density's logarithm.
    score : ndarray, shape (row, col)
        Logarithm of its likelihood over that of no echo.
    """
    delay, score = np.empty((2, capture.counts.size))
    for pixels, prepared in _groups(capture, flux, steps_per_bin):
        for some, curve, weighted in _curves(prepared):
            at = curve.argmax(axis=1)[:, np.newaxis]
            last = curve.shape[1] - 1
            around = np.concatenate([np.maximum(at - 1, 0), at, np.minimum(at + 1, last)], axis=1)
            # Not of the density: beside an echo of many photons that is 0, and has no logarithm.
            log = np.take_along_axis(weighted, around[:, np.newaxis], axis=2).astype(float)
            log = np.logaddexp.reduce(log, axis=1) + np.log(prepared.depth[around])
            left, middle, right = log.transpose(1, 0, 2)
            curvature = np.minimum(left - 2 * middle + right, -1e-9)
            inside = (at[:, 0] > 0) & (at[:, 0] < last)
            shift = np.where(inside, np.clip(0.5 * (left - right) / curvature, -0.5, 0.5), 0.0)
            here = _pixels_of(some, prepared, pixels)
            size = here.stop - here.start
            delay[here] = ((at[:, 0] + 0.5 + shift) / steps_per_bin).ravel()[:size]
            score[here] = middle.ravel()[:size]
    return delay.reshape(capture.shape), score.reshape(capture.shape)


def rate_and_n_armed(histogram: Floats, n_pulses: int | None) -> tuple[Floats, Floats]:
    """Rate of each bin with the pile-up undone (Coates 1968), and the pulses that tell of it.

    Parameters
    ----------
    histogram : ndarray, shape (..., bin)
        Counts, or expected counts.
    n_pulses : int or None
        Pulses sent; None where that is not known, or where a pulse fires more than once.

    Returns
    -------
    rate : ndarray, shape (..., bin)
        Detections per pulse were the detector always armed. A bin in which every armed pulse fired
        counts half a pulse less, so that its rate is finite; those behind it count 0. The counts
        themselves where `n_pulses` is None.
    armed : ndarray, shape (..., bin)
        Pulses armed before each bin; 1 everywhere where `n_pulses` is None.
    """
    if n_pulses is None:
        return histogram, np.ones_like(histogram)
    armed = n_pulses - np.cumsum(histogram, axis=-1) + histogram
    fired = np.divide(histogram, armed, out=np.zeros_like(histogram), where=armed > 0)
    most = 1 - 0.5 / np.maximum(armed, 1.0)
    return np.asarray(-np.log1p(-np.minimum(fired, most))), np.maximum(armed, 0.0)


_DARKEST = 1e-100  # photons: with none at all one count would outweigh every other, without end


def log_likelihood_ratio(histogram: Floats, conditions: Conditions) -> Floats:
    """``T(d)`` of the module's docstring at each bin's beginning, as written.

    Parameters
    ----------
    histogram : ndarray, shape (..., bin)
    conditions : Conditions

    Returns
    -------
    ndarray, shape (..., bin)
    """
    acquisition, n_pulses = conditions.acquisition, conditions.n_pulses
    n_bins = acquisition.n_bins
    # An echo at whole bins is one filter: its share in the bin that lies `step` behind the delay.
    echo = conditions.pulse.bin_probability(n_bins - 1.0, 2 * n_bins - 1, acquisition.bin_width_s)
    b = np.maximum(conditions.background, _DARKEST)[..., np.newaxis] / n_bins
    unfired = np.ones_like(histogram)
    if n_pulses is not None:
        unfired = n_pulses - np.cumsum(histogram, axis=-1)
    ratio = np.zeros_like(histogram)
    for at in np.flatnonzero(echo):
        s, step = np.asarray(conditions.signal)[..., np.newaxis] * echo[at], int(at) - n_bins + 1
        gain = np.log1p(s / b) if n_pulses is None else np.log(np.expm1(-(b + s)) / np.expm1(-b))
        delay = slice(max(-step, 0), n_bins - max(step, 0))
        met = slice(max(step, 0), n_bins - max(-step, 0))
        ratio[..., delay] += gain * histogram[..., met] - s * unfired[..., met]
    return ratio


class _Prepared(NamedTuple):
    """A cube and its light, as the kernels take them."""

    counts: NDArray[np.unsignedinteger]
    """Shape (block, bin, lane): `LANES` lanes, fewer where a table of all delays would be large."""
    signal: Floats
    """Shape (level, block, lane)."""
    background: Floats
    log_share: Floats
    depth: NDArray[np.float32]
    """`FluxModel.depth`, shape (delay,)."""
    echo: NDArray[np.float32]
    """Share of an echo's photons per bin, shape (step, tap)."""
    first_tap: int
    """Bins from a delay to its echo's first tap."""
    n_pulses: int
    """0 where not known."""
    n_pixels: int
    n_counts: int
    """Number of counts in the whole cube that these pixels are a part of."""


def _prepare(
    capture: Capture, cube: NDArray[np.unsignedinteger], flux: FluxModel, steps_per_bin: int
) -> _Prepared:
    """Pixels (row, col, bin) and their light, all at once."""
    lanes = lanes_of(flux.share.size, cube.shape[2] * steps_per_bin)
    flat = cube.reshape(-1, cube.shape[2])
    everyone = _Part(lane_counts(flat, lanes), slice(0, len(flat)), cube.size)
    return _with_echo(capture, everyone, flux, steps_per_bin)


def _groups(
    capture: Capture, flux: FluxModel, steps_per_bin: int
) -> Iterator[tuple[slice, _Prepared]]:
    """All pixels of a capture and their light, so many at a time as keep what is laid out small.

    Yields
    ------
    pixels : slice
        Flat indices.
    prepared : _Prepared
    """
    n_levels, n_pixels, n_bins = flux.share.size, capture.counts.size, capture.cube.shape[2]
    lanes = lanes_of(n_levels, n_bins * steps_per_bin)
    at_once = lanes * max(1, _FLUX_NUMBERS // (n_levels * lanes))
    if lanes < LANES:
        at_once = lanes * max(1, _TABLE_NUMBERS // (n_bins * lanes))
    flat = capture.cube.reshape(-1, n_bins)
    for first in range(0, n_pixels, at_once):
        some = slice(first, min(first + at_once, n_pixels))
        if lanes < LANES:
            counts = lane_counts(flat[some], lanes)
        else:
            counts = capture.blocks.counts[first // LANES : -(-some.stop // LANES)]
        part = _Part(counts, some, capture.cube.size)
        yield some, _with_echo(capture, part, flux, steps_per_bin)


def sampled_numbers(n_levels: int, n_bins: int) -> int:
    """Largest table of levels and delays that is held of a sample of the pixels, in numbers."""
    return max(_SAMPLE_NUMBERS, n_levels * n_bins)


def lanes_of(n_levels: int, n_delays: int) -> int:
    """Pixels treated together, so that a table of their levels and delays stays small."""
    lanes = LANES
    while lanes > _FEWEST_LANES and n_levels * n_delays * lanes > _TABLE_NUMBERS:
        lanes //= 2
    return lanes


def _pixels_of(blocks: slice, prepared: _Prepared, pixels: slice) -> slice:
    """Which of the image's pixels some blocks of a group hold."""
    lanes, first = prepared.counts.shape[2], pixels.start
    return slice(first + blocks.start * lanes, min(first + blocks.stop * lanes, pixels.stop))


class _Part(NamedTuple):
    """Some pixels of an image, laid out."""

    counts: NDArray[np.unsignedinteger]
    """As `_Prepared.counts`."""
    pixels: slice
    """Their flat indices in the image."""
    of_counts: int
    """Counts of the whole image."""


def _with_echo(capture: Capture, part: _Part, flux: FluxModel, steps_per_bin: int) -> _Prepared:
    """A part of an image with its light, that of the image being given."""
    acquisition, lanes = capture.acquisition, part.counts.shape[2]
    # Delays stand for the step around them, so that whole steps fill the gate and any whole bins.
    delay = (np.arange(steps_per_bin) + 0.5) / steps_per_bin
    echo, first = capture.pulse.taps(acquisition.n_bins, acquisition.bin_width_s, delay)
    log_share = np.log(np.maximum(flux.share, np.finfo(float).tiny))
    return _Prepared(
        part.counts,
        _in_lanes(flux.signal, part.pixels, lanes),
        _in_lanes(flux.background, part.pixels, lanes),
        log_share,
        np.repeat(flux.depth, steps_per_bin).astype(np.float32),
        echo.astype(np.float32),
        first,
        capture.gated_pulses or 0,
        part.pixels.stop - part.pixels.start,
        part.of_counts,
    )


def _in_lanes(image: Floats, pixels: slice, lanes: int) -> Floats:
    """Some of (level, row, col) as (level, block, lane); the last block repeats its last pixel."""
    flat = image.reshape(len(image), -1)[:, pixels]
    filled = np.pad(flat, ((0, 0), (0, -flat.shape[1] % lanes)), mode="edge")
    return np.ascontiguousarray(filled.reshape(len(image), -1, lanes))


def _level_evidence(prepared: _Prepared, depth: NDArray[np.float32] | float = 1.0) -> Floats:
    """Log likelihood of each level over that of no echo, (pixel, level).

    How much more often a delay occurs than others is `depth`, of shape (delay, 1).
    """
    n_levels, n_blocks, lanes = prepared.signal.shape
    evidence = np.empty((n_blocks, lanes, n_levels))
    # Some levels at a time, each with the first one, which the others are compared with.
    table = prepared.depth.size * lanes
    at_once = max(1, _TABLE_NUMBERS // table - 1)
    evidence[..., 0] = 0.0
    for first in range(1, n_levels, at_once):
        levels = [0, *range(first, min(first + at_once, n_levels))]
        few = prepared
        if len(levels) < n_levels:
            few = prepared._replace(
                signal=prepared.signal[levels], background=prepared.background[levels]
            )
        for some, log in _log_likelihoods(few):
            top = log.max(axis=2)
            np.subtract(log, top[:, :, np.newaxis], out=log)
            density = np.exp(log, out=log)
            density *= depth
            mean = density.mean(axis=2)
            evidence[some, :, levels] = (top + np.log(mean)).transpose(0, 2, 1)
    return evidence.reshape(-1, n_levels)[: prepared.n_pixels]


def _level_densities(prepared: _Prepared) -> NDArray[np.float32]:
    """Likelihood of each level and delay over the pixel's largest; (pixel, level, delay)."""
    n_levels, n_blocks, lanes = prepared.signal.shape
    n_copied = n_blocks if n_blocks > 1 else 0
    densities = np.empty((n_copied, lanes, n_levels, prepared.depth.size), np.float32)
    for some, log in _log_likelihoods(prepared):
        np.subtract(log, log.max(axis=(1, 2), keepdims=True), out=log)
        density = np.exp(log, out=log).transpose(0, 3, 1, 2)
        if n_blocks == 1:
            densities = density  # as it lies: a copy would take as much again
        else:
            densities[some] = density
    return densities.reshape(-1, *densities.shape[2:])[: prepared.n_pixels]


def _densities(
    prepared: _Prepared,
) -> Iterator[tuple[slice, NDArray[np.float32], Floats, NDArray[np.float32]]]:
    """Likelihood of each delay over that of no echo, all levels of signal weighted.

    Yields
    ------
    blocks : slice
    density : ndarray, shape (block, delay, lane)
        In units of ``exp(top)``.
    top : ndarray, shape (block, lane)
    weighted : ndarray, shape (block, level, delay, lane)
        Logarithms that the density is made of, level by level, `FluxModel.depth` left out.
    """
    weight = prepared.log_share[1:, np.newaxis, np.newaxis].astype(np.float32)
    for some, log in _log_likelihoods(prepared):
        weighted = np.add(log[:, 1:], weight, out=log[:, 1:])
        top = weighted.max(axis=(1, 2), keepdims=True)
        part = weighted - top
        density = np.exp(part, out=part).sum(axis=1)
        density *= prepared.depth[:, np.newaxis]
        yield some, density, top[:, 0, 0].astype(float), weighted


def _curves(
    prepared: _Prepared,
) -> Iterator[tuple[slice, NDArray[np.float32], NDArray[np.float32]]]:
    """A curve that is highest where the density of `_densities` is, and what that is made of.

    Of one level there is nothing to average: its logarithms do, and exponentials are what costs.
    """
    if len(prepared.signal) > 2:
        for some, density, _, weighted in _densities(prepared):
            yield some, density, weighted
        return
    depth = np.log(prepared.depth)[:, np.newaxis]
    for some, log in _log_likelihoods(prepared):
        weighted = log[:, 1:] + np.float32(prepared.log_share[1])
        yield some, weighted[:, 0] + depth, weighted


def _log_likelihoods(prepared: _Prepared) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Log likelihood of each level and delay over that of no echo, some blocks at a time.

    Yields
    ------
    blocks : slice
    log : ndarray, shape (block, level, delay, lane)
    """
    n_levels, n_blocks, lanes = prepared.signal.shape
    n_delays = prepared.counts.shape[1] * prepared.echo.shape[0]
    at_once = max(1, _AT_ONCE // (n_levels * n_delays * lanes))
    for first in range(0, n_blocks, at_once):
        some = slice(first, min(first + at_once, n_blocks))
        log = np.empty((some.stop - first, n_levels, n_delays, lanes), np.float32)
        with entering(prepared.n_counts):
            _fill_blocks(first, prepared, log)
        yield some, log


_AT_ONCE = 2**19  # numbers: what is made of them should find them in the cache


@njit(**COMPILED)
def _fill_reach(b, prepared, fired, unfired, reach):  # type: ignore[no-untyped-def]
    """Counts and unfired pulses of a block as float32, and Σ_k (A_k - n_k) p_k(d) of each delay."""
    n_bins, lanes = fired.shape
    n_steps, n_taps = prepared.echo.shape
    armed = np.full(lanes, float(prepared.n_pulses))
    for k in range(n_bins):
        for i in range(lanes):
            count = prepared.counts[b, k, i]
            armed[i] -= count
            fired[k, i] = count
            unfired[k, i] = armed[i] if prepared.n_pulses > 0 else 1.0
    for d in range(n_bins * n_steps):
        step, first = d % n_steps, d // n_steps + prepared.first_tap
        reach[d, :] = 0.0
        for tap in range(max(0, -first), min(n_taps, n_bins - first)):
            p = prepared.echo[step, tap]
            for i in range(lanes):
                reach[d, i] += p * unfired[first + tap, i]


@njit(**COMPILED)
def _fill_level(b, level, prepared, fired, reach, gain, ratio):  # type: ignore[no-untyped-def]
    """T(d) of one level into `ratio`, (delay, lane)."""
    n_bins, lanes = fired.shape
    n_steps, n_taps = prepared.echo.shape
    previous_signal, previous_background = 0.0, 0.0
    for i in range(lanes):
        signal = prepared.signal[level, b, i]
        background = prepared.background[level, b, i] / n_bins
        if i > 0 and signal == previous_signal and background == previous_background:
            for step in range(n_steps):  # logarithms are what costs, and neighbours are alike
                for tap in range(n_taps):
                    gain[step, tap, i] = gain[step, tap, i - 1]
            continue
        previous_signal, previous_background = signal, background
        bare = -math.expm1(-background)
        for step in range(n_steps):
            for tap in range(n_taps):
                s = signal * prepared.echo[step, tap]
                if prepared.n_pulses > 0:
                    # 1 - exp(-b - s) is what no echo gives, and what it leaves times 1 - exp(-s).
                    odds = 1.0 - math.expm1(-s) * (1.0 - bare) / bare
                    gain[step, tap, i] = math.log(odds)
                else:
                    gain[step, tap, i] = math.log1p(s / background)
    for d in range(n_bins * n_steps):
        step, first = d % n_steps, d // n_steps + prepared.first_tap
        for i in range(lanes):
            ratio[d, i] = -np.float32(prepared.signal[level, b, i]) * reach[d, i]
        for tap in range(max(0, -first), min(n_taps, n_bins - first)):
            for i in range(lanes):
                ratio[d, i] += gain[step, tap, i] * fired[first + tap, i]


@njit(**COMPILED)
def _flat_likelihood(b, level, prepared, fired, unfired, flat):  # type: ignore[no-untyped-def]
    """Log likelihood of the level's background alone, over that of the first level's.

    `fired` and `unfired` are summed over the bins here.
    """
    n_bins, lanes = prepared.counts.shape[1:]
    for i in range(lanes):
        here = prepared.background[level, b, i] / n_bins
        bare = prepared.background[0, b, i] / n_bins
        odds = math.expm1(-here) / math.expm1(-bare) if prepared.n_pulses > 0 else here / bare
        flat[i] = fired[i] * math.log(odds) - unfired[i] * (here - bare)


@njit(**COMPILED)
def _fill_block(b, prepared, log):  # type: ignore[no-untyped-def]
    """Log likelihood of each level and delay over that of no echo; (level, delay, lane)."""
    n_levels, n_delays, lanes = log.shape
    n_bins = prepared.counts.shape[1]
    n_steps, n_taps = prepared.echo.shape
    # On cache lines' boundaries: vectors that straddle them cost twice.
    fired = lane_rows(n_bins, lanes).reshape(n_bins, lanes)
    unfired = lane_rows(n_bins, lanes).reshape(n_bins, lanes)
    reach = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    ratio = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    gain = lane_rows(n_steps * n_taps, lanes).reshape(n_steps, n_taps, lanes)
    all_fired, all_unfired, flat = np.zeros((3, lanes))
    _fill_reach(b, prepared, fired, unfired, reach)
    for k in range(n_bins):
        for i in range(lanes):
            all_fired[i] += fired[k, i]
            all_unfired[i] += unfired[k, i]
    log[0] = 0.0
    for level in range(1, n_levels):
        _fill_level(b, level, prepared, fired, reach, gain, ratio)
        _flat_likelihood(b, level, prepared, all_fired, all_unfired, flat)
        for d in range(n_delays):
            for i in range(lanes):
                log[level, d, i] = ratio[d, i] + np.float32(flat[i])


@njit(**PARALLEL)
def _fill_blocks(first, prepared, log):  # type: ignore[no-untyped-def]
    for b in prange(log.shape[0]):
        _fill_block(first + b, prepared, log[b])
