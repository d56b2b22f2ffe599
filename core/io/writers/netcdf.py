"""netCDF-4 with the metadata of the CF conventions; such a file is an HDF5 file, too. And Zarr.

Variables ``range_m``, ``confidence``, ``counts``, ``bin``, ``score``, ``valid`` (1 or 0) over the
dimensions ``row`` and ``col``; acquisition and source are attributes of the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from core.io.writers.product import Plane, Product

if TYPE_CHECKING:
    import xarray as xr

_FLAGS = {"flag_values": np.array([0, 1], np.int8), "flag_meanings": "no_answer answer"}


def write(product: Product, file: BinaryIO) -> None:
    """Write a dataset."""
    file.write(_dataset(product).to_netcdf(engine="h5netcdf"))


def write_zarr(product: Product, folder: Path) -> None:
    """Write a dataset into a folder, as Zarr."""
    write_folder(_dataset(product), folder)


def write_folder(data: xr.Dataset, folder: Path) -> None:
    """Write a dataset as Zarr.

    It is packed in memory before: of files, Zarr's own threads write more after one has failed.
    """
    from zarr.storage import MemoryStore  # noqa: PLC0415

    packed: dict[str, Any] = {}
    data.to_zarr(MemoryStore(packed), consolidated=False)
    for name, content in packed.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content.to_bytes())


def _dataset(product: Product) -> xr.Dataset:
    import xarray as xr  # noqa: PLC0415 - slow to import

    variables = {
        name: (("row", "col"), _numbers(plane), _attributes(plane))
        for name, plane in product.planes.items()
    }
    about = {"Conventions": "CF-1.11", "title": product.heading}
    return xr.Dataset(variables, attrs={**about, **product.facts})


def _numbers(plane: Plane) -> NDArray[Any]:
    """The values; netCDF has no booleans."""
    return plane.values.astype(np.int8) if plane.values.dtype == bool else plane.values


def _attributes(plane: Plane) -> dict[str, object]:
    flags = _FLAGS if plane.values.dtype == bool else {}
    return {"units": plane.unit, "long_name": plane.meaning, **flags}
