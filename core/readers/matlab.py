"""MATLAB v5 ``.mat`` (saved with ``-v6`` or ``-v7``).

Either a cell array (row, col) holding each pixel's photon arrival times as a vector, or a cube
(row, col, bin) of counts. Other variables may lie beside it, as long as only one fits.

SciPy reads the numbers. It trusts the file, though: a type code out of its table, or a few hundred
kilobytes of cells within cells, end the whole process. So the layout is checked before.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat, whosmat

from core.capture import Capture
from core.checks import require
from core.readers.arrivals import arrivals_capture
from core.readers.dense import cube_capture
from core.readers.guards import decoding, require_fits
from core.readers.request import Request

_NUMERIC = ("double", "single", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)))
_HEADER_BYTES = 128
_BYTES_A_CELL = 256  # of memory that one loaded cell takes

# Codes of the format, as in "MAT-File Format", The MathWorks.
_UINT32, _INT32, _MATRIX, _COMPRESSED = 6, 5, 14, 15
_DATA_TYPES = (1, 2, 3, 4, 5, 6, 7, 9, 12, 13)  # whole numbers and floats
_FIRST_NUMERIC_CLASS, _LAST_NUMERIC_CLASS = 6, 15
_COMPLEX_FLAG = 0x0800


class _Variable(NamedTuple):
    name: str
    shape: tuple[int, ...]
    kind: str
    element: memoryview  # tag and content, as in the file

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {' x '.join(map(str, self.shape))})"

    @property
    def fits(self) -> bool:
        is_cube = self.kind in _NUMERIC and len(self.shape) == 3
        is_cell = self.kind == "cell" and len(self.shape) == 2
        return (is_cube or is_cell) and min(self.shape) > 0


def read(path: Path, request: Request) -> Capture:
    """Read a cell array of arrival times, or a cube."""
    require_fits("the file", path.stat().st_size)
    data = path.read_bytes()
    _require_version_5(data)
    order = "<" if data[126:128] == b"IM" else ">"
    variable = _choose(_variables(data, order), request.variable)
    array = _load(variable, data[:_HEADER_BYTES], order)
    origin = f"{path.name}, variable {variable.name}"
    if variable.kind != "cell":
        return cube_capture(array, variable.name, origin, request)
    times, pixel = _flat(array, variable.name)
    shape = (array.shape[0], array.shape[1])
    return arrivals_capture(times, pixel, shape, variable.name, origin, request)


def _require_version_5(data: bytes) -> None:
    hdf5 = b"\x89HDF\r\n\x1a\n"
    if data.startswith((hdf5, b"MATLAB 7.3")) or data[512:520] == hdf5:
        require("version", "7.3 (HDF5)", False, "a file saved with -v7: 7.3 is not read yet")
    # SciPy takes a zero in the first four bytes for version 4.
    known = data[124:128] in (b"\x00\x01IM", b"\x01\x00MI") and 0 not in data[:4]
    require("version", data[124:128], known, "a MATLAB v5 file, saved with -v6 or -v7")


def _variables(data: bytes, order: str) -> list[_Variable]:
    elements = _elements(data, order)
    with decoding("the list of variables"):
        listed = whosmat(BytesIO(data))
        return [
            _Variable(name, tuple(int(n) for n in shape), kind, element)
            for (name, shape, kind), element in zip(listed, elements, strict=True)
        ]


def _elements(data: bytes, order: str) -> list[memoryview]:
    """The file's parts, one for each variable."""
    parts, start = [], _HEADER_BYTES
    while start < len(data):
        with decoding("the list of variables"):
            _, size = struct.unpack_from(order + "II", data, start)
        end = start + 8 + size
        whole = f"at most {len(data):,}, where the file ends: it was cut short, copy it again"
        require("end of a variable", f"{end:,}", end <= len(data), whole)
        parts.append(memoryview(data)[start:end])
        start = end
    return parts


def _choose(variables: list[_Variable], name: str | None) -> _Variable:
    """The variable asked for, or the only one that fits."""
    for known, times in Counter(variable.name for variable in variables).items():
        require(f"variables named {known!r}", times, times == 1, "each name once")
    fitting = {variable.name: variable for variable in variables if variable.fits}
    listed = ", ".join(map(str, variables)) or "nothing"
    remedy = f"a cell (row, col) of arrival times or a cube (row, col, bin); the file has {listed}"
    if name is not None:
        require("variable", name, name in fitting, f"the name of {remedy}")
        return fitting[name]
    found = ", ".join(fitting) or None
    require("variable", found, len(fitting) == 1, f"as variable the name of {remedy}")
    return next(iter(fitting.values()))


def _load(variable: _Variable, header: bytes, order: str) -> NDArray[Any]:
    """The variable's array, alone, after its layout was checked."""
    name, n_elements = variable.name, prod(variable.shape)
    element = _inflated(variable, order)
    # Each number takes a byte at least, each cell eight.
    remedy = "an array no larger than its file"
    if variable.kind == "cell":
        require_fits(f"{n_elements:,} cells", n_elements * _BYTES_A_CELL)
        require(f"cells of {name}", n_elements, 8 * n_elements <= len(element), remedy)
    else:
        require(f"numbers of {name}", n_elements, n_elements <= len(element), remedy)
    words = np.frombuffer(element, order + "u4", len(element) // 4).astype(np.uint32, copy=False)
    with decoding(name):
        start = np.zeros(1, np.int64)
        starts = _cells(words, n_elements) if variable.kind == "cell" else start
        plain = _plain(words, starts)
    found = "a nested, complex or non-numeric array"
    require(f"content of {name}", found, bool(plain.all()), "real numbers, one vector in each cell")
    with decoding(name):
        array: NDArray[Any] = loadmat(BytesIO(b"".join((header, element))))[name]
    return array


def _inflated(variable: _Variable, order: str) -> bytes | memoryview:
    """The variable's element, decompressed if need be, and no further than it claims to go."""
    tag = struct.Struct(order + "II")
    if tag.unpack_from(variable.element)[0] != _COMPRESSED:
        return variable.element
    with decoding(variable.name):
        inflater = zlib.decompressobj()
        start = inflater.decompress(variable.element[8:], tag.size)
        size = tag.unpack(start)[1]
    require_fits(variable.name, size)
    with decoding(variable.name):
        # Room for one byte more lets the checksum at the end be read, and shows an excess.
        element = start + inflater.decompress(inflater.unconsumed_tail, size + 1)
    found = len(element) - tag.size
    whole = inflater.eof and found == size
    require(f"bytes of {variable.name}", found, whole, f"{size:,}: copy or save the file again")
    return element


def _cells(words: NDArray[np.uint32], n_cells: int) -> NDArray[np.int64]:
    """Where each filled cell starts, in words of 4 bytes."""
    position = int(_after(words, _after(words, np.array(6))))  # beyond the dimensions and the name
    view = words.data
    starts = []
    for _ in range(n_cells):
        size = view[position + 1]
        if size:
            starts.append(position)
        position += 2 + (size + 7) // 8 * 2
    return np.array(starts, np.int64)


def _plain(words: NDArray[np.uint32], starts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether a plain array of real numbers lies at each start, and ends where it says."""
    kind, size, flags_kind, flags_size, flags = (words[starts + k] for k in range(5))
    array_class = flags & 0xFF
    data = _after(words, _after(words, starts + 6))
    data_kind = np.where(words[data] >> 16, words[data] & 0xFFFF, words[data])
    return np.asarray(
        (kind == _MATRIX)
        & (flags_kind == _UINT32)
        & (flags_size == 8)
        & (words[starts + 6] == _INT32)
        & (array_class >= _FIRST_NUMERIC_CLASS)
        & (array_class <= _LAST_NUMERIC_CLASS)
        & (flags & _COMPLEX_FLAG == 0)
        & np.isin(data_kind, _DATA_TYPES)
        & (_after(words, data) == starts + 2 + (size.astype(np.int64) + 7) // 8 * 2)
    )


def _after(words: NDArray[np.uint32], position: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where the next data element starts, in words of 4 bytes.

    A small element has its size in the upper half of its first word and its data in the second.
    """
    is_small = words[position] >> 16 > 0
    size = words[position + 1].astype(np.int64)
    return np.asarray(position + 2 + np.where(is_small, 0, (size + 7) // 8 * 2))


def _flat(cells: NDArray[np.object_], name: str) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """The arrival times of all pixels, and the index of each photon's pixel."""
    vectors = cells.ravel()
    n_photons = np.fromiter((vector.size for vector in vectors), np.int64, vectors.size)
    longest = np.fromiter((max(vector.shape) for vector in vectors), np.int64, vectors.size)
    wide = np.flatnonzero(n_photons > longest)
    if wide.size:
        row, col = divmod(int(wide[0]), cells.shape[1])
        shape = vectors[wide[0]].shape
        require(f"{name} in pixel ({row}, {col})", f"array of shape {shape}", False, "a vector")
    times = np.concatenate(list(vectors), axis=None)
    return times, np.repeat(np.arange(vectors.size), n_photons)
