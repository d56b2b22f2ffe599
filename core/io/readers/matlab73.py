"""MATLAB 7.3 ``.mat`` (saved with ``-v7.3``), which is an HDF5 file behind 512 bytes of its own.

The same variables as in `core.io.readers.matlab`. MATLAB's first axis is HDF5's last, so all axes
are turned round. A cell array is an array of references; a sparse matrix is a group of three
arrays.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from core.capture import Capture
from core.io.readers import guards, hdf5
from core.io.readers.arrivals import BYTES_A_PHOTON, arrivals_capture
from core.io.readers.dense import cube_capture
from core.io.readers.guards import decoding
from core.io.readers.request import Request
from core.io.readers.sparse import Sparse, sparse_capture
from core.io.readers.stored import Numbers, Stored, whole
from core.io.readers.variables import Variable, bin_width, choose


def read(path: Path, request: Request) -> Capture:
    """Read a cell array of arrival times, a cube, or a sparse matrix."""
    arrays, groups = hdf5.arrays(path)
    variables = _variables({array.name: array for array in arrays}, groups)
    variable = choose(variables, request.variable)
    name, origin = variable.name, f"{path.name}, variable {variable.name}"
    if variable.kind == "cell":
        times, sizes = hdf5.cells(path, name, guards.MAX_CUBE_BYTES // BYTES_A_PHOTON)
        n_rows, n_cols = variable.shape
        with decoding(name):
            col, row = np.divmod(np.arange(n_rows * n_cols), n_rows)
            pixel = np.repeat(row * n_cols + col, sizes)
        return arrivals_capture(times, pixel, (n_rows, n_cols), name, origin, request)
    width_s = bin_width(
        float(whole(one.content).item()) for one in variables if one.may_tell_bin_width
    )
    if variable.kind == "sparse":
        values, rows, starts = (whole(part) for part in variable.content)
        matrix = Sparse(values, rows, starts, (variable.shape[0], variable.shape[1]))
        return sparse_capture(matrix, name, origin, request, width_s)
    cube = whole(variable.content).transpose()
    return cube_capture(cube, name, origin, request, guessed_bin_width_s=width_s)


def _variables(arrays: dict[str, Stored], groups: dict[str, dict[str, Any]]) -> list[Variable]:
    found = []
    for name, array in arrays.items():
        known = array.attributes
        kind = known.get("MATLAB_class", array.numbers and array.numbers.dtype.name)
        shape = array.references if array.numbers is None else array.numbers.shape
        hollow = "MATLAB_empty" in known or (array.numbers is None and not array.references)
        if "/" in name:
            continue
        if hollow or "MATLAB_int_decode" in known:
            kind = array.refused or f"{kind}, not numbers"
        found.append(Variable(name, shape[::-1], str(kind), array.numbers))
    for name, known in groups.items():
        parts = [arrays.get(f"{name}/{part}") for part in ("data", "ir", "jc")]
        numbers: list[Numbers] = [
            part.numbers for part in parts if part is not None and part.numbers is not None
        ]
        if "MATLAB_sparse" in known and len(numbers) == len(parts):
            shape = (int(known["MATLAB_sparse"]), numbers[2].shape[0] - 1)
            found.append(Variable(name, shape, "sparse", numbers))
        elif name and "/" not in name:
            found.append(Variable(name, (), str(known.get("MATLAB_class", "group")), None))
    return found
