"""MATLAB ``.mat`` of version 5 (saved with ``-v6`` or ``-v7``) and 7.3 (``-v7.3``, HDF5).

Either a cell array (row, col) holding each pixel's photon arrival times as a vector, or a cube
(row, col, bin) of counts, or a sparse matrix (pixel, bin) of counts as in `core.io.readers.sparse`.
The file may have other variables if only one fits; a number named like ``bin_width`` or
``resolution`` that is plausible in seconds is taken as the bin width, as a guess.

SciPy and h5py read the variables in an isolated process (`core.io.readers.isolation`). In version
7.3 the axes are reversed, a cell array is an array of references, and a sparse matrix a group of
three arrays.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers import guards, hdf5
from core.io.readers.arrivals import BYTES_A_PHOTON, arrivals_capture
from core.io.readers.dense import cube_capture
from core.io.readers.guards import FileVersion, decoding, require_fits
from core.io.readers.isolation import isolated
from core.io.readers.options import ReadOptions
from core.io.readers.sparse import Sparse, sparse_capture
from core.io.readers.stored import Numbers, Stored, whole

_USER_BLOCK = 512  # before the HDF5 of version 7.3
_VERSIONS_5 = (b"\x00\x01IM", b"\x01\x00MI")

NUMERIC = ("double", "single", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)))

_WIDTH_NAMES = {"binwidth", "binsize", "binresolution", "timeresolution", "resolution"}
_SHORTEST_S, _LONGEST_S = 1e-13, 1e-6


class Variable(NamedTuple):
    """A variable of a file.

    ``shape`` is MATLAB's, ``kind`` the class of its elements, or ``"sparse"``; ``content`` loads it
    in version 7.3.
    """

    name: str
    shape: tuple[int, ...]
    kind: str
    content: Any

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {' x '.join(map(str, self.shape))})"

    @property
    def fits(self) -> bool:
        """Whether it has the shape of a capture."""
        is_cube = self.kind in NUMERIC and len(self.shape) == 3
        is_list = self.kind in ("cell", "sparse") and len(self.shape) == 2
        return (is_cube or is_list) and min(self.shape) > 0

    @property
    def may_be_bin_width(self) -> bool:
        """Whether it is a single number with a name like that of a bin width."""
        plain = self.name.lower().replace("_", "")
        return self.kind in NUMERIC and set(self.shape) == {1} and plain in _WIDTH_NAMES


def _choose(variables: Sequence[Variable], name: str | None) -> Variable:
    """The variable asked for, or the only one that fits.

    Raises
    ------
    ValueError
        If no variable fits, or more than one.
    """
    for known, times in Counter(variable.name for variable in variables).items():
        require(f"variables named {known!r}", times, times == 1, "each name once")
    fitting = {variable.name: variable for variable in variables if variable.fits}
    listed = ", ".join(map(str, variables)) or "nothing"
    remedy = (
        "a cell (row, col) of arrival times, a cube (row, col, bin), or a sparse matrix "
        f"(pixel, bin); the file has {listed}"
    )
    if name is not None:
        require("variable", name, name in fitting, f"the name of {remedy}")
        return fitting[name]
    found = ", ".join(fitting) or None
    require("variable", found, len(fitting) == 1, f"as variable the name of {remedy}")
    return next(iter(fitting.values()))


def _bin_width(values: Iterable[float]) -> float | None:
    """The one of some numbers that can be the width of a bin in seconds; None if not just one."""
    found = {value for value in values if _SHORTEST_S <= value <= _LONGEST_S}
    return found.pop() if len(found) == 1 else None


class _Version5:
    """The variables of a file of version 5."""

    def __init__(self, path: Path) -> None:
        self._version = FileVersion.of(path)
        require_fits("the file", path.stat().st_size)
        told, _ = isolated(path, "the list of variables", "list_mat5")
        with decoding("the list of variables"):
            self.variables = [
                Variable(str(name), tuple(shape), str(kind), None)
                for name, shape, kind in told["variables"]
            ]

    def cells(self, variable: Variable) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Arrival times, and the pixel of each."""
        times, sizes = self._read(variable, 2)
        return times, np.repeat(np.arange(sizes.size), sizes)

    def array(self, variable: Variable) -> NDArray[Any]:
        """The numbers of an array."""
        return self._read(variable, 1)[0]

    def sparse(self, variable: Variable) -> Sparse:
        """A sparse matrix."""
        values, rows, starts = self._read(variable, 3)
        return Sparse(values, rows, starts, (variable.shape[0], variable.shape[1]))

    def _read(self, variable: Variable, n_arrays: int) -> list[NDArray[Any]]:
        name, memory = variable.name, 2 * guards.MAX_CUBE_BYTES
        with self._version.unchanged():
            _, found = isolated(self._version.path, name, "read_mat5", memory, name=name)
        require(f"parts of {name}", len(found), len(found) == n_arrays, f"{n_arrays}")
        return found


class _Version73:
    """The variables of a file of version 7.3."""

    def __init__(self, path: Path) -> None:
        self._path = path
        arrays, groups = hdf5.arrays(path)
        self.variables = _variables({array.name: array for array in arrays}, groups)

    def cells(self, variable: Variable) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Arrival times, and the pixel of each."""
        most = guards.MAX_CUBE_BYTES // BYTES_A_PHOTON
        times, sizes = hdf5.cells(self._path, variable.name, most)
        n_rows, n_cols = variable.shape
        with decoding(variable.name):
            col, row = np.divmod(np.arange(n_rows * n_cols), n_rows)
            return times, np.repeat(row * n_cols + col, sizes)

    def array(self, variable: Variable) -> NDArray[Any]:
        """The numbers of an array."""
        return whole(variable.content).transpose()

    def sparse(self, variable: Variable) -> Sparse:
        """A sparse matrix."""
        values, rows, starts = (whole(part) for part in variable.content)
        return Sparse(values, rows, starts, (variable.shape[0], variable.shape[1]))


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like MATLAB, or like HDF5 that may be of version 7.3."""
    return start[124:128] in _VERSIONS_5 or hdf5.SIGNATURE in (start[:8], start[512:520])


def read(path: Path, request: ReadOptions) -> Capture:
    """Read a cell array of arrival times, a cube, or a sparse matrix."""
    with path.open("rb") as opened:
        start = opened.read(_USER_BLOCK + len(hdf5.SIGNATURE))
    file: _Version5 | _Version73
    if hdf5.SIGNATURE in (start[: len(hdf5.SIGNATURE)], start[_USER_BLOCK:]):
        file = _Version73(path)
    else:
        # SciPy takes a zero in the first four bytes for version 4.
        known = start[124:128] in _VERSIONS_5 and 0 not in start[:4]
        require("version", start[124:128], known, "a MATLAB file, saved with -v6, -v7 or -v7.3")
        file = _Version5(path)
    variable = _choose(file.variables, request.variable)
    name, origin = variable.name, f"{path.name}, variable {variable.name}"
    if variable.kind == "cell":
        times, pixel = file.cells(variable)
        shape = (variable.shape[0], variable.shape[1])
        return arrivals_capture(times, pixel, shape, name, origin, request)
    width_s = _bin_width(
        float(file.array(one).item()) for one in file.variables if one.may_be_bin_width
    )
    if variable.kind == "sparse":
        return sparse_capture(file.sparse(variable), name, origin, request, width_s)
    return cube_capture(file.array(variable), name, origin, request, guessed_bin_width_s=width_s)


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
