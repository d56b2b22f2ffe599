"""Builders of HDF5, netCDF, Zarr and MATLAB 7.3 files, laid out as other programs write them."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from core.io.readers.stored import Stored


def hdf5_bytes(user_block: int = 0, **arrays: Any) -> bytes:
    """A file of arrays; a mapping holds ``data``, its ``attributes`` and how to store it."""
    file = io.BytesIO()
    with h5py.File(file, "w", userblock_size=user_block) as target:
        for name, array in arrays.items():
            options = dict(array) if isinstance(array, Mapping) else {"data": array}
            known = options.pop("attributes", {})
            target.create_dataset(name, **options).attrs.update(known)
    return file.getvalue()


def netcdf_bytes(dataset: Any, **encoding: Any) -> bytes:
    """A netCDF-4 file of an xarray dataset; `encoding` is that of its counts."""
    return bytes(dataset.to_netcdf(engine="h5netcdf", encoding={"counts": encoding}))


def zarr_files(dataset: Any, version: int, **encoding: Any) -> dict[str, bytes]:
    """The files of a Zarr directory of an xarray dataset, by their paths in it."""
    with tempfile.TemporaryDirectory() as folder:
        dataset.to_zarr(
            folder, zarr_format=version, consolidated=False, encoding={"counts": encoding}
        )
        files = sorted(file for file in Path(folder).rglob("*") if file.is_file())
        return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


class Matlab73:
    """A file as MATLAB's ``save -v7.3`` lays it out: HDF5 behind a header of 512 bytes.

    Every dataset has the attribute MATLAB_class; axes are in reverse order; a cell array is an
    array of references into a group ``#refs#``; an empty array is stored as its size.
    """

    def __init__(self) -> None:
        self._file = io.BytesIO()
        self._hdf5 = h5py.File(self._file, "w", userblock_size=512)
        self._n_cells = 0

    def number(
        self, name: str, values: Any, kind: str | None = None, **options: Any
    ) -> h5py.Dataset:
        """Numbers, at least a matrix."""
        array = np.atleast_2d(np.asarray(values))
        if array.size:
            dataset = self._hdf5.create_dataset(name, data=array.transpose(), **options)
        else:
            dataset = self._hdf5.create_dataset(name, data=np.array(array.shape, np.uint64))
            dataset.attrs["MATLAB_empty"] = np.uint8(1)
        names = {"float64": "double", "float32": "single"}
        kind = kind or names.get(array.dtype.name, array.dtype.name)
        dataset.attrs["MATLAB_class"] = np.bytes_(kind)
        return dataset

    def cells(self, name: str, cells: NDArray[np.object_], **options: Any) -> h5py.Dataset:
        """A cell array of vectors."""
        references = np.empty(cells.shape, h5py.ref_dtype)
        for place in np.ndindex(cells.shape):
            content = self.number(f"#refs#/c{self._n_cells}", cells[place], **options)
            self._n_cells += 1
            references[place] = content.ref
        dataset = self._hdf5.create_dataset(name, data=references.T, dtype=h5py.ref_dtype)
        dataset.attrs["MATLAB_class"] = np.bytes_("cell")
        return dataset

    def text(self, name: str, text: str) -> None:
        """A row of characters."""
        codes = np.array([[ord(letter) for letter in text]], np.uint16)
        self.number(name, codes, "char").attrs["MATLAB_int_decode"] = np.int32(2)

    def sparse(self, name: str, matrix: Any) -> h5py.Group:
        """A sparse matrix."""
        kept = matrix.tocsc()
        group = self._hdf5.create_group(name)
        group.attrs["MATLAB_class"] = np.bytes_("double")
        group.attrs["MATLAB_sparse"] = np.uint64(matrix.shape[0])
        group["data"] = kept.data.astype(float)
        group["ir"] = kept.indices.astype(np.uint64)
        group["jc"] = kept.indptr.astype(np.uint64)
        return group

    def bytes(self) -> bytes:
        """The file, which is then closed."""
        self._hdf5.close()
        header = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM"
        return header.ljust(512, b"\0") + self._file.getvalue()[512:]


class Reads:
    """Count the bytes of arrays that are read from files."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.n_bytes = 0
        read = Stored.__getitem__

        def counted(array: Stored, box: tuple[slice, ...]) -> NDArray[Any]:
            found = read(array, box)
            self.n_bytes += found.nbytes
            return found

        monkeypatch.setattr(Stored, "__getitem__", counted)
