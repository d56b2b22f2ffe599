"""Two surfaces of each pixel, found together with those of its neighbours, layer by layer.

The image posterior (`core.estimators.image_posterior`) finds the first layer. The likelihood ratio
of one more echo to none, given the first, is evidence of the same kind: combined over neighbours in
the same way, it finds the second layer, or none, in each pixel. Then the first layer is found again
given the second, and so on, `_ROUNDS` times.

The fluxes of both layers and the background are those of the pixels around, by expectation and
maximisation: neighbours share them, and a single pixel of few photons does not show them. How many
pixels have a second surface, how strong it is and how alike neighbours are in that is learned from
the evidence of the pixels by themselves: a net has holes. Layers closer than `_LEAST_DISTANCE_BINS`
are one. A second surface is accepted if it is likelier than all but a given share of those in an
image that is drawn with the first layer alone, and if the pixel by itself, with the share of the
pixels around that have one, rather sees it than not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.estimators.image_model import (
    Pairs,
    Prior,
    image_model_of,
    merged_bins,
    merged_flux,
)
from core.estimators.image_posterior import image_posterior_of, peaks, slopes_of, solved
from core.inference.flux import level_shares
from core.inference.flux_model import Agreement
from core.inference.posterior import TOLERANCE_BINS, States
from core.inference.returns import FALSE_RETURN, echo_model, pixel_counts
from core.kernels.parallel import on_threads
from core.kernels.returns import EchoModel, fill_further, fill_photons
from core.trigger import draw_counts

_ROUNDS = 3  # after two, a plain wall at a low SBR may keep a second layer
_FLUX_STEPS = 3  # of expectation and maximisation, in each round
_WINDOW = 9  # rows and columns whose pixels share their fluxes
_LEVELS = np.array([[0.25, 0.5, 0.75, 1.0], [0.15, 0.3, 0.5, 0.7]])
"""Signals of one more echo in each layer, relative to both."""

_FIRST_SHARES = np.array([0.7, 0.3])  # of the layers in the signal, before it is fitted
_LEAST_DISTANCE_BINS = 2.0
_PRESENCE_STEPS = 20  # of expectation and maximisation
_LIKELY = 0.5  # probability from which a pixel has a second surface
_ALIKE = np.full(_LEVELS.shape[1], 1 / _LEVELS.shape[1])  # shares of levels
_SAMPLE = 1024  # pixels from which shares of levels are learned
_LEAST_SHARE = 1e-4
_IMPOSSIBLE = -1e4
_LEAST = 1e-20  # probability of a state, so that no product of messages is subnormal
_LEAST_FLUX = 1e-9
_BIN_COST = 20  # counts that other kernels process in the time of one


class Layers(NamedTuple):
    """Surfaces of each pixel, each of shape (layer, row, col)."""

    delay: Floats
    """In bins; NaN where there is no second surface."""
    signal: Floats
    """Photons per pulse, or per pixel if all photons are counted."""
    confidence: Floats
    """Probability of a surface within `TOLERANCE_BINS`."""


class _Fluxes(NamedTuple):
    """Fluxes of the pixels, fitted to those around each."""

    background: Floats
    """Shape (pixel,)."""
    signal: Floats
    """Shape (layer, pixel)."""


class _Image(NamedTuple):
    """A capture in the layout of the kernels, and what its pixels share."""

    counts: NDArray[np.uint32]
    model: EchoModel
    shape: tuple[int, int]
    prior: Prior
    agreement: Agreement


@cached_per_capture
def image_layers_of(capture: Capture, false_return: float = FALSE_RETURN) -> Layers | None:
    """Find two layers of surfaces; None if neighbours carry no information or see no surface.

    At most a share `false_return` of the pixels with one surface has a second.
    """
    flux = image_model_of(capture)
    if flux.agreement.alike == 0:
        return None
    alone = image_posterior_of(capture, flux)
    merged, factor = merged_bins(capture)
    flux = merged_flux(flux, factor)
    shape = merged.shape
    image = _Image(
        pixel_counts(merged.cube), echo_model(merged), shape, Prior.of(flux), flux.agreement
    )
    first, delay = alone.by_bin.copy(), np.zeros((2, *shape))
    delay[0] = alone.delay / factor
    slopes: list[NDArray[np.float32] | None] = [alone.slopes, None]
    present = np.stack([alone.surface > 1 - _LIKELY, np.zeros(shape, bool)])
    if not present.any():
        return None
    signal = np.stack([flux.typical_signal.ravel(), np.zeros(delay[0].size)])
    fluxes = _local(image, _Fluxes(flux.typical_background.ravel(), signal), delay, present)
    for number in range(_ROUNDS):
        only = np.stack([present[0], np.zeros(shape, bool)])
        share = _level_shares(image, fluxes, delay[0], only)
        log = _log_ratios(image, fluxes, 1, delay[0], only, share[1:])
        prior = _with_nothing(image.prior, float(share[0]))
        own = _states(log, prior)
        agreement = _agreement(image, own, prior)
        second = solved(own, prior, agreement, slopes[1])
        delay[1], weight = peaks(second.surface)
        slopes[1] = slopes_of(delay[1], weight)
        present[1] = present[0] & (second.nothing < _LIKELY) & _apart(delay)
        if not present[1].any():
            break
        if number == 0:
            total = fluxes.signal[0]
            fluxes = fluxes._replace(signal=_FIRST_SHARES[:, np.newaxis] * total)
        fluxes = _local(image, fluxes, delay, present)
        log = _log_ratios(image, fluxes, 0, delay[1], present, _ALIKE)
        again = solved(_states(log, image.prior), image.prior, flux.agreement, slopes[0])
        found, weight = peaks(again.surface)
        delay[0] = np.where(present[1], found, delay[0])
        first[present[1]] = again.surface[present[1]]
        slopes[0] = slopes_of(delay[0], weight)
    if present[1].any():
        drawn = _with_one_surface(capture, image, fluxes, delay[0], present[0])
        log = _log_ratios(*drawn, 1, delay[0], only, share[1:])
        least = solved(_states(log, prior), prior, agreement).nothing
        most = min(_LIKELY, float(np.quantile(least[present[0]], false_return)))
        present[1] &= (second.nothing < most) & _apart(delay)
    seen = _presence(_log_ratios(image, fluxes, 1, delay[0], only, share[1:]), delay[1])
    present[1] &= seen > _LIKELY
    confidence = np.stack(
        [_mass(first, delay[0]), np.minimum(_mass(second.surface, delay[1]), seen)]
    )
    delay[1, ~present[1]] = np.nan
    return Layers(delay * factor, fluxes.signal.reshape(2, *shape), confidence)


def _presence(log: NDArray[np.float32], delay: Floats) -> Floats:
    """Return the probability that each pixel has a surface where its neighbours do, (row, col).

    They show where it is. How many around have one is learned from the evidence of each pixel by
    itself, log likelihood ratios (row, col, bin), since neighbours may well differ in that, as in
    foliage. The evidence must be that of signals as strong as the capture's second surfaces:
    that of fainter ones hardly differs from that of none.
    """
    away = np.abs(np.arange(log.shape[2]) + 0.5 - delay[..., np.newaxis]) > _LEAST_DISTANCE_BINS
    evidence = np.where(away, -np.inf, log).max(axis=2).astype(float)
    share = presence = np.full(delay.shape, 0.5)
    for _ in range(_PRESENCE_STEPS):
        presence = np.asarray(scipy.special.expit(evidence + scipy.special.logit(share)))
        around = scipy.ndimage.uniform_filter(presence, _WINDOW)
        share = np.clip(around, _LEAST_SHARE, 1 - _LEAST_SHARE)
    return presence


def _apart(delay: Floats) -> NDArray[np.bool_]:
    return np.asarray(np.abs(delay[1] - delay[0]) >= _LEAST_DISTANCE_BINS)


def _level_shares(image: _Image, fluxes: _Fluxes, delay: Floats, only: NDArray[np.bool_]) -> Floats:
    """Learn the shares of pixels without a second surface and with one of each level, (1 + level,).

    From pixels by themselves, given delays (row, col) of the first surface, which is where `only`
    (layer, row, col) says. What neighbours say would confirm itself: a net would have no holes.
    """
    pixels = np.flatnonzero(only[0])
    if pixels.size > _SAMPLE:
        pixels = np.sort(np.random.default_rng(0).permutation(pixels)[:_SAMPLE])
    some = image._replace(counts=image.counts[pixels], shape=(1, pixels.size))
    given = _Fluxes(fluxes.background[pixels], fluxes.signal[:, pixels])
    first, there = delay.ravel()[np.newaxis, pixels], only.reshape(2, 1, -1)[..., pixels]
    depth = image.prior.surface / image.prior.surface.sum()
    n_levels = _LEVELS.shape[1]
    log = np.zeros((pixels.size, 1 + n_levels))
    for level in range(n_levels):
        found = _log_ratios(some, given, 1, first, there, np.eye(n_levels)[level])[0].astype(float)
        top = found.max(axis=1)
        log[:, 1 + level] = top + np.log(np.exp(found - top[:, np.newaxis]) @ depth)
    share = level_shares(np.exp(log - log.max(axis=1, keepdims=True)))
    share = np.maximum(share, _LEAST_SHARE)
    return np.asarray(share / share.sum())


def _agreement(image: _Image, alone: States, prior: Prior) -> Agreement:
    """Return how alike neighbours are in a layer, which may have holes that the first has not."""
    pairs = Pairs.among(alone, prior)
    alike = image.agreement.alike if pairs is None else pairs.likeliest().alike
    # None are alike where pixels by themselves show nothing.
    is_less = 0 < alike < image.agreement.alike
    return image.agreement._replace(alike=alike) if is_less else image.agreement


def _with_one_surface(
    capture: Capture,
    image: _Image,
    fluxes: _Fluxes,
    delay: Floats,
    present: NDArray[np.bool_],
) -> tuple[_Image, _Fluxes]:
    """Draw an image with the first layer alone, which has all of the signal."""
    n_bins = image.counts.shape[1]
    whole = fluxes.signal.sum(axis=0)
    echo = capture.pulse.bin_probability(
        delay.ravel(), n_bins, capture.acquisition.bin_width_s * (capture.cube.shape[2] // n_bins)
    )
    rate = fluxes.background[:, np.newaxis] * image.model.background
    rate += np.where(present.ravel(), whole, 0.0)[:, np.newaxis] * echo
    counts = pixel_counts(draw_counts(rate, capture.gated_pulses, np.random.default_rng(0)))
    one = fluxes._replace(signal=np.stack([whole, np.zeros_like(whole)]))
    return image._replace(counts=counts), one


def _with_nothing(prior: Prior, nothing: float) -> Prior:
    """Return the prior with another probability of no surface."""
    return Prior(prior.surface * (1 - nothing) / (1 - prior.nothing), nothing)


def _log_ratios(
    image: _Image,
    fluxes: _Fluxes,
    layer: int,
    delay: Floats,
    present: NDArray[np.bool_],
    share: Floats,
) -> NDArray[np.float32]:
    """Log likelihood ratios of a surface of a layer to none, (row, col, bin), given the other.

    The other layer has delays (row, col); `present` (layer, row, col) says where it is, and which
    pixels have the layer's photons counted as signal. No second surface is without a first. `share`
    (level,) is that of each of the layer's `_LEVELS`.
    """
    signal, other, is_there = fluxes.signal, 1 - layer, present.reshape(2, -1)
    unexplained = fluxes.background + np.where(is_there[layer], signal[layer], 0.0)
    known = np.where(is_there[other], signal[other], 0.0)
    some = share > 0
    levels = _LEVELS[layer, some, np.newaxis] * signal.sum(axis=0)
    weight, log = np.log(share[some] / share.sum()), np.empty(image.counts.shape, np.float32)
    given = image.counts, image.model, unexplained, known[np.newaxis], delay.reshape(1, -1)
    on_threads(fill_further, len(log), log.size * _BIN_COST, *given, levels, weight, log)
    if layer == 1:
        log[~is_there[0]] = _IMPOSSIBLE
    return log.reshape(*image.shape, -1)


def _local(image: _Image, fluxes: _Fluxes, delay: Floats, present: NDArray[np.bool_]) -> _Fluxes:
    """Fit the fluxes to the pixels around each."""
    background, signal = fluxes
    photons, exposure = np.empty((2, 3, len(image.counts)))
    for _ in range(_FLUX_STEPS):
        here = np.where(present.reshape(2, -1), signal, 0.0)
        model, all_light = image.model, np.ascontiguousarray(background)
        given = image.counts, model, all_light, here, delay.reshape(2, -1), photons, exposure
        on_threads(fill_photons, len(image.counts), image.counts.size * _BIN_COST, *given)
        sums = [
            scipy.ndimage.uniform_filter(each.reshape(3, *image.shape), (0, _WINDOW, _WINDOW))
            for each in (photons, exposure)
        ]
        flux = np.maximum(sums[0] / np.maximum(sums[1], _LEAST_FLUX), _LEAST_FLUX)
        background, signal = flux[0].ravel(), flux[1:].reshape(2, -1)
    return _Fluxes(background, signal)


def _states(log: NDArray[np.float32], prior: Prior) -> States:
    """Return the probabilities of the states of pixels, given log likelihood ratios."""
    log = log + np.log(prior.surface).astype(np.float32)
    none = np.float32(np.log(prior.nothing))
    top = np.maximum(log.max(axis=-1), none)
    surface, nothing = np.exp(log - top[..., np.newaxis]), np.exp(none - top)
    total = surface.sum(axis=-1) + nothing
    surface /= total[..., np.newaxis]
    return States(np.maximum(surface, np.float32(_LEAST)), np.maximum(nothing / total, _LEAST))


def _mass(surface: NDArray[np.float32], delay: Floats) -> Floats:
    """Probability of a surface within `TOLERANCE_BINS` of a delay, shape (row, col)."""
    away = np.abs(np.arange(surface.shape[2]) + 0.5 - delay[..., np.newaxis])
    return np.asarray(np.where(away <= TOLERANCE_BINS, surface, 0.0).sum(axis=2))
