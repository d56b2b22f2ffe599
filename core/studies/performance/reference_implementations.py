"""The tracking estimator as one writes it at first: what the fast kernel is measured against.

As exact as the numbers given (float64, mostly), the equations as they stand. Each gives the
position of the echo in every pixel, as `core.tracking.track` does, for settings whose start is
"mean", whose σ is that of the gate and whose weight all pixels share; others are the estimator's.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.acquisition import Floats
from core.kernels.parallel import COMPILED
from core.kernels.tracking import ROUNDING_32, differentiate, differentiator_step
from core.tracking import START_BINS, TrackingParameters, common_weight

Pixels = NDArray[np.floating]
"""Counts, shape (pixel, bin)."""


def numpy_over_bins(pixels: Pixels, settings: TrackingParameters) -> Pixels:
    """All pixels at once by numpy, one bin after the other, as exact as the numbers given."""
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
    """`core.kernels.tracking.differentiator_step` of many pixels."""
    h, h0 = settings.h, settings.m * settings.h
    d = r * h0
    y = x1 - s + h0 * x2
    a0 = np.sqrt(d * d + 8 * r * np.abs(y))
    a = np.where(np.abs(y) > h0 * d, x2 + (a0 - d) / 2 * np.sign(y), x2 + y / h0)
    fh = np.where(np.abs(a) > d, -r * np.sign(a), -a / h0)
    return x1 + h * x2, x2 + h * fh


def plain_loop(pixels: Pixels, settings: TrackingParameters) -> Floats:
    """Pixel after pixel, compiled; each signal of a pixel is stored before the next is made."""
    weight = common_weight(pixels.shape[1], settings)
    position: Floats = _plain_loop(pixels, weight, settings.l, settings.n, settings.h, settings.m)
    return position


def fused_loop(pixels: Pixels, settings: TrackingParameters) -> Floats:
    """Pixel after pixel, compiled; both scales and the maximum in one pass, nothing stored."""
    weight = common_weight(pixels.shape[1], settings)
    position: Floats = _fused_loop(pixels, weight, settings.l, settings.n, settings.h, settings.m)
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
def _fused_loop(pixels, weight, l, n, h, m):  # type: ignore[no-untyped-def]  # noqa: E741
    position = np.full(pixels.shape[0], np.nan)
    for i in range(pixels.shape[0]):
        s = pixels[i]
        r = l * np.std(s)
        floor = ROUNDING_32 * np.max(s)
        small = large = np.mean(s[:START_BINS])
        small_speed = large_speed = best = 0.0
        for k in range(s.size):
            small, small_speed = differentiator_step(small, small_speed, s[k], r, h, m * h)
            large, large_speed = differentiator_step(large, large_speed, s[k], n * r, h, m * h)
            residual = large - small
            if residual > floor and residual * weight[k] > best:
                best = residual * weight[k]
                position[i] = k
    return position
