"""LAS 1.4 point clouds, and LAZ, their compressed form.

Coordinates are whole multiples of a step: the power of ten that is a thousandth of a bin or less,
down to a hundredth of that; only a cloud too wide for 32 bits gets coarser ones. ``intensity`` is
the counts, at most 65535, ``return_number`` and ``number_of_returns`` are those of the image, or 1,
and colours fill 16 bits as the standard requires. Extra bytes hold the other columns, with units in
their descriptions. A record (VLR) of the user "firstphoton" holds the acquisition, method, settings
(JSON), version and source as lines ``name: value`` of UTF-8, cut off at the 65,535 bytes that fit.
"""

from __future__ import annotations

import math
from typing import BinaryIO

import numpy as np

from core.acquisition import Floats
from core.io.writers.product import COLORS, Product
from core.labels import software

_MOST_IN_RECORD = 2**16 - 1  # bytes

DESCRIPTIONS = {
    "range_m": "range of the surface, m",
    "counts": "detections of the pixel",
    "confidence": "probability within 3 bins, 0-1",
    "range_sd_m": "half the 68 % interval, m",
    "strength": "signal photons per pulse",
    "row": "row of the pixel, 0 on top",
    "col": "column of the pixel",
}
"""Descriptions of the extra bytes, at most 31 characters each."""


def write(product: Product, file: BinaryIO) -> None:
    """Write LAS."""
    _write(product, file, compressed=False)


def write_compressed(product: Product, file: BinaryIO) -> None:
    """Write LAZ."""
    _write(product, file, compressed=True)


def _write(product: Product, file: BinaryIO, *, compressed: bool) -> None:
    import laspy  # noqa: PLC0415 - slow to import

    points = product.points()
    columns = product.point_columns(points)
    colors = {name: columns.pop(name) for name in COLORS if name in columns}
    numbers = {name: columns.pop(name, 1) for name in ("return_number", "number_of_returns")}
    header = laspy.LasHeader(version="1.4", point_format=7 if colors else 6)
    header.generating_software = software()
    text = "\n".join(product.lines).encode()[:_MOST_IN_RECORD].decode(errors="ignore").encode()
    header.vlrs.append(laspy.VLR("firstphoton", 1, "How the ranges were estimated", text))
    header.global_encoding.wkt = True  # as the standard requires of this point format
    header.offsets, header.scales = _grid(points.xyz_m, product.capture.acquisition.bin_length_m)
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name, values.dtype, DESCRIPTIONS[name])
            for name, values in columns.items()
        ]
    )
    las = laspy.LasData(header)
    las.xyz = points.xyz_m
    las.intensity = np.minimum(columns["counts"], 2**16 - 1).astype(np.uint16)
    for name, number in numbers.items():
        las[name][:] = number
    for name, values in columns.items():
        las[name] = values
    for name, values in colors.items():
        las[name] = values.astype(np.uint16) * 257
    las.write(file, do_compress=compressed)


def _grid(xyz_m: Floats, bin_length_m: float) -> tuple[Floats, Floats]:
    """Return offsets and scales of x, y and z in metres."""
    low, high = xyz_m.min(axis=0), xyz_m.max(axis=0)
    offsets = np.round((low + high) / 2)
    extent = float(np.abs(xyz_m - offsets).max())
    fine = math.floor(math.log10(bin_length_m / 1000))
    coarse = math.ceil(math.log10(max(extent, 1e-9) / (2**31 - 1)))
    return offsets, np.full(3, 10.0 ** max(fine, coarse))
