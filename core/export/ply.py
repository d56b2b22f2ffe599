"""PLY point clouds, binary and little-endian.

Coordinates are 32-bit floats, which every reader knows: exact to 6e-8 of themselves. ``range_m`` is
a double.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, BinaryIO

from numpy.typing import NDArray

from core.acquisition import Floats
from core.checks import require
from core.export.product import Product


def write(product: Product, file: BinaryIO) -> None:
    """Write x, y, z, range_m, counts, confidence, row and col of each point."""
    points = product.points()
    write_ply(points.xyz_m, product.point_columns(points), file)


def write_ply(xyz_m: Floats, columns: Mapping[str, NDArray[Any]], file: BinaryIO) -> None:
    """Write points with any properties.

    Parameters
    ----------
    xyz_m : ndarray, shape (point, 3)
        Coordinates in metres.
    columns : mapping of str to ndarray, shape (point,)
        Properties by name, each kept in its type: whole numbers of up to 32 bits, or floats.
        Colours are three uint8 columns named red, green and blue.
    file : file object
        Open for bytes.

    Raises
    ------
    ValueError
        If there are no points.
    """
    require("points", len(xyz_m), len(xyz_m) > 0, "an image with answers: a cloud needs points")
    from trimesh import PointCloud  # noqa: PLC0415 - only who writes PLY waits for it

    cloud = PointCloud(xyz_m, process=False)
    cloud.vertex_attributes = dict(columns)
    cloud.export(file, file_type="ply")
