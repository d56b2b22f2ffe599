"""Texts of the Inspect page: facts, table rows and sentences, without markup."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from app.model.large import Grid
from app.model.methods import method_title
from app.model.state import Viewing
from app.model.store import Answer, Pixel
from app.model.text import (
    CONFIDENCE_HELP,
    PER_PIXEL,
    PER_PULSE,
    WIDTH_GUESSED,
    Cell,
    Fact,
    cell,
    estimate_facts,
    estimate_text,
    milliseconds,
    number,
    percent_cell,
    pixel_name,
    share,
)
from app.pages.inspect.results import Inspected, Pair
from app.units import (
    OPPOSITE_UNIT,
    Quantity,
    Scale,
    between,
    count,
    noted,
    scale,
)
from app.units import interval as format_interval
from core import Acquisition, Capture, pixel_range_intervals
from core.inspection import (
    CONFIDENT,
    Candidate,
    CaptureReport,
    FaultyPixel,
    FluxEstimate,
    LineProfile,
    PixelReport,
    reported_check,
)
from core.io import changed_settings
from core.metrics import Interval
from core.typesetting import probability_text, typeset, value_and_bounds

EXPLANATION = """
**Choose.** Tap the map, use the arrow keys (with Shift: eight pixels), or type a row and a column.
With *Rectangle* or *Lasso*, drag on the map to select a region; its histograms are summed and shown
as one. With *Zoom*, drag to enlarge; the wheel zooms as well, and a double tap shows the whole map.

**Compare.** *Pin this pixel*, or the key P, keeps up to four pixels. *Pins* shows their distances,
*Profile* the ranges along the line that joins them. With *Line*, drag on the map to draw that
line: its ends, and up to two bends, become the pinned pixels. *A/B* keeps an estimate and subtracts
it from later ones.

**Crop.** *Crop the cloud* limits the 3D cloud of Explore and its files to the region, to ranges, or
to both.

**Judge.** Candidates are the peaks of the estimator's score. Each has the probability of a surface
within 3 bins of it, which does not depend on the estimator. S, B and SBR are estimated from the
counts alone, with 95 % intervals. *Fit* compares the counts with those that the model expects; the
map *Goodness of fit* shows where it fails.
"""

MAP_HELP = (
    "Quantity shown on the map. Peak: largest count of a pixel. Fired: share of pulses with a "
    "detection. SBR: estimated from the counts. Goodness of fit: p-value, below 0.05 in 5 % of the "
    "pixels where the model holds. Returns: number found in each pixel without its neighbours; 1 % "
    "of the pixels with one surface show a second by chance. Reported: distance that the sensor "
    "found."
)
MODE_HELP = (
    "What dragging on the map does: zoom, select a region by a rectangle or a lasso, or draw the "
    "line of a profile. A tap always selects a pixel."
)
PLOT_HELP = (
    "Plot below the histogram: the estimator's score or its stages, the rate corrected for "
    "pile-up, the residuals of the counts from those that the model expects, or the probability "
    "of the surface from the pixel, from its neighbours, and from both."
)
NO_EVIDENCE = (
    "Neighbours are shown for a single pixel, if Confidence from (under Method) is the image and "
    "neighbouring pixels agree. Here the score is shown."
)
SUBJECT_HELP = (
    "What to inspect: one pixel, the region, the pinned pixels, the line that joins them, or the "
    "whole capture."
)
PIN_HELP = "Pin this pixel: keep it for comparison (key P on the map)."
SELECT_HELP = "Select region: all pixels in these rows and columns."
CLEAR_HELP = "Clear region: remove the selected region."
NO_PINS = "No pixels are pinned. Select a pixel and press “Pin this pixel”, or P on the map."
NO_PROFILE = (
    "Choose “Line” above the map and drag on the map: the profile runs along the line that you "
    "draw. It also runs along the line that joins two or more pinned pixels."
)
NO_RANGES = "No estimate on the line is confident enough to be shown. Lower “Show from confidence”."
NO_REGION = (
    "No region is selected. Drag a rectangle or a lasso on the map, or type rows and columns such "
    "as 10-20."
)

NO_A = (
    "Keep the estimate on screen as A. Then choose another method, other settings or another "
    "capture: that is B."
)
KEEP_HELP = "Keep as A: the estimate on screen, to compare it with later ones."
FORGET_HELP = "Forget A."
DIFFERENCE_TITLE = "B minus A"

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
    along = scale(unit, answer.gate)
    has_truth = answer.capture.truth_range_m is not None
    facts = [
        *estimate_facts(pixel, along, has_truth),
        *_reported_facts(answer, pixel),
        *_velocity_facts(answer, pixel),
        ("Pixel", place, "Row and column."),
    ]
    counts, help = count(pixel.counts), "Counts in the histogram of this pixel"
    if answer.capture.gated_pulses is not None:
        counts = count(pixel.counts, share(pixel.counts / answer.capture.gated_pulses))
        help += ", and as a share of the pulses"
    return [*facts, ("Detections", counts, f"{help}."), *_flux(found.report)]


def _reported_facts(answer: Answer, pixel: Pixel) -> list[Fact]:
    """Return the range that the instrument reported of a pixel, compared with the estimate."""
    if answer.capture.reported_range_m is None:
        return []
    reported_m = float(answer.capture.reported_range_m[pixel.row, pixel.col])
    decimals = pixel.interval_95_m.decimals
    difference = number(pixel.range_m - reported_m, "m", sign=True, decimals=decimals)
    return [
        ("Reported", number(reported_m, "m", decimals=decimals), "Distance that the sensor found."),
        ("Estimate − reported", difference, "Estimate minus the distance that the sensor found."),
    ]


def _velocity_facts(answer: Answer, pixel: Pixel) -> list[Fact]:
    """Return the radial velocity of a pixel with its interval, of methods that estimate it."""
    velocity, row, col = answer.run.image.velocity, pixel.row, pixel.col
    if velocity is None or not answer.run.image.valid[row, col]:
        return []
    help = "Radial velocity with its 95 % interval; positive if the surface recedes."
    return [("Velocity", velocity.text_at(row, col).replace("-", "−"), help)]


def _region_facts(found: Inspected, unit: str) -> list[Fact]:
    region, along = found.region, scale(unit, found.answer.gate)
    assert region is not None
    spread = "Half the central 68 % range of the estimates, which is one standard deviation."
    median_m, half_m = region.median_m, region.spread_m
    decimals = Interval(median_m, median_m - half_m, median_m + half_m).decimals
    return [
        *estimate_facts(found.pixel, along, has_truth=False),
        ("Pixels", count(region.n_pixels), "Pixels whose centre lies in the region."),
        (
            "Median range",
            number(median_m, "m", decimals=decimals),
            "Median of the estimates of its pixels.",
        ),
        ("Spread", number(half_m, "m", decimals=decimals), spread),
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


def estimate_name(answer: Answer) -> str:
    """Return scene or capture, method, and all that differs from its default."""
    request = answer.request
    light = (request.illumination,) if request.source.is_scene else ()
    names = [request.source.title, method_title(answer.method)]
    for settings in (*light, request.reduction, answer.settings):
        names += changed_settings(settings)
    return ", ".join(names)


def pair_doubts(of_a: str, of_b: str, elsewhere: str) -> str:
    """Return doubts about the confidences of A and B, except one that is stated elsewhere."""
    if of_a == of_b:
        return "" if of_a == elsewhere else of_a
    named = {"A": of_a, "B": of_b}
    return " ".join(f"{name}: {why}" for name, why in named.items() if why not in ("", elsewhere))


def difference_legend(pair: Pair) -> str:
    """Return why pixels of the difference of two estimates are blank."""
    n_blank = int(np.isnan(pair.difference_m).sum())
    return f"Blank: {n_blank:,} pixels that A, B or both do not show." if n_blank else ""


def pair_facts(pair: Pair) -> list[Fact]:
    """Return name, value and help of each number of two estimates."""
    (in_a, in_b), known = pair.shown, pair.difference_m[np.isfinite(pair.difference_m)]
    facts: list[Fact] = [
        ("In both", count(known.size), "Pixels that both show."),
        ("Only in A", count(int((in_a & ~in_b).sum())), "Pixels that only A shows."),
        ("Only in B", count(int((in_b & ~in_a).sum())), "Pixels that only B shows."),
    ]
    if known.size:
        median_m, rms_m = float(np.median(known)), float(np.sqrt(np.mean(known**2)))
        facts += [
            ("Median B − A", number(median_m, "m", sign=True), "Over pixels in both."),
            ("RMS of B − A", number(rms_m, "m"), "Root mean square over pixels in both."),
        ]
        for n in (1, 3):
            within = pair.within(n)
            ends = f"{share(within.low)} to {share(within.high)}"
            name = f"Within {n} bin{'s' * (n > 1)}"
            facts.append((name, share(within.value), f"Share of these; 95 % interval {ends}."))
    for name, answer in (("A", pair.a), ("B", pair.b)):
        if answer.run.figures:
            rmse = number(answer.run.figures["rmse_m"], "m")
            facts.append((f"RMSE of {name}", rmse, "Over target pixels with an estimate."))
        time = milliseconds(answer.run.estimate_s)
        facts.append((f"Time of {name}", time, "Time to estimate all pixels."))
    return facts


def pair_pixel_facts(pair: Pair, row: int, col: int, least_confidence: float) -> list[Fact]:
    """Return name, value and help of each number of one pixel of two estimates."""
    here_m, texts = [], []
    for each in (pair.a, pair.b):
        (range_m,) = pixel_range_intervals(each.capture, each.run.image, row, col, (0.95,))
        confidence = float(each.run.image.confidence[row, col])
        here_m.append(range_m)
        texts.append(estimate_text(range_m, confidence, least_confidence))
    a_m, b_m = here_m
    coarser = min((each.decimals for each in here_m if each.decimals is not None), default=None)
    difference = number(b_m.value - a_m.value, "m", sign=True, decimals=coarser)
    return [
        ("Pixel", pixel_name((row, col), pair.b.grid), "Row and column."),
        ("A here", texts[0], "Estimate of A; with its 95 % interval if it is shown."),
        ("B here", texts[1], "Estimate of B; with its 95 % interval if it is shown."),
        ("B − A here", difference, "Difference of the two."),
    ]


def remark(found: Inspected) -> str:
    """Return the sentence below the facts of a pixel or a region."""
    if found.region is None:
        verdict = found.report.verdict
        return f"Verdict: {verdict.health}. {verdict.why}{_several(found.report)}"
    return (
        f"{found.region.fit.verdict}{_several(found.region.pixel)} The plots show the summed "
        f"histogram of the region. Mean flux of a pixel: {found.region.flux_method}."
    )


def _several(report: PixelReport) -> str:
    """Return where the surfaces are if there are several, and what that means for the fluxes."""
    if len(report.surfaces_bin) < 2:
        return ""
    others = "S is that of one, and B is without the echoes of the others."
    if report.may_be_one_echo:
        others += " Probabilities in the table assume the pulse, which the echoes do not have."
    return f" {report.surfaces_text}. {others}"


def fit_explanation(p_value: float) -> str:
    """Return how to read the fit, with the p-value of a pixel if it is known."""
    p_text = probability_text(p_value)
    known = "" if math.isnan(p_value) else f" Goodness of fit of the pixel: p-value {p_text}."
    return (
        "Expected: one echo over the background, with range and flux from the posterior. If that "
        f"holds, 95 % of the counts are within the band and of the residuals within ±2.{known}"
    )


def with_95(along: Scale) -> str:
    """Return the title of a column of positions with their intervals."""
    return f"{along.title}, ± 95 %"


def candidate_columns(along: Scale) -> list[Sequence[Any]]:
    """Return title, help and sort order of the candidates' columns."""
    return [
        ("Rank", "Rank by score.", 1),
        (with_95(along), "Position along the gate with its 95 % interval, the lag removed.", 1),
        ("Score", "The estimator's score; below, relative to the best.", -1),
        ("Probability", "Probability of a surface within 3 bins.", -1),
    ]


def candidate_rows(
    candidates: Sequence[Candidate], acquisition: Acquisition, along: Scale, other: Scale
) -> list[Any]:
    """Return a row for each candidate, best first."""
    return [
        {
            "name": str(n + 1),
            "cells": [
                _position_cell(
                    Interval(each.range_m, each.range_low_m, each.range_high_m),
                    acquisition,
                    along,
                    other,
                ),
                cell(each.score, below=share(each.relative)),
                percent_cell(each.probability),
            ],
        }
        for n, each in enumerate(candidates)
    ]


def _position_cell(range_m: Interval, acquisition: Acquisition, along: Scale, other: Scale) -> Cell:
    """Return a range with its 95 % interval in two units."""
    ends = (range_m.value, range_m.low, range_m.high)
    found = Interval(*acquisition.range_m_to_bin(ends).tolist())
    return along.number_with_margin(found), found.value, other.place_with_margin(found)


def both_scales(unit: str, answer: Answer) -> tuple[Scale, Scale]:
    """Return the chosen unit along the gate, and the unit shown below it."""
    return scale(unit, answer.gate), scale(OPPOSITE_UNIT[unit], answer.gate)


def pin_columns(along: Scale) -> list[Sequence[Any]]:
    """Return title, help and sort order of the pins' columns."""
    return [
        ("Pixel", "Row and column.", 1),
        (with_95(along), "The estimate along the gate with its 95 % interval.", 1),
        ("Confidence", CONFIDENCE_HELP, -1),
        ("SBR", "Signal divided by background; below, its 95 % interval.", -1),
        ("Verdict", "Whether the pixel is hot or dead.", 1),
    ]


def pin_row(
    found: Inspected, color: str, along: Scale, other: Scale, least_confidence: float
) -> dict[str, Any]:
    """Return the row of a pinned pixel, without a place if its confidence is below the least."""
    pixel, report = found.pixel, found.report
    sbr = report.flux.sbr
    acquisition = found.answer.capture.acquisition
    position = _position_cell(pixel.interval_95_m, acquisition, along, other)
    if math.isnan(pixel.range_m):
        position = ("–", None, "no estimate")
    elif pixel.confidence < least_confidence:
        position = ("–", None, "not reliable")
    return {
        "name": pixel_name((pixel.row, pixel.col), found.answer.grid),
        "color": color,
        "dash": [],
        "cells": [
            position,
            percent_cell(pixel.confidence),
            _sbr_cell(sbr),
            (report.verdict.health, report.verdict.health, ""),
        ],
    }


def _sbr_cell(sbr: Interval) -> Cell:
    """Return an SBR and its interval, or its lower bound where no background was detected."""
    if math.isinf(sbr.value):
        return interval(sbr), sbr.low if math.isfinite(sbr.low) else None, ""
    known = sbr.value if math.isfinite(sbr.value) else None
    value, ends = value_and_bounds(sbr.value, sbr.low, sbr.high)
    return value, known, ends


def range_text(range_m: float, low_m: float, high_m: float) -> str:
    """Format a range and its interval with the digits that the interval supports."""
    decimals = Interval(range_m, low_m, high_m).decimals
    return f"{number(range_m, 'm', decimals=decimals)} ({between(low_m, high_m, 'm')})"


def profile_sentence(answer: Answer, profile: LineProfile, viewing: Viewing) -> str:
    """Return where a profile runs, how much of it is hidden, and what its lengths rest on."""
    row, col, n_pixels = profile.row.tolist(), profile.col.tolist(), profile.row.size
    first, last = (pixel_name((row[end], col[end]), answer.grid) for end in (0, -1))
    n_hidden = int(np.isnan(profile.range_m).sum())
    line = f"{n_pixels:,} pixels from {first} to {last}"
    if n_hidden == n_pixels:
        return f"{line}. {NO_RANGES}"
    length_m = number(float(profile.distance_m[-1]), "m")
    line += f", {length_m} across the line of sight at a depth of {number(profile.depth_m, 'm')}."
    if n_hidden:
        line += f" {n_hidden:,} without a range, or hidden."
    return f"{line} {WIDTH_GUESSED}" if answer.is_width_guessed(viewing) else line


# Hot and dead pixels

FAULTY = "Hot and dead pixels"
MOST_LISTED = 10
"""Pixels of each kind that are listed."""

FAULTY_COLUMNS: list[Sequence[Any]] = [
    ("Pixel", "Row and column.", 1),
    ("Fault", "Hot: more detections than all neighbours, and not in an echo; dead: fewer.", 1),
    ("Counts", "Detections; below, those of its eight neighbours.", -1),
]


def listed(faulty: Sequence[FaultyPixel]) -> list[FaultyPixel]:
    """Return the first pixels of each kind."""
    return [
        each
        for health in ("hot", "dead")
        for each in [one for one in faulty if one.health == health][:MOST_LISTED]
    ]


def faulty_sentence(faulty: Sequence[FaultyPixel], n_listed: int) -> str:
    """Return how many pixels are hot or dead, and how many of them are listed."""
    if not faulty:
        return "No pixel differs significantly from all its neighbours."
    n_hot = sum(each.health == "hot" for each in faulty)
    n_dead = len(faulty) - n_hot
    sentence = f"{n_hot:,} hot (circles on the map), {n_dead:,} dead (crosses)."
    if n_listed == len(faulty):
        return sentence
    more = f"{len(faulty) - n_listed:,} more are only marked."
    return f"{sentence} Listed are up to {MOST_LISTED} of each that differ most; {more}"


def faulty_row(pixel: FaultyPixel, grid: Grid) -> dict[str, Any]:
    """Return the row of a hot or dead pixel, with a button that shows it."""
    neighbours = f"{pixel.neighbours_least:,} to {pixel.neighbours_most:,}"
    return {
        "key": [pixel.row, pixel.col],
        "name": pixel_name((pixel.row, pixel.col), grid),
        "action": "Show",
        "cells": [
            (pixel.health, pixel.health, ""),
            (f"{pixel.counts:,}", pixel.counts, neighbours),
        ],
    }


# The capture as a whole

GATE_HELP = (
    "Apply the gate: bins outside it are cut, and T_n moves with it. “Data reduction” undoes it."
)
T_N_HELP = "Apply T_n: the tracking differentiator ignores the bins before it."


def capture_facts(answer: Answer, report: CaptureReport) -> list[Fact]:
    """Return name, value and help of each number of a capture."""
    rows, cols = answer.capture.shape
    n_pulses = answer.capture.acquisition.n_pulses
    image, target = report.flux, report.target_flux
    per = f"in {report.flux_unit}, with 95 % interval."
    signal = PER_PIXEL if n_pulses is None else PER_PULSE
    of_targets = "Mean of the target pixels, those with an echo"
    all_pixels = "Mean of all pixels but hot and dead ones"
    of_all = f"{all_pixels}; those without an echo have no signal"
    hot, dead = ("–" if n is None else count(n) for n in (report.n_hot, report.n_dead))
    return [
        ("Pixels", f"{rows} × {cols}", "Rows and columns."),
        ("Pulses", "not known" if n_pulses is None else count(n_pulses), "Pulses per pixel."),
        ("Detections", number(float(answer.capture.counts.mean()), ""), "Mean of a pixel."),
        (f"{signal}, target pixels", interval(target.signal), f"{of_targets}: signal flux {per}"),
        ("SBR, target pixels", interval(target.sbr), f"{of_targets}: signal over background."),
        (f"{signal}, all pixels", interval(image.signal), f"{of_all}: signal flux {per}"),
        ("SBR, all pixels", interval(image.sbr), f"{of_all}: signal over background."),
        ("Background", interval(image.background), f"{all_pixels}, over the gate, {per}"),
        *_stated_facts(report),
        *_reported_check_facts(answer),
        ("Hot pixels", hot, "Pixels with more detections than all neighbours, and not in an echo."),
        ("Dead pixels", dead, "Pixels with fewer detections than all neighbours."),
    ]


def _stated_facts(report: CaptureReport) -> list[Fact]:
    """Return what the file states, with the difference of the estimate, in percent."""
    titles = {"signal": "Signal, stated", "background": "Background, stated", "sbr": "SBR, stated"}
    facts: list[Fact] = []
    for each in report.stated:
        change = 100 * each.difference / each.stated if each.stated else math.nan
        note = f"estimate {typeset(f'{change:+.1f}')} %" if math.isfinite(change) else ""
        of = f"in {each.unit} per pixel" if each.unit else "signal over background"
        estimate = interval(each.estimate)
        help = f"Stated by the file, {of}. The estimate of the mean of all pixels is {estimate}."
        facts.append((titles[each.name], noted(each.stated, note), help))
    return facts


def _reported_check_facts(answer: Answer) -> list[Fact]:
    """Return how confident estimates differ from the ranges that the instrument reported."""
    found = reported_check(answer.capture, answer.run.image)
    if found is None:
        return []
    low_m, high_m = found.median_m - found.spread_m, found.median_m + found.spread_m
    decimals = Interval(found.median_m, low_m, high_m).decimals
    median = number(found.median_m, "m", sign=True, decimals=decimals)
    of_pixels = (
        f"over the {found.n_pixels:,} pixels with both, of which the estimate by "
        f"{method_title(answer.method)} has a confidence of {CONFIDENT:g} or more."
    )
    help = f"Estimate minus the distance that the sensor found, median {of_pixels}"
    spread = f"Half the central 68 % range of this difference {of_pixels}"
    return [
        ("Estimate − reported", median, help),
        ("Spread of it", number(found.spread_m, "m", decimals=decimals), spread),
    ]


def flux_sentence(report: CaptureReport) -> str:
    """Return how the fluxes of a capture were estimated, and how far they can be trusted."""
    method = f"Signal, background and SBR: {report.flux_method}; in {report.flux_unit}."
    return f"{method} {report.flux_remark}"


def advice(report: CaptureReport, along: Scale) -> tuple[str, str]:
    """Return the suggested gate and the suggested T_n, each with the reason."""
    suggestion = report.suggestion
    first, end = (f"{along.at(edge):.6g}" for edge in suggestion.gate)
    return (
        f"Suggested gate, in {along.name}: {first} to {end}. {suggestion.why_gate}",
        f"Suggested T_n, in {along.name}: {along.at(suggestion.t_n):.6g}. {suggestion.why_t_n}",
    )


def accuracy_titles(capture: Capture) -> tuple[str, str, str]:
    """Return title and axis labels of the plot of accuracy against pulses."""
    across = "Share of the pulses" if capture.acquisition.n_pulses is None else "Pulses"
    if capture.truth_range_m is not None:
        return "Accuracy against number of pulses", across, "Within 3 bins of the truth"
    within = f"Within 3 bins, confidence {CONFIDENT:g} or more"
    return "Agreement with all pulses, not accuracy", across, within
