"""Depth maps: 16-bit PNG, and the first page of a TIFF of 16-bit numbers or 32-bit floats.

Whole numbers are millimetres and floats metres by default. Pillow decodes: it takes an image's
size from its header, and never unpacks more than that.
"""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from core.acquisition import Floats
from core.checks import require
from core.io.readers.guards import decoding, require_fits

SUFFIXES = (".png", ".tif", ".tiff")

_FORMATS = {".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF"}
_IMAGE = "the image of 16-bit numbers or 32-bit floats"
_BITS_16 = ("I;16", "I;16L", "I;16B", "I;16N")
_FLOATS = "F"
_BYTES_A_PIXEL = 32  # of memory, while it becomes a range
_MILLIMETRE_M = 1e-3


def read(path: Path, unit_m: float | None) -> Floats:
    """Read ranges in metres, shape (row, col), NaN where there is no target."""
    from PIL import Image  # noqa: PLC0415 - slow to import

    require_fits("the file", path.stat().st_size)
    with decoding(_IMAGE):
        # From memory: a file's own reader asks for as many bytes as a part of it claims.
        stream = BytesIO(path.read_bytes())
        image = Image.open(stream, formats=[_FORMATS[path.suffix.lower()]])
    with image:
        require_fits("the image", image.width * image.height * _BYTES_A_PIXEL)
        depths = image.mode in (*_BITS_16, _FLOATS)
        require("kind of pixels", image.mode, depths, "one 16-bit number or 32-bit float for each")
        with decoding(_IMAGE):
            stored = np.asarray(image)
            range_m = stored.astype(np.float64)
    odd = ~((range_m >= 0) & (range_m < np.inf)) & ~np.isnan(range_m)
    if odd.any():
        row, col = (int(index[0]) for index in np.nonzero(odd))
        value = float(range_m[row, col])
        require(f"depth of pixel ({row}, {col})", value, False, "a range, or 0 or NaN for none")
    range_m *= unit_m or (1.0 if stored.dtype.kind == "f" else _MILLIMETRE_M)
    range_m[range_m == 0] = np.nan
    return range_m
