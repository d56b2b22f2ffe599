"""Named arrays of HDF5, netCDF and Zarr files, read box by box.

No array is read before a box of it is needed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.checks import require
from core.io.readers.guards import FileVersion, decoding, require_fits
from core.io.readers.isolation import isolated
from core.io.readers.options import ReadOptions

_SMALL_CHUNK = 2**24  # bytes, however small the array
_MOST_CHUNKS = 2**24  # of one array


@dataclass(frozen=True)
class Numbers:
    """An array in a file, read box by box in an isolated process.

    Parameters
    ----------
    name : str
        Of the array within the file.
    shape : tuple of int
    dtype : dtype
        Type of its numbers.
    chunk : tuple of int
        Size of a chunk along each axis; ones where any box is read without the rest.
    path : Path
        The file or directory.
    task : str
        Task of `core.io.readers.file_worker` that reads a box.
    version : FileVersion
        Of the file or the metadata; refused once it has changed.
    folders : tuple of FileVersion
        Folders of the chunks: an absent chunk was never written unless one of them has changed.

    Raises
    ------
    ValueError
        If a chunk is too large, or there are too many.
    """

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    chunk: tuple[int, ...]
    path: Path
    task: str
    version: FileVersion
    folders: tuple[FileVersion, ...] = ()

    def __post_init__(self) -> None:
        fits = len(self.chunk) == len(self.shape) > 0 and min(*self.shape, *self.chunk) > 0
        require(self.name, f"an array of shape {self.shape}", fits, "one with numbers in it")
        in_all, n_bytes = (prod(one) * self.dtype.itemsize for one in (self.shape, self.chunk))
        most = max(2 * in_all, _SMALL_CHUNK)
        what = f"bytes of a chunk of {self.name}"
        require_fits(what, n_bytes)
        require(what, n_bytes, n_bytes <= most, f"up to {most:,}, as its array has {in_all:,}")
        if n_bytes > self.dtype.itemsize:
            n_chunks = prod(-(-n // step) for n, step in zip(self.shape, self.chunk, strict=True))
            require(f"chunks of {self.name}", n_chunks, n_chunks <= _MOST_CHUNKS, "larger chunks")

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
            told, (found,) = isolated(
                self.path, self.name, self.task, memory, name=self.name, box=edges
            )
            for folder in self.folders if told.get("absent") else ():
                folder.require()
            read = f"array of {found.dtype} and shape {found.shape}"
            same = (found.shape, found.dtype) == (shape, self.dtype)
            require(f"content of {self.name}", read, same, f"{self.dtype} and shape {shape}")
        return found


def whole(numbers: Numbers) -> NDArray[Any]:
    """All numbers of an array."""
    return numbers[(slice(None),) * len(numbers.shape)]


@dataclass(frozen=True)
class Stored:
    """An array in a file.

    Parameters
    ----------
    name : str
        Within the file, with the groups that it lies in.
    numbers : Numbers or None
        None where it is refused.
    axes : tuple of str or None
        Names of the axes, each None where the file gives none.
    attributes : dict
        Numbers, lists of numbers, and text.
    refused : str
        Why it is not read.
    references : tuple of int
        Shape of an array that refers to others, as MATLAB's cell arrays do; such are not read here.
    """

    name: str
    numbers: Numbers | None = None
    axes: tuple[str | None, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    refused: str = ""
    references: tuple[int, ...] = ()

    def __str__(self) -> str:
        size = " x ".join(map(str, self.numbers.shape)) if self.numbers is not None else ""
        return f"{self.name} ({self.refused or size or 'one number'})"

    @property
    def n_axes(self) -> int:
        """Number of axes; 0 for an array that is refused."""
        return 0 if self.numbers is None else len(self.numbers.shape)


def choose(arrays: Sequence[Stored], request: ReadOptions) -> Stored:
    """Choose the requested array, else ``counts``, else the only one with three axes.

    Raises
    ------
    ValueError
        If no array fits, or the one chosen is refused.
    """
    for known, times in Counter(array.name for array in arrays).items():
        require(f"arrays named {known!r}", times, times == 1, "each name once")
    named = {array.name: array for array in arrays}
    listed = ", ".join(map(str, arrays[:20])) + ", ..." * (len(arrays) > 20) or "nothing"
    remedy = f"as variable the name of a (row, col, bin) array; the file has {listed}"
    name = request.variable
    if name is None:
        cubes = [array.name for array in arrays if array.n_axes == 3]
        name = "counts" if "counts" in named else cubes[0] if len(cubes) == 1 else None
        require("variable", ", ".join(cubes) or None, name is not None, remedy)
    require("variable", name, name in named, remedy)
    chosen = named[str(name)]
    within = "an array of whole or real numbers in the file itself"
    require(f"variable {name}", chosen.refused, chosen.numbers is not None, within)
    return chosen


def listed(
    path: Path,
    task: str,
    read: str,
    versions: Mapping[str, FileVersion],
    folders: Mapping[str, tuple[FileVersion, ...]] | None = None,
    **more: Any,
) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """List all arrays of a file, and the attributes of its groups by name; its own under ``""``.

    Parameters
    ----------
    path : Path
    task, read : str
        Tasks of `core.io.readers.file_worker` that list the arrays and read a box.
    versions, folders : dict
        Of each array, see `Numbers`; under ``""`` the version of all others.
    **more
        Arguments of the task.
    """
    told, _ = isolated(path, "the file", task, **more)
    found = []
    with decoding("the list of arrays"):
        for one in told["arrays"]:
            name, known = str(one["name"]), one.get("attributes", {})
            axes = tuple(one.get("axes", ()))
            if "refused" in one:
                references = tuple(one.get("references", ()))
                found.append(Stored(name, None, axes, known, str(one["refused"]), references))
                continue
            shape, dtype = tuple(one["shape"]), np.dtype(one["type"])
            chunk = tuple(one["chunk"] or (1,) * len(shape))
            own, around = versions.get(name, versions[""]), (folders or {}).get(name, ())
            try:
                numbers = Numbers(name, shape, dtype, chunk, path, read, own, around)
            except ValueError as error:
                found.append(Stored(name, None, axes, known, str(error)))
            else:
                found.append(Stored(name, numbers, axes, known))
        return found, told["groups"]
