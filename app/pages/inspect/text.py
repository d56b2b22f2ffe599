"""Texts of the Inspect page: facts, table rows and sentences, without markup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from app.model.large import Grid
from app.model.store import Answer
from app.model.text import CONFIDENCE_HELP, Fact, cell, estimate_facts, number, percent_cell, share
from app.pages.inspect.results import Inspected
from app.units import (
    AXIS_TITLES,
    OPPOSITE_UNIT,
    Quantity,
    Scale,
    bounds,
    count,
    scale,
    three_digits,
)
from app.units import interval as format_interval
from core import Capture
from core.inspection import Candidate, CaptureReport, FluxEstimate
from core.metrics import Interval

EXPLANATION = """
**Choose.** Tap the map, use the arrow keys (with Shift: eight pixels), or type a row and a column.
With *Rectangle* or *Lasso*, drag on the map to select a region; its histograms are summed and shown
as one. With *Zoom*, drag to enlarge; the wheel zooms as well, and a double tap shows the whole map.

**Compare.** *Pin this pixel*, or the key P, keeps up to four pixels.

**Judge.** Candidates are the peaks of the estimator's score. Each has the probability of a surface
within 3 bins of it, which does not depend on the estimator. S, B and SBR are estimated from the
counts alone, with 95 % intervals.
"""

MAP_HELP = (
    "Quantity shown on the map. Peak: largest count of a pixel. Fired: share of pulses with a "
    "detection. SBR: estimated from the counts."
)
MODE_HELP = "What dragging on the map does; a tap always selects a pixel."
SUBJECT_HELP = "What to inspect: one pixel, the region, the pinned pixels, or the whole capture."
PIN_HELP = "Pin this pixel: keep it for comparison (key P on the map)."
SELECT_HELP = "Select region: all pixels in these rows and columns."
CLEAR_HELP = "Clear region: remove the selected region."
TOO_MANY_PINS = "Four pixels are pinned already: remove one first."
NO_PINS = "No pixels are pinned. Select a pixel and press “Pin this pixel”, or P on the map."
NO_REGION = (
    "No region is selected. Drag a rectangle or a lasso on the map, or type rows and columns such "
    "as 10-20."
)

CANDIDATES = "Candidates: peaks of the estimator's score, best first."
PINS = "Pinned pixels."


def interval(found: Interval) -> Quantity:
    """Format an estimate with its 95 % interval; a dash for NaN."""
    return format_interval(found.value, found.low, found.high)


def facts(found: Inspected, unit: str) -> list[Fact]:
    """Return name, value and help of each number of a pixel or a region."""
    return _pixel_facts(found, unit) if found.region is None else _region_facts(found, unit)


def _pixel_facts(found: Inspected, unit: str) -> list[Fact]:
    answer, pixel = found.answer, found.pixel
    place = pixel_name((pixel.row, pixel.col), answer.grid)
    along = scale(unit, answer.capture.acquisition)
    has_truth = answer.capture.truth_range_m is not None
    facts = [("Pixel", place, "Row and column."), *estimate_facts(pixel, along, has_truth)]
    counts, help = count(pixel.counts), "Counts in the histogram of this pixel"
    if answer.capture.gated_pulses is not None:
        counts = count(pixel.counts, share(pixel.counts / answer.capture.gated_pulses))
        help += ", and as a share of the pulses"
    return [*facts, ("Detections", counts, f"{help}."), *_flux(found.report)]


def _region_facts(found: Inspected, unit: str) -> list[Fact]:
    region, along = found.region, scale(unit, found.answer.capture.acquisition)
    assert region is not None
    spread = "Half the central 68 % range of the estimates, which is one standard deviation."
    return [
        ("Pixels", count(region.n_pixels), "Pixels whose centre lies in the region."),
        *estimate_facts(found.pixel, along, has_truth=False),
        ("Median range", number(region.median_m, "m"), "Median of the estimates of its pixels."),
        ("Spread", number(region.spread_m, "m"), spread),
        ("Coverage", share(region.share_answered), "Share of its pixels with an estimate."),
        ("Mean confidence", share(region.mean_confidence), "Mean over the pixels."),
        ("Mean detections", number(region.mean_counts, ""), "Mean over the pixels."),
        *_flux(region),
    ]


def _flux(report: Any) -> list[Fact]:
    """Return the fluxes of a report on a pixel or a region."""
    found: FluxEstimate = report.flux
    per = f"{report.flux_unit}, with 95 % interval."
    return [
        ("Signal S", interval(found.signal), f"Signal flux in {per}"),
        ("Background B", interval(found.background), f"Background flux over the gate in {per}"),
        ("SBR", interval(found.sbr), "Signal divided by background, with 95 % interval."),
    ]


def remark(found: Inspected) -> str:
    """Return the sentence below the facts of a pixel or a region."""
    if found.region is None:
        return f"Verdict: {found.report.verdict.health}. {found.report.verdict.why}"
    return (
        "The plots show the summed histogram of the region. Mean flux of a pixel: "
        f"{found.region.flux_method}."
    )


def candidate_columns(unit: str) -> list[Sequence[Any]]:
    """Return title, help and sort order of the candidates' columns."""
    return [
        ("Rank", "Rank by score.", 1),
        (AXIS_TITLES[unit], "Position along the gate, the estimator's lag removed.", 1),
        ("Score", "The estimator's score; below, relative to the best.", -1),
        ("Probability", "Probability of a surface within 3 bins.", -1),
    ]


def candidate_rows(candidates: Sequence[Candidate], along: Scale, other: Scale) -> list[Any]:
    """Return a row for each candidate, best first."""
    return [
        {
            "name": str(n + 1),
            "cells": [
                (along.number(each.bin), each.bin, other.place(each.bin)),
                cell(each.score, below=share(each.relative)),
                percent_cell(each.probability),
            ],
        }
        for n, each in enumerate(candidates)
    ]


def both_scales(unit: str, answer: Answer) -> tuple[Scale, Scale]:
    """Return the chosen unit along the gate, and the unit shown below it."""
    acquisition = answer.capture.acquisition
    return scale(unit, acquisition), scale(OPPOSITE_UNIT[unit], acquisition)


def pin_columns(unit: str) -> list[Sequence[Any]]:
    """Return title, help and sort order of the pins' columns."""
    return [
        ("Pixel", "Row and column.", 1),
        (AXIS_TITLES[unit], "The estimate along the gate.", 1),
        ("Confidence", CONFIDENCE_HELP, -1),
        ("SBR", "Signal divided by background; below, its 95 % interval.", -1),
        ("Verdict", "Whether the pixel is hot or dead.", 1),
    ]


def pin_row(found: Inspected, name: str, color: str, along: Scale, other: Scale) -> dict[str, Any]:
    """Return the row of a pinned pixel."""
    pixel, report = found.pixel, found.report
    sbr = report.flux.sbr
    known = not math.isnan(pixel.answer_bin)
    below = other.place(pixel.answer_bin) if known else "no estimate"
    return {
        "name": name,
        "color": color,
        "dash": [],
        "cells": [
            (along.number(pixel.answer_bin), pixel.answer_bin if known else None, below),
            percent_cell(pixel.confidence),
            (
                three_digits(sbr.value),
                sbr.value if math.isfinite(sbr.value) else None,
                bounds(sbr.low, sbr.high),
            ),
            (report.verdict.health, report.verdict.health, ""),
        ],
    }


def pixel_name(pixel: tuple[int, int], grid: Grid) -> str:
    """Return row and column of a pixel in its file."""
    row, col = grid.place(*pixel)
    return f"{row}, {col}"


# The capture as a whole

PULSES_HELP = (
    "Share of the pulses to use, as if the recording had ended earlier. A smaller share is a "
    "subset of a larger one."
)
GATE_HELP = (
    "Apply the gate: bins outside it are cut, and T_n moves with it. “Data reduction” undoes it."
)
T_N_HELP = "Apply T_n: the tracking differentiator ignores the bins before it."


def capture_facts(answer: Answer, report: CaptureReport) -> list[Fact]:
    """Return name, value and help of each number of a capture."""
    rows, cols = answer.capture.shape
    n_pulses = answer.capture.acquisition.n_pulses
    flux, per = report.flux, f"mean of all pixels in {report.flux_unit}, with 95 % interval."
    hot, dead = ("–" if n is None else count(n) for n in (report.n_hot, report.n_dead))
    return [
        ("Pixels", f"{rows} × {cols}", "Rows and columns."),
        ("Pulses", "not known" if n_pulses is None else count(n_pulses), "Pulses per pixel."),
        ("Detections", number(float(answer.capture.counts.mean()), ""), "Mean of a pixel."),
        ("Signal (PPP)", interval(flux.signal), f"Signal flux, {per}"),
        ("Background", interval(flux.background), f"Background flux over the gate, {per}"),
        ("SBR", interval(flux.sbr), "Signal divided by background, with 95 % interval."),
        ("Hot pixels", hot, "Pixels with more detections than all neighbours."),
        ("Dead pixels", dead, "Pixels with fewer detections than all neighbours."),
    ]


def flux_sentence(report: CaptureReport) -> str:
    """Return how the fluxes of a capture were estimated."""
    return f"Signal, background and SBR: {report.flux_method}; in {report.flux_unit}."


def advice(report: CaptureReport, along: Scale) -> tuple[str, str]:
    """Return the suggested gate and the suggested T_n, each with the reason."""
    suggestion = report.suggestion
    first, end = (f"{along.at(edge):.6g}" for edge in suggestion.gate)
    return (
        f"Suggested gate, in {along.name}: {first} to {end}. {suggestion.why_gate}",
        f"Suggested T_n: {suggestion.t_n}. {suggestion.why_t_n}",
    )


def accuracy_titles(capture: Capture) -> tuple[str, str, str]:
    """Return title and axis labels of the plot of accuracy against pulses."""
    across = "Share of the pulses" if capture.acquisition.n_pulses is None else "Pulses"
    if capture.truth_range_m is not None:
        return "Accuracy against number of pulses", across, "Within 3 bins of the truth"
    title = "Agreement with the estimate from all pulses (not accuracy)"
    return title, across, "Within 3 bins of it"
