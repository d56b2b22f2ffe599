"""Layout of a cube for kernels that process many pixels at once."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.kernels.parallel import COMPILED, on_threads

LANES = 64
"""Pixels processed together: four vectors of sixteen float32."""

PIXELS_AT_ONCE = 8
_BINS_AT_ONCE = 4  # per read and write of the sums, which cost more than the additions


class Blocks(NamedTuple):
    """Counts with neighbouring pixels in adjacent lanes; the last block is padded with zeros."""

    counts: NDArray[np.unsignedinteger]
    """Shape (block, bin, LANES)."""
    largest: NDArray[np.unsignedinteger]
    """Largest count of each pixel, shape (block, LANES)."""
    sigma: NDArray[np.float64]
    """Standard deviation of each pixel's histogram over the gate, shape (block, LANES)."""
    n_pixels: int
    """Pixels in use."""


def to_blocks(cube: NDArray[np.unsignedinteger]) -> Blocks:
    """Lay out a cube (..., bin) in blocks, in the order of its pixels.

    Counts become uint16 if they fit, since kernels are compiled for each type.
    """
    counts = lane_counts(cube, LANES)
    largest, sigma = lane_spread(counts, cube.shape[-1])
    return Blocks(counts, largest, sigma, math.prod(cube.shape[:-1]))


def lane_counts(cube: NDArray[np.unsignedinteger], lanes: int) -> NDArray[np.unsignedinteger]:
    """Return counts (..., bin) as (block, bin, lane).

    Parameters
    ----------
    cube : ndarray, shape (..., bin)
    lanes : int
        Pixels in a block.
    """
    if cube.dtype == np.uint8 or (cube.dtype == np.uint32 and cube.max(initial=0) < 2**16):
        cube = cube.astype(np.uint16)
    n_bins = cube.shape[-1]
    pixels = np.ascontiguousarray(cube).reshape(-1, n_bins)
    pixels.setflags(write=False)  # writability is part of a numba type: compile for one
    filled, left = divmod(pixels.shape[0], lanes)
    counts = np.empty((filled + (left > 0), n_bins, lanes), cube.dtype)
    if lanes == LANES:
        on_threads(_lay_out, filled, pixels.size, pixels, counts)
    else:
        counts[:filled] = pixels[: filled * lanes].reshape(-1, lanes, n_bins).transpose(0, 2, 1)
    counts[filled:] = 0
    counts[filled:, :, :left] = pixels[filled * lanes :].T
    return counts


@njit(**COMPILED)
def _lay_out(first_block, end_block, pixels, counts):  # type: ignore[no-untyped-def]
    """Transpose pixels (pixel, bin) into full blocks."""
    for b in range(first_block, end_block):
        # A few pixels at a time: their rows are far apart, and the cache holds few such lines.
        for first in range(0, LANES, PIXELS_AT_ONCE):
            for k in range(counts.shape[1]):
                for i in range(first, first + PIXELS_AT_ONCE):
                    counts[b, k, i] = pixels[b * LANES + i, k]


def lane_spread(
    counts: NDArray[np.unsignedinteger], n_bins: int
) -> tuple[NDArray[np.unsignedinteger], NDArray[np.float64]]:
    """Largest count and standard deviation over the first `n_bins` of (block, bin, LANES) counts.

    Both of shape (block, LANES); 0 over no bins.
    """
    shape = len(counts), LANES
    largest, sigma = np.zeros(shape, counts.dtype), np.zeros(shape)
    if n_bins > 0:
        on_threads(_fill_spread, len(counts), counts.size, counts, n_bins, largest, sigma)
    return largest, sigma


@njit(**COMPILED)
def _fill_spread(first, end, counts, n_bins, largest, sigma):  # type: ignore[no-untyped-def]
    """Fill the largest count and the standard deviation, see `lane_spread`."""
    grouped = n_bins - n_bins % _BINS_AT_ONCE
    for b in range(first, end):
        block, top = counts[b], largest[b]
        total, squares = np.zeros(LANES, np.int64), np.zeros(LANES)
        for k in range(0, grouped, _BINS_AT_ONCE):
            for i in range(LANES):
                sums = total[i], squares[i], top[i]
                for j in range(_BINS_AT_ONCE):
                    sums = _with(block[k + j, i], block[0, i], sums)
                total[i], squares[i], top[i] = sums
        for k in range(grouped, n_bins):
            for i in range(LANES):
                sums = total[i], squares[i], top[i]
                total[i], squares[i], top[i] = _with(block[k, i], block[0, i], sums)
        for i in range(LANES):
            mean = total[i] / n_bins
            sigma[b, i] = math.sqrt(max(squares[i] / n_bins - mean * mean, 0.0))


def pixel_sums(cube: NDArray[np.unsignedinteger]) -> NDArray[np.int64]:
    """Add up the counts (..., bin) of each pixel, (...)."""
    if not cube.flags.c_contiguous:
        return np.asarray(cube.sum(axis=-1, dtype=np.int64))
    sums = np.empty(cube.shape[:-1], np.int64)
    pixels = cube.reshape(-1, cube.shape[-1])
    pixels.setflags(write=False)  # as in `lane_counts`
    _fill_sums(pixels, sums.reshape(-1))
    return sums


@njit(**COMPILED)
def _fill_sums(pixels, sums):  # type: ignore[no-untyped-def]
    """Fill the sum of each row of pixels (pixel, bin)."""
    for i in range(len(pixels)):
        total = np.int64(0)
        for count in pixels[i]:
            total += np.int64(count)
        sums[i] = total


@njit(**COMPILED, inline="always")
def _with(count, first, sums):  # type: ignore[no-untyped-def]
    """Add a count to sum, sum of squares and maximum.

    Moments are about the first count, so that σ of a constant histogram is exactly 0.
    """
    total, squares, top = sums
    more = np.int64(count) - np.int64(first)
    return total + more, squares + float(more) * float(more), count if count > top else top


@njit(**COMPILED)
def lane_rows(n_rows, lanes=LANES):  # type: ignore[no-untyped-def]
    """Scratch memory of `n_rows` rows of `lanes` float32, aligned to a cache line."""
    memory = np.empty(n_rows * lanes + 16, np.float32)
    start = (-(memory.ctypes.data // 4)) % 16
    return memory[start : start + n_rows * lanes]
