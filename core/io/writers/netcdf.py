"""netCDF-4 (which is HDF5) and Zarr, with the metadata of the CF conventions.

Variables ``range_m``, ``confidence``, ``counts``, ``bin``, ``score``, ``valid`` (1 or 0) over the
dimensions ``row`` and ``col``; acquisition, method, settings (JSON), version and source are
attributes of the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from core.io.writers.product import Product
from core.labels import images_dataset

if TYPE_CHECKING:
    import xarray as xr


def write(product: Product, file: BinaryIO) -> None:
    """Write a dataset."""
    file.write(_dataset(product).to_netcdf(engine="h5netcdf"))


def write_zarr(product: Product, folder: Path) -> None:
    """Write a dataset into a folder, as Zarr."""
    write_folder(_dataset(product), folder)


def write_folder(data: xr.Dataset, folder: Path) -> None:
    """Write a dataset as Zarr.

    It is packed in memory first: Zarr's own threads go on writing files after one has failed.
    """
    from zarr.storage import MemoryStore  # noqa: PLC0415

    packed: dict[str, Any] = {}
    data.to_zarr(MemoryStore(packed), consolidated=False)
    for name, content in packed.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content.to_bytes())


def _dataset(product: Product) -> xr.Dataset:
    about = {"Conventions": "CF-1.11", "title": product.heading}
    return images_dataset(product.planes, {**about, **product.facts})
