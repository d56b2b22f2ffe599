"""Estimation of signal levels and background from the pixels of a capture.

The distribution of signal levels is estimated from a sample of the pixels (nonparametric maximum
likelihood of a mixing distribution, Kiefer & Wolfowitz 1956, on a grid of levels that includes "no
echo"), and so is the distribution of delays. The background of a pixel is what a signal level
leaves of its total rate.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.flux_model import FluxModel, FluxPrior
from core.inference.likelihood import (
    level_densities,
    level_evidence,
    prepare,
    rate_and_n_armed,
    sampled_numbers,
)
from core.inference.neighbours import weighted_median
from core.inference.resolution import FEW, Difference, difference, pile_up
from core.kernels.posterior import learn_shares, learn_shares_and_depths
from core.trigger import rate_per_bin, trigger_probability

_AT_ONCE = 2**19  # numbers: what is made of them should find them in the cache
LEVELS = 12  # of signal, besides none
SAMPLE = 512  # pixels from which the light is estimated
_SPREAD = 200.0  # the strongest level over the faintest
_MISSED = 2.0  # log likelihood that faint levels must be worth to be kept
_TOO_FEW = 3  # unfired pulses, of which the logarithm is chance
_RARE = 1e-3  # levels with a smaller share are left out


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
        own_weight=_own_weight(total, chance),
    )
    lit = guess.model(total.ravel()[pixels], least)
    share = _shares(level_evidence(prepare(capture, flat[pixels], lit, 1)))
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
        own_weight=_own_weight(total, chance + variance),
    )
    # Delays take a table of all levels of the sample: in a long gate, of fewer pixels.
    each = found.share.size * flat.shape[1]
    most = sampled_numbers(found.share.size, flat.shape[1]) // each
    pixels = np.sort(drawn[:most])[np.newaxis]
    lit = found.model(total.ravel()[pixels], least)
    prepared = prepare(capture, flat[pixels], lit, 1)
    share, depth = _shares_and_depths(level_densities(prepared), found.share)
    found = found._replace(share=share, depth=depth)
    return found._replace(contrast=found.model(total, least).contrast)


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
    prepared = prepare(capture, cube, flux, steps_per_bin)
    evidence = level_evidence(prepared, prepared.depth[:, np.newaxis])
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
    return np.asarray(median * pixels.shape[1])


def _some_rows(pixels: NDArray[Any]) -> Iterator[slice]:
    """Pixels (pixel, bin) a few at a time, so that temporaries stay small."""
    at_once = max(1, _AT_ONCE // pixels.shape[1])
    for first in range(0, len(pixels), at_once):
        yield slice(first, first + at_once)


def _own_weight(total: Floats, unrelated: float) -> float:
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
    learn_shares(likelihood, share)
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
    learn_shares_and_depths(density, share, depth)
    return share, depth * n_bins
