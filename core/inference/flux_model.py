"""Fluxes of an image: parameters that its pixels share, and the levels of each pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats


class Agreement(NamedTuple):
    """How neighbouring pixels of an image resemble each other (`core.estimators.image_model`)."""

    gain: float
    """Mean log likelihood ratio of two neighbours with a common surface to two without."""
    alike: float
    """Share of neighbouring pixels on one surface; 0 if neighbours carry no information."""
    scale_bins: float
    """Scale of the Laplace density of their difference in delay."""


UNRELATED = Agreement(0.0, 0.0, 1.0)
"""Agreement of an image whose neighbouring pixels carry no information about each other."""

_TINY = 1e-100  # photons, instead of none

LEAST_BRIGHTNESS = 0.25
"""Brightness of dark pixels, relative to the mean: with less, no count would speak against an echo
where there is no surface, as in the sky."""


@dataclass(frozen=True, eq=False)
class FluxModel:
    """Possible fluxes of each pixel: signal levels, and how often each occurs.

    Parameters
    ----------
    signal : ndarray, shape (level, row, col)
        Signal photons per pulse; the first level is 0, "no echo".
    background : ndarray, shape (level, row, col)
        Background photons per pulse over the gate if the signal has that level.
    share : ndarray, shape (level,)
        Share of the pixels at each level; sums to 1.
    depth : ndarray, shape (bin,)
        Prior density of the delay in each bin, relative to uniform; 1 on average.
    image_contrast : float, optional
        `contrast` of the image that these pixels belong to; None if they are all of it.
    pile_up : bool
        Whether the pulses resolve that early photons hide later ones.
    background_shape : ndarray, shape (bin,), optional
        Background of each bin relative to its mean over the gate; None if it is uniform.
    agreement : Agreement
        How neighbouring pixels resemble each other; by default not at all.
    """

    signal: Floats
    background: Floats
    share: Floats
    depth: Floats
    image_contrast: float | None = None
    pile_up: bool = True
    background_shape: Floats | None = None
    agreement: Agreement = UNRELATED

    @cached_property
    def typical_signal(self) -> Floats:
        """Mean signal of pixels with an echo, shape (row, col)."""
        share = self.share[1:]
        share = share / share.sum() if share.sum() > 0 else np.full(share.size, 1 / share.size)
        return _weighted_sum(share, self.signal[1:])

    @cached_property
    def typical_background(self) -> Floats:
        """Mean background, shape (row, col)."""
        return _weighted_sum(self.share, self.background)

    @property
    def relative_background(self) -> Floats:
        """`background_shape`, or 1 in each bin."""
        return _ones_unless(self.background_shape, self.depth)

    @property
    def contrast(self) -> float:
        """Mean signal over mean background of the image."""
        if self.image_contrast is not None:
            return self.image_contrast
        return float(self.typical_signal.mean() / self.typical_background.mean())

    def of_pixels(self, pixels: NDArray[np.intp]) -> FluxModel:
        """Return the fluxes of some pixels, given as flat indices of shape (row, col)."""
        flat = (len(self.share), -1)
        return replace(
            self,
            signal=self.signal.reshape(flat)[:, pixels],
            background=self.background.reshape(flat)[:, pixels],
            image_contrast=self.contrast,
        )


class Totals(NamedTuple):
    """Total rates of the pixels of an image, photons per pulse and gate, shape (row, col) each."""

    rate: Floats
    """Estimate."""
    has_signal: NDArray[np.bool_]
    """Whether it includes the signal of its pixel."""
    chance: Floats
    """Its variance due to chance, relative to the mean over the image, and 1 at most."""

    def signal_share(self, in_proportion: bool) -> float:
        """Return the share of the mean signal of the pixels that the mean total includes."""
        return float(np.average(self.has_signal, weights=self.rate if in_proportion else None))

    def of_pixels(self, pixels: NDArray[np.intp]) -> Totals:
        """Return the totals of some pixels, given as flat indices, in one row."""
        return Totals(
            self.rate.ravel()[np.newaxis, pixels],
            self.has_signal.ravel()[np.newaxis, pixels],
            self.chance.ravel()[np.newaxis, pixels],
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
    """Mean background over the image; per level while the signals are unknown."""
    own_weight: float
    """Share of a pixel's deviation from the mean background that is not chance; a larger one of
    pixels with less chance."""
    contrast: float | None = None
    """`FluxModel.contrast` of the image."""
    pile_up: bool = True
    """`FluxModel.pile_up`."""
    background_shape: Floats | None = None
    """`FluxModel.background_shape`."""
    is_in_proportion: bool = False
    """Whether the signal of a pixel is in proportion to its background, as where a surface reflects
    signal and sunlight alike. Then `levels` are those of a pixel with the mean background."""

    @property
    def relative_background(self) -> Floats:
        """`background_shape`, or 1 in each bin."""
        return _ones_unless(self.background_shape, self.depth)

    def brightness(self, totals: Totals) -> Floats:
        """Return signals in proportion to backgrounds relative to `levels`, (level, row, col).

        At least `LEAST_BRIGHTNESS`.
        """
        levels = self.levels[:, np.newaxis, np.newaxis]
        of_mean_pixel = np.maximum(self.background, 0.0) + levels * totals.has_signal
        return np.maximum(totals.rate / np.maximum(of_mean_pixel, _TINY), LEAST_BRIGHTNESS)

    def with_one_level(self) -> FluxPrior:
        """Return the prior with all signal levels replaced by their mean."""
        some = self.share[1:].sum()
        mean = float(self.share[1:] @ self.levels[1:] / some)
        return self._replace(levels=np.array([0.0, mean]), share=np.array([self.share[0], some]))

    def model(self, totals: Totals, least_background: float) -> FluxModel:
        """Return the fluxes of pixels with known total rates."""
        total, has_signal, chance = totals
        shape, levels = (self.levels.size, *total.shape), self.levels[:, np.newaxis, np.newaxis]
        mean = np.broadcast_to(self.background, levels.shape)
        if self.is_in_proportion:
            levels = levels * self.brightness(totals)
        if self.own_weight == 0:  # one number per level
            background = np.broadcast_to(np.maximum(mean, least_background), shape)
        else:
            weight, background = 1 / (1 + (1 / self.own_weight - 1) * chance), np.empty(shape)
            for level, its_mean, filled in zip(levels, mean, background, strict=True):
                own = its_mean + weight * (total - level * has_signal - its_mean)
                np.maximum(own, least_background, out=filled)
        return FluxModel(
            np.broadcast_to(levels, shape),
            background,
            self.share,
            self.depth,
            self.contrast,
            self.pile_up,
            self.background_shape,
        )


def _ones_unless(shape: Floats | None, depth: Floats) -> Floats:
    return np.ones(depth.size) if shape is None else shape


def _weighted_sum(weights: Floats, images: Floats) -> Floats:
    """Compute ``Σ_i weights_i images_i`` in order; a BLAS product depends on the processor."""
    total = np.zeros(images.shape[1:])
    for weight, image in zip(weights, images, strict=True):
        total += weight * image
    return total
