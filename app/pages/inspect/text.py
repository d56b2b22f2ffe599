"""What the Inspect page says: facts, rows of tables and sentences, as plain text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from app.model.large import Grid
from app.model.store import Answer
from app.model.text import Fact, number, share
from app.pages.inspect.results import Seen
from app.units import AXIS_TITLES, OPPOSITE_UNIT, Scale, scale
from core.inspection import Accuracy, Candidate, CaptureReport, FluxEstimate
from core.metrics import Interval

EXPLANATION = """
**Look.** Tap the picture, move by arrow keys (with Shift by eight), or type a row and a column.
*Rectangle* and *Lasso* choose what dragging on the picture does: the pixels within are added up and
looked at as one. *Zoom*, or the wheel, enlarges; a double tap shows all again.

**Compare.** *Pin this pixel*, or the key P, keeps up to four.

**Believe it, or not.** Candidates are the peaks of the estimator's score, each with the probability
that there is a surface within 3 bins of it, whatever the estimator says. S, B and SBR come from the
counts alone, with 95 % intervals.
"""

MAP_HELP = (
    "What to navigate by. Peak: the largest count. Fired: share of the pulses. "
    "SBR: as the counts tell."
)
MODE_HELP = "What dragging on the picture does; a tap always chooses a pixel."
SUBJECT_HELP = "What is looked at: one pixel, the region's pixels as one, pins, or the capture."
PIN_HELP = "Pin this pixel: keeps it to be compared (key P on the picture)."
SELECT_HELP = "Select region: the rectangle of these rows and columns."
CLEAR_HELP = "Clear region: there is none then."
TOO_MANY_PINS = "Four pixels are pinned, as many as can be told apart: remove one first."
NO_PINS = "Nothing is pinned yet. Choose a pixel and press “Pin this pixel”, or P on the picture."
NO_REGION = (
    "No region yet. Drag a rectangle or a lasso on the picture, or type rows and columns "
    "such as 10-20."
)

CANDIDATES = "Candidates: peaks of the estimator's score, the best first."
CANDIDATE_COLUMNS = (
    ("Score", "The estimator's score there; below, as a share of the best.", -1),
    ("Probability", "That there is a surface within 3 bins of it, as the counts tell.", -1),
)

PINS = "Pinned pixels beside each other."


def interval(found: Interval) -> str:
    """An estimate with its 95 % interval; a dash where there is none."""
    if math.isnan(found.value):
        return "–"
    low, high = (_short(end) for end in (found.low, found.high))
    return f"{_short(found.value)} [{low}, {high}]"


def _short(value: float) -> str:
    return "∞" if math.isinf(value) else f"{value:.3g}"


def facts(answer: Answer, seen: Seen, unit: str) -> list[Fact]:
    """Name, value and help of each number of a pixel or a region."""
    return _pixel_facts(answer, seen, unit) if seen.region is None else _region_facts(seen, unit)


def _pixel_facts(answer: Answer, seen: Seen, unit: str) -> list[Fact]:
    pixel, report = seen.pixel, seen.report
    found = [
        (
            "Pixel",
            pixel_name((pixel.row, pixel.col), answer.grid),
            "Row and column; arrow keys move it.",
        ),
        *_estimate(seen, scale(unit, answer.capture.acquisition)),
    ]
    if answer.capture.truth_range_m is not None:
        truth = "no target" if math.isnan(pixel.truth_m) else number(pixel.truth_m, "m")
        error = number(pixel.range_m - pixel.truth_m, "m", sign=True)
        found += [
            ("Truth", truth, "Where the surface is."),
            ("Error", error, "Estimate minus truth."),
        ]
    counts, fired = f"{pixel.counts:,}", "Counts in this pixel's histogram"
    if answer.capture.gated_pulses is not None:
        counts += f" ({share(pixel.counts / answer.capture.gated_pulses)})"
        fired += ", and their share of the pulses"
    return [
        *found,
        ("Detections", counts, f"{fired}."),
        *_light(report.flux, report.flux_unit),
    ]


def _region_facts(seen: Seen, unit: str) -> list[Fact]:
    region = seen.region
    assert region is not None
    spread = "Half the range of the middle 68 % of the answers, as one standard deviation."
    return [
        ("Pixels", f"{region.n_pixels:,}", "Pixels whose centre lies in the region."),
        *_estimate(seen, scale(unit, region.summed.acquisition)),
        ("Median of answers", number(region.median_m, "m"), "Of its pixels, one by one."),
        ("Spread of answers", number(region.spread_m, "m"), spread),
        ("Answered", share(region.share_answered), "Share of its pixels with an answer."),
        ("Mean confidence", share(region.mean_confidence), "Of its pixels, one by one."),
        ("Mean detections", number(region.mean_counts, ""), "Of a pixel."),
        *_light(region.flux, region.flux_unit),
    ]


def _estimate(seen: Seen, along: Scale) -> list[Fact]:
    pixel = seen.pixel
    found = [("Estimate", number(pixel.range_m, "m"), "Range of the surface, lag removed.")]
    if along.name != "m":
        found.append(("Position", along.place(pixel.answer_bin), "The estimate along the gate."))
    sure = "Probability that there is a surface within 3 bins of the estimate."
    return [*found, ("Confidence", share(pixel.confidence), sure)]


def _light(found: FluxEstimate, unit: str) -> list[Fact]:
    per = f", in {unit}, with 95 % interval."
    return [
        ("Signal S", interval(found.signal), f"Photons of the echo{per}"),
        ("Background B", interval(found.background), f"Those of the background over the gate{per}"),
        ("SBR", interval(found.sbr), "Signal over background, with 95 % interval."),
    ]


def remark(seen: Seen) -> str:
    """What is to be said of a pixel or a region besides its numbers."""
    if seen.region is None:
        return f"Verdict: {seen.report.verdict.health}. {seen.report.verdict.why}"
    return (
        f"The plots show its pixels added to one. Light of a pixel on average: "
        f"{seen.region.flux_method}."
    )


def candidate_columns(unit: str) -> list[Sequence[Any]]:
    """Titles, help and order of the candidates' columns."""
    place = (AXIS_TITLES[unit], "Where it lies along the gate, the estimator's lag removed.", 1)
    return [("Rank", "By the score.", 1), place, *CANDIDATE_COLUMNS]


def candidate_rows(candidates: Sequence[Candidate], along: Scale, other: Scale) -> list[Any]:
    """A row for each candidate, the best first."""
    return [
        {
            "name": str(n + 1),
            "cells": [
                [along.number(each.bin), each.bin, other.place(each.bin)],
                [f"{each.score:.4g}", each.score, share(each.relative)],
                [share(each.probability), each.probability, ""],
            ],
        }
        for n, each in enumerate(candidates)
    ]


def both_scales(unit: str, answer: Answer) -> tuple[Scale, Scale]:
    """The unit along the gate, and what complements it."""
    acquisition = answer.capture.acquisition
    return scale(unit, acquisition), scale(OPPOSITE_UNIT[unit], acquisition)


def pin_columns(unit: str) -> list[Sequence[Any]]:
    """Titles, help and order of the pins' columns."""
    return [
        ("Pixel", "Row and column.", 1),
        (AXIS_TITLES[unit], "The estimate along the gate.", 1),
        ("Sure", "Confidence: probability of a surface within 3 bins of the estimate.", -1),
        ("SBR", "Signal over background; below, its 95 % interval.", -1),
        ("Verdict", "Whether the pixel is hot or dead.", 1),
    ]


def pin_row(seen: Seen, name: str, color: str, along: Scale, other: Scale) -> dict[str, Any]:
    """A pinned pixel."""
    pixel, report = seen.pixel, seen.report
    sbr = report.flux.sbr
    value, *ends = interval(sbr).split(" ", 1)
    known = not math.isnan(pixel.answer_bin)
    below = other.place(pixel.answer_bin) if known else "no answer"
    return {
        "name": name,
        "color": color,
        "dash": [],
        "cells": [
            [along.number(pixel.answer_bin), pixel.answer_bin if known else None, below],
            [share(pixel.confidence), pixel.confidence, ""],
            [value, sbr.value if math.isfinite(sbr.value) else None, "".join(ends)],
            [report.verdict.health, report.verdict.health, ""],
        ],
    }


def pixel_name(pixel: tuple[int, int], grid: Grid) -> str:
    """Row and column of a pixel in its file, as short as can be."""
    row, col = grid.place(*pixel)
    return f"{row}, {col}"


# The capture as a whole

PULSES_HELP = (
    "Share of the pulses that are taken, as if recording had ended sooner; what is taken with "
    "fewer is a part of what is taken with more."
)
GATE_HELP = (
    "Apply the gate: bins outside are left out; T_n stays at its place. “Less data, faster” tells "
    "the gate, and takes it back."
)
T_N_HELP = "Apply T_n: bins before are noise to the tracking differentiator."


def capture_facts(answer: Answer, report: CaptureReport) -> list[Fact]:
    """Name, value and help of each number of a capture."""
    rows, cols = answer.capture.shape
    n_pulses = answer.capture.acquisition.n_pulses
    light, per = report.flux, f", in {report.flux_unit}, with 95 % interval."
    narrow = "–" if report.n_hot is None else None
    return [
        ("Pixels", f"{rows} × {cols}", "Rows and columns."),
        ("Pulses", "not known" if n_pulses is None else f"{n_pulses:,}", "Sent for each pixel."),
        ("Detections", f"{answer.capture.counts.mean():.4g}", "Mean of a pixel."),
        ("Signal (PPP)", interval(light.signal), f"Photons of the echo, mean of all pixels{per}"),
        ("Background", interval(light.background), f"Over the whole gate, mean of all pixels{per}"),
        ("SBR", interval(light.sbr), "Signal over background, with 95 % interval."),
        ("Hot pixels", narrow or f"{report.n_hot:,}", "More detections than all neighbours."),
        ("Dead pixels", narrow or f"{report.n_dead:,}", "Fewer detections than all neighbours."),
    ]


def light_told(report: CaptureReport) -> str:
    """How the light of a capture was found."""
    return f"Signal, background and SBR: {report.flux_method}; in {report.flux_unit}."


def gate_advice(report: CaptureReport, along: Scale) -> str:
    """The gate that is suggested, and why."""
    first, end = (f"{along.at(edge):.6g}" for edge in report.suggestion.gate)
    return f"Suggested gate, in {along.name}: {first} to {end}. {report.suggestion.why_gate}"


def t_n_advice(report: CaptureReport) -> str:
    """The T_n that is suggested, and why."""
    return f"Suggested T_n: {report.suggestion.t_n}. {report.suggestion.why_t_n}"


def accuracy_titles(found: Accuracy) -> tuple[str, str, str]:
    """Title of the accuracy's plot, and what its axes count."""
    if found.against == "truth":
        title, unit = "Accuracy against pulses taken", "Within 3 bins of the truth"
    else:
        title = "Agreement with all pulses: not accuracy"
        unit = "Within 3 bins of them"
    across = "Share of the pulses" if found.n_pulses is None else "Pulses"
    return title, across, unit
