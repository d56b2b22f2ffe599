"""NumPy ``.npy``: one histogram cube (row, col, bin) of non-negative whole numbers.

If ``no_trigger`` is given, the array holds raw frames (pulse, row, col), see
`core.io.readers.frames`.
"""

from __future__ import annotations

from math import prod
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.lib import format as npy_format
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import cube_capture
from core.io.readers.frames import AXES, frames_capture, require_frames, stretches_of
from core.io.readers.guards import decoding, require_fits
from core.io.readers.options import ReadOptions


class Header(NamedTuple):
    """Header of an array."""

    shape: tuple[int, ...]
    fortran_order: bool
    dtype: np.dtype[Any]


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
    return cube_capture(cube, "the array", path.name, request)


def frames_in(file: IO[bytes], size: int, name: str, origin: str, request: ReadOptions) -> Capture:
    """A capture from an array of frames in a file of `size` bytes, counted as they are read.

    Parameters are those of `read_array` and `core.io.readers.frames.frames_capture`; the request's
    ``no_trigger`` is the value that marks no trigger.
    """
    shape, fortran_order, dtype = read_header(file, name)
    require_frames(shape, dtype, name)
    _require_whole(file, size, shape, dtype, name)
    stretches, counted = stretches_of(file, shape, dtype, request, fortran_order)
    no_trigger = int(request.no_trigger or 0)
    guessed = [f"axes ({', '.join(AXES)})"] if request.axes is None and name != "frames" else []
    return frames_capture(
        stretches, counted, no_trigger, name, origin, request, also_guessed=guessed
    )


def read_array(file: IO[bytes], size: int, name: str) -> NDArray[Any]:
    """Read one array from a seekable file of `size` bytes, after its header proved true.

    Raises
    ------
    ValueError
        If the array holds objects (pickles are never read), does not fit in `size` or is too large.
    """
    shape, _, dtype = read_header(file, name)
    what = f"type of {name}"
    require(what, str(dtype), dtype.kind in "biufU", "numbers or text; pickled objects are refused")
    require_fits(name, prod(shape) * dtype.itemsize)
    _require_whole(file, size, shape, dtype, name)
    file.seek(0)
    with decoding(name):
        return npy_format.read_array(file, allow_pickle=False)


def _require_whole(
    file: IO[bytes], size: int, shape: tuple[int, ...], dtype: np.dtype[Any], name: str
) -> None:
    found, claimed = size - file.tell(), prod(shape) * dtype.itemsize
    whole = f"a whole file: its header claims {claimed} ({dtype} of shape {shape})"
    require(f"bytes of {name}", found, found == claimed, whole)


def read_header(file: IO[bytes], name: str) -> Header:
    """Shape and type of an array; leaves `file` at the first of its numbers."""
    with decoding(name):
        version = npy_format.read_magic(file)
        readers = {
            (1, 0): npy_format.read_array_header_1_0,
            (2, 0): npy_format.read_array_header_2_0,
        }
        return Header(*readers[version](file))
