"""HDF5, netCDF-4 and classic netCDF: the arrays that a file holds.

Their libraries run in an isolated process (`core.io.readers.isolation`). Links, virtual datasets
and those kept in other files are never followed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.io.readers import guards
from core.io.readers.guards import FileVersion
from core.io.readers.isolation import isolated
from core.io.readers.stored import Stored, listed

SIGNATURE = b"\x89HDF\r\n\x1a\n"
CLASSIC_SIGNATURES = (b"CDF\x01", b"CDF\x02")


def arrays(path: Path) -> tuple[list[Stored], dict[str, dict[str, Any]]]:
    """List all arrays of a file, and the attributes of its groups by name; its own under ``""``."""
    versions = {"": FileVersion.of(path)}
    with path.open("rb") as file:
        kind = "netcdf3" if file.read(4) in CLASSIC_SIGNATURES else "hdf5"
    return listed(path, f"list_{kind}", f"read_{kind}", versions)


def cells(path: Path, name: str, most_values: int) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Read the vectors that an array refers to, one after the other, and the size of each."""
    memory = 2 * guards.MAX_CUBE_BYTES
    _, found = isolated(path, name, "read_cells", memory, name=name, most_values=most_values)
    return found[0], found[1]
