"""What an HDF5 file holds and where; run in a process of its own by `core.io.readers.hdf5`.

The HDF5 library is not made for files that lie: some damaged ones keep it busy for ever, others
have ended the process that read them. So it looks at files only here, where memory and time are
limited, and tells where the numbers lie; `core.io.readers.chunks` reads them. Run as a script,
without the package: it imports nothing of it.

Nothing outside the file is ever touched: only hard links are followed, and virtual or external
datasets, types that are no plain numbers, and filters that `FILTERS` does not name are refused
before more is asked about them.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from functools import partial
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5ds, h5g, h5i, h5o, h5r, h5t, h5z

FILTERS = {h5z.FILTER_DEFLATE: "deflate", h5z.FILTER_SHUFFLE: "shuffle"}
FILTERS |= {h5z.FILTER_FLETCHER32: "fletcher32", h5z.FILTER_LZF: "lzf"}
MOST_LINKS = 10_000
MOST_DEPTH = 10
MOST_CHUNKS = 2**20  # of all arrays
MOST_IN_ATTRIBUTE = 2**20
MOST_TOLD = 2**24  # letters


class Refused(ValueError):
    """What a file holds is no capture: says what it is, and what to give."""


Answer = tuple[dict[str, Any], dict[str, Any]]
"""A description that can be written as JSON, and arrays by name."""


def survey(path: str) -> Answer:
    """All arrays of a file: names, shapes, types, attributes, and the places of their chunks."""
    arrays: list[dict[str, Any]] = []
    groups: dict[str, Any] = {}
    tables: dict[str, Any] = {}
    with h5py.File(path, "r", locking=False) as file:
        root = file.id
        groups[""] = _attributes(h5o.open(root, b"/"))
        for name, found in _walk(root):
            if isinstance(found, str):
                arrays.append({"name": name, "refused": found})
            elif isinstance(found, h5g.GroupID):
                groups[name] = _attributes(found)
            else:
                told = {"name": name, **_dataset(found, f"{len(arrays)}", tables)}
                arrays.append(told)
    return {"arrays": arrays, "groups": groups}, tables


def cells(path: str, name: str, most_values: int) -> Answer:
    """The vectors that the cells of one of MATLAB's cell arrays refer to, one after the other.

    Raises
    ------
    Refused
        If a cell is no vector of plain numbers, or there are more of these than `most_values`.
    """
    with h5py.File(path, "r", locking=False) as file:
        array = h5o.open(file.id, name.encode())
        _created(array)
        n_cells = array.get_space().get_simple_extent_npoints()
        if not 0 < n_cells <= most_values:
            raise Refused(f"cells of {name} = {n_cells:,}: give up to {most_values:,}.")
        references = np.empty(array.shape, h5py.ref_dtype)
        array.read(h5py.h5s.ALL, h5py.h5s.ALL, references)
        values, sizes, total = [], np.zeros(n_cells, np.int64), 0
        types: list[h5t.TypeID] = []
        for k, reference in enumerate(references.ravel().tolist()):
            try:
                cell = h5r.dereference(reference, file.id)
                vector = _vector(cell, types, most_values - total)
            except ValueError as error:
                # MATLAB's first axis is HDF5's last.
                place = tuple(int(n) for n in np.unravel_index(k, array.shape)[::-1])
                raise Refused(f"{name} in pixel {place} = {error}") from error
            sizes[k] = vector.size
            total += vector.size
            values.append(vector)
    filled = [vector for vector in values if vector.size] or values[:1]
    return {}, {"values": np.concatenate(filled), "sizes": sizes}


def _walk(group: h5g.GroupID, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names of all objects in a group, and each object, or why it is refused."""
    waiting, seen = [(group, prefix)], 0
    while waiting:
        group, prefix = waiting.pop(0)
        for raw in group:
            seen += 1
            if seen > MOST_LINKS:
                raise Refused(f"arrays of the file = more than {MOST_LINKS:,}: split the file.")
            name = prefix + raw.decode("utf-8", "replace")
            if name.startswith("#"):  # what MATLAB keeps its cells' contents in
                continue
            kind = group.links.get_info(raw).type
            if kind != h5py.h5l.TYPE_HARD:
                external = "an external link" if kind == h5py.h5l.TYPE_EXTERNAL else "a soft link"
                yield name, external
                continue
            found = h5o.open(group, raw)
            if isinstance(found, h5g.GroupID) and name.count("/") < MOST_DEPTH:
                waiting.append((found, name + "/"))
            if isinstance(found, h5g.GroupID | h5d.DatasetID):
                yield name, found


def _dataset(array: h5d.DatasetID, key: str, tables: dict[str, Any]) -> dict[str, Any]:
    told: dict[str, Any] = {"attributes": _attributes(array)}
    try:
        created, kind = _created(array), array.get_type()
        told["shape"] = array.shape
        if kind.get_class() == h5t.REFERENCE:
            return told | {"refused": "references", "references": True}
        told["type"] = _number_type(kind).str
        told["dimensions"] = _dimensions(array)
        told |= _storage(array, created, key, tables)
    except ValueError as error:
        told["refused"] = str(error)
    return told


def _created(array: Any) -> h5py.h5p.PropDCID:
    """How an array is kept.

    Raises
    ------
    ValueError
        If some of it lies in other files, before anything opens them.
    """
    if not isinstance(array, h5d.DatasetID):
        raise ValueError("no array")
    created = array.get_create_plist()
    if created.get_layout() == h5d.VIRTUAL:
        raise ValueError("a virtual array")
    if created.get_layout() != h5d.CHUNKED and created.get_external_count():
        raise ValueError("an array kept in other files")
    return created


def _number_type(kind: h5t.TypeID) -> np.dtype[Any]:
    """The type of whole or real numbers in no unusual layout."""
    if kind.get_class() not in (h5t.INTEGER, h5t.FLOAT):
        raise ValueError("no numbers")
    dtype: np.dtype[Any] = kind.dtype
    if dtype.kind not in "iuf" or dtype.itemsize > 8 or h5t.py_create(dtype) != kind:
        raise ValueError(f"numbers of an unusual layout, {dtype}")
    return dtype


def _storage(
    array: h5d.DatasetID, created: h5py.h5p.PropDCID, key: str, tables: dict[str, Any]
) -> dict[str, Any]:
    dtype = array.get_type().dtype
    fill = np.zeros(1, dtype)
    if created.fill_value_defined() != h5d.FILL_VALUE_UNDEFINED:
        created.get_fill_value(fill)
    told: dict[str, Any] = {"fill": fill[0].item(), "filters": _filters(created, dtype.itemsize)}
    layout = created.get_layout()
    if layout == h5d.COMPACT:
        values = np.empty(array.shape, dtype)
        array.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
        tables[key] = np.frombuffer(values.tobytes(), np.uint8)
    elif layout == h5d.CONTIGUOUS:
        told["offset"] = array.get_offset()
    else:
        told["chunk"] = created.get_chunk()
        most = MOST_CHUNKS - sum(len(table) for table in tables.values())
        tables[key] = _chunk_table(array, np.array(told["chunk"]), most)
    return told


def _filters(created: h5py.h5p.PropDCID, item_bytes: int) -> list[str]:
    """Names of the filters of an array whose numbers take `item_bytes` each."""
    found = []
    for k in range(created.get_nfilters()):
        code, _, values, name = created.get_filter(k)
        if code not in FILTERS:
            raise ValueError(f"packed by the filter {name.decode(errors='replace') or code}")
        if code == h5z.FILTER_SHUFFLE and values and values[0] != item_bytes:
            raise ValueError(f"shuffled in elements of {values[0]} bytes, not {item_bytes}")
        found.append(FILTERS[code])
    return found


def _chunk_table(array: h5d.DatasetID, chunk: Any, most: int) -> Any:
    """Index along each axis, offset, bytes and filter mask of each chunk that was written."""
    found: list[tuple[int, ...]] = []

    def keep(info: Any) -> None:
        if len(found) >= most:
            raise ValueError(f"more than {MOST_CHUNKS:,} chunks with those before")
        found.append((*info.chunk_offset, info.byte_offset, info.size, info.filter_mask))

    array.chunk_iter(keep)
    table = np.array(found, np.int64).reshape(len(found), chunk.size + 3)
    table[:, : chunk.size] //= chunk
    return table


def _dimensions(array: h5d.DatasetID) -> list[str | None]:
    """Names of the axes, where scales or labels give any."""
    n_axes = len(array.shape)
    if h5ds.is_scale(array) and n_axes == 1:
        return [_name(array)]
    names: list[str | None] = []
    for axis in range(n_axes):
        found: list[str] = []
        if h5ds.get_num_scales(array, axis) > 0:
            h5ds.iterate(array, axis, partial(_keep_name, found), 0)
        label = h5ds.get_label(array, axis).decode("utf-8", "replace")
        names.append((found or [label])[0] or None)
    return names


def _keep_name(names: list[str], scale: h5d.DatasetID) -> None:
    names.append(_name(scale))


def _name(array: h5d.DatasetID) -> str:
    name: str = (h5i.get_name(array) or b"").decode("utf-8", "replace")
    return name.rpartition("/")[2]


def _attributes(place: Any) -> dict[str, Any]:
    """Attributes that are numbers or text; others are left out.

    One that is too long is a text that says so, which is refused where numbers are wanted.
    """
    told: dict[str, Any] = {}
    for k in range(h5a.get_num_attrs(place)):
        attribute = h5a.open(place, index=k)
        kind = attribute.get_type().get_class()
        if kind not in (h5t.INTEGER, h5t.FLOAT, h5t.STRING):
            continue
        name = attribute.name.decode("utf-8", "replace")
        length = attribute.get_space().get_simple_extent_npoints()
        if length > MOST_IN_ATTRIBUTE:
            told[name] = f"{length:,} values, more than {MOST_IN_ATTRIBUTE:,}"
            continue
        manager = h5py.AttributeManager(_Owner(place))
        value = manager.get(name)
        if isinstance(value, bytes):
            value = value.decode("utf-8", "replace")
        if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "iuf":
            told[name] = value.item() if value.size == 1 else value.ravel().tolist()
        elif isinstance(value, str):
            told[name] = value
    return told


class _Owner:
    """As much of an object as `h5py.AttributeManager` asks for."""

    def __init__(self, place: Any) -> None:
        self.id = place


def _vector(array: Any, types: list[h5t.TypeID], most: int) -> Any:
    """The numbers of one cell; `types` are those that proved fine before."""
    try:
        created, kind = _created(array), array.get_type()
        _filters(created, kind.get_size())
        if kind not in types:
            _number_type(kind)
            types.append(kind)
        if h5a.exists(array, b"MATLAB_int_decode"):
            raise ValueError("text or logical")
    except ValueError as error:
        raise ValueError(f"{error} is not accepted: give real numbers.") from error
    if h5a.exists(array, b"MATLAB_empty"):
        return np.empty(0, kind.dtype)
    shape = array.shape
    n_values = math.prod(shape)
    if n_values != max(shape, default=1):
        raise ValueError(f"array of shape {shape[::-1]} is not accepted: give a vector.")
    if n_values > most:
        raise ValueError(f"{n_values:,} photons, too many with those before: give fewer.")
    values = np.empty(n_values, kind.dtype)
    if n_values:
        array.read(h5py.h5s.ALL, h5py.h5s.ALL, values.reshape(shape))
    return values


def limit(memory_bytes: int, seconds: int) -> None:
    """Let this process take no more memory and time; on Windows the caller's clock alone counts."""
    try:
        import resource  # noqa: PLC0415 - not on Windows
    except ImportError:
        return
    wanted = {
        resource.RLIMIT_AS: memory_bytes,
        resource.RLIMIT_CPU: seconds,
        resource.RLIMIT_FSIZE: memory_bytes,
        resource.RLIMIT_CORE: 0,
    }
    for kind, most in wanted.items():
        hard = resource.getrlimit(kind)[1]  # which nobody may raise
        least = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (least, least))


def main(memory_bytes: str, seconds: str, task: str, path: str, *more: str) -> None:
    """Write the answer to a task to the standard output, as an ``.npz``."""
    limit(int(memory_bytes), int(seconds))
    arrays: dict[str, Any] = {}
    try:
        if task == "survey":
            told, arrays = survey(path)
        else:
            told, arrays = cells(path, more[0], int(more[1]))
    except Refused as error:
        told = {"refused": str(error)}
    except MemoryError:
        told = {"error": "more memory than it may have"}
    except Exception as error:  # whatever it is, it goes back in words
        told = {"error": f"{type(error).__name__}: {error}"}
    text = json.dumps(told)
    if len(text) > MOST_TOLD:
        text, arrays = json.dumps({"refused": "attributes = too many: give fewer."}), {}
    np.savez(sys.stdout.buffer, _told=np.array(text), **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])
