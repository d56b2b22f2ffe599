"""Captures and range images as labelled arrays (xarray), in memory and in files alike.

The names, units and attributes are those that `core.io.readers.labelled` reads.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Pulse
from core.version import __version__

if TYPE_CHECKING:
    import xarray as xr

    from core.capture import Capture

AXES = ("row", "col", "bin")

_FLAGS: dict[str, Any] = {
    "flag_values": np.array([0, 1], np.int8),
    "flag_meanings": "no_estimate estimate",
}


class Described(Protocol):
    """Metadata of counts, such as a `core.Capture`."""

    @property
    def acquisition(self) -> Acquisition:
        """Settings of the recording."""

    @property
    def pulse(self) -> Pulse:
        """Shape of an echo."""

    @property
    def detection(self) -> str:
        """First photons or all."""

    @property
    def source(self) -> str:
        """Origin of the counts."""


class Plane(NamedTuple):
    """One image, shape (row, col), its unit (by UDUNITS) and its meaning."""

    values: NDArray[Any]
    unit: str
    meaning: str


def software() -> str:
    """Return name and version of this project, as files state them."""
    return f"firstphoton {__version__}"


def fields_of(known: Described) -> dict[str, Any]:
    """Return the fields that a file keeps; what is unknown is left out."""
    acquisition, pulse = known.acquisition, known.pulse
    fields = {
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
    return {name: value for name, value in fields.items() if value is not None}


def stated_fields(capture: Capture) -> dict[str, float]:
    """Return the fields that a file keeps of the fluxes that it states."""
    stated = {} if capture.stated_flux is None else vars(capture.stated_flux)
    return {f"stated_{name}": value for name, value in stated.items() if value is not None}


def dataset(capture: Capture) -> xr.Dataset:
    """Return a capture as `core.Capture.to_xarray` describes."""
    import xarray as xr  # noqa: PLC0415 - half a second that reading a .npz should not pay

    counts = xr.DataArray(capture.cube, dims=AXES, attrs={"long_name": "detections"})
    if capture.background is not None:
        counts.attrs["background"] = capture.background
    counts.attrs |= stated_fields(capture)
    images = {
        name: (AXES[:2], image, {"units": unit})
        for name, image, unit in (
            ("truth_range_m", capture.truth_range_m, "m"),
            ("reported_range_m", capture.reported_range_m, "m"),
            ("signal", capture.signal, "1"),
        )
        if image is not None
    }
    return xr.Dataset({"counts": with_description(counts, capture), **images})


def with_description(counts: xr.DataArray, known: Described) -> xr.DataArray:
    """Return counts (row, col, bin) with a description as attributes and coordinates."""
    acquisition = known.acquisition
    opens = np.arange(acquisition.n_bins)
    time_s = acquisition.gate_delay_s + opens * acquisition.bin_width_s
    coordinates = {
        "time_s": ("bin", time_s, {"units": "s", "long_name": "time after the pulse"}),
        "range_m": ("bin", acquisition.bin_to_range_m(opens), {"units": "m"}),
    }
    labelled = counts.drop_vars([name for name in coordinates if name in counts.coords])
    labelled = labelled.assign_coords(coordinates)
    replaced = {"n_pulses", "pixel_angle_rad", "pulse_samples", "source"}
    others = {name: value for name, value in counts.attrs.items() if name not in replaced}
    labelled.attrs = others | fields_of(known)
    return labelled


def images_dataset(planes: Mapping[str, Plane], attributes: Mapping[str, Any]) -> xr.Dataset:
    """Return images (row, col) with their units, rows and columns; a flag as 1 or 0.

    Parameters
    ----------
    planes : mapping of str to Plane
    attributes : mapping
        Attributes of the whole dataset.
    """
    import xarray as xr  # noqa: PLC0415 - slow to import

    variables = {}
    for name, (values, unit, meaning) in planes.items():
        is_flag = values.dtype == bool  # which netCDF does not have
        known = {"units": unit, "long_name": meaning} | (_FLAGS if is_flag else {})
        variables[name] = (AXES[:2], values.astype(np.int8) if is_flag else values, known)
    shape = next(iter(planes.values())).values.shape
    places = {
        axis: (axis, np.arange(size), {"units": "1", "long_name": meaning})
        for axis, size, meaning in zip(
            AXES, shape, ("row of the pixel, 0 on top", "column of the pixel"), strict=False
        )
    }
    return xr.Dataset(variables, places, attributes)
