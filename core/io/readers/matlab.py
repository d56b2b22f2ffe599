"""MATLAB ``.mat`` version 5 (saved with ``-v6`` or ``-v7``); 7.3 is in `core.io.readers.matlab73`.

Either a cell array (row, col) holding each pixel's photon arrival times as a vector, or a cube
(row, col, bin) of counts, or a sparse matrix (pixel, bin) of counts as in `core.io.readers.sparse`.
Other variables may lie beside it, as long as only one fits; of these, a number named like
``bin_width`` or ``resolution`` that can be seconds is taken for the bin width, as a guess.

SciPy reads the numbers, but those of sparse matrices, whose places it does not check. It trusts the
file, though: a type code out of its table, or a few hundred kilobytes of cells within cells, end
the whole process, and it takes as much memory as a size claims. So the layout is checked before.
"""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers import hdf5, matlab73
from core.io.readers.arrivals import arrivals_capture
from core.io.readers.dense import cube_capture
from core.io.readers.guards import decoding, require_fits
from core.io.readers.request import Request
from core.io.readers.sparse import Sparse, sparse_capture
from core.io.readers.variables import Variable, bin_width, choose

_HEADER_BYTES = 128
_USER_BLOCK = 512  # what stands before the HDF5 of version 7.3
_VERSIONS_5 = (b"\x00\x01IM", b"\x01\x00MI")
_BYTES_A_CELL = 256  # of memory that one loaded cell takes

# Codes of the format, as in "MAT-File Format", The MathWorks.
_UINT32, _INT32, _MATRIX, _COMPRESSED = 6, 5, 14, 15
_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8"}
_NUMBERS |= {13: "u8"}
_FIRST_NUMERIC_CLASS, _LAST_NUMERIC_CLASS = 6, 15
_COMPLEX_FLAG, _LOGICAL_FLAG = 0x0800, 0x0200
_CLASSES = {1: "cell", 2: "struct", 3: "object", 4: "char", 5: "sparse", 16: "function"}
_CLASSES |= {6: "double", 7: "single", 8: "int8", 9: "uint8", 10: "int16", 11: "uint16"}
_CLASSES |= {12: "int32", 13: "uint32", 14: "int64", 15: "uint64"}
_DIMENSIONS = 6  # where they begin, in words of 4 bytes, after the tag and the flags
_BEGINNING_BYTES = 4096


def recognizes(start: bytes) -> bool:
    """Whether a file starts like one of MATLAB, or like HDF5 that may be of version 7.3."""
    return start[124:128] in _VERSIONS_5 or hdf5.SIGNATURE in (start[:8], start[512:520])


def read(path: Path, request: Request) -> Capture:
    """Read a cell array of arrival times, a cube, or a sparse matrix."""
    with path.open("rb") as file:
        start = file.read(_USER_BLOCK + len(hdf5.SIGNATURE))
    if hdf5.SIGNATURE in (start[: len(hdf5.SIGNATURE)], start[_USER_BLOCK:]):
        return matlab73.read(path, request)
    require_fits("the file", path.stat().st_size)
    data = path.read_bytes()
    # SciPy takes a zero in the first four bytes for version 4.
    known = data[124:128] in _VERSIONS_5 and 0 not in data[:4]
    require("version", data[124:128], known, "a MATLAB file, saved with -v6, -v7 or -v7.3")
    order = "<" if data[126:128] == b"IM" else ">"
    variables = _variables(data, order)
    variable = choose(variables, request.variable)
    name, header = variable.name, data[:_HEADER_BYTES]
    origin = f"{path.name}, variable {name}"
    if variable.kind == "cell":
        array = _load(variable, header, order)
        times, pixel = _flat(array, name)
        shape = (array.shape[0], array.shape[1])
        return arrivals_capture(times, pixel, shape, name, origin, request)
    widths = [_load(one, header, order) for one in variables if one.may_tell_bin_width]
    width_s = bin_width(float(value.item()) for value in widths)
    if variable.kind == "sparse":
        return sparse_capture(_sparse(variable, order), name, origin, request, width_s)
    array = _load(variable, header, order)
    return cube_capture(array, name, origin, request, guessed_bin_width_s=width_s)


def _variables(data: bytes, order: str) -> list[Variable]:
    found = []
    for element in _elements(data, order):
        with decoding("the list of variables"):
            start = _beginning(element, order)
            words = np.frombuffer(start, order + "u4", len(start) // 4)
            require(
                "kind of a variable", int(words[0]), words[0] == _MATRIX, f"{_MATRIX}, a matrix"
            )
            name_at = int(_after(words, np.array(_DIMENSIONS)))
            shape = tuple(_numbers(start, words, _DIMENSIONS, order).tolist())
            name = _numbers(start, words, name_at, order).tobytes().decode("latin-1")
            kind = _CLASSES.get(int(words[4]) & 0xFF, "unknown")
            if words[4] & _LOGICAL_FLAG and kind != "sparse":
                kind = "logical"
        found.append(Variable(name, shape, kind, element))
    return found


def _beginning(element: memoryview, order: str) -> bytes:
    """As much of a variable's element as its description takes, decompressed if need be."""
    if struct.unpack_from(order + "I", element)[0] != _COMPRESSED:
        return bytes(element[:_BEGINNING_BYTES])
    return zlib.decompressobj().decompress(element[8:], _BEGINNING_BYTES)


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


def _load(variable: Variable, header: bytes, order: str) -> NDArray[Any]:
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
        array: NDArray[Any] = scipy.io.loadmat(BytesIO(b"".join((header, element))))[name]
    return array


def _inflated(variable: Variable, order: str) -> bytes | memoryview:
    """The variable's element, decompressed if need be, and no further than it claims to go."""
    tag = struct.Struct(order + "II")
    packed: memoryview = variable.content
    if tag.unpack_from(packed)[0] != _COMPRESSED:
        return packed
    with decoding(variable.name):
        inflater = zlib.decompressobj()
        start = inflater.decompress(packed[8:], tag.size)
        size = tag.unpack(start)[1]
    require_fits(variable.name, size)
    with decoding(variable.name):
        # Room for one byte more lets the checksum at the end be read, and shows an excess.
        element = start + inflater.decompress(inflater.unconsumed_tail, size + 1)
    found = len(element) - tag.size
    whole = inflater.eof and found == size
    require(f"bytes of {variable.name}", found, whole, f"{size:,}: copy or save the file again")
    return element


def _sparse(variable: Variable, order: str) -> Sparse:
    """A sparse matrix: after its name come the rows, the starts of the columns, the values."""
    element = _inflated(variable, order)
    words = np.frombuffer(element, order + "u4", len(element) // 4).astype(np.uint32, copy=False)
    with decoding(variable.name):
        place = _after(words, _after(words, np.array(_DIMENSIONS)))
        parts = []
        for _ in ("rows", "starts", "values"):
            parts.append(_numbers(element, words, int(place), order))
            place = _after(words, place)
        is_real = not words[4] & _COMPLEX_FLAG
    require(f"content of {variable.name}", "complex numbers", is_real, "real numbers")
    rows, starts, values = parts
    return Sparse(values, rows, starts, (variable.shape[0], variable.shape[1]))


def _numbers(
    element: bytes | memoryview, words: NDArray[np.uint32], place: int, order: str
) -> NDArray[Any]:
    """The numbers of the data element that starts at a word."""
    small = int(words[place]) >> 16
    size = small or int(words[place + 1])
    dtype = np.dtype(order + _NUMBERS[int(words[place]) & 0xFFFF if small else int(words[place])])
    begin = 4 * place + (4 if small else 8)
    return np.frombuffer(element, dtype, size // dtype.itemsize, begin)


def _cells(words: NDArray[np.uint32], n_cells: int) -> NDArray[np.int64]:
    """Where each filled cell starts, in words of 4 bytes."""
    position = int(
        _after(words, _after(words, np.array(_DIMENSIONS)))
    )  # beyond the dimensions and the name
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
    data = _after(words, _after(words, starts + _DIMENSIONS))
    data_kind = np.where(words[data] >> 16, words[data] & 0xFFFF, words[data])
    return np.asarray(
        (kind == _MATRIX)
        & (flags_kind == _UINT32)
        & (flags_size == 8)
        & (words[starts + _DIMENSIONS] == _INT32)
        & (array_class >= _FIRST_NUMERIC_CLASS)
        & (array_class <= _LAST_NUMERIC_CLASS)
        & (flags & _COMPLEX_FLAG == 0)
        & np.isin(data_kind, [*_NUMBERS])
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
