"""HDF5 and netCDF-4: what arrays a file holds, and their numbers.

The HDF5 library looks at the file in a process of its own (`core.io.readers.hdf5_survey`) and tells
where the numbers lie; they are read and unpacked here. Of filters, deflate, shuffle, fletcher32 and
LZF are known. Links to other files, virtual datasets and those kept in other files are never
followed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.io.readers.chunks import Chunked, Contiguous, Filter, Part, Stretches, Whole
from core.io.readers.guards import FileVersion, decoding, isolated
from core.io.readers.stored import Numbers, Stored

SIGNATURE = b"\x89HDF\r\n\x1a\n"

_SURVEY = Path(__file__).with_name("hdf5_survey.py")
_OF_NETCDF = ("CLASS", "NAME", "_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties")
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"


def arrays(path: Path) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """All arrays of a file, and the attributes of its groups by name; the file's own are ``""``."""
    file = FileVersion.of(path)
    told, tables = isolated(_SURVEY, path, "the file", "survey")
    with decoding("the list of arrays"):
        groups = {name: _plain(known) for name, known in told["groups"].items()}
        found = [
            _stored(file, one, tables.get(f"{k}"))
            for k, one in enumerate(told["arrays"])
            if not str(one.get("attributes", {}).get("NAME", "")).startswith(_NO_VARIABLE)
        ]
    return found, groups


def cells(path: Path, name: str, most_values: int) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """The vectors in an array of references, one after the other, and the size of each."""
    _, found = isolated(_SURVEY, path, name, "cells", name, str(most_values))
    return found["values"], found["sizes"]


def _stored(file: FileVersion, one: Mapping[str, Any], table: NDArray[Any] | None) -> Stored:
    name, known = str(one["name"]), _plain(one.get("attributes", {}))
    if "refused" in one:
        shape = tuple(one["shape"]) if "references" in one else ()
        return Stored(name, None, (), known, str(one["refused"]), shape)
    shape = tuple(int(n) for n in one["shape"])
    if not shape or min(shape) == 0:
        return Stored(name, None, attributes=known, refused=f"an array of shape {shape}")
    axes = tuple(one["dimensions"])
    try:
        numbers = _numbers(file, name, shape, one, table)
    except ValueError as error:
        return Stored(name, None, axes, known, str(error))
    return Stored(name, numbers, axes, known)


def _numbers(
    file: FileVersion,
    name: str,
    shape: tuple[int, ...],
    one: Mapping[str, Any],
    table: NDArray[Any] | None,
) -> Numbers:
    dtype, fill = np.dtype(one["type"]), one["fill"]
    if "chunk" in one:
        filters = [Filter(packed, dtype.itemsize) for packed in one["filters"]]
        chunk = tuple(int(n) for n in one["chunk"])
        places = Stretches(file, _places(table, len(shape), filters))
        return Chunked(name, shape, dtype, chunk, places, fill)
    if table is not None:  # compact: within the array's header
        return Chunked(name, shape, dtype, shape, Whole(table.tobytes()))
    if one["offset"] is None:  # nothing was ever written
        return Chunked(name, shape, dtype, (1, *shape[1:]), _nothing, fill)
    return Contiguous(name, shape, dtype, file, int(one["offset"]))


def _nothing(_: tuple[int, ...]) -> Part | None:
    return None


def _places(
    table: NDArray[Any] | None, n_axes: int, filters: list[Filter]
) -> dict[tuple[int, ...], tuple[int, int, tuple[Filter, ...]]]:
    """Offset, bytes and filters of each chunk; a bit of its mask tells a filter left out."""
    rows = [] if table is None else table.tolist()
    return {
        tuple(row[:n_axes]): (
            row[n_axes],
            row[n_axes + 1],
            tuple(step for k, step in reversed([*enumerate(filters)]) if not row[-1] >> k & 1),
        )
        for row in rows
    }


def _plain(known: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes without those that netCDF keeps for itself."""
    return {name: value for name, value in known.items() if name not in _OF_NETCDF}
