"""PicoQuant ``.ptu``: images of time-tagged photons (T3 mode), as TCSPC electronics record them.

Each photon carries its time since the laser's last pulse in bins of the instrument, whose width is
in the file; bins that begin within one period of the laser are kept. Frames are summed, all or
those of ``records``, and so are detectors unless ``variable`` picks one, such as ``"channel 0"``.
Photons outside the scan's lines, as on the way back of a mirror, belong to no pixel; incomplete
frames at the beginning and the end are left out. The gate opens with the pulse by default. All
photons of a pulse count.

Electronics that measure from the photon to the next pulse (reverse start-stop) count backwards:
give the laser's period as ``stop_s``.

`ptufile` decodes the records in an isolated process (`core.io.readers.isolation`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import ceil, inf
from pathlib import Path
from typing import Any

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, cube_capture
from core.io.readers.guards import require_fits
from core.io.readers.isolation import isolated
from core.io.readers.options import ReadOptions
from core.io.readers.records import chosen_records, described, span_of

_BYTES_A_RECORD = 4
_BYTES_A_COUNT = 4

# Whole numbers that the header must hold; `ptufile` raises 2 to the power of a marker.
_ACCEPTED = {
    "Measurement_Mode": (3, 3, "T3 records"),
    "Measurement_SubMode": (3, 3, "an image"),
    "ImgHdr_Dimensions": (3, 3, "an image"),
    "ImgHdr_PixY": (1, 2**16, "pixels"),
    "ImgHdr_PixX": (1, 2**16, "pixels"),
    "ImgHdr_LineStart": (1, 8, "a marker"),
    "ImgHdr_LineStop": (1, 8, "a marker"),
    "ImgHdr_Frame": (1, 8, "a marker"),
}


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like one of PicoQuant."""
    return start.startswith(b"PQTTTR")


def read(path: Path, request: ReadOptions) -> Capture:
    """Read the histograms of an image."""
    header, _ = isolated(path, "the header", "list_ptu", working_bytes=0)
    bin_width_s, n_bins = _bins(header["tags"])
    n_bytes = path.stat().st_size - header["record_offset"]
    rows, cols = _require_image(header["tags"], n_bytes, n_bins)
    channel = _channel(request.variable)
    shape = [rows, cols, n_bins]
    known, cubes = isolated(
        path, "the records", "read_ptu", channel=channel, shape=shape, span=span_of(request)
    )
    channels, n_frames = known["channels"], known["n_frames"]
    listed = ", ".join(f"channel {one}" for one in channels) or "none"
    require("photons of the image", listed, bool(channels), "a file with photons")
    chosen = chosen_records(request, n_frames)
    require("variable", request.variable, bool(cubes), f"None for all, or one of {listed}")
    summed = [f"{n_frames} frames"] * (request.records is None and n_frames > 1)
    summed += [f"{len(channels)} channels"] * (channel is None and len(channels) > 1)
    origin = path.name if channel is None else f"{path.name}, channel {channel}"
    origin += f", {described(chosen, n_frames, 'frame')}" if request.records is not None else ""
    origin += f", {' and '.join(summed)} summed" if summed else ""
    complete = replace(
        request,
        bin_width_s=request.bin_width_s or bin_width_s,
        detection=request.detection or "all",
        records=None,
    )
    capture = cube_capture(cubes[0], "the image", origin, complete, axes=" ".join(AXES))
    return replace(capture, n_records=n_frames)


def _bins(tags: Mapping[str, Any]) -> tuple[float, int]:
    """Return the width of a bin in seconds, and how many begin within one period of the laser."""
    width_s = _positive(tags, "MeasDesc_Resolution")
    period_s = _positive(tags, "MeasDesc_GlobalResolution")
    n_bins = period_s / width_s
    require(
        "MeasDesc_GlobalResolution / MeasDesc_Resolution",
        n_bins,
        1 - 1e-6 <= n_bins < 2**31,
        "a laser's period of at least one bin",
    )
    return width_s, ceil(n_bins - 1e-6)  # a quotient of floats may miss a whole number


def _positive(tags: Mapping[str, Any], name: str) -> float:
    value = tags.get(name)
    fits = isinstance(value, int | float) and 0 < value < inf
    require(name, value, fits, "a file whose tag is a positive number")
    return float(value)  # type: ignore[arg-type]  # as was just required


def _require_image(tags: Mapping[str, Any], size: int, n_bins: int) -> tuple[int, int]:
    """Return rows and columns of a header that describes an image no larger than its file."""
    found = {"ImgHdr_Dimensions": 3, "ImgHdr_Frame": 3, **tags}  # these may be missing
    for name, (lowest, highest, what) in _ACCEPTED.items():
        value = found.get(name)
        fits = isinstance(value, int) and lowest <= value <= highest
        require(name, value, fits, f"{what}, from {lowest} to {highest:,}")
    sine = found.get("ImgHdr_SinCorrection", 0)
    require("ImgHdr_SinCorrection", sine, sine == 0, "0, a mirror that moves evenly")
    rows, cols = found["ImgHdr_PixY"], found["ImgHdr_PixX"]
    require_fits("the image", rows * cols * n_bins * _BYTES_A_COUNT)
    claimed = found.get("TTResult_NumberOfRecords")
    held = size // _BYTES_A_RECORD
    whole = isinstance(claimed, int) and 0 < claimed <= held
    require("TTResult_NumberOfRecords", claimed, whole, f"a whole file: it holds {held:,} records")
    return rows, cols


def _channel(variable: str | None) -> int | None:
    """Return the number of the requested channel, None for all, -1 for a name of none."""
    if variable is None:
        return None
    number = variable.removeprefix("channel ")
    return int(number) if variable == f"channel {number}" and number.isdecimal() else -1
