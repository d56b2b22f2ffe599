"""Sample of an image that is too large to be processed as a whole."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.inference.neighbours import random_patches

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

    patches = random_patches(array.shape, SAMPLE_COUNTS // n_bins, _PATCH)
    return np.concatenate(dask.compute(*(array[patch] for patch in patches)))
