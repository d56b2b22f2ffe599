"""Histograms of an AMS TMF8820, a time-of-flight sensor of nine zones, as ``.json``.

The file is a list of records, each one measurement of all zones:

===================  ==============  ==============================================================
field                shape           meaning
===================  ==============  ==============================================================
``hists``            (zone, bin)     counts; the only field that must be there
``reference_hist``   (bin,)          the pulse, as a detector inside of the sensor sees it; all of
                                     the records have it, or none
``dist_to_plane``    number          distance in metres of the plane in front; null: not known
===================  ==============  ==============================================================

Other fields are left alone. The capture is the image (record, zone): one row for each measurement.
``variable="record 17"`` takes that one alone, its zones as the square that they see.

Defaults: a bin is 91 ps. The pulse is the sum of the reference histograms from the first bin
that reaches a hundredth of the highest; that bin is its time zero. An echo from 0 m has its peak
1.1 ns after the histogram begins (both times are those published with the data), so the gate opens
as much before the pulse, less the time from the pulse's zero to its peak. All photons of a pulse
count.

The truth is the distance of the plane for every zone. Zones next to the middle one see it at an
angle, up to 3 % further away. In the published records, ranges of the middle zone come out 6 mm too
far (1.14 ns would fit) and those of the others 0 to 21 mm: each zone has its own delay. The
sensor's clock is not corrected.
"""

from __future__ import annotations

import json
from dataclasses import replace
from math import isqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats, Pulse
from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, dense_capture, require_pulse_in_gate, whole_counts
from core.io.readers.guards import decoding, require_fits
from core.io.readers.options import ReadOptions
from core.io.readers.times import time_text

BIN_WIDTH_S = 91e-12
PEAK_AT_0_M_S = 1.1e-9

_MEMORY_A_BYTE = 32  # of text: the three characters of an empty object take 72 bytes
_RISE = 0.01

Record = dict[str, Any]


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like a JSON list."""
    return start.lstrip().startswith(b"[") and b"\0" not in start


def read(path: Path, request: ReadOptions) -> Capture:
    """Read all records, or one."""
    require_fits("the records", path.stat().st_size * _MEMORY_A_BYTE)
    records = _records(path.read_bytes())
    first, chosen = 0, records
    if request.variable is not None:
        first = _number(request.variable, len(records))
        chosen = records[first : first + 1]
    cube = _zones(chosen, first)
    require("axes", request.axes, request.order(AXES) in (None, (0, 1, 2)), repr(" ".join(AXES)))
    truth_m = _truth_m(chosen, first, cube.shape[1])
    if request.variable is not None:
        side = isqrt(cube.shape[1])
        square = (side, side) if side**2 == cube.shape[1] else cube.shape[:2]
        cube = cube.reshape(*square, cube.shape[2])
        truth_m = None if truth_m is None else truth_m.reshape(square)
    origin = path.name if request.variable is None else f"{path.name}, {request.variable}"
    return replace(
        _capture(cube, _reference(chosen, first), origin, request), truth_range_m=truth_m
    )


def _capture(
    cube: NDArray[Any], reference: Floats | None, origin: str, request: ReadOptions
) -> Capture:
    """Build a capture with this sensor's default times."""
    counts = whole_counts(cube, "hists")
    width_s = request.bin_width_s or BIN_WIDTH_S
    pulse = None if reference is None else Pulse.measured(reference, width_s)
    known = replace(
        request,
        bin_width_s=width_s,
        pulse=request.pulse or pulse,
        detection=request.detection or "all",
    )
    if request.gate_delay_s is None and request.stop_s is None:
        peak_s = _peak_s(known.pulse or Pulse.gaussian(width_s))
        known = replace(known, gate_delay_s=peak_s - PEAK_AT_0_M_S)
    guessed = [f"bin width {time_text(width_s)}"] * (request.bin_width_s is None)
    if known.gate_delay_s is not None and request.gate_delay_s is None:
        guessed.append(f"zero range {time_text(-known.gate_delay_s)} after the first bin")
    capture = dense_capture(counts, origin, known, also_guessed=guessed)
    if request.pulse is None:
        require_pulse_in_gate(capture.pulse, capture.acquisition)
    return capture


def _peak_s(pulse: Pulse) -> float:
    """Time from a pulse's zero to its peak, in seconds."""
    if pulse.shape == "measured":
        return (int(np.argmax(pulse.samples)) + 0.5) * pulse.tau_s
    return 0.0 if pulse.shape == "gaussian" else pulse.tau_s


def _records(text: bytes) -> list[Record]:
    """The file's list."""
    with decoding("the list of records"):
        records = json.loads(text, parse_constant=_no_number)
    require("the file", type(records).__name__, isinstance(records, list), "a list of records")
    require("records", len(records), len(records) > 0, "at least one")
    for number, record in enumerate(records):
        is_record = isinstance(record, dict) and "hists" in record
        what = "a record with the histograms of a TMF8820, hists"
        require(f"record {number}", type(record).__name__, is_record, what)
    return list(records)


def _no_number(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")


def _number(variable: str, n_records: int) -> int:
    """The record that `variable` names."""
    word, _, number = variable.partition(" ")
    fits = word == "record" and number.isdecimal() and int(number) < n_records
    require("variable", variable, fits, f"None for all, or 'record 0' to 'record {n_records - 1}'")
    return int(number)


def _numbers(value: object, name: str, n_axes: int) -> NDArray[Any]:
    """An array of `n_axes` axes from lists of numbers."""
    with decoding(name):
        # As objects first: one long text would make room for itself in place of every number.
        array = np.array(value, object)
        if {*map(type, array.flat)} <= {int, float}:
            array = np.array(value)
    what = f"{array.dtype} array of shape {array.shape}"
    fits = array.ndim == n_axes and array.size > 0 and array.dtype.kind in "iuf"
    require(name, what, fits, f"numbers in {n_axes} axes, as many in each list")
    return array


def _zones(records: list[Record], first: int) -> NDArray[Any]:
    """The histograms of all records, shape (record, zone, bin)."""
    found: list[NDArray[Any]] = []
    for number, record in enumerate(records, first):
        name = f"hists of record {number}"
        found.append(_numbers(record["hists"], name, 2))
        shape, wanted = found[-1].shape, found[0].shape
        require(f"shape of {name}", shape, shape == wanted, f"{wanted}, that of record {first}")
    return np.stack(found)


def _reference(records: list[Record], first: int) -> Floats | None:
    """The sum of all references from its rise on; None where there are none."""
    if all("reference_hist" not in record for record in records):
        return None
    found: list[NDArray[Any]] = []
    for number, record in enumerate(records, first):
        name = f"reference_hist of record {number}"
        found.append(_numbers(record.get("reference_hist"), name, 1))
        lowest, shape, wanted = found[-1].min().item(), found[-1].shape, found[0].shape
        require(name, lowest, lowest >= 0, "counts, 0 or more")
        require(f"shape of {name}", shape, shape == wanted, f"{wanted}, that of record {first}")
    reference = np.sum(found, axis=0, dtype=float)
    highest = float(reference.max())
    require("reference_hist", highest, 0 < highest < np.inf, "finite counts, not all 0")
    return np.asarray(reference[np.argmax(reference >= _RISE * highest) :])


def _truth_m(records: list[Record], first: int, n_zones: int) -> Floats | None:
    """Distance of the plane for each record and zone; None if no record has it."""
    distances: list[float] = []
    for number, record in enumerate(records, first):
        value = record.get("dist_to_plane")
        plain = value is None or (isinstance(value, int | float) and 0 <= value < np.inf)
        require(f"dist_to_plane of record {number}", value, plain, "metres, or null")
        distances.append(np.nan if value is None else value)
    truth_m = np.repeat(np.array(distances, float)[:, np.newaxis], n_zones, axis=1)
    return None if np.isnan(truth_m).all() else truth_m
