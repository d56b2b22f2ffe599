"""netCDF-3, the classic format: SciPy reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.array_utils import byte_bounds

from core.io.readers.chunks import Chunked, Whole, read_stretch
from core.io.readers.guards import FileVersion, decoding, require_fits
from core.io.readers.stored import Stored

SIGNATURES = (b"CDF\x01", b"CDF\x02")
_LARGEST = 3  # axes of an array that can be of use


def arrays(path: Path) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """All arrays of a file, and its attributes under the name ``""``."""
    from scipy.io import netcdf_file  # noqa: PLC0415 - not for every file

    version = FileVersion.of(path)
    # Mapped: SciPy would read every variable at once, and any number of them may share their bytes.
    # The map itself is never read: that would end the process if the file became shorter meanwhile.
    with decoding("the file"):
        file = netcdf_file(path, mmap=True)
    with file, version.unchanged():
        with decoding("the file"):
            n_bytes = sum(one.data.nbytes for one in file.variables.values() if _is_useful(one))
        require_fits("all variables", n_bytes)
        with decoding("the file"):
            names, begin = list(file.variables), byte_bounds(file._mm_buf)[0]
            # None is left, or the map could not be closed.
            found = [_stored(path, begin, name, file.variables.pop(name)) for name in names]
            return found, {"": _plain(file._attributes)}


def _is_useful(variable: Any) -> bool:
    values = variable.data
    return bool(1 <= values.ndim <= _LARGEST and values.dtype.kind in "iuf" and values.size)


def _stored(path: Path, begin: int, name: str, variable: Any) -> Stored:
    """A copy of a variable of a file that is mapped from an address on."""
    values, known = variable.data, _plain(variable._attributes)
    if not _is_useful(variable):
        return Stored(name, attributes=known, refused="no numbers with 1 to 3 axes")
    first, end = byte_bounds(values)
    data = read_stretch(path, first - begin, end - first)
    if len(data) != values.nbytes:  # a variable that grows with the file lies among others
        data = np.ndarray(values.shape, values.dtype, data, strides=values.strides).tobytes()
    numbers = Chunked(name, values.shape, values.dtype, values.shape, Whole(data))
    return Stored(name, numbers, tuple(variable.dimensions), known)


def _plain(known: Any) -> dict[str, Any]:
    """Attributes that are numbers or text."""
    plain: dict[str, Any] = {}
    for name, value in known.items():
        if isinstance(value, bytes):
            plain[name] = value.decode("utf-8", "replace")
        elif np.asarray(value).dtype.kind in "iuf":
            plain[name] = np.asarray(value).tolist()
    return plain
