"""MATLAB ``.mat`` of version 5 (saved with ``-v6`` or ``-v7``) and 7.3 (``-v7.3``, HDF5).

Either a cell array (row, col) holding each pixel's photon arrival times as a vector, or a cube
(row, col, bin) of counts, or a sparse matrix (pixel, bin) of counts, as published simulated
captures are stored. The file may have other variables if only one fits. Numbers under the names of
the project's own layout, ``bin_width_s``, ``gate_delay_s``, ``n_pulses`` and ``pixel_angle_rad``,
and under the other names of `core.io.readers.layout`, are used; fluxes are kept.

The pixels of a sparse matrix follow each other column by column, as MATLAB's ``reshape`` lists
them, or row by row with ``axes="row col"``. Rows and columns come from ``shape``; without it they
are guessed to be those of another array with as many elements along its first two axes, or the
image to be square.

SciPy and h5py read the variables in an isolated process (`core.io.readers.isolation`). In version
7.3 the axes are reversed, a cell array is an array of references, and a sparse matrix a group of
three arrays.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from math import isqrt, prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers import guards
from core.io.readers.arrivals import BYTES_A_PHOTON, arrivals_capture
from core.io.readers.dense import (
    LARGEST_COUNT,
    cube_capture,
    dense_capture,
    with_guesses,
)
from core.io.readers.guards import FileVersion, decoding, require_fits
from core.io.readers.isolation import isolated
from core.io.readers.layout import completed, stated_flux, stating, timing, without_unit
from core.io.readers.maps import Map
from core.io.readers.options import ReadOptions, choose_variable
from core.io.readers.stored import HDF5_SIGNATURE, Stored, arrays
from core.trigger import count_dtype

_USER_BLOCK = 512  # before the HDF5 of version 7.3
_VERSIONS_5 = (b"\x00\x01IM", b"\x01\x00MI")

NUMERIC = ("double", "single", *(f"{u}int{n}" for u in ("", "u") for n in (8, 16, 32, 64)))

_FRACTIONS = ("double", "single")


class Variable(NamedTuple):
    """Variable of a file.

    ``shape`` is MATLAB's, ``kind`` the class of its elements, or ``"sparse"``; ``parts`` are its
    arrays in version 7.3.
    """

    name: str
    shape: tuple[int, ...]
    kind: str
    parts: tuple[Stored, ...] = ()

    def __str__(self) -> str:
        return f"{self.name} ({self.kind}, {' x '.join(map(str, self.shape))})"

    @property
    def fits(self) -> bool:
        """Whether it has the shape of a capture."""
        is_cube = self.kind in NUMERIC and len(self.shape) == 3
        is_list = self.kind in ("cell", "sparse") and len(self.shape) == 2
        return (is_cube or is_list) and min(self.shape) > 0

    @property
    def is_number(self) -> bool:
        """Whether it is a single number."""
        return self.kind in NUMERIC and set(self.shape) == {1}


class _Version5:
    """Variables of a file of version 5."""

    def __init__(self, path: Path) -> None:
        self._path, self._version = path, FileVersion.of(path)
        require_fits("the file", path.stat().st_size)
        listed, _ = isolated(path, "the list of variables", "list_mat5", working_bytes=0)
        self.variables = [
            Variable(name, tuple(shape), kind) for name, shape, kind in listed["variables"]
        ]

    def cells(self, variable: Variable) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Return arrival times, and the pixel of each."""
        times, sizes = self._read(variable, 2)
        return times, np.repeat(np.arange(sizes.size), sizes)

    def array(self, variable: Variable) -> NDArray[Any]:
        """Return the numbers of an array."""
        return self._read(variable, 1)[0]

    def sparse(self, variable: Variable) -> list[NDArray[Any]]:
        """Return values, rows and starts of a sparse matrix."""
        return self._read(variable, 3)

    def _read(self, variable: Variable, n_arrays: int) -> list[NDArray[Any]]:
        name = variable.name
        with self._version.unchanged():
            _, found = isolated(self._path, name, "read_mat5", name=name)
        require(f"parts of {name}", len(found), len(found) == n_arrays, f"{n_arrays}")
        return found


class _Version73:
    """Variables of a file of version 7.3."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.variables = _variables(*arrays(path))

    def cells(self, variable: Variable) -> tuple[NDArray[Any], NDArray[np.int64]]:
        """Return arrival times, and the pixel of each."""
        name, most = variable.name, guards.MAX_CUBE_BYTES // BYTES_A_PHOTON
        _, (times, sizes) = isolated(self._path, name, "read_cells", name=name, most_values=most)
        n_rows, n_cols = variable.shape
        with decoding(name):
            col, row = np.divmod(np.arange(n_rows * n_cols), n_rows)
            return times, np.repeat(row * n_cols + col, sizes)

    def array(self, variable: Variable) -> NDArray[Any]:
        """Return the numbers of an array."""
        return variable.parts[0].whole().transpose()

    def sparse(self, variable: Variable) -> list[NDArray[Any]]:
        """Return values, rows and starts of a sparse matrix."""
        return [part.whole() for part in variable.parts]


def _variables(arrays: Sequence[Stored], groups: dict[str, dict[str, Any]]) -> list[Variable]:
    """Return the variables that the arrays and groups of a file of version 7.3 make."""
    found = []
    for array in arrays:
        known = array.attributes
        kind = str(known.get("MATLAB_class", array.dtype.name))
        hollow = "MATLAB_empty" in known or (array.refused and not array.references)
        if hollow or "MATLAB_int_decode" in known:
            kind = array.refused or f"{kind}, not numbers"
        shape = array.references or array.shape
        if "/" not in array.name:
            found.append(Variable(array.name, shape[::-1], kind, (array,)))
    named = {array.name: array for array in arrays if not array.refused}
    for name, known in groups.items():
        names = [f"{name}/{part}" for part in ("data", "ir", "jc")]
        if "MATLAB_sparse" in known and named.keys() >= set(names):
            parts = tuple(named[part] for part in names)
            shape = (int(known["MATLAB_sparse"]), parts[2].shape[0] - 1)
            found.append(Variable(name, shape, "sparse", parts))
        elif name and "/" not in name:
            found.append(Variable(name, (), str(known.get("MATLAB_class", "group"))))
    return found


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like MATLAB, or like HDF5 that may be of version 7.3."""
    return start[124:128] in _VERSIONS_5 or _is_hdf5(start)


def _is_hdf5(start: bytes) -> bool:
    return any(start[k:].startswith(HDF5_SIGNATURE) for k in (0, _USER_BLOCK))


def read(path: Path, request: ReadOptions) -> Capture:
    """Read a cell array of arrival times, a cube, or a sparse matrix."""
    file = _opened(path)
    variable = _choose(file.variables, request.variable)
    numbers = {one.name: one for one in file.variables if one.is_number}

    def values(names: Iterable[str]) -> dict[str, Any]:
        return {name: file.array(numbers[name]) for name in names if name in numbers}

    origin, known = f"{path.name}, variable {variable.name}", values(timing(numbers))
    capture = _capture(file, variable, origin, completed(request, known), known)
    capture = replace(capture, stated_flux=stated_flux(values(stating(numbers))))
    return with_guesses(capture, variable=variable.name)


def _capture(
    file: _Version5 | _Version73,
    variable: Variable,
    origin: str,
    request: ReadOptions,
    known: Mapping[str, Any],
) -> Capture:
    name = variable.name
    if variable.kind == "cell":
        times, pixel = file.cells(variable)
        shape = (variable.shape[0], variable.shape[1])
        return arrivals_capture(times, pixel, shape, name, origin, request)
    width_s, left_out = without_unit(request, known)
    if variable.kind == "sparse":
        parts = file.sparse(variable)
        shaped, guessed = _with_shape(request, variable, file.variables)
        guessed += left_out
        return _sparse_capture(parts, variable.shape, name, origin, shaped, guessed, width_s)
    counts = file.array(variable)
    return cube_capture(counts, name, origin, request, guessed=left_out, bin_width_s=width_s)


def maps(path: Path) -> list[Map]:
    """List matrices of numbers, and cells, each of which must then hold one number."""
    file = _opened(path)
    found = []
    for each in file.variables:
        if len(each.shape) == 2 and each.kind in (*NUMERIC, "cell"):
            load = partial(_one_each, file) if each.kind == "cell" else file.array
            found.append(Map(each.name, each.shape, partial(load, each)))
    return found


def _one_each(file: _Version5 | _Version73, variable: Variable) -> NDArray[Any]:
    """Return the numbers of a cell array as a matrix."""
    numbers, pixel = file.cells(variable)
    size = np.bincount(pixel, minlength=prod(variable.shape))
    accepted = "one number in each of them"
    require(
        f"numbers in a cell of {variable.name}", int(size.max()), bool((size == 1).all()), accepted
    )
    return np.asarray(numbers[np.argsort(pixel)].reshape(variable.shape))


def _opened(path: Path) -> _Version5 | _Version73:
    with path.open("rb") as opened:
        start = opened.read(_USER_BLOCK + len(HDF5_SIGNATURE))
    if _is_hdf5(start):
        return _Version73(path)
    # SciPy takes a zero in the first four bytes for version 4.
    if start[124:128] not in _VERSIONS_5 or 0 in start[:4]:
        raise ValueError(
            "the header is not that of a MATLAB file: give one that was saved with -v6, -v7 or "
            "-v7.3."
        )
    return _Version5(path)


def _choose(variables: Sequence[Variable], name: str | None) -> Variable:
    """Return the requested variable, else the only one that fits."""
    fitting = {variable.name: variable for variable in variables if variable.fits}
    listed = ", ".join(map(str, variables)) or "nothing"
    accepted = "a cell (row, col) of arrival times, a cube (row, col, bin), or a sparse matrix "
    accepted += "(pixel, bin)"
    whole = {each: variable.kind not in _FRACTIONS for each, variable in fitting.items()}
    return fitting[choose_variable(name, fitting, whole, accepted, listed)]


def _with_shape(
    request: ReadOptions, pixels: Variable, variables: Iterable[Variable]
) -> tuple[ReadOptions, list[str]]:
    """Return a request with rows and columns for a list of pixels; and what was guessed of them.

    An array with as many elements along its first two axes gives the shape; otherwise the image
    is square.
    """
    n_pixels = pixels.shape[0]
    if request.shape is not None:
        return request, []
    likely: dict[tuple[int, ...], str] = {}
    for each in variables:
        size = each.shape[:2]
        if each.kind in NUMERIC and len(size) == 2 and min(size) > 1 and prod(size) == n_pixels:
            likely.setdefault(size, each.name)
    if len(likely) == 1:
        ((rows, cols), name), *_ = likely.items()
        return replace(request, shape=(rows, cols)), [f"shape {rows} x {cols}, that of {name}"]
    side = isqrt(n_pixels)
    if side**2 != n_pixels:
        return request, []
    return replace(request, shape=(side, side)), [f"shape {side} x {side}"]


def _sparse_capture(
    parts: list[NDArray[Any]],
    shape: tuple[int, ...],
    name: str,
    origin: str,
    request: ReadOptions,
    guessed: list[str],
    bin_width_s: float | None,
) -> Capture:
    """Return a capture from a sparse matrix (pixel, bin) of counts.

    Its `parts` are the values column by column, the row of each, and the start of each column,
    followed by the end of the last one.
    """
    n_pixels, n_bins = shape
    by_row = request.order(("row", "col")) == (0, 1)
    rows, cols = request.shape or (0, 0)
    accepted = f"rows and columns of {n_pixels} pixels in all"
    require("shape", request.shape, rows * cols == n_pixels, accepted)
    guessed = [*guessed, *([] if request.axes else ["pixels column by column"])]
    pixel, bins, counts = _entries(parts, n_pixels, n_bins, name)
    if not by_row:
        col, row = np.divmod(pixel, rows)
        pixel = row * cols + col
    dtype = count_dtype(int(counts.max(initial=0)))
    require_fits(f"the cube of {name}", n_pixels * n_bins * dtype.itemsize)
    cube = np.zeros((n_pixels, n_bins), dtype)
    cube[pixel, bins] = counts
    known = replace(request, shape=None, axes=None)
    cube = cube.reshape(rows, cols, n_bins)
    return dense_capture(cube, origin, known, guessed=guessed, bin_width_s=bin_width_s)


def _entries(
    parts: list[NDArray[Any]], n_rows: int, n_cols: int, name: str
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return row, column and value of each entry of a sparse matrix after checking them."""
    values, rows, starts = parts[0], parts[1], parts[2].astype(np.int64)
    n_found = len(starts) - 1
    require(f"columns of {name}", n_found, n_found == n_cols, f"{n_cols}, as its shape says")
    steps: NDArray[np.int64] = np.diff(starts)
    n_entries, most = int(starts[-1]), min(len(values), len(rows))
    rising = starts[0] == 0 and bool((steps >= 0).all()) and n_entries <= most
    require(f"entries of {name}", n_entries, rising, f"columns one after the other, up to {most}")
    values, row = values[:n_entries], rows[:n_entries].astype(np.int64)
    col = np.repeat(np.arange(n_cols), steps)
    inside = bool(((row >= 0) & (row < n_rows)).all())
    once = bool((np.diff(col * n_rows + row) > 0).all())
    require(f"rows of {name}", "out of order", inside and once, f"rising ones below {n_rows}")
    odd = ~((values >= 0) & (values <= LARGEST_COUNT) & (values == np.floor(values)))
    if odd.any():
        require(name, values[odd][0].item(), False, f"whole counts from 0 to {LARGEST_COUNT:,}")
    return row, col, values.astype(np.int64)
