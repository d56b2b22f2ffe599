"""A cube laid out for kernels that treat many pixels at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.parallel import COMPILED

LANES = 64
"""Pixels treated together: four vectors of sixteen float32, in flight side by side."""


class Blocks(NamedTuple):
    """Counts with neighbouring pixels side by side; the last block is filled up with zeros."""

    counts: NDArray[np.unsignedinteger]
    """Shape (block, bin, LANES)."""
    largest: NDArray[np.float64]
    """Largest count of each pixel, shape (block, LANES)."""
    sigma: NDArray[np.float64]
    """Standard deviation of each pixel's histogram over the gate, shape (block, LANES)."""
    n_pixels: int
    """Pixels in use."""


def to_blocks(cube: NDArray[np.unsignedinteger]) -> Blocks:
    """Lay out a cube (..., bin) in blocks, pixels in their order.

    Counts that fit are uint16 there, whatever they come as: kernels are compiled for each type.
    """
    if cube.dtype == np.uint8 or (cube.dtype == np.uint32 and cube.max(initial=0) < 2**16):
        cube = cube.astype(np.uint16)
    n_bins = cube.shape[-1]
    pixels = cube.reshape(-1, n_bins)
    n_pixels = pixels.shape[0]
    missing = -n_pixels % LANES
    if missing:
        pixels = np.concatenate([pixels, np.zeros((missing, n_bins), cube.dtype)])
    counts = np.ascontiguousarray(pixels.reshape(-1, LANES, n_bins).transpose(0, 2, 1))
    largest = counts.max(axis=1).astype(np.float64)
    return Blocks(counts, largest, lane_sigma(counts, n_bins), n_pixels)


@njit(**COMPILED)
def lane_sigma(counts, n_bins):  # type: ignore[no-untyped-def]
    """Standard deviation over the first `n_bins` of (block, bin, LANES) counts; 0 over none."""
    sigma = np.zeros((counts.shape[0], LANES))
    total, squares = np.empty(LANES), np.empty(LANES)
    for b in range(counts.shape[0] if n_bins > 0 else 0):
        total[:] = 0.0
        squares[:] = 0.0
        # Moments about the first count: a constant histogram has a σ of exactly 0.
        for k in range(n_bins):
            for i in range(LANES):
                c = np.float64(counts[b, k, i]) - np.float64(counts[b, 0, i])
                total[i] += c
                squares[i] += c * c
        for i in range(LANES):
            mean = total[i] / n_bins
            sigma[b, i] = math.sqrt(max(squares[i] / n_bins - mean * mean, 0.0))
    return sigma


@njit(**COMPILED)
def lane_rows(n_rows):  # type: ignore[no-untyped-def]
    """Scratch of `n_rows` rows of LANES float32, on a cache line's boundary."""
    memory = np.empty(n_rows * LANES + 16, np.float32)
    start = (-(memory.ctypes.data // 4)) % 16
    return memory[start : start + n_rows * LANES]
