"""Two surfaces of each pixel, found together with those of its neighbours, layer by layer.

The image posterior (`core.estimators.image_posterior`) finds the first layer. The likelihood ratio
of one more echo to none, given the first, is evidence of the same kind: combined over neighbours in
the same way, it finds the second layer, or none, in each pixel. Then the first layer is found again
given the second, and so on, `_ROUNDS` times.

The fluxes of both layers and the background are those of the pixels around, by expectation and
maximisation: neighbours share them, and a single pixel of few photons does not show them. How many
pixels have a second surface is the mean of their probabilities. Layers closer than
`_LEAST_DISTANCE_BINS` are one. A second surface is accepted if it is likelier than all but a given
share of those in an image that is drawn with the first layer alone.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.estimators.image_model import (
    Prior,
    image_model_of,
    merged_bins,
    merged_flux,
)
from core.estimators.image_posterior import image_posterior_of, peaks, slopes_of, solved
from core.inference.flux_model import Agreement
from core.inference.posterior import TOLERANCE_BINS, States
from core.inference.returns import FALSE_RETURN, echo_model, pixel_counts
from core.kernels.parallel import on_threads
from core.kernels.returns import EchoModel, fill_further, fill_photons
from core.trigger import draw_counts

_ROUNDS = 3
_FLUX_STEPS = 3  # of expectation and maximisation, in each round
_WINDOW = 9  # rows and columns whose pixels share their fluxes
_LEVELS = np.array([[1.0, 0.75, 0.5, 0.25], [0.7, 0.5, 0.3, 0.15]])
"""Signals of one more echo in each layer, relative to both."""

_FIRST_SHARES = np.array([0.7, 0.3])  # of the layers in the signal, before it is fitted
_LEAST_DISTANCE_BINS = 2.0
_LIKELY = 0.5  # probability from which a pixel has a second surface
_FIRST_SHARE = 0.1  # of the pixels that have one, before any is seen
_LEAST_SHARE, _MOST_SHARE = 1e-4, 1 - 1e-4
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
    """Find two layers of surfaces; None where neighbours carry no information.

    At most a share `false_return` of the pixels with one surface has a second.
    """
    flux = image_model_of(capture)
    if flux.agreement.alike == 0:
        return None
    alone = image_posterior_of(capture, flux)
    merged, factor = merged_bins(capture)
    flux = merged_flux(flux, factor)
    shape, prior = merged.shape, Prior.of(flux)
    image = _Image(pixel_counts(merged.cube), echo_model(merged), shape, prior, flux.agreement)
    first, delay = alone.by_bin.copy(), np.zeros((2, *shape))
    delay[0] = alone.delay / factor
    slopes: list[NDArray[np.float32] | None] = [alone.slopes, None]
    present = np.stack([alone.surface > 1 - _LIKELY, np.zeros(shape, bool)])
    signal = np.stack([flux.typical_signal.ravel(), np.zeros(delay[0].size)])
    fluxes = _local(image, _Fluxes(flux.typical_background.ravel(), signal), delay, present)
    share = _FIRST_SHARE
    for number in range(_ROUNDS):
        second = _second_layer(image, fluxes, delay[0], present[0], share, slopes[1])
        delay[1], weight = peaks(second.surface)
        slopes[1] = slopes_of(delay[1], weight)
        share = float(np.clip(1 - second.nothing[present[0]].mean(), _LEAST_SHARE, _MOST_SHARE))
        present[1] = present[0] & (second.nothing < _LIKELY) & _apart(delay)
        if not present[1].any():
            break
        if number == 0:
            total = fluxes.signal[0]
            fluxes = fluxes._replace(signal=_FIRST_SHARES[:, np.newaxis] * total)
        fluxes = _local(image, fluxes, delay, present)
        evidence = _evidence(image, fluxes, 0, delay[1], present, prior.nothing)
        again = solved(evidence, prior, flux.agreement, slopes[0])
        found, weight = peaks(again.surface)
        delay[0] = np.where(present[1], found, delay[0])
        first[present[1]] = again.surface[present[1]]
        slopes[0] = slopes_of(delay[0], weight)
    if present[1].any():
        least = _nothing_of_one_surface(capture, image, fluxes, delay[0], present[0], share)
        most = min(_LIKELY, float(np.quantile(least[present[0]], false_return)))
        present[1] &= (second.nothing < most) & _apart(delay)
    confidence = np.stack([_mass(first, delay[0]), _mass(second.surface, delay[1])])
    delay[1, ~present[1]] = np.nan
    return Layers(delay * factor, fluxes.signal.reshape(2, *shape), confidence)


def _apart(delay: Floats) -> NDArray[np.bool_]:
    return np.asarray(np.abs(delay[1] - delay[0]) >= _LEAST_DISTANCE_BINS)


def _second_layer(
    image: _Image,
    fluxes: _Fluxes,
    delay: Floats,
    present: NDArray[np.bool_],
    share: float,
    slopes: NDArray[np.float32] | None,
) -> States:
    """Find the second layer, given the delays (row, col) of the first and where it is present."""
    only = np.stack([present, np.zeros_like(present)])
    evidence = _evidence(image, fluxes, 1, delay, only, 1 - share)
    prior = _with_nothing(image.prior, 1 - share)
    return solved(evidence, prior, image.agreement, slopes)


def _nothing_of_one_surface(
    capture: Capture,
    image: _Image,
    fluxes: _Fluxes,
    delay: Floats,
    present: NDArray[np.bool_],
    share: float,
) -> NDArray[np.float32]:
    """Return the probabilities of no second surface in an image drawn with the first alone."""
    n_bins = image.counts.shape[1]
    whole = fluxes.signal.sum(axis=0)
    echo = capture.pulse.bin_probability(
        delay.ravel(), n_bins, capture.acquisition.bin_width_s * (capture.cube.shape[2] // n_bins)
    )
    rate = fluxes.background[:, np.newaxis] * image.model.background
    rate += np.where(present.ravel(), whole, 0.0)[:, np.newaxis] * echo
    counts = pixel_counts(draw_counts(rate, capture.gated_pulses, np.random.default_rng(0)))
    drawn = image._replace(counts=counts)
    one = fluxes._replace(signal=np.stack([whole, np.zeros_like(whole)]))
    return _second_layer(drawn, one, delay, present, share, None).nothing


def _with_nothing(prior: Prior, nothing: float) -> Prior:
    """Return the prior with another probability of no surface."""
    return Prior(prior.surface * (1 - nothing) / (1 - prior.nothing), nothing)


def _evidence(
    image: _Image,
    fluxes: _Fluxes,
    layer: int,
    delay: Floats,
    present: NDArray[np.bool_],
    nothing: float,
) -> States:
    """Return the evidence of a layer, given the delays (row, col) of the other one.

    `present` (layer, row, col) says where the other one is, and which pixels have the layer's
    photons counted as signal; `nothing` is the prior probability of no surface.
    """
    signal, other, is_there = fluxes.signal, 1 - layer, present.reshape(2, -1)
    unexplained = fluxes.background + np.where(is_there[layer], signal[layer], 0.0)
    known = np.where(is_there[other], signal[other], 0.0)
    levels = _LEVELS[layer, :, np.newaxis] * signal.sum(axis=0)
    log = np.empty(image.counts.shape, np.float32)
    given = image.counts, image.model, unexplained, known[np.newaxis], delay.reshape(1, -1)
    on_threads(fill_further, len(log), log.size * _BIN_COST, *given, levels, log)
    if layer == 1:
        log[~is_there[0]] = _IMPOSSIBLE  # no second surface without a first
    log -= np.float32(np.log(len(levels)))
    return _states(log.reshape(*image.shape, -1), _with_nothing(image.prior, nothing))


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
