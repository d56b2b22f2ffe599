"""What looks at a pixel's neighbours."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats


def pooled_at(
    cube: NDArray[np.unsignedinteger], row: int, col: int, reach: int
) -> NDArray[np.uint64]:
    """What `pooled` gives one pixel, shape (bin,)."""
    steps = np.arange(reach) - reach // 2
    rows = np.clip(row + steps, 0, cube.shape[0] - 1)
    cols = np.clip(col + steps, 0, cube.shape[1] - 1)
    return np.asarray(cube[np.ix_(rows, cols)].sum(axis=(0, 1), dtype=np.uint64))


def pooled(cube: NDArray[np.unsignedinteger], reach: int) -> NDArray[np.unsignedinteger]:
    """Each pixel's counts added to those of its neighbours.

    Parameters
    ----------
    cube : ndarray, shape (row, col, bin)
    reach : int
        Rows and columns of the neighbourhood, odd.

    Returns
    -------
    ndarray, shape (row, col, bin)
        At the image's edge the outermost pixels stand in for the missing ones, so that every
        pixel's counts are those of the same number of pulses. As uint32, or as uint64 where that
        may not hold them.
    """
    return box_sum(cube.astype(np.uint64 if cube.dtype == np.uint32 else np.uint32), reach, "edge")


def pooled_in(
    cube: NDArray[np.unsignedinteger], here: tuple[slice, slice], reach: int
) -> NDArray[np.unsignedinteger]:
    """Return `pooled` for some rows and columns; the cube itself where `reach` is 1."""
    if reach == 1:
        return cube[here]
    wide, inner = widened(here, reach // 2)
    return pooled(cube[wide], reach)[inner]


Patch = tuple[slice, slice]
"""Rows and columns of an image."""


def widened(here: Patch, margin: int) -> tuple[Patch, Patch]:
    """Rows and columns with a margin, as far as there is one, and where in them the former lie."""
    first = [max(part.start - margin, 0) for part in here]
    wide = [slice(at, part.stop + margin) for at, part in zip(first, here, strict=True)]
    inner = [slice(part.start - at, part.stop - at) for at, part in zip(first, here, strict=True)]
    return (wide[0], wide[1]), (inner[0], inner[1])


def patches(shape: tuple[int, ...], most: int) -> Iterator[Patch]:
    """Cut a cube into parts that hold about `most` counts each, about as high as wide.

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


def box_sum(image: NDArray[Any], reach: int, beyond: Literal["edge", "constant"]) -> NDArray[Any]:
    """Sum over the neighbourhood of each pixel.

    Parameters
    ----------
    image : ndarray, shape (row, col, ...)
    reach : int
        Rows and columns of the neighbourhood, odd.
    beyond : str
        Beyond the image's edge: its outermost pixels ("edge"), or zeros ("constant").

    Returns
    -------
    ndarray, shape (row, col, ...)
        Of the image's type.
    """
    half = reach // 2
    around = [(half, half), (half, half)] + [(0, 0)] * (image.ndim - 2)
    wide = np.pad(image, around, mode=beyond)
    rows, cols = image.shape[:2]
    over_rows = wide[:rows].copy()
    for i in range(1, reach):
        over_rows += wide[i : i + rows]
    over_both = over_rows[:, :cols].copy()
    for i in range(1, reach):
        over_both += over_rows[:, i : i + cols]
    return over_both


def neighbours(image: Floats, missing: float) -> Floats:
    """The values of each pixel's 8 neighbours, shape (8, row, col).

    Parameters
    ----------
    image : ndarray, shape (row, col)
    missing : float
        Stands for a neighbour beyond the image's edge.
    """
    wide = np.pad(image, 1, constant_values=missing)
    rows, cols = image.shape
    steps = [(i, j) for i in range(3) for j in range(3) if (i, j) != (1, 1)]
    return np.stack([wide[i : i + rows, j : j + cols] for i, j in steps])


def weighted_median(values: Floats, weights: Floats) -> Floats:
    """Smallest value with at least half of the weight at or below it, along the first axis.

    Parameters
    ----------
    values, weights : ndarray, shape (n, ...)
        Weights are non-negative; that of a NaN must be 0.

    Returns
    -------
    ndarray, shape (...)
        NaN where all values are.
    """
    order = np.argsort(values, axis=0)  # NaN last
    until = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    middle = np.argmax(until >= 0.5 * until[-1], axis=0)[np.newaxis]
    return np.asarray(np.take_along_axis(values, np.take_along_axis(order, middle, 0), axis=0)[0])
