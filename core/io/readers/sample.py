"""Sample of an image that is too large to be processed as a whole."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

SAMPLE_COUNTS = 2**25
"""Largest sample, in counts of bins: 64 MiB of uint16. A smaller image is its own."""

_PATCH = 32  # rows and columns that stay together, for estimates from neighbours


def sample_of(array: Any) -> NDArray[Any]:
    """Return patches of an array (row, col, bin), Dask's or numpy's, from all over the image.

    All of it if it is small. Of a larger one few chunks are read: those in which the patches lie.
    """
    rows, cols, n_bins = array.shape
    if rows * cols * n_bins <= SAMPLE_COUNTS:
        return np.asarray(array)
    import dask  # noqa: PLC0415 - half a second that others should not pay

    high, wide = min(_PATCH, rows), min(_PATCH, cols)
    n_patches = max(1, SAMPLE_COUNTS // (high * wide * n_bins))
    rng = np.random.default_rng(0)
    corners = rng.integers((rows - high + 1, cols - wide + 1), size=(n_patches, 2)).tolist()
    patches = [array[top : top + high, left : left + wide] for top, left in corners]
    return np.concatenate(dask.compute(*patches))
