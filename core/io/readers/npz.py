"""The project's own layout: a NumPy ``.npz`` archive, compressed or not.

====================  ==============  ==========================================================
field                 shape           meaning
====================  ==============  ==========================================================
``format``            text            ``"firstphoton-capture-1"``; may be absent
``cube``              (row, col, bin) counts, unsigned; the only field that must be there
``bin_width_s``       scalar          width of a bin in seconds
``gate_delay_s``      scalar          time from the pulse to the first bin in seconds
``n_pulses``          scalar          pulses sent for each pixel; 0 or absent: unknown
``pixel_angle_rad``   scalar          angle between neighbouring pixels in radians; absent: unknown
``pulse_shape``       text            ``"gamma"``, ``"gaussian"`` or ``"measured"``
``pulse_tau_s``       scalar          time constant, standard deviation or sample spacing
``pulse_samples``     (sample,)       the measured pulse; empty or absent for the others
``truth_range_m``     (row, col)      true range in metres, NaN without a target; may be absent
``reported_range_m``  (row, col)      range in metres that the instrument reported; may be absent
``signal``            (row, col)      true signal photons per pulse; may be absent
``background``        scalar          true background photons per pulse and gate; may be absent
``stated_sbr``, ...   scalars         fields of `core.capture.StatedFlux`; may be absent
``detection``         text            ``"first"`` or ``"all"``, see `core.capture.Detection`
``source``            text            where the capture came from; may be absent
``group_counts``      (group, ...)    cubes of successive groups of pulses, in order; may be absent
``group_pulses``      (group,)        pulses of each group
``pulse_rate_hz``     scalar          pulses per second, with groups; may be absent
====================  ==============  ==========================================================

Text is an array of one unicode string. Where timing or pulse are absent they are guessed: bins of
1 ns, a gate that opens with the pulse, and the pulse from the counts. An archive of other names
opens too if exactly one array has three axes, or if ``variable`` names one; the scalars of the
table are used there, too, but no pulse.

In place of a cube there may be raw ``frames`` (pulse, row, col) of trigger bins with a whole number
``no_trigger`` that marks no trigger, as in `core.io.readers.frames`; the other fields may
accompany them. Frames that are stored without compression may be larger than memory.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from math import prod
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, cube_capture, dense_capture, stored_counts, with_guesses
from core.io.readers.frames import Header, require_counts
from core.io.readers.guards import decoding, require_fits
from core.io.readers.layout import (
    PULSE,
    TIMING,
    completed,
    number,
    require_image,
    require_pulse_in_gate,
    stated_flux,
    stating,
    timing,
    without_unit,
)
from core.io.readers.maps import Map, with_own_truth
from core.io.readers.npy import frames_in, read_array, read_header
from core.io.readers.options import ReadOptions, choose_variable
from core.labels import fields_of, stated_fields
from core.pulse_groups import PulseGroups

FORMAT = "firstphoton-capture-1"

_FIELDS = (
    *TIMING,
    *PULSE,
    "format",
    "detection",
    "source",
    "no_trigger",
    "background",
    "pulse_rate_hz",
)
_MOST_BYTES = 2**16  # of a field that is one number or one text
_MOST_BYTES_OF_SAMPLES = 2**23 + 2**12


def fields(capture: Capture) -> dict[str, NDArray[Any]]:
    """Return the arrays that this layout keeps of a capture."""
    kept = {
        "format": FORMAT,
        "cube": capture.cube,
        **fields_of(capture),
        "truth_range_m": capture.truth_range_m,
        "reported_range_m": capture.reported_range_m,
        "signal": capture.signal,
        "background": capture.background,
        **stated_fields(capture),
    }
    if capture.groups is not None:
        kept |= {
            "group_counts": capture.groups.counts,
            "group_pulses": capture.groups.n_pulses,
            "pulse_rate_hz": capture.groups.pulse_rate_hz,
        }
    return {name: np.asarray(value) for name, value in kept.items() if value is not None}


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like a ZIP archive."""
    return start.startswith((b"PK\x03\x04", b"PK\x05\x06"))


def read(path: Path, request: ReadOptions) -> Capture:
    """Read our own layout, the one cube of an archive, or raw frames."""
    with _archive(path) as archive:
        names = _names(archive)
        name = _choose(archive, names, request)
        origin = f"{path.name}, variable {name}"
        numbers = [each for each in stating(names) if _is_number(archive, each)]
        stated = stated_flux({each: _field(archive, each) for each in numbers})
        is_frames = name == "frames" or (request.no_trigger is not None and name != "cube")
        numbers = [each for each in timing(names) if _is_number(archive, each)]
        if name != "cube" and not is_frames:
            counts = _array(archive, name)
            require_counts(counts, name, request.axes)
            known = {each: _field(archive, each) for each in numbers}
            complete = completed(request, known)
            width_s, left_out = without_unit(complete, known)
            capture = cube_capture(
                counts, name, origin, complete, guessed=left_out, bin_width_s=width_s
            )
            return with_guesses(replace(capture, stated_flux=stated), variable=name)
        kept = {*numbers, *_FIELDS}
        known = {field: _field(archive, field) for field in names if field in kept}
        version = known.get("format", FORMAT)
        require("format", version, str(version) == FORMAT, FORMAT)
        if "gate_delay_s" in known:
            request.refuse(["stop_s"], "the file has a gate_delay_s of its own")
        complete = completed(request, known)
        origin = str(known.get("source", origin))
        if is_frames:
            if complete.no_trigger is None:
                value = number(known, "no_trigger")
                whole = value is not None and value.is_integer()
                accepted = "a whole number, the value for no trigger; -1 if that is NaN"
                require("no_trigger", value, whole, accepted)
                complete = replace(complete, no_trigger=int(value or 0))
            size = archive.getinfo(f"{name}.npy").file_size
            with _opened(archive, name, may_be_large=True) as file:
                capture = frames_in(file, size, name, origin, complete)
        else:
            in_order = request.order(AXES) in (None, (0, 1, 2))
            require("axes", request.axes, in_order, repr(" ".join(AXES)))
            counts = stored_counts(_array(archive, name), name)
            width_s, left_out = without_unit(complete, known)
            capture = dense_capture(counts, origin, complete, guessed=left_out, bin_width_s=width_s)
        if request.pulse is None:
            require_pulse_in_gate(capture.pulse, capture.acquisition)
        truth_m = _image(archive, "truth_range_m", capture.shape)
        return replace(
            with_own_truth(with_guesses(capture, variable=name), truth_m),
            reported_range_m=_image(archive, "reported_range_m", capture.shape),
            signal=_image(archive, "signal", capture.shape),
            background=number(known, "background"),
            stated_flux=stated,
            groups=capture.groups or _groups(archive, known),
        )


def _groups(archive: ZipFile, known: Mapping[str, Any]) -> PulseGroups | None:
    """Read the groups of pulses of an archive, if it has any."""
    if "group_counts.npy" not in archive.namelist():
        return None
    counts, n_pulses = (_array(archive, name) for name in ("group_counts", "group_pulses"))
    fits = n_pulses.ndim == 1 and n_pulses.dtype.kind in "iu"
    found = f"{n_pulses.dtype} array of shape {n_pulses.shape}"
    require("group_pulses", found, fits, "whole numbers, one for each group")
    rate_hz = number(known, "pulse_rate_hz")
    return PulseGroups(counts, tuple(n_pulses.tolist()), rate_hz)


def maps(path: Path) -> list[Map]:
    """List the images of an archive."""

    def load(name: str) -> NDArray[Any]:
        with _archive(path) as archive:
            return _array(archive, name)

    with _archive(path) as archive:
        shapes = {name: _header(archive, name).shape for name in _names(archive)}
    return [Map(name, of, partial(load, name)) for name, of in shapes.items() if len(of) == 2]


def _archive(path: Path) -> ZipFile:
    with decoding("the archive"):
        return ZipFile(path)


def _names(archive: ZipFile) -> list[str]:
    return [name[:-4] for name in archive.namelist() if name.endswith(".npy")]


def _header(archive: ZipFile, name: str) -> Header:
    with _opened(archive, name) as file:
        return read_header(file, name)


def _choose(archive: ZipFile, names: list[str], request: ReadOptions) -> str:
    """Return the requested array, else ``cube``, ``frames``, or the only one with three axes."""
    listed, variable = ", ".join(names) or "none", request.variable
    for name in ("cube", "frames") if request.no_trigger is None else ("frames",):
        if variable is None and name in names:
            return name
    cubes = {}
    for name in names if variable is None else ():
        header = _header(archive, name)
        if len(header.shape) == 3:
            cubes[name] = header.dtype.kind in "iu"
    return choose_variable(variable, names, cubes, "a (row, col, bin) array", listed)


def _field(archive: ZipFile, name: str) -> Any:
    """Read a number, a text, or the samples of a pulse."""
    n_bytes = archive.getinfo(f"{name}.npy").file_size
    most = _MOST_BYTES_OF_SAMPLES if name == "pulse_samples" else _MOST_BYTES
    require(f"bytes of {name}", n_bytes, n_bytes <= most, f"up to {most:,}")
    array = _array(archive, name)
    return array.item() if array.size == 1 else array


def _is_number(archive: ZipFile, name: str) -> bool:
    """Return whether an archive has one number of that name."""
    if f"{name}.npy" not in archive.namelist():
        return False
    with _opened(archive, name) as file:
        header = read_header(file, name)
    return prod(header.shape) == 1 and header.dtype.kind in "iuf"


def _image(archive: ZipFile, name: str, shape: tuple[int, int]) -> Floats | None:
    """Read an image that accompanies the counts, after checking its header."""
    if f"{name}.npy" not in archive.namelist():
        return None
    header = _header(archive, name)
    require(name, f"array of {header.dtype}", header.dtype.kind in "biuf", "real numbers")
    require_image(name, header.shape, shape)
    return np.asarray(_array(archive, name), np.float64)


def _array(archive: ZipFile, name: str) -> NDArray[Any]:
    with _opened(archive, name) as file:
        return read_array(file, archive.getinfo(f"{name}.npy").file_size, name)


def _opened(archive: ZipFile, name: str, *, may_be_large: bool = False) -> IO[bytes]:
    """Open an array after checking its size and compression.

    What is stored as it is can be no larger than the archive; a few bytes may unpack to any size.
    """
    info = archive.getinfo(f"{name}.npy")
    method = info.compress_type
    if not (may_be_large and method == ZIP_STORED):
        require_fits(name, info.file_size)
    # LZMA's header sizes its own buffers, up to 4 GiB.
    plain = method in (ZIP_STORED, ZIP_DEFLATED)
    require(f"compression method of {name}", method, plain, "0 (stored) or 8 (deflated)")
    with decoding(name):
        return archive.open(info)
