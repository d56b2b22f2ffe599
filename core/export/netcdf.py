"""netCDF-4 with the metadata of the CF conventions; such a file is an HDF5 file, too.

Variables ``range_m``, ``confidence``, ``counts``, ``bin``, ``score``, ``valid`` (1 or 0) over the
dimensions ``row`` and ``col``; acquisition and source are attributes of the file.
"""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from core.export.product import Plane, Product

_FLAGS = {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "no_answer answer"}


def write(product: Product, file: BinaryIO) -> None:
    """Write a dataset."""
    import xarray  # noqa: PLC0415 - only who writes netCDF waits for it

    variables = {
        name: (("row", "col"), _numbers(plane), _attributes(plane))
        for name, plane in product.planes.items()
    }
    about = {"Conventions": "CF-1.11", "title": product.heading}
    dataset = xarray.Dataset(variables, attrs={**about, **product.facts})
    file.write(dataset.to_netcdf(engine="h5netcdf"))


def _numbers(plane: Plane) -> NDArray[Any]:
    """The values; netCDF has no booleans."""
    return plane.values.astype(np.int8) if plane.values.dtype == bool else plane.values


def _attributes(plane: Plane) -> dict[str, object]:
    flags = _FLAGS if plane.values.dtype == bool else {}
    return {"units": plane.unit, "long_name": plane.meaning, **flags}
