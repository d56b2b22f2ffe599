"""Zarr, versions 2 and 3: a directory of arrays, each a directory of chunks.

Only its JSON is believed, and that no further than it can be checked: types that are plain numbers,
chunks on a regular grid, and the codecs zlib, gzip, zstd, blosc, shuffle, fletcher32, crc32c and
transpose. Chunks are files whose names are whole numbers, so they cannot lie elsewhere; a directory
with a symbolic link anywhere in it is refused. Consolidated metadata is not needed, nor looked at.
"""

from __future__ import annotations

import base64
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from core.checks import require
from core.io.readers.chunks import Chunked, Filter, Part, read_stretch
from core.io.readers.guards import FileVersion, decoding
from core.io.readers.stored import Stored

_MOST_JSON_BYTES = 2**24  # of a whole directory
MARKS = ("zarr.json", ".zarray", ".zgroup")
"""Names of files, one of which the folder contains."""
_METADATA = (*MARKS, ".zattrs")
_TYPES_2 = re.compile(r"[<>|]([iu][1248]|f[248])")
_TYPES_3 = re.compile(r"u?int(8|16|32|64)|float(16|32|64)")
_CODECS = {"zlib": "deflate", "gzip": "deflate", "zstd": "zstd", "blosc": "blosc"}
_CODECS |= {"shuffle": "shuffle", "fletcher32": "fletcher32", "crc32c": "crc32c"}
_MOST_CODECS = 32  # of one array, as in HDF5
_MOST_AXES = 32
_MOST_ELEMENT_BYTES = 16  # the largest number that NumPy has
_NOT_FINITE = {"NaN": np.nan, "Infinity": np.inf, "-Infinity": -np.inf}


@dataclass(frozen=True)
class ChunkFiles:
    """Chunks that are files of their own.

    Parameters
    ----------
    folder : Path
        Of the array.
    prefix, separator : str
        Of a file's name: before the first index, and between one and the next.
    filters : tuple of Filter
        What every chunk went through, the last one first.
    metadata : FileVersion
        Of the array; no chunk is read once it has changed.
    folders : dict
        Folders as they were when they were listed, by their paths; a chunk that is missing from one
        in which files have come or gone since is refused.
    """

    folder: Path
    prefix: str
    separator: str
    filters: tuple[Filter, ...]
    metadata: FileVersion
    folders: Mapping[Path, FileVersion]

    def __call__(self, index: tuple[int, ...]) -> Part | None:
        """The bytes of a chunk, None where it was never written."""
        path = self.folder / (self.prefix + self.separator.join(map(str, index)))
        with self.metadata.unchanged():
            if path.exists():
                return Part(read_stretch(path, 0, path.stat().st_size), self.filters)
            if path.parent in self.folders:
                self.folders[path.parent].require()  # else it may have been there
            return None


def arrays(path: Path) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """All arrays in a directory, and the attributes of its groups by name; its own are ``""``."""
    found: list[Stored] = []
    groups: dict[str, dict[str, Any]] = {}
    n_bytes = 0
    folders: dict[Path, FileVersion] = {}
    for folder, files in _folders(path, folders):
        n_bytes += sum((folder / name).stat().st_size for name in files.intersection(_METADATA))
        most = f"up to {_MOST_JSON_BYTES:,}"
        require("bytes of metadata", n_bytes, n_bytes <= _MOST_JSON_BYTES, most)
        name = folder.relative_to(path).as_posix().removeprefix(".")
        versions = [{"zarr.json"}, {".zarray", ".zgroup"}]
        require(
            f"metadata of {name or path.name}",
            "versions 2 and 3",
            not all(files & own for own in versions),
            "one of them",
        )
        described = [name for name in _METADATA if name in files]
        if not described:
            continue
        version = FileVersion.of(folder / described[0])
        if "zarr.json" in files:
            about = _json(folder / "zarr.json")
            known = _plain(about.get("attributes"))
            is_array = about.get("node_type") == "array"
            describe = _array_3
        elif files & versions[1]:
            is_array = ".zarray" in files
            about = _json(folder / ".zarray") if is_array else {}
            known = _json(folder / ".zattrs") if ".zattrs" in files else {}
            axes = known.get("_ARRAY_DIMENSIONS")
            about["dimension_names"] = axes
            known, describe = _plain(known), _array_2
        else:
            continue
        if not is_array:
            groups[name] = known
            continue
        title = name or path.name
        try:
            kept = partial(ChunkFiles, folder, metadata=version, folders=folders)
            numbers, axes = describe(title, kept, about), about.get("dimension_names")
            known = known | _missing(about, known, numbers)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            found.append(
                Stored(title, attributes=known, refused=f"{type(error).__name__}: {error}")
            )
            continue
        named = isinstance(axes, list) and len(axes) == len(numbers.shape)
        texts = [axis if isinstance(axis, str) else None for axis in axes or [] if named]
        found.append(Stored(title, numbers, tuple(texts), known))
    require("arrays", 0, bool(found), "a directory that holds some, of Zarr version 2 or 3")
    return found, groups


def _folders(path: Path, versions: dict[Path, FileVersion]) -> Iterator[tuple[Path, set[str]]]:
    """Every directory with the names of its files, none of them a link or no file at all.

    Adds the version of each to `versions`.
    """
    waiting = [path]
    while waiting:
        folder = waiting.pop(0)
        versions[folder] = FileVersion.of(folder)
        files = set()
        with os.scandir(folder) as entries:
            for entry in sorted(entries, key=lambda entry: entry.name):
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(folder / entry.name)
                    continue
                plain = entry.is_file(follow_symlinks=False)
                inside = str(Path(entry.path).relative_to(path))
                require("a file of the directory", inside, plain, "plain files, no links")
                files.add(entry.name)
        yield folder, files


def _array_2(name: str, kept: Callable[..., ChunkFiles], about: Mapping[str, Any]) -> Chunked:
    require("zarr_format", about["zarr_format"], about["zarr_format"] == 2, "2 in .zarray")
    kind, separator = about["dtype"], about.get("dimension_separator", ".")
    plain = isinstance(kind, str) and _TYPES_2.fullmatch(kind) is not None
    require("dtype", kind, plain, "plain numbers")
    require("dimension_separator", separator, separator in (".", "/"), "'.' or '/'")
    require("order", about["order"], about["order"] in ("C", "F"), "'C' or 'F'")
    # Written through the filters, then the compressor; read the other way.
    packed = [*(about.get("filters") or []), *filter(None, [about.get("compressor")])]
    _require_few("filters", packed, _MOST_CODECS)
    filters = tuple(_filter(one["id"], one, np.dtype(kind)) for one in reversed(packed))
    shape, chunk = _sizes(about["shape"]), _sizes(about["chunks"])
    return Chunked(
        name,
        shape,
        np.dtype(kind),
        chunk,
        kept("", separator, filters),
        _fill(about.get("fill_value")),
        order=tuple(reversed(range(len(shape)))) if about["order"] == "F" else None,
    )


def _array_3(name: str, kept: Callable[..., ChunkFiles], about: Mapping[str, Any]) -> Chunked:
    require("zarr_format", about["zarr_format"], about["zarr_format"] == 3, "3 in zarr.json")
    kind, grid, keys = about["data_type"], about["chunk_grid"], about["chunk_key_encoding"]
    plain = isinstance(kind, str) and _TYPES_3.fullmatch(kind) is not None
    require("data_type", kind, plain, "plain numbers")
    require("chunk_grid", grid["name"], grid["name"] == "regular", "'regular'")
    prefixes = {"default": "c", "v2": ""}
    require("chunk_key_encoding", keys["name"], keys["name"] in prefixes, "'default' or 'v2'")
    prefix = prefixes[keys["name"]]
    separator = keys.get("configuration", {}).get("separator", "/" if prefix else ".")
    require("separator", separator, separator in (".", "/"), "'.' or '/'")
    extras = about.get("storage_transformers") or []
    require("storage_transformers", extras, not extras, "none")
    filters: list[Filter] = []
    dtype, order = np.dtype(kind), None
    _require_few("codecs", about["codecs"], _MOST_CODECS)
    for codec in about["codecs"]:
        told = codec.get("configuration", {})
        if codec["name"] == "bytes":
            dtype = dtype.newbyteorder(">" if told.get("endian") == "big" else "<")
        elif codec["name"] == "transpose":
            require("transpose", "twice", order is None, "one of them")
            order = tuple(told["order"])
            every = sorted(order) == list(range(len(about["shape"])))
            require("order", order, every, "each axis once")
        else:
            filters.insert(0, _filter(codec["name"], told, dtype))
    return Chunked(
        name,
        _sizes(about["shape"]),
        dtype,
        _sizes(grid["configuration"]["chunk_shape"]),
        kept(prefix + separator * bool(prefix), separator, tuple(filters)),
        _fill(about.get("fill_value")),
        order=order,
    )


def _missing(
    about: Mapping[str, Any], known: Mapping[str, Any], numbers: Chunked
) -> dict[str, float]:
    """What stands for a missing number, where xarray keeps it in a way of its own.

    In version 2 that is the fill itself, of which 0 is only what was never written. In version 3 it
    is an attribute, that of floats as the base64 of a double.
    """
    if about["zarr_format"] == 2:
        return {"_FillValue": numbers.fill} if about.get("fill_value") else {}
    value = known.get("_FillValue")
    if not isinstance(value, str):
        return {}
    (number,) = np.frombuffer(base64.b64decode(value, validate=True), "<f8").tolist()
    return {"_FillValue": number}


def _filter(name: Any, told: Mapping[str, Any], dtype: np.dtype[Any]) -> Filter:
    known = isinstance(name, str) and name in _CODECS
    require("codec", name, known, "one of " + ", ".join(_CODECS))
    element = told.get("elementsize", dtype.itemsize)
    fits = type(element) is int and 1 <= element <= _MOST_ELEMENT_BYTES
    require("elementsize", element, fits, f"a whole number from 1 to {_MOST_ELEMENT_BYTES}")
    return Filter(_CODECS[name], element)


def _sizes(values: Any) -> tuple[int, ...]:
    _require_few("sizes", values, _MOST_AXES)
    whole = all(type(n) is int and 0 < n < 2**63 for n in values)
    require("sizes", values, whole, "whole numbers from 1 to 2**63 - 1")
    return tuple(values)


def _require_few(name: str, values: Any, most: int) -> None:
    """Raise ``ValueError`` unless something is a list of no more than so many."""
    found = (
        f"{len(values):,} of them" if isinstance(values, list) and len(values) > most else values
    )
    few = isinstance(values, list) and len(values) <= most
    require(name, found, few, f"a list of at most {most}")


def _fill(value: Any) -> float:
    number = 0 if value is None else _NOT_FINITE.get(value, value)
    require("fill_value", value, isinstance(number, int | float), "a number")
    return number


def _json(path: Path) -> dict[str, Any]:
    with decoding(path.name):
        known = json.loads(path.read_bytes())
        require("content", type(known).__name__, isinstance(known, dict), "an object")
    return known  # type: ignore[no-any-return]


def _plain(known: Any) -> dict[str, Any]:
    """Attributes that are numbers, lists of them, or text."""

    def is_number(value: Any) -> bool:
        return isinstance(value, int | float) and not isinstance(value, bool)

    return {
        name: value
        for name, value in (known.items() if isinstance(known, dict) else ())
        if is_number(value)
        or isinstance(value, str)
        or (isinstance(value, list) and value and all(map(is_number, value)))
    }
