"""netCDF-3, the classic format: SciPy reads it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from core.readers.chunks import Chunked, Whole
from core.readers.guards import decoding, require_fits
from core.readers.stored import Stored

SIGNATURES = (b"CDF\x01", b"CDF\x02")
_LARGEST = 3  # axes of an array that can be of use


def arrays(path: Path) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """All arrays of a file, and its attributes under the name ``""``."""
    from scipy.io import netcdf_file  # noqa: PLC0415 - not for every file

    found, n_bytes = [], 0
    # Mapped: SciPy would read every variable at once, and any number of them may share their bytes.
    with decoding("the file"), netcdf_file(path, mmap=True) as file:
        groups = {"": _plain(file._attributes)}
        for name in list(file.variables):
            variable = file.variables.pop(name)
            values, known = variable.data, _plain(variable._attributes)
            useful = 1 <= values.ndim <= _LARGEST and values.dtype.kind in "iuf" and values.size
            if not useful:
                found.append(Stored(name, attributes=known, refused="no numbers with 1 to 3 axes"))
            else:
                n_bytes += values.nbytes
                require_fits("all variables", n_bytes)
                whole = Whole(values.tobytes())
                numbers = Chunked(name, values.shape, values.dtype, values.shape, whole)
                found.append(Stored(name, numbers, tuple(variable.dimensions), known))
            del variable, values
    return found, groups


def _plain(known: Any) -> dict[str, Any]:
    """Attributes that are numbers or text."""
    plain: dict[str, Any] = {}
    for name, value in known.items():
        if isinstance(value, bytes):
            plain[name] = value.decode("utf-8", "replace")
        elif np.asarray(value).dtype.kind in "iuf":
            plain[name] = np.asarray(value).tolist()
    return plain
