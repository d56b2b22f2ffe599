"""The project's own layout: a NumPy ``.npz`` archive, compressed or not.

==================  ==============  ==========================================================
field               shape           meaning
==================  ==============  ==========================================================
``format``          text            ``"firstphoton-capture-1"``; may be absent
``cube``            (row, col, bin) counts, unsigned; the only field that must be there
``bin_width_s``     scalar          width of a bin in seconds
``gate_delay_s``    scalar          time from the pulse to the first bin in seconds
``n_pulses``        scalar          pulses sent for each pixel; 0 or absent: unknown
``pixel_angle_rad`` scalar          angle between neighbouring pixels in radians; absent: unknown
``pulse_shape``     text            ``"gamma"``, ``"gaussian"`` or ``"measured"``
``pulse_tau_s``     scalar          time constant, standard deviation or sample spacing
``pulse_samples``   (sample,)       the measured pulse; empty or absent for the others
``truth_range_m``   (row, col)      true range in metres, NaN without a target; may be absent
``signal``          (row, col)      true signal photons per pulse; may be absent
``background``      scalar          true background photons per pulse and gate; may be absent
``detection``       text            ``"first"`` or ``"all"``, see `core.capture.Detection`
``source``          text            where the capture came from; may be absent
==================  ==============  ==========================================================

Text is an array of one unicode string. Where timing or pulse are absent they are guessed: bins of
1 ns, a gate that opens with the pulse, and the default pulse. An archive of other names opens too
if exactly one array has three axes, or if ``variable`` names one; its pulse is then guessed to be a
Gaussian of one bin.

In place of a cube there may be raw ``frames`` (pulse, row, col) of trigger bins with a whole number
``no_trigger`` that marks no trigger, as in `core.io.readers.frames`; the other fields may
accompany them. Frames that are stored without compression may be larger than memory.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats, Pulse
from core.capture import Capture
from core.checks import require
from core.io.readers.dense import (
    AXES,
    PULSE,
    cube_capture,
    dense_capture,
    require_image,
    require_pulse_in_gate,
    stored_counts,
    stored_pulse,
)
from core.io.readers.guards import decoding, require_fits
from core.io.readers.npy import Header, frames_in, read_array, read_header
from core.io.readers.options import ReadOptions

FORMAT = "firstphoton-capture-1"

_TIMING = ("bin_width_s", "gate_delay_s", "pixel_angle_rad")
_OTHERS = ("format", "n_pulses", "detection", "source", "no_trigger", "background")
_FIELDS = (*_TIMING, *PULSE, *_OTHERS)
_MOST_BYTES = 2**16  # of a field that is one number or one text
_MOST_BYTES_OF_SAMPLES = 2**23 + 2**12


def fields(capture: Capture) -> dict[str, NDArray[Any]]:
    """The arrays that this layout keeps of a capture."""
    acquisition, pulse = capture.acquisition, capture.pulse
    kept = {
        "format": FORMAT,
        "cube": capture.cube,
        "bin_width_s": acquisition.bin_width_s,
        "gate_delay_s": acquisition.gate_delay_s,
        "n_pulses": acquisition.n_pulses or 0,
        "pixel_angle_rad": acquisition.pixel_angle_rad,
        "pulse_shape": pulse.shape,
        "pulse_tau_s": pulse.tau_s,
        "pulse_samples": np.array(pulse.samples, float),
        "truth_range_m": capture.truth_range_m,
        "signal": capture.signal,
        "background": capture.background,
        "detection": capture.detection,
        "source": capture.source or None,
    }
    return {name: np.asarray(value) for name, value in kept.items() if value is not None}


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like a ZIP archive."""
    return start.startswith((b"PK\x03\x04", b"PK\x05\x06"))


def read(path: Path, request: ReadOptions) -> Capture:
    """Read our own layout, the one cube of an archive, or raw frames."""
    with decoding("the archive"):
        archive = ZipFile(path)
    with archive:
        names = _names(archive)
        name = _choose(archive, names, request)
        origin = f"{path.name}, variable {name}"
        stored = {field: _field(archive, field) for field in names if field in _FIELDS}
        if name == "frames" or (request.no_trigger is not None and name != "cube"):
            return _frames(archive, name, stored, origin, request)
        cube = _array(archive, name)
        if name != "cube":
            return cube_capture(cube, name, origin, request)
        as_told = request.order(AXES) in (None, (0, 1, 2))
        require("axes", request.axes, as_told, repr(" ".join(AXES)))
        origin = _text(stored, "source", origin)
        counts = stored_counts(cube, name)
        capture = dense_capture(counts, origin, _known(stored, request), Pulse())
        return _completed(capture, archive, stored, request)


def _frames(
    archive: ZipFile,
    name: str,
    stored: Mapping[str, NDArray[Any]],
    origin: str,
    request: ReadOptions,
) -> Capture:
    """A capture from frames, which are counted as they are unpacked."""
    no_trigger = request.no_trigger
    if no_trigger is None:
        no_trigger = _whole(_number(stored, "no_trigger"), "no_trigger", "what stands for none")
    info = _info(archive, name, stored_at_any_size=True)
    origin, known = _text(stored, "source", origin), _known(stored, request)
    with decoding(name):
        file = archive.open(info)
    with file:
        capture = frames_in(
            file, info.file_size, name, origin, replace(known, no_trigger=no_trigger)
        )
    return _completed(capture, archive, stored, request)


def _known(stored: Mapping[str, NDArray[Any]], request: ReadOptions) -> ReadOptions:
    """The request, completed by the fields of our layout."""
    version = _text(stored, "format", FORMAT)
    require("format", version, version == FORMAT, FORMAT)
    if "gate_delay_s" in stored:
        request.refuse(["stop_s"], "the file's own gate_delay_s tells")
    known: dict[str, Any] = {name: _number(stored, name) for name in _TIMING}
    known |= {
        "n_pulses": _n_pulses(stored),
        "pulse": _pulse(stored),
        "detection": _text(stored, "detection", "") or None,
    }
    told = {name: value for name, value in known.items() if getattr(request, name) is None}
    return replace(request, **told)


def _completed(
    capture: Capture, archive: ZipFile, stored: Mapping[str, NDArray[Any]], request: ReadOptions
) -> Capture:
    """Add the ground truth to a capture after checking the length of its pulse."""
    if request.pulse is None:
        require_pulse_in_gate(capture.pulse, capture.acquisition)
    return replace(
        capture,
        truth_range_m=_image(archive, "truth_range_m", capture.shape),
        signal=_image(archive, "signal", capture.shape),
        background=_number(stored, "background"),
    )


def _pulse(stored: Mapping[str, NDArray[Any]]) -> Pulse | None:
    if not any(name in stored for name in PULSE):
        return None
    samples = stored.get("pulse_samples", np.empty(0))
    _require_reals("pulse_samples", samples.dtype)
    shape = _text(stored, "pulse_shape", "gamma")
    return stored_pulse(_number(stored, "pulse_tau_s"), shape, samples)


def _n_pulses(stored: Mapping[str, NDArray[Any]]) -> int | None:
    value = _whole(_number(stored, "n_pulses") or 0.0, "n_pulses", "0 if not known")
    require("n_pulses", value, value >= 0, "0 or more")
    return value or None


def _whole(value: float | None, name: str, meaning: str) -> int:
    whole = value is not None and value.is_integer()
    require(name, value, whole, f"a whole number, {meaning}")
    return int(value or 0)


def _number(stored: Mapping[str, NDArray[Any]], name: str) -> float | None:
    if name not in stored:
        return None
    _require_reals(name, stored[name].dtype)
    require(name, f"array of shape {stored[name].shape}", stored[name].size == 1, "one number")
    return float(stored[name].item())


def _text(stored: Mapping[str, NDArray[Any]], name: str, default: str) -> str:
    if name not in stored:
        return default
    text = stored[name]
    what = f"{text.dtype} array of shape {text.shape}"
    require(name, what, text.dtype.kind == "U" and text.size == 1, "one unicode string")
    return str(text.item())


def _image(archive: ZipFile, name: str, shape: tuple[int, int]) -> Floats | None:
    """Read an image that accompanies the counts, after checking the shape in its header."""
    if f"{name}.npy" not in archive.namelist():
        return None
    header = _header(archive, name)
    _require_reals(name, header.dtype)
    require_image(name, header.shape, shape)
    return np.asarray(_array(archive, name), np.float64)


def _require_reals(name: str, dtype: np.dtype[Any]) -> None:
    require(name, f"array of {dtype}", dtype.kind in "biuf", "real numbers")


def _names(archive: ZipFile) -> list[str]:
    """Names of the arrays in the archive, none of them twice."""
    counted = Counter(archive.namelist())
    for name, times in counted.items():
        require(f"arrays named {name!r}", times, times == 1, "each name once")
    return [name.removesuffix(".npy") for name in counted if name.endswith(".npy")]


def _choose(archive: ZipFile, names: list[str], request: ReadOptions) -> str:
    """The array asked for, or ``cube``, or ``frames``, or the only array with three axes."""
    listed, variable = ", ".join(names) or "none", request.variable
    if variable is not None:
        require(
            "variable", variable, variable in names, f"the name of an array; the file has {listed}"
        )
        return variable
    ours = ("cube", "frames") if request.no_trigger is None else ("frames",)
    for name in ours:
        if name in names:
            return name
    cubes = [name for name in names if len(_header(archive, name).shape) == 3]
    remedy = f"as variable the name of a (row, col, bin) array; the file has {listed}"
    require("variable", ", ".join(cubes) or None, len(cubes) == 1, remedy)
    return cubes[0]


def _header(archive: ZipFile, name: str) -> Header:
    info = _info(archive, name)
    with decoding(name), archive.open(info) as file:
        return read_header(file, name)


def _field(archive: ZipFile, name: str) -> NDArray[Any]:
    """A number, a text, or the samples of a pulse; together they take little."""
    n_bytes = archive.getinfo(f"{name}.npy").file_size
    most = _MOST_BYTES_OF_SAMPLES if name == "pulse_samples" else _MOST_BYTES
    require(f"bytes of {name}", n_bytes, n_bytes <= most, f"up to {most:,}")
    return _array(archive, name)


def _array(archive: ZipFile, name: str) -> NDArray[Any]:
    info = _info(archive, name)
    with decoding(name):
        file = archive.open(info)
    with file:
        return read_array(file, info.file_size, name)


def _info(archive: ZipFile, name: str, stored_at_any_size: bool = False) -> ZipInfo:
    """The archive's entry for an array, once its size and compression proved harmless.

    What is stored as it is can be no larger than the archive; a few bytes may unpack to any size.
    """
    info = archive.getinfo(f"{name}.npy")
    method = info.compress_type
    if not (stored_at_any_size and method == ZIP_STORED):
        require_fits(name, info.file_size)
    # LZMA's header sizes its own buffers, up to 4 GiB.
    plain = method in (ZIP_STORED, ZIP_DEFLATED)
    require(f"compression method of {name}", method, plain, "0 (stored) or 8 (deflated)")
    return info
