"""Labelled arrays (xarray): what netCDF, Zarr and HDF5 files hold, larger than memory as well.

Counts are an array with the axes ``row``, ``col`` and ``bin``. Along ``bin`` lie the coordinates
``time_s`` (when a bin opens, after the pulse) and ``range_m``; what else is known of the capture
stands in the attributes of the counts, under the names and with the meaning of
`core.io.readers.npz`.

Arrays of others open too. Their axes are known by the names below, or by ``axes``; bins by any
coordinate along them whose ``units`` are a time's or metres, or whose name ends in such a unit.
Where a file names no axes, as plain HDF5 does not, they are guessed to be (row, col, bin).

Unsigned counts of 8, 16 or 32 bits keep their type. Others are checked when they are read, and are
uint16 or uint32 in a capture, uint32 in an array that is opened but not read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import SPEED_OF_LIGHT_M_S, Acquisition, Floats, Pulse
from core.capture import COUNT_TYPES, Capture, CaptureError, Detection
from core.checks import require
from core.io.readers import hdf5, zarr
from core.io.readers.dense import (
    AXES,
    PULSE,
    guess_detection,
    require_image,
    require_pulse_in_gate,
    require_sums,
    stored_counts,
    stored_pulse,
    whole_counts,
)
from core.io.readers.guards import require_fits
from core.io.readers.options import ReadOptions
from core.io.readers.pulse_guess import guessed_pulse
from core.io.readers.sample import sample_of
from core.io.readers.stored import Numbers, Stored, choose, whole
from core.io.readers.times import UNITS_S as TIME_UNITS_S
from core.io.readers.wording import guesses, sentence

if TYPE_CHECKING:
    import xarray as xr

NAMES = {
    "row": ("row", "rows", "y", "line", "lines"),
    "col": ("col", "cols", "column", "columns", "x", "pixel"),
    "bin": ("bin", "bins", "time", "time_s", "t", "tof", "delay", "range", "range_m", "h"),
}
"""Names by which each axis is known, in small letters."""

_SECONDS = {"": "s", "milli": "ms", "micro": "us", "nano": "ns", "pico": "ps"}
UNITS_S = TIME_UNITS_S | {
    f"{name}second{s}": TIME_UNITS_S[unit] for s in ("", "s") for name, unit in _SECONDS.items()
}
UNITS_S |= dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 2 / SPEED_OF_LIGHT_M_S)
UNITS_S["km"] = 1e3 * UNITS_S["m"]
"""Seconds of the light's way there and back, for each unit of a coordinate along the bins."""


BLOCK_BYTES = 2**24
"""Approximate size of a block of an array that is opened lazily."""

_LONGEST = 2**20  # coordinate that is read
_MOST_COORDINATES = 100
_MISSING = ("_FillValue", "missing_value")
_OF_ENCODING = (
    *_MISSING,
    *("scale_factor", "add_offset", "coordinates", "_ARRAY_DIMENSIONS", "_NCProperties"),
)


class Description(NamedTuple):
    """Metadata of an array of counts, without the counts themselves."""

    acquisition: Acquisition
    pulse: Pulse
    detection: Detection
    source: str


@dataclass(frozen=True)
class Counts:
    """An array of a file as counts, checked as they are read.

    Parameters
    ----------
    numbers : Numbers
        With three axes.
    name, file : str
        What to call the array and the file in a refusal.
    missing : dict
        Values that mark missing numbers, by the name of the attribute that defines them.
    """

    numbers: Numbers
    name: str
    file: str
    missing: Mapping[str, float] = field(default_factory=dict)
    ndim = len(AXES)

    @property
    def shape(self) -> tuple[int, ...]:
        """Size along each axis, in the order of the file."""
        return self.numbers.shape

    @property
    def dtype(self) -> np.dtype[np.unsignedinteger]:
        """The file's own where it is one for counts, uint32 elsewhere."""
        stored = self.numbers.dtype.newbyteorder("=")
        return stored if stored in COUNT_TYPES else np.dtype(np.uint32)

    def __getitem__(self, key: tuple[int | slice, ...]) -> NDArray[np.unsignedinteger]:
        """The counts at whole numbers and slices; raises `CaptureError` where one is none."""
        boxes, within = zip(*map(_box, key, self.shape), strict=True)
        try:
            found = self.read(boxes)
            if found.dtype != self.dtype and found.size:
                found = whole_counts(found, self.name, self.dtype)
        except ValueError as error:
            raise CaptureError(f"{self.file}: {error}") from error
        return found.astype(self.dtype, copy=False)[within]

    def read(self, box: tuple[slice, ...]) -> NDArray[Any]:
        """The numbers in a box of slices, none of them missing."""
        found = self.numbers[box]
        for attribute, value in self.missing.items():
            gaps = bool((found == value).any())
            require(f"{attribute} of {self.name}", value, not gaps, "counts without gaps")
        return found


def _box(key: int | slice, size: int) -> tuple[slice, int | slice]:
    """Convert an index along an axis to a slice of positive step and an index within it."""
    if not isinstance(key, slice):
        place = range(size)[key]
        return slice(place, place + 1), 0
    picked = range(*key.indices(size))
    if not picked:
        return slice(0, 0), slice(None)
    if picked.step < 0:
        picked, within = picked[::-1], slice(None, None, -1)
    else:
        within = slice(None)
    return slice(picked[0], picked[-1] + 1, picked.step), within


class _File:
    """The arrays of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.arrays, self.groups = (zarr if path.is_dir() else hdf5).arrays(path)

    def origin(self, chosen: Stored) -> str:
        """Describe the origin of a capture for its source."""
        return f"{self.path.name}, variable {chosen.name}"

    def counts(self, chosen: Stored) -> Counts:
        """An array as counts."""
        known = chosen.attributes
        for name, plain in (("scale_factor", 1.0), ("add_offset", 0.0)):
            value = _number(known, name)
            require(f"{name} of {chosen.name}", value, value in (None, plain), "counts as they are")
        require(f"axes of {chosen.name}", chosen.n_axes, chosen.n_axes == 3, "row, col and bin")
        assert chosen.numbers is not None
        told = {name: _number(known, name) for name in _MISSING}
        missing = {name: value for name, value in told.items() if value is not None}
        return Counts(chosen.numbers, chosen.name, self.path.name, missing)

    def labelled(self, chosen: Stored, data: Any, request: ReadOptions) -> xr.DataArray:
        """Counts with the names, coordinates and attributes that the file gives them."""
        import xarray as xr  # noqa: PLC0415

        group, _, name = chosen.name.rpartition("/")
        dims = _named_axes(chosen, request)
        require(f"axes of {name}", dims, len({*dims}) == len(dims), "each name once")
        along = [
            one
            for one in self.arrays
            if one.name.rpartition("/")[0] == group
            and one.numbers is not None
            and one.n_axes == 1
            and one.axes[0] in dims
            and one.numbers.shape[0] == data.shape[dims.index(one.axes[0])] <= _LONGEST
        ]
        require("coordinates", len(along), len(along) <= _MOST_COORDINATES, "fewer")
        beside = {
            one.name.rpartition("/")[2]: (one.axes, whole(one.numbers), dict(one.attributes))
            for one in along
            if one.numbers is not None
        }
        inherited = dict(self.groups.get("", {})) | self.groups.get(group, {})
        known = {
            key: value
            for key, value in (inherited | dict(chosen.attributes)).items()
            if key not in _OF_ENCODING
        }
        coords = xr.Coordinates(beside, indexes={})
        return xr.DataArray(data, coords=coords, dims=dims, name=name, attrs=known)

    def image(self, chosen: Stored, name: str, request: ReadOptions) -> Floats | None:
        """Read an image (row, col) that accompanies the counts; None if the file has none."""
        prefix = chosen.name.removesuffix("counts")
        dims = _named_axes(chosen, request)
        places = _places(dims, request, chosen.name)
        row, col = (dims[k] for k in places[:2])
        assert chosen.numbers is not None
        shape = tuple(chosen.numbers.shape[k] for k in places[:2])
        for one in self.arrays:
            if one.name == prefix + name and one.n_axes == 2 and one.numbers is not None:
                turned = one.axes == (col, row)
                found = one.numbers.shape[::-1] if turned else one.numbers.shape
                require_image(name, found, shape)
                values = whole(one.numbers).astype(float, copy=False)
                return values.T if turned else values
        return None


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like HDF5 (but not MATLAB) or like classic netCDF."""
    places = (0, *(2**k for k in range(9, 13)))
    is_hdf5 = any(start[k : k + 8] == hdf5.SIGNATURE for k in places)
    return start[:4] in hdf5.CLASSIC_SIGNATURES or (is_hdf5 and not start.startswith(b"MATLAB"))


def read(path: Path, request: ReadOptions) -> Capture:
    """Read counts and, from a file of our own layout, the ground truth."""
    file = _File(path)
    chosen = choose(file.arrays, request)
    every = (slice(None),) * len(AXES)
    cube = stored_counts(file.counts(chosen).read(every), chosen.name)
    counts = oriented(file.labelled(chosen, cube, request), request)
    require_sums(counts.shape)
    known = describe(counts, request, file.origin(chosen), _guessed(chosen, request))
    ours = chosen.name.rpartition("/")[2] == "counts"
    return Capture(
        np.ascontiguousarray(counts.data),
        known.acquisition,
        known.pulse,
        truth_range_m=file.image(chosen, "truth_range_m", request) if ours else None,
        signal=file.image(chosen, "signal", request) if ours else None,
        background=_number(counts.attrs, "background") if ours else None,
        source=known.source,
        detection=known.detection,
    )


def open_counts(path: Path, request: ReadOptions) -> xr.DataArray:
    """Open counts lazily; `describe` then has nothing left to guess.

    Parameters
    ----------
    path : Path
        Of an HDF5 or netCDF file, or a Zarr directory.
    request : ReadOptions

    Returns
    -------
    DataArray, shape (row, col, bin)
        A dask array in blocks of whole chunks, some `BLOCK_BYTES` large, all bins in one block. A
        number that is no count raises `CaptureError` when its block is read.
    """
    import dask.array as da  # noqa: PLC0415

    file = _File(path)
    chosen = choose(file.arrays, request)
    numbers = file.counts(chosen)
    time_axis = _places(_named_axes(chosen, request), request, chosen.name)[2]
    lazy = da.from_array(
        numbers,
        chunks=_blocks(numbers, time_axis),
        name=False,  # a hash would have to read it all
        meta=np.empty((0, 0, 0), numbers.dtype),
    )
    counts = oriented(file.labelled(chosen, lazy, request), request)
    known = describe(counts, request, file.origin(chosen), _guessed(chosen, request))
    return completed(counts, known)


def _named_axes(chosen: Stored, request: ReadOptions) -> tuple[str, ...]:
    """Return the names of an array's axes, guessed if the file gives none."""
    if _guessed(chosen, request):
        return AXES
    return tuple(name or f"axis_{k}" for k, name in enumerate(chosen.axes))


def _guessed(chosen: Stored, request: ReadOptions) -> list[str]:
    """Return the guess of the axes if neither the file nor the request names any."""
    nameless = chosen.n_axes == len(AXES) and not any(chosen.axes) and request.axes is None
    return [f"axes ({', '.join(AXES)})"] if nameless else []


def _blocks(counts: Counts, time_axis: int) -> tuple[int, ...]:
    """Return the shape of a block: whole chunks, all bins, about `BLOCK_BYTES`."""
    block = list(counts.numbers.chunk)
    block[time_axis] = counts.shape[time_axis]
    for axis in reversed(range(len(block))):
        n_bytes = prod(block) * counts.dtype.itemsize
        block[axis] = min(counts.shape[axis], block[axis] * max(1, BLOCK_BYTES // n_bytes))
    what, remedy = f"a block of {counts.name} with all its bins", "chunks of fewer pixels"
    require_fits(what, prod(block) * counts.dtype.itemsize, remedy)
    return tuple(block)


def dataset(capture: Capture) -> xr.Dataset:
    """A capture as an array ``counts``, with ``truth_range_m`` and ``signal`` where known."""
    import xarray as xr  # noqa: PLC0415 - half a second that reading a .npz should not pay

    counts = xr.DataArray(capture.cube, dims=AXES, attrs={"long_name": "detections"})
    if capture.background is not None:
        counts.attrs["background"] = capture.background
    images = {
        name: (AXES[:2], image, {"units": unit})
        for name, image, unit in (
            ("truth_range_m", capture.truth_range_m, "m"),
            ("signal", capture.signal, "1"),
        )
        if image is not None
    }
    known = Description(capture.acquisition, capture.pulse, capture.detection, capture.source)
    return xr.Dataset({"counts": completed(counts, known), **images})


def completed(counts: xr.DataArray, known: Description) -> xr.DataArray:
    """Return counts (row, col, bin) with a description as attributes and coordinates."""
    acquisition, pulse = known.acquisition, known.pulse
    opens = np.arange(acquisition.n_bins)
    time_s = acquisition.gate_delay_s + opens * acquisition.bin_width_s
    told: dict[str, Any] = {
        "bin_width_s": acquisition.bin_width_s,
        "gate_delay_s": acquisition.gate_delay_s,
        "n_pulses": acquisition.n_pulses,
        "pixel_angle_rad": acquisition.pixel_angle_rad,
        "pulse_shape": pulse.shape,
        "pulse_tau_s": pulse.tau_s,
        "pulse_samples": list(pulse.samples) or None,
        "detection": known.detection,
        "source": known.source or None,
    }
    others = {name: value for name, value in counts.attrs.items() if name not in told}
    coordinates = {
        "time_s": ("bin", time_s, {"units": "s", "long_name": "time after the pulse"}),
        "range_m": ("bin", acquisition.bin_to_range_m(opens), {"units": "m"}),
    }
    labelled = counts.drop_vars([name for name in coordinates if name in counts.coords])
    labelled = labelled.assign_coords(coordinates)
    labelled.attrs = others | {name: value for name, value in told.items() if value is not None}
    return labelled


def oriented(counts: xr.DataArray, request: ReadOptions) -> xr.DataArray:
    """The array with its axes named and ordered (row, col, bin).

    The bins of a common-stop instrument (``stop_s``) are reversed.

    Raises
    ------
    ValueError
        If it does not have three axes, or their names are unknown and ``axes`` is not given.
    """
    import xarray as xr  # noqa: PLC0415

    dims = tuple(map(str, counts.dims))
    found = [counts.dims[k] for k in _places(dims, request, str(counts.name or "the array"))]
    # What lies along an axis keeps its own name where the axis gets another.
    along = dict(zip(found, AXES, strict=True))
    beside = {
        name: (
            [along.get(dim, dim) for dim in coordinate.dims],
            coordinate.data,
            _with_unit(str(name), coordinate.attrs),
        )
        for name, coordinate in counts.coords.items()
    }
    bare = counts.drop_vars(list(beside)).transpose(*found)
    named = bare.rename({old: new for old, new in along.items() if old != new})
    labelled = named.assign_coords(xr.Coordinates(beside, indexes={}))
    return labelled if request.stop_s is None else labelled.isel(bin=slice(None, None, -1))


def _places(dims: tuple[str, ...], request: ReadOptions, name: str) -> tuple[int, ...]:
    """Return the positions of row, col and bin among the axes of an array."""
    require(f"axes of {name}", dims, len(dims) == 3, "three: row, col and bin")
    order = request.order(AXES)
    if order is not None:
        return order
    known = {alias: axis for axis, aliases in NAMES.items() for alias in aliases}
    named = {known.get(dim.lower()): k for k, dim in enumerate(dims)}
    told = "names row, col and bin, or axes, such as 'row col bin', in the order of the file"
    require(f"axes of {name}", dims, named.keys() == set(AXES), told)
    return tuple(named[axis] for axis in AXES)


def _with_unit(name: str, known: Mapping[Any, Any]) -> dict[Any, Any]:
    """The attributes of a coordinate, with the unit that its name ends in where they have none."""
    unit = _unit_of(name)
    return ({"units": unit} if unit in UNITS_S else {}) | dict(known)


def describe(
    counts: xr.DataArray, request: ReadOptions, origin: str = "", also_guessed: Sequence[str] = ()
) -> Description:
    """Describe counts by the request, the attributes and the coordinates; guess the rest.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `oriented` gives them; a sample is looked at where pulse or detection must be guessed.
    request : ReadOptions
        Takes precedence over the attributes of the array.
    origin : str
        Origin of the capture if its attributes name none.
    also_guessed : sequence of str
        Guesses made before.

    Raises
    ------
    ValueError
        If an attribute or a coordinate is invalid.
    """
    known = counts.attrs
    request.refuse(["time_unit_s", "first_detections"], "labelled counts know their bins")
    request.refuse(["shape", "no_trigger"], "labelled counts know their axes")
    n_bins = counts.sizes["bin"]
    require("n_bins", request.n_bins, request.n_bins in (None, n_bins), f"{n_bins} or None")
    times, left_out = _times(counts)
    if times is not None and "bin_width_s" not in known and counts.sizes["bin"] > 1:
        also_guessed = [*also_guessed, f"{times.name} is when a bin opens"]
    also_guessed = [*also_guessed, *left_out]
    known_times = str(times.name) if times is not None else None
    require(
        "stop_s",
        request.stop_s,
        None in (request.stop_s, known_times),
        f"None: {known_times} tells",
    )
    timing = {} if times is None else _timing(times)
    told: dict[str, Any] = {
        name: _number(known, name) if getattr(request, name) is None else getattr(request, name)
        for name in ("bin_width_s", "gate_delay_s", "n_pulses", "pixel_angle_rad")
    }
    told |= {name: value for name, value in timing.items() if told[name] is None}
    if request.stop_s is not None and request.gate_delay_s is None:
        opens = told["gate_delay_s"]
        require("stop_s", request.stop_s, opens is None, f"None: bins open {opens} s after a pulse")
        told["gate_delay_s"] = request.stop_s - n_bins * (told["bin_width_s"] or 1e-9)
    if told["n_pulses"] is not None:
        whole = float(told["n_pulses"]).is_integer() and told["n_pulses"] >= 0
        require("n_pulses", told["n_pulses"], whole, "a whole number, 0 if not known")
        told["n_pulses"] = int(told["n_pulses"]) or None
    pulse = request.pulse or _pulse(known)
    detection = request.detection or known.get("detection")
    complete = ReadOptions(**told, n_bins=n_bins, pulse=pulse, detection=detection)
    acquisition = Acquisition(
        n_bins=n_bins,
        bin_width_s=1e-9 if complete.bin_width_s is None else complete.bin_width_s,
        gate_delay_s=complete.gate_delay_s or 0.0,
        n_pulses=complete.n_pulses,
        pixel_angle_rad=complete.pixel_angle_rad,
    )
    if pulse is not None and request.pulse is None:
        require_pulse_in_gate(pulse, acquisition)
    if pulse is None or detection is None:
        sample = sample_of(counts.data)  # in memory or not: both ways in make the same guess
        pulse = pulse or guessed_pulse(sample, acquisition.bin_width_s)
        detection = detection or guess_detection(sample, acquisition.n_pulses)
    guessed = [*also_guessed, *guesses(complete, acquisition, pulse, detection)]
    return Description(
        acquisition, pulse, detection, sentence(str(known.get("source", origin)), guessed)
    )


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
        told = f"of unit {unit!r}" if "units" in coordinate.attrs else "without a unit"
        left_out.append(f"{name}, {told}, left out")
    return None, left_out


def _timing(times: xr.DataArray) -> dict[str, float]:
    """Bin width and gate delay, from the times or ranges at which bins open."""
    unit_s = UNITS_S[str(times.attrs.get("units", _unit_of(str(times.name))))]
    opens_s: Floats = np.asarray(times, float) * unit_s
    if opens_s.size < 2:
        return {"gate_delay_s": float(opens_s[0])}
    width_s = float(opens_s[-1] - opens_s[0]) / (opens_s.size - 1)
    uneven = float(np.abs(np.diff(opens_s) - width_s).max())
    even = width_s > 0 and uneven <= 1e-3 * width_s
    what = f"steps of {times.name}"
    require(what, f"up to {uneven:g} s uneven", even, "bins of one width, rising")
    return {"bin_width_s": width_s, "gate_delay_s": float(opens_s[0])}


def _unit_of(name: str) -> str:
    return name.rpartition("_")[2]


def _pulse(known: dict[Any, Any]) -> Pulse | None:
    if not any(name in known for name in PULSE):
        return None
    told = known.get("pulse_samples", ())
    samples = np.asarray(told)
    require("pulse_samples", told, samples.dtype.kind in "biuf", "real numbers")
    return stored_pulse(
        _number(known, "pulse_tau_s"), str(known.get("pulse_shape", "gamma")), samples
    )


def _number(known: Mapping[Any, Any], name: str) -> float | None:
    if name not in known:
        return None
    value = np.asarray(known[name])
    real = value.size == 1 and value.dtype.kind in "iuf"
    require(name, known[name], real, "one number")
    return float(value.item())
