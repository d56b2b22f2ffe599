"""PLY point clouds, binary and little-endian.

Coordinates are 32-bit floats, which every reader supports: exact to a relative 6e-8. ``range_m``
is a double. Comments of the header hold the acquisition, method, settings (JSON), version and
source, one line ``name: value`` each, those of more than 500 characters in several.
"""

from __future__ import annotations

from typing import BinaryIO

from core.io.writers.product import Product


def write(product: Product, file: BinaryIO) -> None:
    """Write x, y, z, range_m, counts, confidence, row and col of each point.

    Where they are known, range_sd_m, half the 68 % interval, and the colour follow.
    """
    from trimesh import PointCloud  # noqa: PLC0415 - slow to import

    points = product.points()
    cloud = PointCloud(points.xyz_m, process=False)
    cloud.vertex_attributes = product.point_columns(points)
    magic, kind, rest = cloud.export(file_type="ply").split(b"\n", 2)
    comments = [f"comment {line}".encode() for line in product.ascii_lines]
    file.write(b"\n".join([magic, kind, *comments, rest]))
