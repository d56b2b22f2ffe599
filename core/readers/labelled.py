"""Labelled arrays (xarray): what netCDF, Zarr and HDF5 files hold, larger than memory as well.

Counts are an array with the axes ``row``, ``col`` and ``bin``. Along ``bin`` lie the coordinates
``time_s`` (when a bin opens, after the pulse) and ``range_m``; what else is known of the capture
stands in the attributes of the counts, under the names and with the meaning of `core.readers.npz`.

Arrays of others open too. Their axes are known by the names below, or by ``axes``; bins by any
coordinate along them whose ``units`` are a time's or metres, or whose name ends in such a unit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.constants import speed_of_light

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture, Detection
from core.checks import require
from core.readers.dense import AXES
from core.readers.request import Request
from core.readers.wording import guesses, sentence

if TYPE_CHECKING:
    import xarray as xr

NAMES = {
    "row": ("row", "rows", "y", "line", "lines"),
    "col": ("col", "cols", "column", "columns", "x", "pixel"),
    "bin": ("bin", "bins", "time", "time_s", "t", "tof", "delay", "range", "range_m", "h"),
}
"""Names by which each axis is known, in small letters."""

UNITS_S = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "ps": 1e-12}
UNITS_S["m"] = UNITS_S["metre"] = UNITS_S["meter"] = 2 / speed_of_light
"""Seconds of the light's way there and back, for each unit of a coordinate along the bins."""


class Description(NamedTuple):
    """What is known of an array of counts without looking at them."""

    acquisition: Acquisition
    pulse: Pulse
    detection: Detection
    source: str


def dataset(capture: Capture) -> xr.Dataset:
    """A capture as an array ``counts``, with ``truth_range_m`` and ``signal`` where known."""
    import xarray as xr  # noqa: PLC0415 - half a second that reading a .npz should not pay

    acquisition, pulse = capture.acquisition, capture.pulse
    opens = np.arange(acquisition.n_bins)
    time_s = acquisition.gate_delay_s + opens * acquisition.bin_width_s
    known: dict[str, Any] = {
        "long_name": "detections",
        "bin_width_s": acquisition.bin_width_s,
        "gate_delay_s": acquisition.gate_delay_s,
        "n_pulses": acquisition.n_pulses,
        "pixel_angle_rad": acquisition.pixel_angle_rad,
        "pulse_shape": pulse.shape,
        "pulse_tau_s": pulse.tau_s,
        "pulse_samples": list(pulse.samples) or None,
        "background": capture.background,
        "detection": capture.detection,
        "source": capture.source or None,
    }
    counts = xr.DataArray(
        capture.cube,
        dims=AXES,
        coords={
            "time_s": ("bin", time_s, {"units": "s", "long_name": "time after the pulse"}),
            "range_m": ("bin", acquisition.bin_to_range_m(opens), {"units": "m"}),
        },
        attrs={name: value for name, value in known.items() if value is not None},
    )
    images = {
        name: (AXES[:2], image, {"units": unit})
        for name, image, unit in (
            ("truth_range_m", capture.truth_range_m, "m"),
            ("signal", capture.signal, "1"),
        )
        if image is not None
    }
    return xr.Dataset({"counts": counts, **images})


def oriented(counts: xr.DataArray, request: Request) -> xr.DataArray:
    """The array with its axes named and ordered (row, col, bin).

    Raises
    ------
    ValueError
        If it has not three axes, or they are named otherwise and ``axes`` is not told.
    """
    name = counts.name or "the array"
    require(f"axes of {name}", counts.dims, counts.ndim == 3, "three: row, col and bin")
    order = request.order(AXES)
    if order is not None:
        found = [counts.dims[place] for place in order]
    else:
        known = {alias: axis for axis, aliases in NAMES.items() for alias in aliases}
        named = {known.get(str(dim).lower()): dim for dim in counts.dims}
        told = "names row, col and bin, or as axes their order in the file"
        require(f"axes of {name}", counts.dims, named.keys() == set(AXES), told)
        found = [named[axis] for axis in AXES]
    # Coordinates of an axis go by its old name; as variables of their own they keep it.
    renamed = counts.transpose(*found).reset_index([d for d in found if d in counts.indexes])
    return renamed.rename({old: new for old, new in zip(found, AXES, strict=True) if old != new})


def describe(counts: xr.DataArray, request: Request, origin: str = "") -> Description:
    """What the request, the attributes and the coordinates tell of counts; the rest is guessed.

    Parameters
    ----------
    counts : DataArray, shape (row, col, bin)
        As `oriented` gives them; none is looked at.
    request : Request
        Goes before what the array says.
    origin : str
        What to call the capture, where it does not say itself.

    Raises
    ------
    ValueError
        If an attribute or a coordinate is no such thing.
    """
    known = counts.attrs
    request.refuse(["time_unit_s", "first_detections"], "labelled counts know their bins")
    request.refuse(["shape", "no_trigger", "stop_s"], "labelled counts know their axes")
    n_bins = counts.sizes["bin"]
    require("n_bins", request.n_bins, request.n_bins in (None, n_bins), f"{n_bins} or None")
    timing = _timing(counts)
    told: dict[str, Any] = {
        name: _number(known, name) if getattr(request, name) is None else getattr(request, name)
        for name in ("bin_width_s", "gate_delay_s", "n_pulses", "pixel_angle_rad")
    }
    told["bin_width_s"] = told["bin_width_s"] or timing.get("bin_width_s")
    if told["gate_delay_s"] is None:
        told["gate_delay_s"] = timing.get("gate_delay_s")
    if told["n_pulses"] is not None:
        whole = float(told["n_pulses"]).is_integer() and told["n_pulses"] >= 0
        require("n_pulses", told["n_pulses"], whole, "a whole number, 0 if not known")
        told["n_pulses"] = int(told["n_pulses"]) or None
    pulse = request.pulse or _pulse(known)
    detection = request.detection or known.get("detection")
    complete = Request(**told, n_bins=n_bins, pulse=pulse, detection=detection)
    acquisition = Acquisition(
        n_bins=n_bins,
        bin_width_s=1e-9 if complete.bin_width_s is None else complete.bin_width_s,
        gate_delay_s=complete.gate_delay_s or 0.0,
        n_pulses=complete.n_pulses,
        pixel_angle_rad=complete.pixel_angle_rad,
    )
    if pulse is None:
        pulse = Pulse.gaussian(acquisition.bin_width_s)
    if detection is None:
        detection = "all" if acquisition.n_pulses is None else "first"
    guessed = guesses(complete, acquisition, pulse, detection)
    return Description(
        acquisition, pulse, detection, sentence(str(known.get("source", origin)), guessed)
    )


def _timing(counts: xr.DataArray) -> dict[str, float]:
    """Bin width and gate delay, from the first coordinate along the bins that tells of time."""
    for name, coordinate in counts.coords.items():
        unit_s = UNITS_S.get(str(coordinate.attrs.get("units", str(name).rpartition("_")[2])))
        if coordinate.dims != ("bin",) or unit_s is None or coordinate.dtype.kind not in "iuf":
            continue
        opens_s: Floats = np.asarray(coordinate, float) * unit_s
        if opens_s.size < 2:
            return {"gate_delay_s": float(opens_s[0])}
        width_s = float(opens_s[-1] - opens_s[0]) / (opens_s.size - 1)
        uneven = float(np.abs(np.diff(opens_s) - width_s).max())
        even = width_s > 0 and uneven <= 1e-3 * width_s
        require(f"steps of {name}", f"up to {uneven:g} s uneven", even, "bins of one width, rising")
        return {"bin_width_s": width_s, "gate_delay_s": float(opens_s[0])}
    return {}


def _pulse(known: dict[Any, Any]) -> Pulse | None:
    if "pulse_tau_s" not in known:
        return None
    samples = np.atleast_1d(np.asarray(known.get("pulse_samples", ())))
    require("pulse_samples", f"{samples.dtype}", samples.dtype.kind in "biuf", "real numbers")
    tau_s = _number(known, "pulse_tau_s")
    shape: Any = str(known.get("pulse_shape", "gamma"))
    return Pulse(tau_s, shape=shape, samples=tuple(samples.astype(float).tolist()))  # type: ignore[arg-type]


def _number(known: dict[Any, Any], name: str) -> float | None:
    if name not in known:
        return None
    value = np.asarray(known[name])
    real = value.size == 1 and value.dtype.kind in "iuf"
    require(name, known[name], real, "one number")
    return float(value.item())
