"""Histograms of an AMS TMF8820, a time-of-flight sensor of nine zones, as ``.json``.

The file is a list of records, each one measurement of all zones:

===================  ==============  ==============================================================
field                shape           meaning
===================  ==============  ==============================================================
``hists``            (zone, bin)     counts; the only field that must be there
``reference_hist``   (bin,)          the pulse, recorded by a detector inside the sensor; in all
                                     records or in none
``dist_to_plane``    number          distance in metres of the plane in front; null: not known
``distances``        list            what the sensor reports: ``depths_1`` in millimetres and
                                     ``confs_1``, the confidence, of each zone
===================  ==============  ==============================================================

Other fields are ignored. The capture is the image (record, zone): one row for each measurement.
``records=17`` reads that record alone and ``records=(3, 7)`` adds up five of them, their zones
arranged as a square; ``variable="record 17"`` is the same as the former.

Defaults: a bin is 91 ps. The pulse is that of `core.io.readers.reference_pulse`. An echo from 0 m
has its peak 1.1 ns after the histogram begins (both times are those published with the data), so
the gate opens 1.1 ns minus the time from the pulse's zero to its peak before the pulse. All photons
of a pulse count.

The truth is the distance of the plane for every zone; records that are added up have one only if
the plane does not move. The lines of sight of the outer zones are oblique, so that their ranges are
up to 3 % longer. In the published records, ranges of the middle zone are 6 mm too long (1.14 ns
would fit) and those of the others 0 to 21 mm: each zone has its own delay. The sensor's clock is
not corrected. The range that the sensor reported is that of its first target.

The records are parsed in an isolated process (`core.io.readers.isolation`).
"""

from __future__ import annotations

from dataclasses import replace
from math import isqrt
from pathlib import Path

import numpy as np

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, dense_capture, whole_counts
from core.io.readers.isolation import isolated
from core.io.readers.layout import require_pulse_in_gate
from core.io.readers.options import ReadOptions
from core.io.readers.records import added, chosen_records, described, median_m, span_of
from core.io.readers.reference_pulse import completed_by_sensor, reference_pulse

BIN_WIDTH_S = 91e-12
PEAK_AT_0_M_S = 1.1e-9


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like a JSON list."""
    return start.lstrip().startswith(b"[") and b"\0" not in start


def read(path: Path, request: ReadOptions) -> Capture:
    """Read all records as rows, or add up some."""
    variable = request.variable
    if variable is not None:
        request.refuse(["records"], "variable names the record")
    span = span_of(request)
    found, arrays = isolated(
        path, "the list of records", "read_tmf8820", variable=variable, span=span
    )
    n_records = found["n_records"]
    chosen = chosen_records(request, n_records)
    parts = dict(zip(found["parts"], arrays, strict=True))
    require("axes", request.axes, request.order(AXES) in (None, (0, 1, 2)), repr(" ".join(AXES)))
    counts, truth_m, reported_m = parts["counts"], parts["distances_m"], parts.get("reported_m")
    n_zones = counts.shape[1]
    truth_m = np.repeat(truth_m[:, np.newaxis], n_zones, axis=1)
    if variable is None and span is None:
        counts, origin = whole_counts(counts, "hists"), f"{n_records} records, one in each row"
    else:
        origin = variable or described(chosen, n_records)
        side = isqrt(n_zones)
        shape = (side, side) if side**2 == n_zones else (1, n_zones)
        counts = added(counts[:, np.newaxis], "hists").reshape(*shape, -1)
        moves = bool(np.any(truth_m != truth_m[0]))
        truth_m = np.full(shape, np.nan if moves else truth_m[0, 0])
        reported_m = None if reported_m is None else median_m(reported_m).reshape(shape)
    width_s, pulse = request.bin_width_s or BIN_WIDTH_S, None
    if "reference" in parts:
        pulse = reference_pulse(parts["reference"], width_s, "reference_hist").pulse
    known, guessed = completed_by_sensor(request, width_s, pulse, PEAK_AT_0_M_S)
    known = replace(known, records=None)
    capture = dense_capture(counts, f"{path.name}, {origin}", known, guessed=guessed)
    if request.pulse is None:
        require_pulse_in_gate(capture.pulse, capture.acquisition)
    return replace(
        capture,
        truth_range_m=None if np.isnan(truth_m).all() else truth_m,
        reported_range_m=reported_m,
        n_records=n_records,
    )
