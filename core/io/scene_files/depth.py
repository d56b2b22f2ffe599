"""Depth maps: 16-bit PNG, and the first page of a TIFF of 16-bit numbers or 32-bit floats.

Whole numbers are millimetres and floats metres by default. Pillow decodes them in an isolated
process (`core.io.readers.isolation`).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from core.acquisition import Floats
from core.checks import require
from core.io.readers import guards
from core.io.readers.isolation import isolated

SUFFIXES = (".png", ".tif", ".tiff")

_BYTES_A_PIXEL = 32  # of memory, while it becomes a range
_MILLIMETRE_M = 1e-3


def read(path: Path, unit_m: float | None) -> Floats:
    """Read ranges in metres, shape (row, col), NaN where there is no target."""
    kind = "PNG" if path.suffix.lower() == ".png" else "TIFF"
    most = guards.MAX_CUBE_BYTES // _BYTES_A_PIXEL
    _, (stored,) = isolated(path, "the image", "read_depths", kind=kind, most_pixels=most)
    range_m = stored.astype(np.float64)
    odd = ~((range_m >= 0) & (range_m < np.inf)) & ~np.isnan(range_m)
    if odd.any():
        row, col = (int(index[0]) for index in np.nonzero(odd))
        value = float(range_m[row, col])
        require(f"depth of pixel ({row}, {col})", value, False, "a range, or 0 or NaN for none")
    range_m *= unit_m or (1.0 if stored.dtype.kind == "f" else _MILLIMETRE_M)
    range_m[range_m == 0] = np.nan
    return range_m
