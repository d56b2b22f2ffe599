"""Straightforward implementations of tracking that the fast kernel is compared with.

`numpy_over_bins` and `plain_loop` return the position of the echo in every pixel as
`core.tracking.track` does, in the precision of their input, for settings with start "mean", σ from
the gate and a weight common to all pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.acquisition import Floats
from core.kernels.parallel import COMPILED
from core.kernels.tracking import ROUNDING_32, differentiate
from core.tracking import START_BINS, TrackingParameters, common_weight

Pixels = NDArray[np.floating]
"""Counts, shape (pixel, bin)."""


def numpy_over_bins(pixels: Pixels, settings: TrackingParameters) -> Pixels:
    """Advance all pixels together with numpy, bin by bin."""
    r_small = settings.l * pixels.std(axis=1)
    first = pixels[:, :START_BINS].mean(axis=1)
    floor = ROUNDING_32 * pixels.max(axis=1)
    small, large = (first, np.zeros_like(first)), (first, np.zeros_like(first))
    best, position = np.zeros_like(first), np.full_like(first, np.nan)
    for k, weight in enumerate(common_weight(pixels.shape[1], settings)):
        small = _numpy_step(*small, pixels[:, k], r_small, settings)
        large = _numpy_step(*large, pixels[:, k], settings.n * r_small, settings)
        residual = large[0] - small[0]
        enhanced = np.where(residual > floor, residual * weight, 0.0)
        position = np.where(enhanced > best, k, position)
        best = np.maximum(best, enhanced)
    return position


def _numpy_step(
    x1: Pixels, x2: Pixels, s: Pixels, r: Pixels, settings: TrackingParameters
) -> tuple[Pixels, Pixels]:
    """Apply `core.kernels.tracking.differentiator_step` to many pixels."""
    h, h0 = settings.h, settings.m * settings.h
    d = r * h0
    y = x1 - s + h0 * x2
    a0 = np.sqrt(d * d + 8 * r * np.abs(y))
    a = np.where(np.abs(y) > h0 * d, x2 + (a0 - d) / 2 * np.sign(y), x2 + y / h0)
    fh = np.where(np.abs(a) > d, -r * np.sign(a), -a / h0)
    return x1 + h * x2, x2 + h * fh


def plain_loop(pixels: Pixels, settings: TrackingParameters) -> Floats:
    """Compiled loop over pixels that stores each signal before it computes the next."""
    weight = common_weight(pixels.shape[1], settings)
    position: Floats = _plain_loop(pixels, weight, settings.l, settings.n, settings.h, settings.m)
    return position


@njit(**COMPILED)
def _plain_loop(pixels, weight, l, n, h, m):  # type: ignore[no-untyped-def]  # noqa: E741
    position = np.full(pixels.shape[0], np.nan)
    for i in range(pixels.shape[0]):
        s = pixels[i]
        r = l * np.std(s)
        first = np.mean(s[:START_BINS])
        small, large = np.empty_like(s), np.empty_like(s)
        differentiate(s, r, h, m, first, small)
        differentiate(s, n * r, h, m, first, large)
        residual = large - small
        enhanced = np.where(residual > ROUNDING_32 * np.max(s), residual * weight, 0.0)
        best = np.argmax(enhanced)
        if enhanced[best] > 0.0:
            position[i] = best
    return position


@njit(**COMPILED)
def take_roots(numbers, times):  # type: ignore[no-untyped-def]
    """Replace each number by its square root, a number of times: the roofline of tracking."""
    for _ in range(times):
        for i in range(numbers.size):
            numbers[i] = math.sqrt(numbers[i])
