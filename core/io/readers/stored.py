"""Named arrays of HDF5, netCDF and Zarr files: listed at once, read box by box when needed.

Their libraries run in an isolated process (`core.io.readers.isolation`). Links, virtual datasets
and those kept in other files are never followed; a Zarr directory with a link in it is refused.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.checks import require
from core.io.readers.guards import FileVersion, decoding, require_fits
from core.io.readers.isolation import isolated
from core.io.readers.maps import Map
from core.io.readers.options import ReadOptions, choose_variable

HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
CLASSIC_SIGNATURES = (b"CDF\x01", b"CDF\x02")
ZARR_MARKS = ("zarr.json", ".zarray", ".zgroup")
"""File names, one of which a Zarr directory contains."""

_SMALL_CHUNK = 2**24  # bytes, however small the array
_MOST_CHUNKS = 2**24  # of one array


@dataclass(frozen=True)
class Stored:
    """Array in a file.

    Parameters
    ----------
    name : str
        Name of the array with the groups that it lies in.
    path : Path
        The file or directory.
    task : str
        Task of `core.io.readers.file_worker` that reads a box.
    version : FileVersion
        Version of the file, or of the metadata in a directory; refused once it has changed.
    folders : tuple of FileVersion
        Folders of the chunks: an absent chunk was never written unless one of them has changed.
    attributes : dict
        Numbers, lists of numbers, and text.
    axes : tuple of str or None
        Names of the axes, each None where the file gives none.
    refused : str
        Why it is not read; then the fields below are empty.
    references : tuple of int
        Shape of an array that refers to others, as MATLAB's cell arrays do; such are not read here.
    shape, dtype, chunk
        Size and type of the numbers; size of a chunk, ones where any box is read without the rest.
    """

    name: str
    path: Path
    task: str
    version: FileVersion
    folders: tuple[FileVersion, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    axes: tuple[str | None, ...] = ()
    refused: str = ""
    references: tuple[int, ...] = ()
    shape: tuple[int, ...] = ()
    dtype: np.dtype[Any] = np.dtype(float)  # noqa: RUF009 - immutable
    chunk: tuple[int, ...] = ()

    def __str__(self) -> str:
        size = " x ".join(map(str, self.shape))
        return f"{self.name} ({self.refused or size})"

    def __getitem__(self, box: tuple[slice, ...]) -> NDArray[Any]:
        """Read the numbers in a box of slices of positive steps."""
        edges = [slice_.indices(n) for slice_, n in zip(box, self.shape, strict=True)]
        shape = tuple(len(range(*each)) for each in edges)
        n_bytes, chunk_bytes = (prod(one) * self.dtype.itemsize for one in (shape, self.chunk))
        require_fits(self.name, n_bytes)
        if not n_bytes:
            return np.empty(shape, self.dtype)
        memory = 2 * n_bytes + 4 * chunk_bytes
        with self.version.unchanged():
            known, (found,) = isolated(
                self.path, self.name, self.task, working_bytes=memory, name=self.name, box=edges
            )
            for folder in self.folders if known.get("absent") else ():
                folder.require()
            read = f"array of {found.dtype} and shape {found.shape}"
            same = (found.shape, found.dtype) == (shape, self.dtype)
            require(f"content of {self.name}", read, same, f"{self.dtype} and shape {shape}")
        return found

    def whole(self) -> NDArray[Any]:
        """Read all numbers."""
        return self[(slice(None),) * len(self.shape)]


def arrays(path: Path) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """List all arrays of a file, and the attributes of its groups by name; its own under ``""``."""
    own = FileVersion.of(path)
    kind = "zarr" if path.is_dir() else "hdf5"
    if kind == "hdf5":
        with path.open("rb") as file:
            kind = "netcdf3" if file.read(4) in CLASSIC_SIGNATURES else kind
    listed, _ = isolated(path, "the file", f"list_{kind}", working_bytes=0)
    with decoding("the list of arrays"):
        return [_stored(one, path, f"read_{kind}", own) for one in listed["arrays"]], listed[
            "groups"
        ]


def _stored(one: dict[str, Any], path: Path, task: str, version: FileVersion) -> Stored:
    """Return the array that an entry of the list describes."""
    stamps = [one["version"], *one["folders"]] if "version" in one else []
    versions = [FileVersion(path / inside, tuple(stamp)) for inside, *stamp in stamps] or [version]
    about = {
        "attributes": one.get("attributes", {}),
        "axes": tuple(one.get("axes", ())),
        "refused": one.get("refused", ""),
        "references": tuple(one.get("references", ())),
    }
    found = Stored(str(one["name"]), path, task, versions[0], tuple(versions[1:]), **about)
    if found.refused:
        return found
    shape, dtype = tuple(one["shape"]), np.dtype(one["type"])
    chunk = tuple(one["chunk"] or (1,) * len(shape))
    try:
        _require_readable(found.name, shape, dtype.itemsize, chunk)
    except ValueError as error:
        return replace(found, refused=str(error))
    return replace(found, shape=shape, dtype=dtype, chunk=chunk)


def _require_readable(
    name: str, shape: tuple[int, ...], n_bytes: int, chunk: tuple[int, ...]
) -> None:
    """Raise ``ValueError`` if a chunk is too large, or there are too many."""
    fits = len(chunk) == len(shape) > 0 and min(*shape, *chunk) > 0
    require(name, f"an array of shape {shape}", fits, "one with numbers in it")
    in_all, in_chunk = prod(shape) * n_bytes, prod(chunk) * n_bytes
    most = max(2 * in_all, _SMALL_CHUNK)
    what = f"bytes of a chunk of {name}"
    require_fits(what, in_chunk)
    require(what, in_chunk, in_chunk <= most, f"up to {most:,}, as its array has {in_all:,}")
    if in_chunk > n_bytes:
        n_chunks = prod(-(-n // step) for n, step in zip(shape, chunk, strict=True))
        require(f"chunks of {name}", n_chunks, n_chunks <= _MOST_CHUNKS, "larger chunks")


def maps(path: Path) -> list[Map]:
    """List the images of a file; NaN where a number is missing."""
    listed, _ = arrays(path)
    return [
        Map(each.name, each.shape, partial(_decoded, each), str(each.attributes.get("units", "")))
        for each in listed
        if len(each.shape) == 2
    ]


def _decoded(image: Stored) -> NDArray[Any]:
    """Return the numbers of an image that may be packed, by the conventions of netCDF."""
    known = image.attributes
    stored = image.whole()
    gaps = [stored == known[name] for name in ("_FillValue", "missing_value") if name in known]
    scale, offset = (
        known.get(name, value) for name, value in (("scale_factor", 1), ("add_offset", 0))
    )
    numbers = stored.astype(float) * float(scale) + float(offset)
    numbers[np.logical_or.reduce(gaps, axis=0)] = np.nan
    return numbers


def choose(arrays: Sequence[Stored], request: ReadOptions) -> Stored:
    """Choose the requested array, else ``counts``, else the only one with three axes.

    Raises
    ------
    ValueError
        If no array fits, or the one chosen is refused.
    """
    named = {array.name: array for array in arrays}
    listed = ", ".join(map(str, arrays[:20])) + ", ..." * (len(arrays) > 20) or "nothing"
    requested = request.variable
    if requested is None and "counts" in named:
        requested = "counts"
    cubes = {array.name: array.dtype.kind in "iu" for array in arrays if len(array.shape) == 3}
    name = choose_variable(requested, named, cubes, "a (row, col, bin) array", listed)
    chosen = named[name]
    within = "an array of whole or real numbers in the file itself"
    require(f"variable {name}", chosen.refused, not chosen.refused, within)
    return chosen
