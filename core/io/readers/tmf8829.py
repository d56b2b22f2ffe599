"""Logs of an AMS TMF8829, a time-of-flight sensor of 8 x 8 to 48 x 32 zones, as ``.json``.

The file is what the sensor's evaluation software and its Python driver write, with histograms
switched on. It is an object with a list of records, ``Result_Set``, each a measurement of all
zones, and the ``configuration``:

==============================  =======================  ===========================================
field of a record               shape                    meaning
==============================  =======================  ===========================================
``mp_histo``, ``mp_histo_HA``   (row, col) of ``bin``    counts of each zone; in dual mode both
                                                         (long range, high accuracy), of which
                                                         ``variable`` chooses one
``ref_histo``, ``ref_histo_HA`` (pixel,) of ``bin``      the pulse, recorded by a detector inside
                                                         the sensor; in all records or in none
``results``                     (row, col) of ``peaks``  ``distance`` in millimetres and ``snr`` of
                                                         the targets that the sensor found
==============================  =======================  ===========================================

By the configuration's ``bin_shift``, a bin consists of ``2**bin_shift`` bins of the sensor
(``ref_bin_shift`` for the reference). ``histogram_bins`` is the number of the sensor's bins that
are filled: bins filled in part or not at all are left out. If ``select`` is 0, distances are not in
millimetres and are left out.

All records are added up, or those of ``records``. The capture's reported range is the distance of
the peak with the highest SNR, the median over the records. Some loggers project distances onto the
optical axis, which a log does not state.

Defaults: a bin of the sensor is 205 ps, which fits the distances of the published log (the
registers' names round it to 200 ps), and ``bin_shift`` is 2. The pulse is that of
`core.io.readers.reference_pulse`, which runs on the clock of the zones: an echo from 0 m has its
peak where the reference has, or without a reference 2.87 ns after the first bin begins. Ranges of
the published log are then 18 mm longer than those that the sensor reported; a bin is 123 mm long.
All photons of a pulse count.

Two statements of the log are not used. ``iterations`` are thousands by the name of their register;
1800 thousand pulses at the ``vcsel_period`` of 50 ns would take three times as long as a record, so
that the number of pulses stays unknown. The ``x``, ``y`` and ``z`` of targets imply zones that are
not square (of 16 x 16, 83 mrad wide and 63 mrad high), for which no single pixel angle holds.

The published log repeats each histogram in all columns of its row: those of row r belong to zone
(0, r), as the distances show. In a log of which all columns are the same, the capture has that one
row of zones.

The log is parsed in an isolated process (`core.io.readers.isolation`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.io.readers.dense import AXES, dense_capture, with_guesses
from core.io.readers.isolation import isolated
from core.io.readers.layout import require_pulse_in_gate
from core.io.readers.options import ReadOptions, choose_variable
from core.io.readers.records import added, chosen_records, described, median_m, span_of
from core.io.readers.reference_pulse import completed_by_sensor, reference_pulse

SENSOR_BIN_S = 205e-12
BIN_SHIFT = 2
MOST_BIN_SHIFT = 3  # of two bits
PEAK_AT_0_M_S = 2.87e-9

_DISTANCES_ARE_BINS = 0


def recognizes(start: bytes) -> bool:
    """Return whether a file starts like a JSON object."""
    return start.lstrip().startswith(b"{") and b"\0" not in start


def read(path: Path, request: ReadOptions) -> Capture:
    """Add up the records of a log."""
    found, arrays = isolated(
        path, "the log", "read_tmf8829", variable=request.variable, span=span_of(request)
    )
    n_records, names, settings = found["n_records"], found["histograms"], found["settings"]
    chosen = chosen_records(request, n_records)
    accepted, listed = "histograms of the log", ", ".join(names) or "none in its first record"
    name = choose_variable(request.variable, names, dict.fromkeys(names, True), accepted, listed)
    require("axes", request.axes, request.order(AXES) in (None, (0, 1, 2)), repr(" ".join(AXES)))
    parts = dict(zip(found["parts"], arrays, strict=True))
    origin = f"{path.name}, variable {name}, {described(chosen, n_records)}"
    if _repeats_columns(parts["counts"]):
        origin += ", the first row of zones, which the log repeats in each column"
        parts = _first_row(parts)
    shift = _shift(settings, "bin_shift", BIN_SHIFT)
    cube = added(parts["counts"][..., : _n_filled(settings, shift)], name)
    width_s = request.bin_width_s or SENSOR_BIN_S * 2**shift
    pulse, peak_s = None, PEAK_AT_0_M_S
    if "reference" in parts:
        reference_width_s = width_s * 2.0 ** (_shift(settings, "ref_bin_shift", shift) - shift)
        histograms = parts["reference"].reshape(-1, parts["reference"].shape[-1])
        reference = reference_pulse(histograms, reference_width_s, "ref_histo")
        pulse, peak_s = reference.pulse, reference.peak_s
    known, guessed = completed_by_sensor(request, width_s, pulse, peak_s)
    known = replace(known, records=None)
    capture = dense_capture(cube, origin, known, guessed=guessed)
    if request.pulse is None:
        require_pulse_in_gate(capture.pulse, capture.acquisition)
    capture = with_guesses(replace(capture, n_records=n_records), variable=name)
    in_metres = settings.get("select") != _DISTANCES_ARE_BINS
    if in_metres and "reported_m" in parts and parts["reported_m"].shape[1:] == capture.shape:
        return replace(capture, reported_range_m=median_m(parts["reported_m"]))
    return capture


def _repeats_columns(counts: NDArray[Any]) -> bool:
    """Return whether counts (record, row, col, bin) are the same in all columns, as none are."""
    return counts.shape[2] > 1 and bool(counts.any()) and bool((counts == counts[:, :, :1]).all())


def _first_row(parts: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the parts of a log that has the histograms of its first row of zones as rows."""
    first_row = {**parts, "counts": parts["counts"][:, :, :1].swapaxes(1, 2)}
    if "reported_m" in parts:
        first_row["reported_m"] = parts["reported_m"][:, :1]
    return first_row


def _shift(settings: Mapping[str, int], name: str, default: int) -> int:
    shift = settings.get(name, default)
    require(name, shift, 0 <= shift <= MOST_BIN_SHIFT, f"0 to {MOST_BIN_SHIFT}")
    return shift


def _n_filled(settings: Mapping[str, int], shift: int) -> int | None:
    """Return the number of bins that are filled; None if it is not stated."""
    if "histogram_bins" not in settings:
        return None
    n_bins, fewest = settings["histogram_bins"], 2**shift
    require("histogram_bins", n_bins, n_bins >= fewest, f"{fewest}, one bin, or more")
    return n_bins >> shift
