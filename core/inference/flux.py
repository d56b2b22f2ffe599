"""Estimation of signal levels and background from the pixels of a capture.

The distributions of signal levels and of delays are estimated from a sample of the pixels
(nonparametric maximum likelihood of a mixing distribution, Kiefer & Wolfowitz 1956, on a grid of
levels that includes "no echo"). The background of a pixel is its total rate minus the signal level.

Signals are alike over the image, or in proportion to the backgrounds of the pixels, whichever is
likelier: a surface that reflects less of the pulse often reflects less of the sunlight, too.

At a low SBR single pixels hardly show their level, and a signal that is not found raises the
background, which hides it further. Then the distribution of delays, which many pixels show
together, is estimated for each level, and the likeliest level is tried as that of all echoes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import LONGEST_S, Floats
from core.capture import Capture, cached_per_capture
from core.inference.background import (
    echo_free,
    echo_window,
    fitted_shape,
    mean_background,
    nodes_of,
)
from core.inference.flux_model import LEAST_BRIGHTNESS, FluxModel, FluxPrior, Totals
from core.inference.likelihood import (
    level_densities,
    level_evidence,
    prepare,
    rate_and_n_armed,
    sampled_numbers,
    sums_before,
    windowed_sums,
)
from core.inference.neighbours import weighted_median
from core.inference.resolution import FEW, Difference, difference, pile_up
from core.kernels.posterior import learn_shares, learn_shares_and_depths
from core.trigger import rate_per_bin, trigger_probability

_AT_ONCE = 2**19  # numbers that fit in the cache
LEVELS = 12  # of signal, without "no echo"
SAMPLE = 512  # pixels from which the levels of signal are estimated
DEPTH_SAMPLE = 1024  # pixels from which the distribution of delays is estimated
_MORE = 2  # times as many pixels, once the signal levels are known
_DEPTH_STEPS = 60  # of expectation and maximisation
_LAST_DEPTH_STEPS = 30  # likewise, from a distribution that is already found
LEVEL_SPAN = 200.0  # ratio of the strongest level to the faintest
_LEAST_GAIN = 2.0  # in log likelihood, for which faint levels are kept
_CLEAR = 1.0  # mean gain in log likelihood of pixels that show their signal levels one by one
_MOST_OF_SCATTER = 0.5  # of the totals, due to backgrounds, for signals in proportion to them
_LEAST_GAIN_IN_PROPORTION = 10.0  # of all pixels, for signals in proportion to backgrounds
_LEAST_JOINT_GAIN = 15.0  # of all pixels; without echoes it was at most 9 in 96 captures
_TOO_FEW = 3  # unfired pulses, whose logarithm is unreliable
_MARGIN = 5  # times as many, which chance may leave instead
_COUNTS_IN_PART, _FEWEST_PARTS = 3, 7  # of the gate, whose median rate is that of the background
_CLEARLY_MORE = 2.0  # standard deviations of a total above the background, for which an echo fired
_VARIANCE_OF_MEDIAN = math.pi / 2  # relative to that of the mean of a Gaussian
_MANY_SPENT = 0.01  # share of the pixels with so few of them, which biases the mean total
_SHAPE_ROUNDS = 4  # of the estimation of a background that varies over the gate
_FEWEST_OF_SHAPE = 24  # pixels; in fewer, other surfaces might be taken for background
_MOST_AT_ECHOES = 1.5  # of the mean background; with more, one may be taken for the other
_MOST_RISE = 1.1  # of that from the first round to the last; up to 1.02 if it is background
_LONGER = 3.0, 6.0  # times the pulse, with which echoes may explain a shape of the background
_RARE = 1e-3  # levels with a smaller share are left out
_TINY = 1e-30  # likelihood of a level relative to the likeliest, whose logarithm is finite


@cached_per_capture
def flux_model_of(capture: Capture) -> FluxModel:
    """Estimate signal levels, their shares, and the background of each pixel of a capture."""
    return flux_model_with(capture, flux_prior_of(capture))


def flux_model_with(capture: Capture, flux_prior: FluxPrior) -> FluxModel:
    """Return the flux model of a capture with flux parameters from elsewhere."""
    return flux_prior.model(_totals(capture).of, _least_background(capture))


def _model_of_pixels(
    capture: Capture, flux_prior: FluxPrior, pixels: NDArray[np.intp], least_background: float
) -> FluxModel:
    """Return the fluxes of pixels, given as flat indices, in one row."""
    return flux_prior.model(_totals(capture).of.of_pixels(pixels), least_background)


@cached_per_capture
def flux_prior_of(capture: Capture) -> FluxPrior:
    """Estimate the flux parameters that the pixels share, in the simplest sufficient model.

    Pile-up that the pulses do not resolve is neglected (`core.inference.resolution`). If the pulses
    of a pixel do not resolve the signal levels, their mean is used for all: the levels then order
    delays nearly alike. Returns `Capture.flux_prior` if it is given.
    """
    if capture.flux_prior is not None:
        return capture.flux_prior
    return _simplified(detailed_flux_prior_of(capture), capture)


def flux_prior_over(capture: Capture, background_shape: Floats | None) -> FluxPrior:
    """Estimate `flux_prior_of` over a background of known shape, uniform if None."""
    return _simplified(detailed_flux_prior_over(capture, background_shape), capture)


def detailed_flux_prior_over(capture: Capture, background_shape: Floats | None) -> FluxPrior:
    """Estimate `detailed_flux_prior_of` over a background of known shape, uniform if None."""
    return _flux_prior(capture, background_shape)[0]


def _simplified(found: FluxPrior, capture: Capture) -> FluxPrior:
    """Leave out of a detailed prior what the pulses of the capture do not resolve.

    Then the share of no echo and the distribution of delays are estimated for the levels that are
    left: echoes of the grid on which these were found explain too many pixels without one.
    """
    n_pulses = capture.gated_pulses
    if n_pulses is not None:
        # The more pulses fire, the clearer it is: of all but a few pixels, where most fire.
        n_few = math.floor(FEW * capture.counts.size)
        most = np.partition(capture.counts, -1 - n_few, axis=None)[-1 - n_few]
        found = found._replace(pile_up=not pile_up(most / n_pulses, n_pulses).is_hidden)
    is_resolved = level_differences(found, capture).is_resolved
    if found.share[1:] @ is_resolved <= FEW:
        found = found.with_one_level()
    _, density = _sampled_densities(capture, found, _MORE * DEPTH_SAMPLE)
    share, depth = shares_and_depths(density, found.share, found.depth, _LAST_DEPTH_STEPS)
    return found._replace(share=share, depth=depth)


@cached_per_capture
def detailed_flux_prior_of(capture: Capture) -> FluxPrior:
    """Estimate `flux_prior_of` with all signal levels that the pixels together resolve.

    The background is uniform over the gate unless bins without echoes contradict that. Then its
    shape and the other parameters are estimated in turn (`core.inference.background`).

    A shape that is large at the echoes raises two doubts. Echoes over a uniform background may be
    found where the background is in fact larger, which hides its shape there. The estimation then
    also starts from the shape of all photons, and the likelier start is continued. On the other
    hand, the shape may consist of photons of echoes that are longer than the pulse. Then longer
    echoes over a uniform background are likelier, or the shape rises at the echoes from round to
    round: echoes over a larger background explain fewer photons. A background does not depend on
    the one that is assumed.
    """
    uniform, shapes = _flux_prior(capture, None)
    if not shapes:
        return uniform
    first = shapes[0]
    if len(shapes) == 1:
        found, shapes = _flux_prior(capture, first)
    else:
        starts = [_flux_prior(capture, shape) for shape in shapes]
        likelihoods = [_log_likelihood(capture, start) for start, _ in starts]
        if max(likelihoods) < _of_longer_echoes(capture):
            return uniform
        found, shapes = starts[int(np.argmax(likelihoods))]
    for _ in range(_SHAPE_ROUNDS - 1):
        if not shapes:
            return uniform
        found, shapes = _flux_prior(capture, shapes[0])
    at_echoes = _at_echoes(found.relative_background, found)
    has_risen = at_echoes > _MOST_RISE * _at_echoes(first, found)
    is_of_echoes = at_echoes > _MOST_AT_ECHOES and has_risen
    return uniform if is_of_echoes else found


def _of_longer_echoes(capture: Capture) -> float:
    """Largest `_log_likelihood` of echoes longer than the pulse over a uniform background."""
    pulse, likelihoods = capture.pulse, []
    longest_s = LONGEST_S / max(len(pulse.samples), 1)
    for stretch in _LONGER:
        longer = replace(pulse, tau_s=min(stretch * pulse.tau_s, longest_s))
        as_if = replace(capture, pulse=longer)
        likelihoods.append(_log_likelihood(as_if, _flux_prior(as_if, None)[0]))
    return max(likelihoods)


def _at_echoes(shape: Floats, flux_prior: FluxPrior) -> float:
    """Mean of a background shape over the delays of echoes."""
    return float(np.average(shape, weights=flux_prior.depth))


_Shapes = tuple[Floats, ...]
"""Background shapes to try, the one to doubt least first; none if it is uniform."""


class _Background(NamedTuple):
    """Background in bins without an echo."""

    mean: float
    """Photons per pulse over the gate; NaN if no bin is free of echoes."""
    shapes: _Shapes


def _background(
    capture: Capture, known: FluxPrior, pixels: NDArray[np.intp], density: NDArray[np.float32]
) -> _Background:
    """Estimate the background from pixels, given as flat indices.

    `density` is that of `level_densities`.
    """
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    flux = _model_of_pixels(capture, known, pixels, _least_background(capture))
    seen = capture.cube.reshape(-1, n_bins)[pixels], n_pulses, echo_window(capture)
    guess, background = known.relative_background, flux.background[:, 0].T
    free = echo_free(density, known.share[:, np.newaxis] * known.depth, background, *seen, guess)
    mean = mean_background(free, n_pulses is not None, guess)
    shape = fitted_shape(free, capture) if pixels.size >= _FEWEST_OF_SHAPE else None
    if shape is None:
        return _Background(mean, ())
    if known.background_shape is not None or _at_echoes(shape, known) <= _MOST_AT_ECHOES:
        return _Background(mean, (shape,))
    alone = np.ones((pixels.size, 1, n_bins), np.float32)
    everything = echo_free(alone, np.ones((1, n_bins)), background[:, :1], *seen, guess)
    other = fitted_shape(everything, capture)
    return _Background(mean, (shape,) if other is None else (shape, other))


def _flux_prior(capture: Capture, shape: Floats | None) -> tuple[FluxPrior, _Shapes]:
    """Estimate `detailed_flux_prior_of` with a shape of the background, and better shapes.

    Where pixels differ in their backgrounds, signals may be in proportion to them.
    """
    alike = _estimated(capture, shape, in_proportion=False)
    if alike[0].own_weight < _MOST_OF_SCATTER:
        return alike
    proportional = _estimated(capture, shape, in_proportion=True)
    if proportional[0].own_weight == 0:
        return alike
    gain = _log_likelihood(capture, proportional[0], with_totals=True)
    gain -= _log_likelihood(capture, alike[0], with_totals=True)
    return proportional if gain > _LEAST_GAIN_IN_PROPORTION else alike


def _estimated(
    capture: Capture, shape: Floats | None, in_proportion: bool
) -> tuple[FluxPrior, _Shapes]:
    """Estimate `_flux_prior` with signals that depend on the totals of pixels, or do not.

    The total rate of a pixel (Coates 1968) is signal plus background. The total minus a signal
    level is shrunk towards the mean background of the image as far as its scatter is explained by
    chance (James & Stein 1961, with the variance of Greenwood 1926). If all pixels see the same
    background, all get the same value. Where all pulses fire, only the background of a pixel is
    known (`_background_of`), from which no signal is subtracted.
    """
    totals, chance, _ = _totals(capture)
    total, signal_share = totals.rate, totals.signal_share(in_proportion)
    flat = capture.cube.reshape(total.size, -1)
    pixels, least = _sampled(total.size, SAMPLE), _least_background(capture)
    levels = _levels(pixels, capture, shape, in_proportion)
    # Initially each level is the signal of all pixels; a few pixels show how many have it.
    found = FluxPrior(
        levels,
        share=np.full(levels.size, 1 / levels.size),
        depth=np.ones(flat.shape[1]),
        background=total.mean() - signal_share * levels[:, np.newaxis, np.newaxis],
        own_weight=_own_weight(total, chance),
        background_shape=shape,
        is_in_proportion=in_proportion,
    )
    start, squared = found, 1.0
    if in_proportion:
        squared = float((np.maximum(total / total.mean(), LEAST_BRIGHTNESS) ** 2).mean())
    for some in (_sampled(total.size, SAMPLE // 4), pixels):
        flux = _model_of_pixels(capture, found, some, least)
        evidence = level_evidence(prepare(capture, flat[np.newaxis, some], flux, 1))
        levels_of = _relative(evidence)
        share = level_shares(levels_of.likelihood)
        mean = np.asarray(share @ levels)
        variance = float(share @ (levels - mean) ** 2) * squared
        found = found._replace(
            background=total.ravel()[some].mean() - signal_share * mean,
            own_weight=_own_weight(total, chance + variance),
        )
    prior, shapes = _completed(capture, found, share)
    if _mean_log_likelihood(levels_of, share) < _CLEAR:
        other, other_shapes = _completed(capture, found, _shares_of_one_level(capture, start))
        gain = _log_likelihood(capture, other) - _log_likelihood(capture, prior)
        if gain > _LEAST_JOINT_GAIN:
            return other, other_shapes
    return prior, shapes


def _completed(capture: Capture, found: FluxPrior, share: Floats) -> tuple[FluxPrior, _Shapes]:
    """Return `_flux_prior`, given the shares of the coarse grid of levels that `found` has."""
    totals = _totals(capture).of
    total, signal_share = totals.rate, totals.signal_share(found.is_in_proportion)
    mean = signal_share * (share @ found.levels)
    levels, share, pair = _halved(found.levels, share, _kept(share))
    found = found._replace(levels=levels, share=share, background=total.mean() - mean)
    found, density, free = _with_depths(capture, found)
    if found.background < mean and free.mean < total.mean():
        # A small difference of large numbers: pixels without an echo seem to have a faint one.
        found, density, free = _with_depths(
            capture, found._replace(background=np.asarray(free.mean))
        )
    # Given the delays, and one background for all levels, faint levels are less plausible.
    likelihood = _evidence(density, found.depth).likelihood
    share = level_shares(likelihood)
    learn_shares(likelihood, share)  # of the levels that are left
    levels, share = _joined(found.levels, share, pair)
    kept = _kept(share)
    levels, share = levels[kept], share[kept] / share[kept].sum()
    background = float(total.mean() - signal_share * (share @ levels))
    is_biased = has_many_spent(capture) and found.own_weight == 0
    if is_biased and math.isfinite(free.mean):
        background = free.mean
    elif background < share @ levels and free.mean < total.mean():
        # A small difference of large numbers, while the echoes stand out clearly.
        background = free.mean
        levels = levels * ((total.mean() - background) / (share @ levels))
    found = found._replace(levels=levels, share=share, background=np.asarray(background))
    contrast = flux_model_with(capture, found).contrast
    return found._replace(contrast=contrast), free.shapes


def _with_depths(
    capture: Capture, known: FluxPrior
) -> tuple[FluxPrior, NDArray[np.float32], _Background]:
    """Estimate the delays of a sample; return the prior with them, its densities and background."""
    pixels, density = _sampled_densities(capture, known, DEPTH_SAMPLE)
    share, depth = shares_and_depths(density, known.share)
    found = known._replace(share=share, depth=depth)
    return found, density, _background(capture, found, pixels, density)


def _sampled_densities(
    capture: Capture, flux_prior: FluxPrior, n_pixels: int
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Return the flat indices of a sample of `n_pixels`, or fewer, and their `level_densities`."""
    n_bins = capture.acquisition.n_bins
    # A table of all levels and delays: fewer pixels in a long gate.
    n_levels = flux_prior.share.size
    most = sampled_numbers(n_levels, n_bins) // (n_levels * n_bins)
    pixels = _sampled(capture.counts.size, min(most, n_pixels))
    flux = _model_of_pixels(capture, flux_prior, pixels, _least_background(capture))
    cube = capture.cube.reshape(-1, n_bins)[np.newaxis, pixels]
    return pixels, level_densities(prepare(capture, cube, flux, 1))


class _Evidence(NamedTuple):
    """Likelihood of the signal levels of pixels."""

    likelihood: Floats
    """Relative to the likeliest level of the pixel, shape (pixel, level)."""
    highest: Floats
    """Logarithm of that of the likeliest level, shape (pixel,)."""


def _relative(log: Floats) -> _Evidence:
    """Return the evidence of log likelihoods (pixel, level)."""
    highest = log.max(axis=1)
    return _Evidence(np.asarray(np.exp(log - highest[:, np.newaxis])), highest)


def _evidence(density: NDArray[np.float32], depth: Floats) -> _Evidence:
    """Mean of densities (pixel, level, bin) over the delays."""
    mean = np.maximum(density @ depth.astype(np.float32), _TINY)
    return _relative(np.asarray(np.log(mean)))


def _mean_log_likelihood(evidence: _Evidence, share: Floats) -> float:
    """Mean over the pixels, given the shares of the levels."""
    return float((np.log(evidence.likelihood @ share) + evidence.highest).mean())


def _log_likelihood(capture: Capture, flux_prior: FluxPrior, with_totals: bool = False) -> float:
    """Log likelihood of a sample of the pixels, if required with that of their own backgrounds.

    Own backgrounds follow from the totals. The density of these is the normal one of the
    backgrounds, times their derivative by the total: ``B / (B + s)`` if background and signal share
    it in proportion.
    """
    pixels, least = _sampled(capture.counts.size, DEPTH_SAMPLE), _least_background(capture)
    known = flux_prior._replace(background=np.maximum(flux_prior.background, least))
    log = level_likelihoods(capture, pixels, known, 1)
    if with_totals:
        totals = _totals(capture).of
        own = known.model(totals.of_pixels(pixels), least).background[:, 0].T
        variance = known.own_weight * float(totals.rate.var())
        log -= ((own - known.background) ** 2 / variance + math.log(variance)) / 2
        if known.is_in_proportion:
            has_signal = totals.has_signal.ravel()[pixels, np.newaxis]
            log -= np.log1p(known.levels * has_signal / known.background)
    return pixels.size * _mean_log_likelihood(_relative(log), known.share)


def _shares_of_one_level(capture: Capture, start: FluxPrior) -> Floats:
    """Estimate the shares of no echo and of the likeliest level, as if all echoes had that one.

    The likelihood of a level is that with the distribution of delays that suits it best.
    """
    _, density = _sampled_densities(capture, start, DEPTH_SAMPLE)
    most, best = -math.inf, start.share
    for level in range(1, start.share.size):
        pair = np.ascontiguousarray(density[:, [0, level]])
        share, depth = shares_and_depths(pair, np.array([0.5, 0.5]))
        here = _mean_log_likelihood(_evidence(pair, depth), share)
        if here > most:
            most, best = here, np.zeros_like(best)
            best[[0, level]] = share
    return best


@lru_cache(maxsize=64)
def _sampled(n_pixels: int, most: int) -> NDArray[np.intp]:
    """Sample at most as many pixels, one at random of each of equal parts of the image.

    Their share of every surface is closer to that in the image than if all were drawn at random. A
    regular step could miss columns.
    """
    first = np.arange(min(most, n_pixels) + 1) * n_pixels // min(most, n_pixels)
    pixels = np.random.default_rng(0).integers(first[:-1], first[1:])
    pixels.setflags(write=False)
    return pixels


def total_rates(capture: Capture) -> Floats:
    """Estimate the sum of signal and background of each pixel, shape (row, col)."""
    return _totals(capture).of.rate


def has_many_spent(capture: Capture) -> bool:
    """Return whether nearly all pulses fire in so many pixels that the mean total is biased."""
    return _totals(capture).spent > _MANY_SPENT


def background_in_strong_sun(capture: Capture) -> tuple[float, float] | None:
    """Mean background of the pixels, and its standard deviation due to chance.

    None if all totals include the signals of their pixels, of which the background is what these
    leave.
    """
    totals = _totals(capture)
    if totals.of.has_signal.all():
        return None
    mean = float(detailed_flux_prior_of(capture).background)
    return mean, math.sqrt(totals.chance / totals.of.rate.size)


def level_likelihoods(
    capture: Capture, pixels: NDArray[np.intp], flux_prior: FluxPrior, steps_per_bin: int
) -> Floats:
    """Log likelihood of each signal level, with `FluxPrior.depth` as the prior of the delay.

    Parameters
    ----------
    capture : Capture
    pixels : ndarray, shape (pixel,)
        Flat indices.
    flux_prior : FluxPrior
    steps_per_bin : int
        Delays per bin.

    Returns
    -------
    ndarray, shape (pixel, level)
        Without terms that depend only on the counts.
    """
    n_bins, n_pulses = capture.cube.shape[2], capture.gated_pulses
    # A mean background below half a count is known from many pixels.
    least = min(_least_background(capture), float(flux_prior.background))
    flux = _model_of_pixels(capture, flux_prior, pixels, least)
    cube = capture.cube.reshape(-1, n_bins)[np.newaxis, pixels]
    prepared = prepare(capture, cube, flux, steps_per_bin)
    evidence = level_evidence(prepared, prepared.depth)
    b, (node, node_weight) = flux.background[0, 0] / n_bins, nodes_of(flux.relative_background)
    at_nodes = b[:, np.newaxis] * node
    fires = at_nodes if n_pulses is None else -np.expm1(-at_nodes)
    fired, unfired = np.empty(fires.shape), np.empty(pixels.size)
    for rows in _some_rows(cube[0]):
        counts = cube[0, rows].astype(float)
        left = np.ones_like(counts) if n_pulses is None else n_pulses - np.cumsum(counts, axis=1)
        fired[rows] = counts @ node_weight.T
        unfired[rows] = left @ flux.relative_background
    without = (fired * np.log(fires)).sum(axis=1) - b * unfired
    return np.asarray(evidence + without[:, np.newaxis])


def level_differences(flux_prior: FluxPrior, capture: Capture) -> Difference:
    """Compare each signal level with their mean, shape (level - 1,).

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
    """Rate of half a count, the lower bound of a background without detections."""
    return 0.5 / (capture.gated_pulses or 1)


class _Totals(NamedTuple):
    """Total rates of a capture."""

    of: Totals
    """Those of its pixels."""
    chance: float
    """Mean of their variances due to chance."""
    spent: float
    """Share of the pixels of which nearly all pulses fired."""


@cached_per_capture
def _totals(capture: Capture) -> _Totals:
    """Estimate the total rate of each pixel, or its background where that fires nearly all pulses.

    If u of M pulses do not fire, Coates' rates add up to ``ln(M / u)`` over the gate,
    and Greenwood's variances to ``1 / u - 1 / M``. The mean of the logarithm is biased; that of
    ``ln((M + 1/2) / (u + 1/2))`` much less (Anscombe 1956), also with few pulses.
    """
    n_pulses = capture.gated_pulses
    if n_pulses is None:
        total = capture.counts.astype(float)
        return _Totals(
            _with_chance(total, np.ones(capture.shape, bool), total), float(total.mean()), 0.0
        )
    unfired = np.maximum(n_pulses - capture.counts, 0)
    variance = 1 / np.maximum(unfired, 0.5) - 1 / n_pulses
    total = np.log((n_pulses + 0.5) / (unfired + 0.5))
    has_signal, spent = np.ones(capture.shape, bool), capture.counts > n_pulses - _TOO_FEW
    if spent.any():
        # Chosen by the background: of pixels that are alike, chance leaves few pulses in some only.
        some = capture.counts > n_pulses - _MARGIN * _TOO_FEW
        background, most = _background_of(capture.cube[some], n_pulses), np.sqrt(variance[some])
        most = background + _CLEARLY_MORE * most
        # Few pulses leave the background uncertain: it is shrunk to the median as far as chance
        # explains how many pulses of the pixels do not fire.
        chance = float((unfired * (n_pulses - unfired)).mean()) / n_pulses
        middle = float(np.median(background))
        shrunk = middle + _own_weight(unfired, chance) * (background - middle)
        has_signal[some] = (shrunk < math.log(n_pulses / _TOO_FEW)) | (total[some] > most)
        total[some] = np.where(has_signal[some], total[some], background)
        variance[~has_signal] = _VARIANCE_OF_MEDIAN * total[~has_signal] ** 2 / n_pulses
    pixels = _with_chance(total, has_signal, variance)
    return _Totals(pixels, float(variance.mean()), float(spent.mean()))


def _with_chance(total: Floats, has_signal: NDArray[np.bool_], variance: Floats) -> Totals:
    """Return the totals of pixels of a known variance due to chance."""
    mean = variance.mean() or 1.0
    return Totals(total, has_signal, np.minimum(variance / mean, 1.0))


def _background_of(pixels: NDArray[np.unsignedinteger], n_pulses: int) -> Floats:
    """Total background rate of pixels (pixel, bin) in which (nearly) all pulses fired.

    Bins without armed pulses have no rate; theirs is taken as the median of the others, weighted
    with their armed pulses. That is the background if it fired the pulses, and nearly 0 if an echo
    did. Without this, flux that fires every pulse early in the gate would be mistaken for an echo.
    Few pulses leave most bins empty at any background; the median is that of parts of the gate in
    which a background that fires the pulses is detected.

    Where all fire in the first bin, its rate has only a lower bound, which is higher for all such
    pixels together than for one.
    """
    median, n_parts = np.empty(len(pixels)), max(_FEWEST_PARTS, n_pulses // _COUNTS_IN_PART)
    for some in _some_rows(pixels):
        rate, armed = rate_and_n_armed(pixels[some].astype(float), n_pulses)
        if n_parts < pixels.shape[1]:
            rate, armed = _in_parts(rate, armed, n_parts)
        # The median of a Poisson variable, an integer, is 1/6 less than its mean on average.
        rate += 1 / (6 * np.maximum(armed, 1))
        median[some] = weighted_median(rate.T, armed.T)
    at_once = pixels[:, 0] >= n_pulses
    median[at_once] = math.log(2 * n_pulses * max(int(at_once.sum()), 1))
    return np.asarray(median * pixels.shape[1])


def _in_parts(rate: Floats, armed: Floats, n_parts: int) -> tuple[Floats, Floats]:
    """Join bins (pixel, bin) to parts of about as many armed pulses, shape (pixel, part).

    Returns their mean rates, and their sums of armed pulses.
    """
    until = np.cumsum(armed, axis=1)
    part = np.minimum(n_parts * (until - armed / 2) / until[:, -1:], n_parts - 1).astype(np.intp)
    part += n_parts * np.arange(len(part))[:, np.newaxis]

    def joined(values: Floats) -> Floats:
        sums = np.bincount(part.ravel(), values.ravel(), n_parts * len(part))
        return np.asarray(sums.reshape(-1, n_parts), float)

    n_armed = joined(armed)
    return joined(rate * armed) / np.maximum(n_armed, 1), n_armed


def _some_rows(pixels: NDArray[Any]) -> Iterator[slice]:
    """Yield slices of pixels (pixel, bin), so that temporaries stay small."""
    at_once = max(1, _AT_ONCE // pixels.shape[1])
    for first in range(0, len(pixels), at_once):
        yield slice(first, first + at_once)


def _own_weight(total: Floats, unrelated: float) -> float:
    """Share of the variance of the totals that exceeds the variance `unrelated` to background.

    0 where chance explains it: less than three standard deviations of a variance more.
    """
    scatter, chance = float(total.var()), 3 * math.sqrt(2 / total.size)
    return 1 - unrelated / scatter if scatter > (1 + chance) * unrelated else 0.0


def _levels(
    pixels: NDArray[np.intp], capture: Capture, shape: Floats | None, in_proportion: bool
) -> Floats:
    """Signal levels: 0, and a geometric grid up to the strongest echoes of pixels."""
    flat = capture.cube.reshape(-1, capture.cube.shape[2])
    excess = _largest_excess(flat[pixels], capture, shape)
    if in_proportion:
        totals = _totals(capture).of.of_pixels(pixels)
        left = np.maximum(totals.rate - excess * totals.has_signal, 0.0)[0]
        excess /= np.maximum(left / (left.mean() or 1.0), LEAST_BRIGHTNESS)
    top = max(float(np.quantile(excess, 0.999)), 1.0 / (capture.gated_pulses or 1))
    return np.concatenate([[0.0], np.geomspace(top / LEVEL_SPAN, top, LEVELS)])


def _largest_excess(
    pixels: NDArray[np.unsignedinteger], capture: Capture, shape: Floats | None
) -> Floats:
    """Largest excess of each pixel (pixel, bin) over its background in a window of an echo."""
    n_bins = pixels.shape[1]
    excess, width = np.empty(len(pixels)), min(capture.echo_bins, n_bins)
    for some in _some_rows(pixels):
        rate, _ = rate_and_n_armed(pixels[some].astype(float), capture.gated_pulses)
        until = sums_before(rate)
        inside = until[:, width:] - until[:, :-width]
        if shape is not None:  # the background of each window, above the mean one
            inside -= until[:, -1:] * (windowed_sums(shape[np.newaxis], width) - width) / n_bins
        excess[some] = inside.max(axis=1) - until[:, -1] * width / n_bins
    return excess


def _halved(
    levels: Floats, share: Floats, kept: NDArray[np.bool_]
) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Replace each level, except no echo, by two, which together form a grid of half the spacing.

    The mean of a coarse grid of levels is biased: the signal of an image lies between two of them.
    Next to the kept levels, one more is added on either side. Also returns the coarse level of
    each.
    """
    quarter = LEVEL_SPAN ** (0.25 / (LEVELS - 1))
    pairs = (levels[1:, np.newaxis] * [1 / quarter, quarter]).ravel()
    near = np.pad(np.repeat(kept[1:], 2), 1)
    some = np.flatnonzero(near[:-2] | near[1:-1] | near[2:])
    halves = np.maximum(np.repeat(share[1:] / 2, 2)[some], _RARE)
    shares = np.append(share[0], halves)
    return np.append(0.0, pairs[some]), shares / shares.sum(), some // 2


def _joined(levels: Floats, share: Floats, pair: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Join pairs of levels from `_halved` in their means."""
    weight = np.maximum(share[1:], np.finfo(float).tiny)
    total = np.bincount(pair, weight)
    some = total > 0
    means = np.bincount(pair, weight * levels[1:])[some] / total[some]
    return np.append(0.0, means), np.append(share[0], total[some])


def _kept(share: Floats) -> NDArray[np.bool_]:
    """Return which levels to keep: no echo and others that are not rare, or else the strongest.

    If echoes are so rare that the sample has none, the strongest level gets a share.
    """
    kept = share > _RARE
    kept[0] = True
    if not kept[1:].any():
        kept[-1], share[-1] = True, _RARE
    return kept


def level_shares(likelihood: Floats) -> Floats:
    """Estimate the shares of levels from the likelihood of each, as `_Evidence.likelihood`.

    A tenth of an additional pixel has no echo, so that its share is never 0. The faintest levels
    cannot be distinguished from no echo; they are merged with it as long as the likelihood
    decreases little.
    """
    n_levels = likelihood.shape[1]
    share = np.full(n_levels, 1 / n_levels)
    learn_shares(likelihood, share)
    least = np.log(likelihood @ share).sum() - _LEAST_GAIN
    for faintest in range(1, n_levels - 1):
        simpler = share.copy()
        simpler[0], simpler[faintest] = share[0] + share[faintest], 0.0
        mixture = likelihood @ simpler
        if mixture.min() == 0 or np.log(mixture).sum() < least:
            break
        share = simpler
    return share


def shares_and_depths(
    density: NDArray[np.float32],
    share: Floats,
    depth: Floats | None = None,
    n_steps: int = _DEPTH_STEPS,
) -> tuple[Floats, Floats]:
    """Estimate the share of no echo, and those of delays in each bin, from densities.

    Densities have shape (pixel, level, bin). The first level, no echo, has the same density at all
    delays; the other levels keep their ratios. There are too few pixels for an independent share of
    each bin: delays have a sparse prior, are smoothed over a bin in each step, and keep a uniform
    part, as large as the pixels require. They begin uniform, or as `depth`.
    """
    n_bins = density.shape[2]
    share = share.copy()
    depth = np.full(n_bins, 1 / n_bins) if depth is None else depth / n_bins
    learn_shares_and_depths(density, n_steps, share, depth)
    return share, depth * n_bins
