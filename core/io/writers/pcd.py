"""PCD 0.7 point clouds, binary, as the Point Cloud Library reads them.

Coordinates are 32-bit floats, exact to 6e-8 of themselves; ``range_m`` is a double.
Comments of the header hold the acquisition, method, settings (JSON), version and source, one line
``name: value`` each, those of more than 500 characters in several.
"""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from core.io.writers.product import Product


def write(product: Product, file: BinaryIO) -> None:
    """Write x, y, z, range_m, counts, confidence, row and col of each point.

    Where they are known, range_sd_m, half the 68 % interval, and the colour follow.
    """
    from pypcd4 import Encoding, PointCloud  # noqa: PLC0415 - slow to import

    points = product.points()
    xyz_m = dict(zip("xyz", points.xyz_m.T.astype(np.float32), strict=True))
    columns = xyz_m | product.point_columns(points)
    types = [values.dtype for values in columns.values()]
    cloud = PointCloud.from_points(list(columns.values()), list(columns), types)
    for line in product.ascii_lines:
        file.write(f"# {line}\n".encode())
    cloud.save(file, encoding=Encoding.BINARY)
