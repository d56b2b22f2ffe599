"""MATLAB's sparse matrices (pixel, bin) of counts, as published simulated captures are kept.

The pixels of the image lie one after the other, column by column unless ``axes`` says ``"row col"``
instead of ``"col row"``: MATLAB's ``reshape`` makes such a list of an image. Rows and columns come
from ``shape``; without it the image is guessed to be square.
"""

from __future__ import annotations

from dataclasses import replace
from math import isqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import LARGEST_COUNT, count_dtype, dense_capture
from core.io.readers.guards import require_fits
from core.io.readers.options import ReadOptions


class Sparse(NamedTuple):
    """A matrix as MATLAB keeps it.

    The ``values`` are in column order, ``rows`` gives the row of each, and ``starts`` where each
    column begins, followed by the end of the last one.
    """

    values: NDArray[Any]
    rows: NDArray[Any]
    starts: NDArray[Any]
    shape: tuple[int, int]


def sparse_capture(
    matrix: Sparse, name: str, origin: str, request: ReadOptions, bin_width_s: float | None = None
) -> Capture:
    """A capture from a sparse matrix (pixel, bin).

    Parameters
    ----------
    matrix : Sparse
    name, origin : str
        Name of the matrix in errors, and origin of the capture in its source.
    request : ReadOptions
    bin_width_s : float, optional
        Used if none is given.

    Raises
    ------
    ValueError
        If the matrix is damaged, holds no counts, or its pixels make no image.
    """
    n_pixels, n_bins = matrix.shape
    by_row = request.order(("row", "col")) == (0, 1)
    side = isqrt(n_pixels)
    shape = request.shape or (side, side)
    product = f"rows and columns of {n_pixels} pixels in all"
    require("shape", request.shape, shape[0] * shape[1] == n_pixels, product)
    guessed = [] if request.shape else [f"shape {shape[0]} x {shape[1]}"]
    guessed += [] if request.axes else ["pixels column by column"]
    pixel, bins, counts = _entries(matrix, name)
    if not by_row:
        col, row = np.divmod(pixel, shape[0])
        pixel = row * shape[1] + col
    dtype = count_dtype(int(counts.max(initial=0)))
    require_fits(f"the cube of {name}", n_pixels * n_bins * dtype.itemsize)
    cube = np.zeros((n_pixels, n_bins), dtype)
    cube[pixel, bins] = counts
    told = replace(request, shape=None, axes=None)
    return dense_capture(
        cube.reshape(*shape, n_bins),
        origin,
        told,
        also_guessed=guessed,
        guessed_bin_width_s=bin_width_s,
    )


def _entries(
    matrix: Sparse, name: str
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Row, column and value of each entry, once they proved to be what they should."""
    n_rows, n_cols = matrix.shape
    found = len(matrix.starts)
    require(f"columns of {name}", found - 1, found == n_cols + 1, f"{n_cols}, as its shape says")
    starts = matrix.starts.astype(np.int64)
    steps = np.diff(starts)
    n_entries = int(starts[-1])
    most = min(len(matrix.values), len(matrix.rows))
    rising = starts[0] == 0 and bool((steps >= 0).all()) and n_entries <= most
    require(f"entries of {name}", n_entries, rising, f"columns one after the other, up to {most}")
    values, row = matrix.values[:n_entries], matrix.rows[:n_entries].astype(np.int64)
    col = np.repeat(np.arange(n_cols), steps)
    inside = bool(((row >= 0) & (row < n_rows)).all())
    once = bool((np.diff(col * n_rows + row) > 0).all())
    require(f"rows of {name}", "out of order", inside and once, f"rising ones below {n_rows}")
    odd = ~((values >= 0) & (values <= LARGEST_COUNT) & (values == np.floor(values)))
    if odd.any():
        require(name, values[odd][0].item(), False, f"whole counts from 0 to {LARGEST_COUNT:,}")
    return row, col, values.astype(np.int64)
