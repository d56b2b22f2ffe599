"""Sums, values and medians of the neighbours of each pixel."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats


def pooled_at(
    cube: NDArray[np.unsignedinteger], row: int, col: int, window_size: int
) -> NDArray[np.uint64]:
    """Return `pooled` for one pixel, shape (bin,)."""
    steps = np.arange(window_size) - window_size // 2
    rows = np.clip(row + steps, 0, cube.shape[0] - 1)
    cols = np.clip(col + steps, 0, cube.shape[1] - 1)
    return np.asarray(cube[np.ix_(rows, cols)].sum(axis=(0, 1), dtype=np.uint64))


def pooled(cube: NDArray[np.unsignedinteger], window_size: int) -> NDArray[np.unsignedinteger]:
    """Add the counts of the neighbours to those of each pixel.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
    window_size : int
        Rows and columns of the neighbourhood, odd.

    Returns
    -------
    ndarray, shape (row, col, bin)
        Pixels at the edge of the image are repeated beyond it, so that all sums are of the same
        number of pulses. As uint32, or uint64 for a uint32 cube.
    """
    wide = np.uint64 if cube.dtype == np.uint32 else np.uint32
    return box_sum(cube.astype(wide), window_size, "edge")


def pooled_in(
    cube: NDArray[np.unsignedinteger], here: tuple[slice, slice], window_size: int
) -> NDArray[np.unsignedinteger]:
    """Return `pooled` for some rows and columns; a view of the cube if `window_size` is 1."""
    if window_size == 1:
        return cube[here]
    wide, inner = widened(here, window_size // 2)
    return pooled(cube[wide], window_size)[inner]


Patch = tuple[slice, slice]
"""Rows and columns of an image."""


def random_patches(shape: tuple[int, ...], most_pixels: int, side: int) -> list[Patch]:
    """Return places of patches of an image (row, col, ...), the same ones at each call.

    At least one, and as many as hold `most_pixels`, of at most `side` rows and columns.
    """
    high, wide = min(side, shape[0]), min(side, shape[1])
    n_patches = max(1, most_pixels // (high * wide))
    last = (shape[0] - high + 1, shape[1] - wide + 1)
    corners = np.random.default_rng(0).integers(last, size=(n_patches, 2)).tolist()
    return [(slice(top, top + high), slice(left, left + wide)) for top, left in corners]


def widened(here: Patch, margin: int) -> tuple[Patch, Patch]:
    """Return a patch with a margin, clipped to the image, and the position of `here` in it."""
    first = [max(part.start - margin, 0) for part in here]
    wide = [slice(at, part.stop + margin) for at, part in zip(first, here, strict=True)]
    inner = [slice(part.start - at, part.stop - at) for at, part in zip(first, here, strict=True)]
    return (wide[0], wide[1]), (inner[0], inner[1])


def patches(shape: tuple[int, ...], most: int) -> Iterator[Patch]:
    """Split a cube into nearly square patches of about `most` counts each.

    Parameters
    ----------
    shape : tuple of int
        Rows, columns and bins.
    most : int
    """
    rows, cols, n_bins = shape
    wide = min(cols, max(1, math.isqrt(most // n_bins)))
    high = max(1, most // (wide * n_bins))
    for row in range(0, rows, high):
        for col in range(0, cols, wide):
            yield slice(row, min(row + high, rows)), slice(col, min(col + wide, cols))


def box_sum(
    image: NDArray[Any], window_size: int, beyond: Literal["edge", "constant"]
) -> NDArray[Any]:
    """Sum over the neighbourhood of each pixel.

    Parameters
    ----------
    image : ndarray, shape (row, col, ...)
    window_size : int
        Rows and columns of the neighbourhood, odd.
    beyond : str
        Values beyond the edge of the image: its outermost pixels ("edge") or zeros ("constant").

    Returns
    -------
    ndarray, shape (row, col, ...)
        Same dtype as the image.
    """
    half = window_size // 2
    around = [(half, half), (half, half)] + [(0, 0)] * (image.ndim - 2)
    wide = np.pad(image, around, mode=beyond)
    rows, cols = image.shape[:2]
    over_rows = wide[:rows].copy()
    for i in range(1, window_size):
        over_rows += wide[i : i + rows]
    over_both = over_rows[:, :cols].copy()
    for i in range(1, window_size):
        over_both += over_rows[:, i : i + cols]
    return over_both


def neighbours(image: Floats, half: int, missing: float) -> Floats:
    """Values of the pixels around each pixel, shape (n, row, col).

    Parameters
    ----------
    image : ndarray, shape (row, col)
    half : int
        Rows and columns on either side: 1 for the 8 neighbours, 2 for 24.
    missing : float
        Value beyond the edge of the image.
    """
    wide, size = np.pad(image, half, constant_values=missing), 2 * half + 1
    rows, cols = image.shape
    steps = [(i, j) for i in range(size) for j in range(size) if (i, j) != (half, half)]
    return np.stack([wide[i : i + rows, j : j + cols] for i, j in steps])


def weighted_median(values: Floats, weights: Floats) -> Floats:
    """Smallest value with at least half of the weight at or below it, along the first axis.

    Parameters
    ----------
    values, weights : ndarray, shape (n, ...)
        Weights are non-negative, and 0 for NaN.

    Returns
    -------
    ndarray, shape (...)
        NaN where all values are NaN.
    """
    order = np.argsort(values, axis=0)  # NaN last
    until = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    middle = np.argmax(until >= 0.5 * until[-1], axis=0)[np.newaxis]
    return np.asarray(np.take_along_axis(values, np.take_along_axis(order, middle, 0), axis=0)[0])
