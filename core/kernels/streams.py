"""Counter-based random numbers for kernels, with one stream per pixel.

A number depends only on the seed, the pixel and its position in the stream, not on the thread.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from core.kernels.parallel import COMPILED

DRAWN_UNITS = 2**53
"""Integers below it are drawn, which are exact as floating-point numbers."""


@njit(**COMPILED, inline="always")
def _splitmix64(state):  # type: ignore[no-untyped-def]
    """Output of the SplitMix64 generator (Steele, Lea & Flood 2014) at a state."""
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@njit(**COMPILED, inline="always")
def pixel_key(seed, pixel):  # type: ignore[no-untyped-def]
    """Key of a pixel's random stream."""
    return _splitmix64(_splitmix64(seed + np.uint64(1)) + np.uint64(pixel))


@njit(**COMPILED, inline="always")
def integer_at(key, draw):  # type: ignore[no-untyped-def]
    """Uniform integer below `DRAWN_UNITS` at position `draw` of a stream."""
    state = key + np.uint64(draw) * np.uint64(0x9E3779B97F4A7C15)
    return _splitmix64(state) >> np.uint64(11)


@njit(**COMPILED, inline="always")
def uniform_at(key, draw):  # type: ignore[no-untyped-def]
    """Uniform number in [0, 1) at position `draw` of a stream."""
    return np.float64(integer_at(key, draw)) * (1 / DRAWN_UNITS)


@njit(**COMPILED)
def uniforms(seed, pixels, first, n):  # type: ignore[no-untyped-def]
    """Numbers at the positions from `first` of the streams of pixels (pixel,), (pixel, n)."""
    numbers = np.empty((pixels.size, n))
    for i in range(pixels.size):
        key = pixel_key(seed, pixels[i])
        for j in range(n):
            numbers[i, j] = uniform_at(key, first + j)
    return numbers
