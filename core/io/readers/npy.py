"""NumPy ``.npy``: one histogram cube of non-negative whole numbers, in any order of its axes.

If ``no_trigger`` is given, the array holds raw frames (pulse, row, col), see
`core.io.readers.frames`. An array that looks like such is refused without it; ``axes`` declares it
a cube if 0 would mark no trigger.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import IO, Any

from numpy.lib import format as npy_format
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import cube_capture
from core.io.readers.frames import Header, frames_from, require_counts
from core.io.readers.guards import decoding, require_fits
from core.io.readers.maps import Map
from core.io.readers.options import ReadOptions


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like a NumPy array."""
    return start.startswith(npy_format.MAGIC_PREFIX)


def read(path: Path, request: ReadOptions) -> Capture:
    """Read a cube, or frames; everything else is given or guessed."""
    require("variable", request.variable, request.variable is None, "None: .npy holds one array")
    size = path.stat().st_size
    with path.open("rb") as file:
        if request.no_trigger is not None:
            return frames_in(file, size, "the array", path.name, request)
        cube = read_array(file, size, "the array")
    require_counts(cube, "the array", request.axes)
    return cube_capture(cube, "the array", path.name, request)


def maps(path: Path) -> list[Map]:
    """List the array of a file if it is an image."""

    def load() -> NDArray[Any]:
        with path.open("rb") as file:
            return read_array(file, path.stat().st_size, "the array")

    with path.open("rb") as file:
        shape = read_header(file, "the array").shape
    return [Map("", shape, load)] if len(shape) == 2 else []


def frames_in(file: IO[bytes], size: int, name: str, origin: str, request: ReadOptions) -> Capture:
    """Count an array of frames in a file of `size` bytes as they are read."""
    header = read_header(file, name)
    _require_whole(file, size, header, name)
    return frames_from(file, header, name, origin, request)


def read_array(file: IO[bytes], size: int, name: str) -> NDArray[Any]:
    """Read one array from a seekable file of `size` bytes, after checking its header.

    Raises
    ------
    ValueError
        If the array holds objects (pickles are never read), does not fit in `size` or is too large.
    """
    header = read_header(file, name)
    dtype = header.dtype
    numeric = dtype.kind in "biufU"
    remedy = "numbers or text; pickled objects are refused"
    require(f"type of {name}", str(dtype), numeric, remedy)
    require_fits(name, prod(header.shape) * dtype.itemsize)
    _require_whole(file, size, header, name)
    file.seek(0)
    with decoding(name):
        return npy_format.read_array(file, allow_pickle=False)


def _require_whole(file: IO[bytes], size: int, header: Header, name: str) -> None:
    found, claimed = size - file.tell(), prod(header.shape) * header.dtype.itemsize
    whole = f"a whole file: its header claims {claimed} ({header.dtype} of shape {header.shape})"
    require(f"bytes of {name}", found, found == claimed, whole)


def read_header(file: IO[bytes], name: str) -> Header:
    """Read shape and type of an array; leave `file` at the first of its numbers."""
    with decoding(name):
        version = npy_format.read_magic(file)
        readers = {
            (1, 0): npy_format.read_array_header_1_0,
            (2, 0): npy_format.read_array_header_2_0,
        }
        return Header(*readers[version](file))
