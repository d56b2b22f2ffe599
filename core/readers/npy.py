"""NumPy ``.npy``: one histogram cube (row, col, bin) of non-negative whole numbers."""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.readers.dense import cube_capture
from core.readers.guards import decoding, require_fits
from core.readers.request import Request


def read(path: Path, request: Request) -> Capture:
    """Read a cube; everything else is given or guessed."""
    require("variable", request.variable, request.variable is None, "None: .npy holds one array")
    with path.open("rb") as file:
        cube = read_array(file, path.stat().st_size, "the array")
    return cube_capture(cube, "the array", path.name, request)


def read_array(file: IO[bytes], size: int, name: str) -> NDArray[Any]:
    """Read one array from a seekable file of `size` bytes, after its header proved true.

    Raises
    ------
    ValueError
        If the array holds objects (pickles are never read), does not fit in `size` or is too large.
    """
    shape, dtype = read_header(file, name)
    what = f"type of {name}"
    require(what, str(dtype), dtype.kind in "biufU", "numbers or text; pickled objects are refused")
    found, claimed = size - file.tell(), prod(shape) * dtype.itemsize
    require_fits(name, claimed)
    whole = f"a whole file: its header claims {claimed} ({dtype} of shape {shape})"
    require(f"bytes of {name}", found, found == claimed, whole)
    file.seek(0)
    with decoding(name):
        return npy_format.read_array(file, allow_pickle=False)


def read_header(file: IO[bytes], name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of an array; leaves `file` at the first of its numbers."""
    with decoding(name):
        version = npy_format.read_magic(file)
        readers = {
            (1, 0): npy_format.read_array_header_1_0,
            (2, 0): npy_format.read_array_header_2_0,
        }
        shape, _, dtype = readers[version](file)
    return shape, dtype
