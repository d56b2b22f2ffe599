"""Flux and smoothness of an image, estimated from neighbouring pixels.

At a low SBR single pixels cannot distinguish an echo from background, and the signal level
estimated from them collapses. Neighbouring pixels that see one surface act like one pixel with more
pulses. Unless pixels by themselves tell where their surfaces are, the levels are therefore
estimated with 1 x 1 to 4 x 4 pixels added, and those are kept that make neighbours agree most. With
the posteriors q of two pixels by themselves, the prior p and a Laplace density K of scale a, the
pair is ::

    c = Σ q(d) K(d - d') q'(d') / p(d')

times as likely with one surface as with two. ``mean log (1 - ρ + ρ c)`` over pairs of neighbours is
maximised over ρ and a; the same maximum of pairs at random, which see two surfaces, is subtracted.
If nothing remains, the same is computed for pairs of tiles, whose evidence is stronger: on a plain
wall at SBR .02, pairs of tiles agree clearly, and pairs of pixels not at all. If nothing remains
there either, neighbours carry no information about each other.

Where no surface of these levels is likely, one that must be there is fainter. Its level may be any
from a small part to twice the typical signal (`with_any_level`), so that its pixel follows its
neighbours rather than the background.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import MOST_PULSES, Floats
from core.capture import Capture, cached_per_capture
from core.inference.flux import (
    detailed_flux_prior_of,
    detailed_flux_prior_over,
    flux_model_of,
    flux_model_with,
)
from core.inference.flux_model import UNRELATED, Agreement, FluxModel, FluxPrior
from core.inference.likelihood import prepare, prepared_groups
from core.inference.posterior import States, states_of
from core.kernels.messages import MOST_TAPS, fill_lags
from core.kernels.parallel import on_threads
from core.reductions import merge_bins, pool_pixels

_SIDES = (1, 2, 3, 4)  # of the tiles whose pixels are added
FEWEST_PIXELS = 64
"""Pixels, or tiles, from which distributions are learned."""

SCALES_BINS = (0.3, 0.6, 1.2, 2.4)
"""Scales of the Laplace density that are tried."""

_MOST_COUNT = 2**32 // max(_SIDES) ** 2
_PAIRS = 1024  # pixels whose right and lower neighbours are compared
_SHARES = np.linspace(0.0, 0.95, 39)
_SURE = 3.0  # standard errors
_FEW_BINS = 2.0  # among which a pixel hesitates that tells by itself where its surface is
_ECHO_BINS = 4  # merged bins of an echo; more add no information
_LEAST_SHARE = 1e-6  # of the pixels
_LEAST_DEPTH = 0.3  # relative to a uniform prior; fewer pixels teach depths than are estimated
_ANY_LEVEL = np.geomspace(0.06, 2.0, 8)  # relative to the typical signal
_LEAST_EVIDENCE = 1e-20  # so that no product of messages is subnormal


class _Found(NamedTuple):
    """The likeliest agreement of neighbours so far, and the fluxes under which they agree."""

    agreement: Agreement
    flux: FluxModel


@cached_per_capture
def image_model_of(capture: Capture) -> FluxModel:
    """Estimate flux and smoothness of a capture from its pixels and their neighbours."""
    found = of_tiles = _Found(UNRELATED, flux_model_of(capture))
    for prior, tiles in _flux_priors(capture):
        flux = flux_model_with(capture, prior)
        pairs = Pairs.of(capture, flux)
        if pairs is None:
            break
        found = max(found, _Found(pairs.agreement(), flux), key=_gain)
        if pairs.are_clear():
            break
        if tiles is not None and found.agreement.alike == 0:
            pairs = Pairs.of(tiles, flux_model_of(tiles))
            here = UNRELATED if pairs is None else pairs.agreement()
            of_tiles = max(of_tiles, _Found(here, flux), key=_gain)
    best, flux = of_tiles if found.agreement.alike == 0 else found
    depth = tempered(flux.depth) if best.alike > 0 else flux.depth
    return replace(flux, depth=depth, agreement=best)


def _gain(found: _Found) -> float:
    return found.agreement.gain


def tempered(depth: Floats) -> Floats:
    """Return a weaker prior of the delays than the pixels by themselves teach, of shape (bin,).

    Its square root, and no less than `_LEAST_DEPTH`. The delays of pixels by themselves are those
    of the large and bright surfaces; at a low SBR, a delay that few pixels have is not found at
    all. Neighbours show such a delay together, and must be able to.
    """
    root = np.sqrt(depth)
    weaker = np.maximum(root / root.mean(), _LEAST_DEPTH)
    return np.asarray(weaker / weaker.mean())


def merged_bins(capture: Capture) -> tuple[Capture, int]:
    """Merge bins that are much shorter than an echo; return the capture and the bins in one."""
    factor = max(1, min(capture.echo_bins // _ECHO_BINS, capture.acquisition.n_bins))
    return (capture, 1) if factor == 1 else (merge_bins(capture, factor), factor)


def merged_flux(flux: FluxModel, factor: int) -> FluxModel:
    """Return a flux model after merging bins; bins left over at the end of the gate are dropped."""
    if factor == 1:
        return flux
    kept = flux.depth.size // factor * factor
    shape, relative = flux.background_shape, flux.relative_background

    def merged(values: Floats) -> Floats:
        found = values[:kept].reshape(-1, factor).mean(axis=1)
        return np.asarray(found / found.mean())

    return replace(
        flux,
        background=flux.background * (relative[:kept].sum() / relative.sum()),
        depth=merged(flux.depth),
        background_shape=None if shape is None else merged(shape),
    )


def _flux_priors(capture: Capture) -> Iterator[tuple[FluxPrior, Capture | None]]:
    """Yield the flux prior of the pixels, then those of tiles, per pixel, with the tiles."""
    if capture.flux_prior is not None:
        yield capture.flux_prior, None
        return
    own = detailed_flux_prior_of(capture)
    yield own, None
    n_pulses, is_first = capture.acquisition.n_pulses or 1, capture.gated_pulses is not None
    for side in _SIDES[1:]:
        tiles = math.prod(size // side for size in capture.shape)
        fits = int(capture.cube.max()) < _MOST_COUNT and n_pulses * side**2 <= MOST_PULSES
        if tiles < FEWEST_PIXELS or not fits:
            return
        pooled = pool_pixels(capture, side)
        prior = detailed_flux_prior_over(pooled, own.background_shape)
        each = 1 if is_first else side**2  # counts of a pixel, or photons per pulse
        per_pixel = prior._replace(
            levels=prior.levels / each,
            background=prior.background / each,
            own_weight=own.own_weight,
        )
        yield per_pixel, replace(pooled, flux_prior=prior)


class Pairs(NamedTuple):
    """Posteriors of some pixels by themselves, and of their right and lower neighbours."""

    surface: NDArray[np.float32]
    """Shape (pixel or neighbour, pair, bin)."""
    nothing: Floats
    """Shape (pixel or neighbour, pair)."""
    prior: Prior

    @classmethod
    def of(cls, capture: Capture, flux: FluxModel) -> Pairs | None:
        """Choose pairs and compute their posteriors; None if there are too few."""
        capture, factor = merged_bins(capture)
        flux, pixels = merged_flux(flux, factor), cls._chosen(*capture.shape)
        if pixels is None:
            return None
        return cls._of(states_of_pixels(capture, flux, pixels), Prior.of(flux))

    @classmethod
    def among(cls, alone: States, prior: Prior) -> Pairs | None:
        """Choose pairs from the posteriors of the pixels of an image by themselves."""
        pixels = cls._chosen(*alone.nothing.shape)
        if pixels is None:
            return None
        surface = alone.surface.reshape(-1, alone.surface.shape[2])[pixels]
        return cls._of(States(surface, alone.nothing.ravel()[pixels]), prior)

    @staticmethod
    def _chosen(rows: int, cols: int) -> NDArray[np.intp] | None:
        """Choose pixels, followed by their right and by their lower neighbours, by flat index."""
        if min(rows, cols) < 2 or rows * cols < FEWEST_PIXELS:
            return None
        at = np.random.default_rng(0).permutation((rows - 1) * (cols - 1))[:_PAIRS]
        one = at // (cols - 1) * cols + at % (cols - 1)
        return np.concatenate([one, one + 1, one + cols])

    @classmethod
    def _of(cls, chosen: States, prior: Prior) -> Pairs:
        n_pairs = chosen.nothing.size // 3
        surface = chosen.surface.reshape(3, n_pairs, -1)
        return cls(surface, chosen.nothing.reshape(3, n_pairs).astype(float), prior)

    def are_clear(self) -> bool:
        """Return whether pixels with a surface tell by themselves where it is.

        A pixel hesitates among ``1 / Σ q(d)²`` bins. Where levels collapse, hardly any pixel has a
        surface, and those hesitate among three bins or more.
        """
        each = self.surface.astype(float)  # whose squares are numbers, too
        surface = each.sum(axis=2)
        n_bins = surface**2 / np.vecdot(each, each)
        mean = math.exp(np.average(np.log(n_bins), weights=surface))
        return mean < _FEW_BINS and float(surface.sum()) >= FEWEST_PIXELS

    def agreement(self) -> Agreement:
        """Find how similar neighbours are; unrelated if pairs at random are half as similar."""
        best, chance = self.likeliest(), 0.0
        if best.alike == 0:
            return UNRELATED
        apart = self.nothing.shape[1] // 2  # pixels are in random order
        for ratio in self.ratios(apart):
            chance = max(chance, float(_likeliest_share(ratio)[1].mean()))
        left = best.gain - chance
        return best._replace(gain=left) if left > 0.5 * best.gain else UNRELATED

    def likeliest(self) -> Agreement:
        """Find the likeliest similarity of neighbours, be it by chance."""
        best = UNRELATED
        for scale, ratio in zip(SCALES_BINS, self.ratios(0), strict=True):
            share, gain = _likeliest_share(ratio)
            mean, error = float(gain.mean()), float(gain.std()) / math.sqrt(gain.size)
            if mean > max(best.gain, _SURE * error):
                best = Agreement(mean, share, scale)
        return best

    def ratios(self, apart: int) -> Floats:
        """Compute c of each scale and of pixels and the neighbours of others, (scale, pair)."""
        other = np.roll(self.surface[1:], apart, axis=1) / self.prior.surface.astype(np.float32)
        lags = np.empty((*other.shape[:2], MOST_TAPS), np.float32)
        for neighbour, of_neighbour in zip(other, lags, strict=True):
            work = neighbour.size * MOST_TAPS
            on_threads(fill_lags, len(neighbour), work, self.surface[0], neighbour, of_neighbour)
        kernels = np.zeros((len(SCALES_BINS), MOST_TAPS))
        for scale, kernel in zip(SCALES_BINS, kernels, strict=True):
            filled = laplace(scale)
            beyond = (MOST_TAPS - filled.size) // 2
            kernel[beyond : beyond + filled.size] = filled
        dark = self.nothing[0] * np.roll(self.nothing[1:], apart, axis=1) / self.prior.nothing
        return np.asarray(kernels @ lags.reshape(-1, MOST_TAPS).T + dark.ravel())


def _likeliest_share(ratio: Floats) -> tuple[float, Floats]:
    """Find the ρ of `_SHARES` with the largest mean of ``log(1 - ρ + ρ c)``; return these, too.

    The mean is concave in ρ: its maximum lies where the derivative changes its sign.
    """
    excess = ratio - 1
    low, high = 0, _SHARES.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if np.mean(excess / (1 + _SHARES[middle] * excess)) > 0:
            low = middle
        else:
            high = middle
    found = [(float(share), np.log1p(share * excess)) for share in _SHARES[[low, high]]]
    return max(found, key=lambda each: float(each[1].mean()))


class Prior(NamedTuple):
    """Prior of the states of a pixel."""

    surface: Floats
    """Probability of a surface in each bin, shape (bin,)."""
    nothing: float
    """Probability of no surface."""

    @classmethod
    def of(cls, flux: FluxModel) -> Prior:
        """Return the prior of a flux model; no state is impossible.

        It is not normalised again: at a low SBR the share of pixels without an echo is estimated
        too large, and what is added to the depths makes up for that.
        """
        nothing = min(max(float(flux.share[0]), _LEAST_SHARE), 1 - _LEAST_SHARE)
        depth = np.maximum(flux.depth, _LEAST_DEPTH) / flux.depth.size
        return cls((1 - nothing) * depth, nothing)


def with_any_level(capture: Capture, flux: FluxModel, empty: float) -> FluxModel:
    """Return a flux model with levels of any strength, and a share `empty` without a surface."""
    typical = float(flux.typical_signal.mean())
    share = np.append(empty, np.full(_ANY_LEVEL.size, (1 - empty) / _ANY_LEVEL.size))
    known = detailed_flux_prior_of(capture)
    prior = FluxPrior(
        np.append(0.0, typical * _ANY_LEVEL),
        share,
        flux.depth,
        np.asarray(flux.typical_background.mean()),
        known.own_weight,
        flux.contrast,
        flux.pile_up,
        flux.background_shape,
        known.is_in_proportion,
    )
    return replace(flux_model_with(capture, prior), agreement=flux.agreement)


def states_of_image(capture: Capture, flux: FluxModel) -> States:
    """Return the probabilities of the states of each pixel by itself, of shape (row, col, ...)."""
    (rows, cols), none = capture.shape, Prior.of(flux).nothing
    surface = np.empty((rows * cols, capture.cube.shape[2]), np.float32)
    nothing = np.empty(rows * cols, np.float32)
    for pixels, prepared in prepared_groups(capture, flux, 1):
        surface[pixels], nothing[pixels] = states_of(prepared, none, _LEAST_EVIDENCE)
    return States(surface.reshape(rows, cols, -1), nothing.reshape(rows, cols))


def states_of_pixels(capture: Capture, flux: FluxModel, pixels: NDArray[np.intp]) -> States:
    """Return `states_of_image` of some pixels (n,), by flat index, of shape (n, ...)."""
    cube = capture.cube.reshape(-1, capture.cube.shape[2])[pixels][np.newaxis]
    prepared = prepare(capture, cube, flux.of_pixels(pixels[np.newaxis]), 1)
    return states_of(prepared, Prior.of(flux).nothing, _LEAST_EVIDENCE)


def laplace(scale_bins: float) -> Floats:
    """Kernel of a Laplace density at whole bins, normalised, of odd size."""
    half = min(max(1, math.ceil(7 * scale_bins)), 16)
    kernel = np.exp(-np.abs(np.arange(-half, half + 1)) / scale_bins)
    return np.asarray(kernel / kernel.sum())
