"""Histograms of an AMS TMF8820, a time-of-flight sensor of nine zones, as ``.json``.

The file is a list of records, each one measurement of all zones:

===================  ==============  ==============================================================
field                shape           meaning
===================  ==============  ==============================================================
``hists``            (zone, bin)     counts; the only field that must be there
``reference_hist``   (bin,)          the pulse, recorded by a detector inside the sensor; in all
                                     records or in none
``dist_to_plane``    number          distance in metres of the plane in front; null: not known
===================  ==============  ==============================================================

Other fields are ignored. The capture is the image (record, zone): one row for each measurement.
``variable="record 17"`` reads that record alone, its zones arranged as a square.

Defaults: a bin is 91 ps. The pulse is the sum of the reference histograms from the first bin
that reaches a hundredth of the highest; that bin is its time zero. An echo from 0 m has its peak
1.1 ns after the histogram begins (both times are those published with the data), so the gate opens
1.1 ns minus the time from the pulse's zero to its peak before the pulse. All photons of a pulse
count.

The truth is the distance of the plane for every zone. The lines of sight of the outer zones are
oblique, so that their ranges are up to 3 % longer. In the published records, ranges of the middle
zone are 6 mm too long (1.14 ns would fit) and those of the others 0 to 21 mm: each zone has its own
delay. The sensor's clock is not corrected.

The records are parsed in an isolated process (`core.io.readers.isolation`).
"""

from __future__ import annotations

from dataclasses import replace
from math import isqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Pulse
from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, dense_capture, whole_counts
from core.io.readers.isolation import isolated
from core.io.readers.layout import require_pulse_in_gate
from core.io.readers.options import ReadOptions
from core.io.readers.quantities import time_text

BIN_WIDTH_S = 91e-12
PEAK_AT_0_M_S = 1.1e-9

_RISE = 0.01


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like a JSON list."""
    return start.lstrip().startswith(b"[") and b"\0" not in start


def read(path: Path, request: ReadOptions) -> Capture:
    """Read all records, or one."""
    variable = request.variable
    _, (cube, distances_m, *reference) = isolated(
        path, "the list of records", "read_tmf8820", variable=variable
    )
    require("axes", request.axes, request.order(AXES) in (None, (0, 1, 2)), repr(" ".join(AXES)))
    n_zones = cube.shape[1]
    if variable is not None:
        side = isqrt(n_zones)
        cube = cube.reshape(*((side, side) if side**2 == n_zones else (1, n_zones)), -1)
    known, guessed = _with_defaults(request, *reference)
    origin = path.name if variable is None else f"{path.name}, {variable}"
    capture = dense_capture(whole_counts(cube, "hists"), origin, known, guessed=guessed)
    if request.pulse is None:
        require_pulse_in_gate(capture.pulse, capture.acquisition)
    if np.isnan(distances_m).all():
        return capture
    truth_m = np.repeat(distances_m, n_zones).reshape(capture.shape)
    return replace(capture, truth_range_m=truth_m)


def _with_defaults(
    request: ReadOptions, reference: NDArray[Any] | None = None
) -> tuple[ReadOptions, list[str]]:
    """Complete a request by the defaults of this sensor; return what was guessed, too."""
    width_s = request.bin_width_s or BIN_WIDTH_S
    pulse = None if reference is None else Pulse.measured(_risen(reference), width_s)
    known = replace(
        request,
        bin_width_s=width_s,
        pulse=request.pulse or pulse,
        detection=request.detection or "all",
    )
    guessed = [f"bin width {time_text(width_s)}"] * (request.bin_width_s is None)
    if request.gate_delay_s is None and request.stop_s is None:
        delay_s = _peak_s(known.pulse or Pulse.gaussian(width_s)) - PEAK_AT_0_M_S
        known = replace(known, gate_delay_s=delay_s)
        guessed.append(f"zero range {time_text(-delay_s)} after the first bin")
    return known, guessed


def _peak_s(pulse: Pulse) -> float:
    """Return the time from a pulse's zero to its peak, in seconds."""
    if pulse.shape == "measured":
        return (int(np.argmax(pulse.samples)) + 0.5) * pulse.tau_s
    return 0.0 if pulse.shape == "gaussian" else pulse.tau_s


def _risen(references: NDArray[Any]) -> NDArray[Any]:
    """Return the sum of all reference histograms from its rise on."""
    lowest = references.min().item()
    require("reference_hist", lowest, lowest >= 0, "counts, 0 or more")
    reference = references.sum(axis=0, dtype=float)
    highest = float(reference.max())
    require("reference_hist", highest, 0 < highest < np.inf, "finite counts, not all 0")
    return np.asarray(reference[np.argmax(reference >= _RISE * highest) :])
