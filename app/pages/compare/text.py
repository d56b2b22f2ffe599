"""Texts of the Compare page: its table, captions and sentences, without markup."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from app.model.colors import Unseen
from app.model.methods import METHOD_TITLES
from app.model.store import Answer
from app.model.text import (
    COMPUTING,
    NOT_COMPUTED,
    TRUTH_HELP,
    Cell,
    Fact,
    cause,
    cell,
    estimate_text,
    number,
    percent_cell,
    reason,
    share,
    target,
)
from app.pages.compare.ranking import TOLERANCES_BINS, Reference, Result, Task, agreement
from app.units import count
from core import ESTIMATORS, Capture, limits, pixel_range_intervals
from core.inspection import CONFIDENT

Column = tuple[str, str, int]
"""Title, help, and sort order of the first click: 1 ascending, -1 descending."""

EXPLANATION = """
**Pictures.** All chosen methods use the same capture: the scene with its flux and seed, or the
file, that *Explore* shows. Pictures share one view and one colour scale: drag a box on any of them
to zoom, double-click to reset. A tap, or the arrow keys, choose the pixel whose *scores* are
plotted. A method's estimate is the maximum of its score minus the method's lag, which is calibrated
from the model.

**Confidence** is the same for all methods: the probability, from the exact likelihood, of a
surface within 3 bins of the estimate. *Confidence from* chooses whether the counts of the pixel
alone determine it, or those of the neighbouring pixels, too. In the *reliability diagram*, a line
on the diagonal means that nine of ten estimates with confidence 0.9 are correct. Pixels without a
target count as wrong.

**The oracle** is the likelihood with known signal and background. **The single-pixel limit** has
two parts: the probability that the oracle's likeliest delay is that of the echo, if depths are
uniform over the gate, and the smallest standard deviation of an unbiased estimate. Both assume a
background that is uniform over the gate; for a scene with another one, such as *fog*, neither is
shown. The probability is an approximation; below it stands its largest error found in simulations.
It does not bound other methods: the rule *window* is right within 3 bins slightly more often, and
those that use neighbouring pixels, or know where targets are, may do better. The shares of the
methods also have a sampling error, which is the interval below them.

**Reconstruction** marks a method whose original code was not available.
"""

FALSE_ALARM_HELP = (
    "Share of echo-free pixels for which a method may report a range. With lower values it reports "
    "one only where its score exceeds the level of noise. 1 reports all. Methods that add "
    "neighbouring pixels report more next to surfaces. Unmixing ignores it: its own τ_FA decides."
)

TABLE = "Methods and their figures; click a column's header to sort."

LIMIT_UNKNOWN = (
    "Not known: it requires the true range and flux of every pixel, with one surface at rest, "
    "which only simulated scenes have."
)


AGREEMENT_ONLY = (
    "This capture has no truth: the table shows agreement with the likelihood in target pixels of "
    f"which it is confident ({CONFIDENT:g} or more). That is not accuracy."
)

_TIME: Column = (
    "Time (ms)",
    "Time to estimate all pixels, without the estimate of the fluxes, which all methods share.",
    1,
)


def columns(capture: Capture) -> list[Column]:
    """Return the columns of the table; those that need the truth only if there is one."""
    method: Column = ("Method", "Estimators of core.ESTIMATORS.", 1)
    if capture.truth_range_m is None:
        agreement = (
            "Share of the pixels of which the likelihood is confident, within 3 bins of it: "
            "agreement, not accuracy."
        )
        return [
            method,
            ("Agreement, not accuracy", agreement, -1),
            ("Coverage", "Share of all pixels with an estimate.", -1),
            ("Mean confidence", "Mean over the estimates.", -1),
            _TIME,
        ]
    within = (
        (
            f"Within {n} bin{'s' if n > 1 else ''}",
            f"RD: share of target pixels within {n} bins of the truth; below, its 95 % interval.",
            -1,
        )
        for n in TOLERANCES_BINS
    )
    detection: list[Column] = []
    if np.isnan(capture.truth_range_m).any():
        detection = [
            ("Precision", "Share of pixels with an estimate that have a target.", -1),
            ("Recall", "Share of target pixels with an estimate.", -1),
        ]
    return [
        method,
        *within,
        ("RMSE (m)", "Root mean square error over target pixels with an estimate.", 1),
        ("MAE (m)", "Mean absolute error over target pixels with an estimate.", 1),
        ("Inlier RMSE (m)", "Root mean square error of estimates within 3 bins of the truth.", 1),
        ("Bias (m)", "Mean error over target pixels with an estimate; sorted by magnitude.", 1),
        ("Coverage", "Share of target pixels with an estimate.", -1),
        *detection,
        _TIME,
    ]


def rows(
    capture: Capture,
    tasks: Mapping[str, Task],
    results: Mapping[Task, Result | str],
    reference: Reference | None,
    styles: Mapping[str, tuple[str, list[int]]],
) -> list[dict[str, Any]]:
    """Return a row for each method, and the single-pixel limit below them."""
    rows = []
    for method, task in tasks.items():
        color, dash = styles[method]
        origin = ESTIMATORS[method].reconstructed
        row = {"name": ESTIMATORS[method].title, "color": color, "dash": dash, "cells": []}
        row["note"] = f"Reconstructed from {origin}" if origin else ""
        result = results.get(task)
        if isinstance(result, Result):
            row["cells"] = _cells(result, reference)
        else:
            row["message"] = result or NOT_COMPUTED
        rows.append(row)
    return [
        *rows,
        {
            "name": "Single-pixel limit",
            "note": f"For {limits.ASSUMES}; others may exceed it",
            "last": True,
            **_limit_row(capture, reference),
        },
    ]


def _cells(result: Result, reference: Reference | None) -> list[Cell]:
    run, accuracy = result.answer.run, result.accuracy
    time = cell(1e3 * run.estimate_s, "{:,.1f}")
    if accuracy is None:
        image, likelihood = run.image, reference and reference.likelihood
        agrees = agreement(image, likelihood) if likelihood else math.nan
        confidence = image.confidence[image.valid]
        mean = float(confidence.mean()) if confidence.size else math.nan
        return [*map(percent_cell, (agrees, float(image.valid.mean()), mean)), time]
    figures, detection = run.figures, accuracy.detection
    within = [
        percent_cell(each.value, f"{100 * each.low:.1f} to {100 * each.high:.1f}")
        for each in accuracy.within
    ] or [("–", None, "")] * len(TOLERANCES_BINS)
    bias = figures["bias_m"]
    return [
        *within,
        *(cell(figures[name]) for name in ("rmse_m", "mae_m", "inlier_rmse_m")),
        (number(bias, "", sign=True), abs(bias) if math.isfinite(bias) else None, ""),
        percent_cell(figures["coverage"]),
        *map(percent_cell, [] if detection is None else [detection.precision, detection.recall]),
        time,
    ]


def _limit_row(capture: Capture, reference: Reference | None) -> dict[str, Any]:
    if reference is None:
        return {"message": NOT_COMPUTED}
    if reference.limit is None:
        return {"message": reference.failure or LIMIT_UNKNOWN}
    right, spread = reference.limit.right_bin_probability, reference.limit.cramer_rao_m
    finite = spread[np.isfinite(spread)]
    floor = math.sqrt(float(np.mean(finite**2))) if finite.size else math.nan
    mean = float(np.nanmean(right)) if np.isfinite(right).any() else math.nan
    error = limits.approximation_error(mean, capture.acquisition.n_pulses or 1)
    below = f"off by at most {100 * error:g} percentage points" if math.isfinite(mean) else ""
    known = {
        "Within 3 bins": percent_cell(mean, below),
        "Inlier RMSE (m)": cell(floor, below="Cramér–Rao"),
    }
    return {"cells": [known.get(title, ("", None, "")) for title, *_ in columns(capture)[1:]]}


def pixel_facts(answer: Answer, reference: Reference | None, row: int, col: int) -> list[Fact]:
    """Return name, value and help of what is known of a pixel besides the estimates."""
    capture = answer.capture
    place = "row {}, col {}".format(*answer.grid.place(row, col))
    facts = [("Pixel", place, "Arrow keys on the pictures move it.")]
    if capture.truth_range_m is not None:
        facts.append(("Truth", target(float(capture.truth_range_m[row, col])), TRUTH_HELP))
    found = spread = "–" if reference is None else "not known"
    if reference is not None and reference.limit is not None:
        found = share(float(reference.limit.right_bin_probability[row, col]))
        spread = number(float(reference.limit.cramer_rao_m[row, col]), "m")
    return [
        *facts,
        (
            "Limit: found",
            found,
            "Approximate probability that the oracle's likeliest delay is that of this echo.",
        ),
        ("Limit: spread", spread, "Cramér–Rao bound: smallest possible standard deviation."),
        ("Detections", count(int(capture.counts[row, col])), "Counts in this pixel's histogram."),
    ]


def caption(answer: Answer, row: int, col: int) -> str:
    """Return a method's estimate of a pixel, for the line under its picture.

    The 95 % interval is that of a surface: only a confident estimate has one.
    """
    image, truth_m = answer.run.image, answer.capture.truth_range_m
    if not image.valid[row, col]:
        return "no estimate"
    confidence = float(image.confidence[row, col])
    (range_m,) = pixel_range_intervals(answer.capture, image, row, col, (0.95,))
    error = ""
    if truth_m is not None and math.isfinite(truth_m[row, col]):
        error_m = range_m.value - float(truth_m[row, col])
        error = f" ({number(error_m, '', sign=True, decimals=range_m.decimals)})"
    estimate = estimate_text(range_m, confidence, CONFIDENT)
    return f"{estimate}{error}, confidence {100 * confidence:.0f} %"


def progress(done: int, total: int, method: str | None, n_failed: int = 0) -> str:
    """Return the progress of the comparison.

    `method` is the one that is running; `n_failed` could not be used, for which the table says why.
    """
    if total == 0:
        return "Choose at least one method"
    if method is not None:
        return f"{done + 1} of {total}: {ESTIMATORS[method].title}"
    if done < total:
        return f"Stopped: {done} of {total} done"
    unusable = f", {n_failed} not usable here" if n_failed else ""
    return f"{total - n_failed} methods compared{unusable}"


def waiting(method: str, running: str | None) -> str:
    """Return why a method has no picture yet; `running` is the one that is running."""
    if running is None:
        return "Stopped. Press Resume to compute it."
    return COMPUTING if method == running else "Waiting for its turn."


def failure(error: Exception) -> str:
    """Return why a method has no estimate."""
    if isinstance(error, ValueError):
        return f"Not possible here: {cause(error)}"
    return f"Failed: {cause(error)}. To run the method again, deselect and select it."


def no_reference(error: Exception) -> str:
    """Return why the reference could not be computed."""
    return f"{reason(error)} The next capture will be tried again."


def legend(pictures: Mapping[str, Unseen], least_confidence: float) -> str:
    """Return how many pixels are blank, grey or hidden in the picture of each method."""
    reasons = (
        "Blank, without a value",
        f"Hidden below confidence {least_confidence:g}",
        "Grey, beyond the colour scale",
    )  # in the order of the fields of `Unseen`
    sentences = []
    for why, counts in zip(reasons, zip(*pictures.values(), strict=True), strict=False):
        listed = [
            f"{n:,} ({METHOD_TITLES[method]})"
            for method, n in zip(pictures, counts, strict=True)
            if n
        ]
        if listed:
            sentences.append(f"{why}: {', '.join(listed)}.")
    return " ".join(sentences)


def remarks(capture: Capture, working: Sequence[Task], n_pictures: int) -> str:
    """Return remarks on the comparison of the methods that work here; empty if there are none.

    Those on some of the methods begin with their names.
    """
    methods_of: dict[str, list[str]] = {}
    for task in working:
        remark = ESTIMATORS[task.method].remark(capture, task.false_alarm, task.settings)
        for clause in filter(None, remark.split("; ")):
            methods_of.setdefault(clause, []).append(METHOD_TITLES[task.method])
    remarks = [AGREEMENT_ONLY] if capture.truth_range_m is None else []
    for clause, methods in methods_of.items():
        named = "" if len(methods) == len(working) else f"{', '.join(methods)}: "
        sentence = f"{named}{clause}."
        remarks.append(f"{sentence[0].upper()}{sentence[1:]}")
    if n_pictures < len(working):
        remarks.append(
            f"Pictures show the first {n_pictures} methods; plots and table show all "
            f"{len(working)}."
        )
    return " ".join(remarks)
