"""Published captures with a truth: how accurate each method is on measured data.

The mannequin's face, a raster scan of 340 x 340 pixels with 8 photons per pixel (photon counting),
is compared with a scan of many photons: the median offset over the face is subtracted, and a pixel
without an estimate counts as wrong. The distances of a TMF8820 are compared with the plane in front
of which it was held.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture
from core.checks import require
from core.estimators import ESTIMATORS, estimate
from core.inference.posterior import posterior_of
from core.io.readers import read_capture
from core.io.readers.arrivals import NATIVE_BIN_S
from core.metrics import Interval, wilson
from core.studies.outputs import Table
from core.studies.statistics import median_interval
from core.tuning import tuned

FACE, FACE_TRUTH = "data_face.mat", "data_mannequin_face_truth.mat"
TMF8820 = "tmf8820_distance_data.json"

_IN_SCAN = np.s_[0:340, 3:343]  # the part of the truth's 350 x 350 that the capture covers
_FACE_BINS = 3550.0, 3700.0
_WALL_BIN = 4000.0
WITHIN_M = 0.03, 0.15

GAUSSIAN = Pulse.gaussian(45 * NATIVE_BIN_S)
METHODS = tuple(
    name for name, each in ESTIMATORS.items() if not (each.knows_flux or each.follows_motion)
)
TUNED = "tracking, tuned"
"""Tracking with settings that are chosen for each capture (`core.tuned`)."""

KNOWN = {
    "all photons": (0.824, 0.940, 0.914, 0.966),
    "first 3 detections": (0.783, 0.907, 0.821, 0.949),
    "background, SBR 0.30": (0.599, 0.694, 0.816, 0.861),
    "background, SBR 0.06": (0.367, 0.446, 0.647, 0.701),
}
"""Shares of pixels with a photon within 30 mm and 150 mm, by peak and matched filter, as measured
by others on this capture with a Gaussian of 360 ps."""


class Face(NamedTuple):
    """The truth of the face capture."""

    range_m: Floats
    """Shape (row, col)."""
    is_face: NDArray[np.bool_]
    is_wall: NDArray[np.bool_]


def face_truth(folder: Path) -> Face:
    """Read the truth of `FACE`."""
    cells = loadmat(folder / FACE_TRUTH)["D_true"]
    bins = np.array([cell.item() if cell.size else np.nan for cell in cells.ravel()])
    bins = bins.reshape(cells.shape)[_IN_SCAN]
    unit = Acquisition(n_bins=1, bin_width_s=NATIVE_BIN_S, gate_delay_s=0.0)
    is_face = (bins > _FACE_BINS[0]) & (bins < _FACE_BINS[1])
    return Face(unit.bin_to_range_m(bins), is_face, bins == _WALL_BIN)


def wall_pulse(folder: Path, truth: Face) -> Pulse:
    """Measure the pulse on the wall behind the face, which is not scored.

    The background is subtracted, and the rest cut to where it exceeds a hundredth of its peak.
    """
    capture = read_capture(folder / FACE, bin_width_s=NATIVE_BIN_S, pulse=GAUSSIAN)
    seen = capture.cube[truth.is_wall].sum(axis=0, dtype=np.int64).astype(float)
    echo = np.maximum(seen - np.median(seen), 0.0)
    kept = np.flatnonzero(echo > 0.01 * echo.max())
    around = kept[np.abs(kept - echo.argmax()) < 300]  # there are other surfaces in the gate
    return Pulse.measured(echo[around[0] : around[-1] + 1], bin_width_s=NATIVE_BIN_S)


def with_background(capture: Capture, sbr: float) -> Capture:
    """Add uniform background, taking the capture's own photons for signal."""
    rate = capture.counts.mean() / sbr / capture.acquisition.n_bins
    added = np.random.default_rng(0).poisson(rate, capture.cube.shape).astype(np.uint16)
    return replace(capture, cube=capture.cube + added, source=f"{capture.source}; SBR {sbr:g}")


def face_captures(folder: Path, pulse: Pulse) -> Iterator[tuple[str, Capture]]:
    """Yield the four conditions."""
    everything = read_capture(folder / FACE, pulse=pulse)
    names = iter(KNOWN)
    yield next(names), everything
    yield next(names), read_capture(folder / FACE, pulse=pulse, first_detections=3)
    for name, sbr in zip(names, (0.30, 0.06), strict=True):
        yield name, with_background(everything, sbr)


def face_tables(
    folder: Path, pulse: Pulse, key: str, title: str, progress: Callable[[str], None]
) -> list[Table]:
    """Return the share of the face's pixels within 30 mm and within 150 mm, for each method.

    Intervals are those of a share of as many independent pixels (95 %).

    Raises
    ------
    ValueError
        If a capture is absent.
    """
    truth = face_truth(folder)
    methods = (*METHODS, TUNED)
    cells: dict[tuple[float, str], list[Interval]] = {(w, m): [] for w in WITHIN_M for m in methods}
    spent_s, has_photon = dict.fromkeys(methods, 0.0), []
    for condition, capture in face_captures(folder, pulse):
        posterior_of(capture)  # computed once per capture, whatever the method
        for method in methods:
            progress(f"{title}, {condition}: {method}")
            started = perf_counter()
            if method == TUNED:
                range_m = estimate(capture, "tracking", tuned(capture).settings).range_m
            else:
                range_m = estimate(capture, method).range_m
            spent_s[method] += perf_counter() - started
            error_m = (range_m - truth.range_m)[truth.is_face]
            error_m = np.abs(error_m - np.nanmedian(error_m))
            for within_m in WITHIN_M:
                right = int((error_m <= within_m).sum())
                cells[within_m, method].append(wilson(right, error_m.size))
        has_photon.append(float((capture.counts[truth.is_face] > 0).mean()))
    tables = []
    for at, within_m in enumerate(WITHIN_M):
        rows = [
            (method, *cells[within_m, method], f"{spent_s[method] / len(KNOWN):.1f}")
            for method in methods
        ]
        for name, first in (("peak", 0), ("matched filter", 2)):
            known = (values[first + at] for values in KNOWN.values())
            shares = (share * seen for share, seen in zip(known, has_photon, strict=True))
            rows.append((f"published: {name}", *shares, ""))
        tables.append(
            Table(
                f"{key}_{1e3 * within_m:.0f}_mm",
                f"{title}: share of the pixels within {1e3 * within_m:.0f} mm",
                ("method", *KNOWN, "s"),
                tuple(rows),
                "Published shares are of the pixels with a photon; here, of all pixels.",
            )
        )
    return tables


def tmf8820_table(folder: Path) -> Table:
    """Return median and spread of the errors of the middle zone, for each method.

    Rows are records in time here: the image posterior would treat them as neighbours.

    Raises
    ------
    ValueError
        If the capture is absent.
    """
    capture = read_capture(folder / TMF8820)
    if capture.truth_range_m is None:
        raise ValueError(f"dist_to_plane = None is not accepted: give a {TMF8820} with distances.")
    middle = capture.shape[1] // 2
    rows = []
    for method in (each for each in METHODS if each != "image_posterior"):
        error_m = (estimate(capture, method).range_m - capture.truth_range_m)[:, middle]
        found_mm = 1e3 * error_m[np.isfinite(error_m)]
        low, high = np.percentile(found_mm, [16, 84])
        estimated = wilson(found_mm.size, error_m.size)
        rows.append((method, median_interval(found_mm), float(high - low) / 2, estimated))
    return Table(
        "tmf8820",
        f"TMF8820, middle zone of {capture.shape[0]} records, against the plane's distance",
        ("method", "median error, mm", "half the middle 68 %, mm", "estimated"),
        tuple(rows),
        formats={"median error, mm": ".1f", "half the middle 68 %, mm": ".1f"},
    )


def tables(folder: Path, progress: Callable[[str], None]) -> Iterator[Table]:
    """Yield a table for each comparison with a truth.

    Raises
    ------
    ValueError
        If a capture is absent from the folder.
    """
    for name in (FACE, FACE_TRUTH, TMF8820):
        require("captures", str(folder / name), (folder / name).is_file(), "a folder with it")
    wall = wall_pulse(folder, face_truth(folder))
    yield tmf8820_table(folder)
    yield from face_tables(
        folder, GAUSSIAN, "face_gaussian", "Face, pulse a Gaussian of 360 ps", progress
    )
    yield from face_tables(folder, wall, "face_wall", "Face, pulse measured on the wall", progress)
