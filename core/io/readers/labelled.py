"""HDF5, netCDF and Zarr as labelled arrays (xarray), which may be larger than memory.

Counts are an array with the axes ``row``, ``col`` and ``bin``. Along ``bin`` lie the coordinates
``time_s`` (when a bin opens, after the pulse) and ``range_m``; what else is known of the capture
stands in the attributes of the counts, under the names and with the meaning of
`core.io.readers.npz`.

Arrays of others open too. Their axes are known by the names below, or by ``axes``; bins by any
coordinate along them whose ``units`` are a time's or metres, or whose name ends in such a unit.
Where a file names no axes, as plain HDF5 does not, `core.io.readers.dense.guess_axes` does.

Unsigned counts of 8, 16 or 32 bits keep their type. Others are checked when they are read, and are
uint16 or uint32 in a capture, uint32 in an array that is opened but not read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import SPEED_OF_LIGHT_M_S, Floats
from core.capture import COUNT_TYPES, Capture, CaptureError
from core.checks import require
from core.io.readers.dense import (
    AXES,
    Description,
    capture_of,
    description_of,
    guess_axes,
    require_sums,
    stored_counts,
    whole_counts,
    with_guesses,
)
from core.io.readers.guards import require_fits
from core.io.readers.layout import (
    completed,
    number,
    require_image,
    require_pulse_in_gate,
    stated_flux,
    without_unit,
)
from core.io.readers.maps import with_own_truth
from core.io.readers.options import IN_ORDER, ReadOptions
from core.io.readers.quantities import UNITS_S as TIME_UNITS_S
from core.io.readers.sample import sample_of
from core.io.readers.stored import CLASSIC_SIGNATURES, HDF5_SIGNATURE, Stored, arrays, choose
from core.labels import dataset, with_description  # noqa: F401 - the layout that is read here

if TYPE_CHECKING:
    import xarray as xr

NAMES = {
    "row": ("row", "rows", "y", "line", "lines"),
    "col": ("col", "cols", "column", "columns", "x", "pixel"),
    "bin": ("bin", "bins", "time", "time_s", "t", "tof", "delay", "range", "range_m", "h"),
}
"""Accepted names of each axis, in lower case."""

_SECONDS = {"": "s", "milli": "ms", "micro": "us", "nano": "ns", "pico": "ps"}
UNITS_S = TIME_UNITS_S | {
    f"{name}second{s}": TIME_UNITS_S[unit] for s in ("", "s") for name, unit in _SECONDS.items()
}
UNITS_S |= dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 2 / SPEED_OF_LIGHT_M_S)
UNITS_S["km"] = 1e3 * UNITS_S["m"]
"""Seconds (two-way, for lengths) of each unit of a coordinate along the bins."""

BLOCK_BYTES = 2**24
"""Approximate size of a block of an array that is opened lazily."""

_LONGEST = 2**20  # coordinate that is read
_MOST_COORDINATES = 100
_MISSING = ("_FillValue", "missing_value")
_ENCODING = (*_MISSING, "scale_factor", "add_offset", "coordinates", "_ARRAY_DIMENSIONS")


@dataclass(frozen=True)
class CheckedCounts:
    """Counts in a file, checked as they are read.

    Parameters
    ----------
    stored : Stored
        With three axes.
    missing : dict
        Values that mark missing numbers, by the name of the attribute that defines them.
    """

    stored: Stored
    missing: Mapping[str, float] = field(default_factory=dict)
    ndim = len(AXES)

    @property
    def shape(self) -> tuple[int, ...]:
        """Size along each axis, in the order of the file."""
        return self.stored.shape

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """Type in the file where it is one for counts, else uint32."""
        stored = self.stored.dtype.newbyteorder("=")
        return stored if stored in COUNT_TYPES else np.dtype(np.uint32)

    def __getitem__(self, key: tuple[int | slice, ...]) -> NDArray[np.unsignedinteger]:
        """Read counts at whole numbers and slices; raise `CaptureError` where one is no count."""
        boxes, within = zip(*map(_box, key, self.shape), strict=True)
        try:
            found = self.read(boxes)
            if found.dtype != self.dtype and found.size:
                found = whole_counts(found, self.stored.name, self.dtype)
        except ValueError as error:
            raise CaptureError(f"{self.stored.path.name}: {error}") from error
        return found.astype(self.dtype, copy=False)[within]

    def read(self, box: tuple[slice, ...]) -> NDArray[Any]:
        """Read the numbers in a box of slices, none of them missing."""
        found = self.stored[box]
        for attribute, value in self.missing.items():
            gaps = bool((found == value).any())
            require(f"{attribute} of {self.stored.name}", value, not gaps, "counts without gaps")
        return found


def _box(key: int | slice, size: int) -> tuple[slice, int | slice]:
    """Convert an index along an axis to a slice of positive step and an index within it."""
    if not isinstance(key, slice):
        place = range(size)[key]
        return slice(place, place + 1), 0
    picked = range(*key.indices(size))
    if not picked:
        return slice(0, 0), slice(None)
    if picked.step > 0:
        return slice(picked[0], picked[-1] + 1, picked.step), slice(None)
    return slice(picked[-1], picked[0] + 1, -picked.step), slice(None, None, -1)


class _File:
    """Counts that the user chooses from a file, and the arrays that accompany them."""

    def __init__(self, path: Path, request: ReadOptions) -> None:
        self._arrays, self._groups = arrays(path)
        self._request = request
        self._chosen = chosen = choose(self._arrays, request)
        self._group, _, self._name = chosen.name.rpartition("/")
        self.origin = f"{path.name}, variable {chosen.name}"
        known = chosen.attributes
        for name, plain in (("scale_factor", 1.0), ("add_offset", 0.0)):
            value = number(known, name)
            require(f"{name} of {chosen.name}", value, value in (None, plain), "counts as they are")
        n_axes = len(chosen.shape)
        require(f"axes of {chosen.name}", n_axes, n_axes == len(AXES), "row, col and bin")
        missing = {name: value for name in _MISSING if (value := number(known, name)) is not None}
        self.counts = CheckedCounts(chosen, missing)
        is_nameless = not any(chosen.axes) and request.axes is None
        axes = chosen.axes or (None,) * n_axes
        named = tuple(name or f"axis_{k}" for k, name in enumerate(axes))
        self.dims = guess_axes(chosen.shape) if is_nameless else named
        self.guessed = [f"axes ({', '.join(self.dims)})"] if is_nameless else []
        distinct = len({*self.dims}) == len(self.dims)
        require(f"axes of {chosen.name}", self.dims, distinct, "each name once")
        self.places = _places(self.dims, request, chosen.name)

    def labelled(self, data: Any) -> xr.DataArray:
        """Return counts (row, col, bin) with the coordinates and attributes of the file."""
        import xarray as xr  # noqa: PLC0415

        sizes = dict(zip(self.dims, data.shape, strict=True))
        along = [
            one
            for one in self._arrays
            if one.name.rpartition("/")[0] == self._group
            and len(one.shape) == 1
            and one.shape[0] == sizes.get(one.axes[0] or "", 0) <= _LONGEST
        ]
        require("coordinates", len(along), len(along) <= _MOST_COORDINATES, "fewer")
        coordinates = {
            one.name.rpartition("/")[2]: (one.axes, one.whole(), dict(one.attributes))
            for one in along
        }
        known = self._groups.get("", {}) | self._groups.get(self._group, {})
        known |= self._chosen.attributes
        found = xr.DataArray(
            data,
            coords=xr.Coordinates(coordinates, indexes={}),
            dims=self.dims,
            name=self._name,
            attrs={name: value for name, value in known.items() if name not in _ENCODING},
        )
        return oriented(found, self._request)

    def image(self, name: str) -> Floats | None:
        """Read an image (row, col) that accompanies counts of our own layout, if there is one."""
        prefix = self._chosen.name.removesuffix("counts")
        row, col = (self.dims[k] for k in self.places[:2])
        shape = self.counts.shape[self.places[0]], self.counts.shape[self.places[1]]
        for one in self._arrays if self._name == "counts" else ():
            if one.name == prefix + name and len(one.shape) == 2:
                turned = one.axes == (col, row)
                require_image(name, one.shape[::-1] if turned else one.shape, shape)
                values = one.whole().astype(float, copy=False)
                return values.T if turned else values
        return None


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like HDF5 (but not MATLAB) or like classic netCDF."""
    places = (0, *(2**k for k in range(9, 13)))
    is_hdf5 = any(start[k : k + 8] == HDF5_SIGNATURE for k in places)
    return start[:4] in CLASSIC_SIGNATURES or (is_hdf5 and not start.startswith(b"MATLAB"))


def read(path: Path, request: ReadOptions) -> Capture:
    """Read counts and, from a file of our own layout, the ground truth."""
    file = _File(path, request)
    cube = stored_counts(file.counts.read((slice(None),) * len(AXES)), file.counts.stored.name)
    counts = file.labelled(cube)
    require_sums(counts.shape)
    known = describe(counts, request, file.origin, file.guessed)
    name, axes = file.counts.stored.name, {"axes": " ".join(file.dims)} if file.guessed else {}
    is_own = name.rpartition("/")[2] == "counts"
    capture = capture_of(np.ascontiguousarray(counts.data), known)
    capture = with_guesses(capture, variable=name, **axes)
    return replace(
        with_own_truth(capture, file.image("truth_range_m")),
        reported_range_m=file.image("reported_range_m"),
        signal=file.image("signal"),
        background=number(counts.attrs, "background") if is_own else None,
        stated_flux=stated_flux(counts.attrs),
    )


def open_counts(path: Path, request: ReadOptions) -> xr.DataArray:
    """Open counts lazily; `describe` then has nothing left to guess.

    Parameters
    ----------
    path : Path
        An HDF5 or netCDF file, or a Zarr directory.
    request : ReadOptions

    Returns
    -------
    DataArray, shape (row, col, bin)
        A dask array in blocks of whole chunks, about `BLOCK_BYTES` each, all bins in one block. A
        number that is no count raises `CaptureError` when its block is read.
    """
    import dask.array as da  # noqa: PLC0415

    file = _File(path, request)
    lazy = da.from_array(
        file.counts,
        chunks=_blocks(file.counts, file.places[2]),
        name=False,  # a hash would have to read it all
        meta=np.empty((0, 0, 0), file.counts.dtype),
    )
    counts = file.labelled(lazy)
    return with_description(counts, describe(counts, request, file.origin, file.guessed))


def _blocks(counts: CheckedCounts, time_axis: int) -> tuple[int, ...]:
    """Return the shape of a block: whole chunks, all bins, about `BLOCK_BYTES`."""
    block = list(counts.stored.chunk)
    block[time_axis] = counts.shape[time_axis]
    for axis in reversed(range(len(block))):
        n_bytes = prod(block) * counts.dtype.itemsize
        block[axis] = min(counts.shape[axis], block[axis] * max(1, BLOCK_BYTES // n_bytes))
    what, remedy = f"a block of {counts.stored.name} with all its bins", "chunks of fewer pixels"
    require_fits(what, prod(block) * counts.dtype.itemsize, remedy)
    return tuple(block)


def oriented(counts: xr.DataArray, request: ReadOptions) -> xr.DataArray:
    """Return the array with its axes named and ordered (row, col, bin).

    The bins of a common-stop instrument (``stop_s``) are reversed.

    Raises
    ------
    ValueError
        If it does not have three axes, or their names are unknown and ``axes`` is not given.
    """
    import xarray as xr  # noqa: PLC0415

    dims = tuple(map(str, counts.dims))
    found = [counts.dims[k] for k in _places(dims, request, str(counts.name or "the array"))]
    # A coordinate keeps its own name where its axis gets another.
    new_names = dict(zip(found, AXES, strict=True))
    coordinates = {
        name: (
            [new_names.get(dim, dim) for dim in coordinate.dims],
            coordinate.data,
            _with_unit(str(name), coordinate.attrs),
        )
        for name, coordinate in counts.coords.items()
    }
    bare = counts.drop_vars(list(coordinates)).transpose(*found)
    named = bare.rename({old: new for old, new in new_names.items() if old != new})
    labelled = named.assign_coords(xr.Coordinates(coordinates, indexes={}))
    return labelled if request.stop_s is None else labelled.isel(bin=slice(None, None, -1))


def _places(dims: tuple[str, ...], request: ReadOptions, name: str) -> tuple[int, ...]:
    """Return the positions of row, col and bin among the axes of an array."""
    require(f"axes of {name}", dims, len(dims) == 3, "three: row, col and bin")
    order = request.order(AXES)
    if order is not None:
        return order
    known = {alias: axis for axis, aliases in NAMES.items() for alias in aliases}
    named = {known.get(dim.lower()): k for k, dim in enumerate(dims)}
    accepted = "names row, col and bin, or axes, such as 'row col bin', in the order of the file"
    require(f"axes of {name}", dims, named.keys() == set(AXES), accepted)
    return tuple(named[axis] for axis in AXES)


def _with_unit(name: str, known: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return the attributes of a coordinate; its name gives the unit if they have none."""
    unit = _unit_of(name)
    return ({"units": unit} if unit in UNITS_S else {}) | dict(known)


def _unit_of(name: str) -> str:
    return name.rpartition("_")[2]


def describe(
    counts: xr.DataArray, request: ReadOptions, origin: str = "", guessed: Sequence[str] = ()
) -> Description:
    """Describe counts by the request, the attributes and the coordinates; guess the rest.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `oriented` returns them; a sample is read where pulse or detection must be guessed.
    request : ReadOptions
        Takes precedence over the attributes of the array.
    origin : str
        Origin of the capture if its attributes name none.
    guessed : sequence of str
        Guesses made before.

    Raises
    ------
    ValueError
        If an attribute or a coordinate is invalid.
    """
    request.refuse(["time_unit_s", "first_detections"], "labelled counts have bins")
    request.refuse(["shape", "no_trigger"], "labelled counts have axes")
    request.refuse(["records"], "labelled counts are no sequence")
    request.refuse(IN_ORDER, "labelled counts keep no order of the pulses")
    n_bins, stop_s = counts.sizes["bin"], request.stop_s
    require("n_bins", request.n_bins, request.n_bins in (None, n_bins), f"{n_bins} or None")
    known = completed(request, counts.attrs)
    times, left_out = _times(counts)
    if times is not None:
        require("stop_s", stop_s, stop_s is None, f"None: {times.name} gives the times of the bins")
        if "bin_width_s" not in counts.attrs and n_bins > 1:
            guessed = [*guessed, f"{times.name} is when a bin opens"]
        width_s, opens_s = _timing(times)
        if known.bin_width_s is None:
            known = replace(known, bin_width_s=width_s)
        if known.gate_delay_s is None:
            known = replace(known, gate_delay_s=opens_s)
    plausible_s, unitless = without_unit(known, counts.attrs)
    guessed_s = plausible_s or 1e-9
    if stop_s is not None and request.gate_delay_s is None:
        what = f"None: bins open {known.gate_delay_s} s after a pulse"
        require("stop_s", stop_s, known.gate_delay_s is None, what)
        known = replace(known, gate_delay_s=stop_s - n_bins * (known.bin_width_s or guessed_s))
    found = description_of(
        replace(known, n_bins=n_bins),
        n_bins,
        lambda: sample_of(counts.data),  # in memory or not: both lead to the same guess
        str(counts.attrs.get("source", origin)),
        guessed=[*guessed, *left_out, *unitless],
        bin_width_s=guessed_s,
    )
    if request.pulse is None and known.pulse is not None:
        require_pulse_in_gate(known.pulse, found.acquisition)
    return found


def _times(counts: xr.DataArray) -> tuple[xr.DataArray | None, list[str]]:
    """Return the first time or range coordinate along the bins, else those ignored."""
    coordinate: xr.DataArray
    left_out = []
    for name, coordinate in counts.coords.items():
        if coordinate.dims != ("bin",) or coordinate.dtype.kind not in "iuf":
            continue
        unit = str(coordinate.attrs.get("units", _unit_of(str(name))))
        if unit in UNITS_S:
            return coordinate, []
        described = f"of unit {unit!r}" if "units" in coordinate.attrs else "without a unit"
        left_out.append(f"{name}, {described}, left out")
    return None, left_out


def _timing(times: xr.DataArray) -> tuple[float | None, float]:
    """Return bin width (None for one bin) and gate delay, from times or ranges of the bins."""
    unit_s = UNITS_S[str(times.attrs.get("units", _unit_of(str(times.name))))]
    opens_s: Floats = np.asarray(times, float) * unit_s
    if opens_s.size < 2:
        return None, float(opens_s[0])
    width_s = float(opens_s[-1] - opens_s[0]) / (opens_s.size - 1)
    uneven = float(np.abs(np.diff(opens_s) - width_s).max())
    even = width_s > 0 and uneven <= 1e-3 * width_s
    what = f"steps of {times.name}"
    require(what, f"up to {uneven:g} s uneven", even, "bins of one width, rising")
    return width_s, float(opens_s[0])
