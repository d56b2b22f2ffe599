"""What the Compare page says: its table, captions and sentences, as plain text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from app.model.store import Answer
from app.model.text import NOT_COMPUTED, Fact, cause, number, reason, share
from app.pages.compare.ranking import TOLERANCES_BINS, Result, Task, Yardstick, agreement
from core import ESTIMATORS, Capture

Column = tuple[str, str, int]
"""Title, line of help, and which end a first click brings to the top: 1 the least, -1 the most."""

Cell = tuple[str, float | None, str]
"""Text, the value to sort by, and a smaller second line."""

EXPLANATION = """
**Side by side.** Every picked method ranges the same capture: the scene, light and seed, or the
file, that *Explore* shows. Pictures share one view and one colour scale: zoom by dragging a box
over any of them, double click for all of it. A tap, or the arrow keys, choose the pixel whose
*score curves* are drawn: what each method makes of each bin. Its answer is where its curve is
highest, less its own lag, which is known from the model.

**Confidence** is the same for all: the probability, by the exact first-photon likelihood, that a
surface lies within 3 bins of the answer. Where a line of the *reliability diagram* lies on the
dashed one, nine in ten of the answers told 0.9 are right. A pixel without a target counts as wrong.

**The oracle** is the likelihood told the true light. **Physics' limit** is what no method can beat
that looks at single pixels: the probability of finding the echo at all, and the least spread around
it. Methods that look at neighbours may do better.

**Reconstruction** marks a method whose original was not available.
"""

LIMIT_UNKNOWN = (
    "Not known here: it takes the true range and light of every pixel, which only a simulated "
    "scene tells."
)

RELIABILITY_UNKNOWN = "Reliability needs a known truth: this capture has none."

AGREEMENT_ONLY = (
    "This capture has no known truth: the table tells how far methods agree with the likelihood. "
    "That is agreement, not accuracy."
)

_TIME: Column = (
    "Time (ms)",
    "To range every pixel. What all methods share, the estimate of the light, is made once and not "
    "counted.",
    1,
)


def columns(capture: Capture) -> list[Column]:
    """Columns of the table; those that need a truth only where there is one."""
    method: Column = ("Method", "Estimators of core.ESTIMATORS.", 1)
    if capture.truth_range_m is None:
        agrees = "Share of pixels within 3 bins of the likelihood: agreement, not accuracy."
        return [
            method,
            ("Agreement, not accuracy", agrees, -1),
            ("Answered", "Share of all pixels with an answer.", -1),
            ("Mean confidence", "Of the answers.", -1),
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
    found: list[Column] = []
    if np.isnan(capture.truth_range_m).any():
        found = [
            ("Precision", "Share of answered pixels that have a target.", -1),
            ("Recall", "Share of target pixels that are answered.", -1),
        ]
    return [
        method,
        *within,
        ("RMSE (m)", "Root mean square error over answered target pixels.", 1),
        ("MAE (m)", "Mean absolute error over answered target pixels.", 1),
        ("Inlier RMSE (m)", "Root mean square error of those within 3 bins of the truth.", 1),
        ("Bias (m)", "Mean error over answered target pixels; sorted by its size.", 1),
        ("Answered", "Share of target pixels with an answer.", -1),
        *found,
        _TIME,
    ]


def rows(
    capture: Capture,
    tasks: Mapping[str, Task],
    results: Mapping[Task, Result | str],
    measure: Yardstick | None,
    styles: Mapping[str, tuple[str, list[int]]],
) -> list[dict[str, Any]]:
    """Rows of the table: a method each, and physics' limit below."""
    found = []
    for method, task in tasks.items():
        color, dash = styles[method]
        origin = ESTIMATORS[method].reconstructed
        row = {"name": ESTIMATORS[method].title, "color": color, "dash": dash, "cells": []}
        row["note"] = f"Reconstructed from {origin}" if origin else ""
        result = results.get(task)
        if isinstance(result, Result):
            row["cells"] = _cells(result, measure)
        else:
            row["message"] = result or NOT_COMPUTED
        found.append(row)
    return [*found, {"name": "Physics’ limit", "last": True, **_limit_row(capture, measure)}]


def _cells(result: Result, measure: Yardstick | None) -> list[Cell]:
    run, verdict = result.answer.run, result.verdict
    milliseconds = 1e3 * run.estimate_s
    time: Cell = (f"{milliseconds:,.1f}", milliseconds, "")
    if verdict is None:
        image = run.image
        likelihood = measure and measure.likelihood
        agrees = agreement(image, likelihood) if likelihood else math.nan
        sure = image.confidence[image.valid]
        shares = (agrees, float(image.valid.mean()), float(sure.mean()) if sure.size else math.nan)
        return [*map(_percent, shares), time]
    figures = run.figures
    within: list[Cell] = [
        (share(each.value), each.value, f"{100 * each.low:.1f}–{100 * each.high:.1f}")
        for each in verdict.within
    ] or [("–", None, "")] * len(TOLERANCES_BINS)
    detection = verdict.detection
    told = [] if detection is None else [detection.precision, detection.recall]
    return [
        *within,
        *(_metres(figures[name]) for name in ("rmse_m", "mae_m", "inlier_rmse_m")),
        _bias(figures["bias_m"]),
        _percent(figures["coverage"]),
        *map(_percent, told),
        time,
    ]


def _limit_row(capture: Capture, measure: Yardstick | None) -> dict[str, Any]:
    if measure is None:
        return {"message": NOT_COMPUTED}
    if measure.limit is None:
        return {"message": measure.failed or LIMIT_UNKNOWN}
    right, spread = measure.limit.right_bin_probability, measure.limit.cramer_rao_m
    finite = spread[np.isfinite(spread)]
    floor = math.sqrt(float(np.mean(finite**2))) if finite.size else math.nan
    mean = float(np.nanmean(right)) if np.isfinite(right).any() else math.nan
    known = {
        "Within 3 bins": (share(mean), mean, "mean probability"),
        "Inlier RMSE (m)": (number(floor, ""), floor, "Cramér–Rao"),
    }
    return {"cells": [known.get(title, ("", None, "")) for title, *_ in columns(capture)[1:]]}


def pixel_facts(answer: Answer, measure: Yardstick | None, row: int, col: int) -> list[Fact]:
    """Name, value and help of what is known of a pixel besides the answers."""
    capture = answer.capture
    place = "row {}, col {}".format(*answer.grid.place(row, col))
    facts = [("Pixel", place, "Arrow keys on the pictures move it.")]
    if capture.truth_range_m is not None:
        truth_m = float(capture.truth_range_m[row, col])
        has_target = math.isfinite(truth_m)
        truth = number(truth_m, "m") if has_target else "no target"
        facts.append(("Truth", truth, "Where the surface is."))
    found = spread = "–" if measure is None else "not known"
    if measure is not None and measure.limit is not None:
        found = share(float(measure.limit.right_bin_probability[row, col]))
        spread = number(float(measure.limit.cramer_rao_m[row, col]), "m")
    return [
        *facts,
        ("Limit: found", found, "Probability of finding this echo that no method can beat."),
        ("Limit: spread", spread, "Cramér–Rao: least standard deviation around the echo."),
        ("Detections", f"{int(capture.counts[row, col]):,}", "Counts in this pixel's histogram."),
    ]


def caption(answer: Answer, row: int, col: int) -> str:
    """A method's answer for a pixel, as a line under its picture."""
    image, truth_m = answer.run.image, answer.capture.truth_range_m
    if not image.valid[row, col]:
        return "no answer"
    range_m, sure = float(image.range_m[row, col]), float(image.confidence[row, col])
    off = ""
    if truth_m is not None and math.isfinite(truth_m[row, col]):
        off = f" ({range_m - float(truth_m[row, col]):+.2f})"
    return f"{range_m:,.2f} m{off}, {100 * sure:.0f} % sure"


def progress(done: int, total: int, method: str | None) -> str:
    """Where the comparison stands; `method` is the one under way."""
    if total == 0:
        return "Pick at least one method"
    if method is not None:
        return f"{done + 1} of {total}: {ESTIMATORS[method].title}"
    return f"{total} methods compared" if done == total else f"Stopped: {done} of {total} done"


def problem(error: Exception) -> str:
    """Why a method has no answer."""
    if isinstance(error, ValueError):
        return f"Not possible here: {cause(error)}"
    return f"Failed: {cause(error)}. To try again, pick the method anew."


def no_yardstick(error: Exception) -> str:
    """Why it is not known what all methods are measured by."""
    return f"{reason(error)} It is tried anew with the next capture."


def remarks(capture: Capture, answered: int, pictured: int) -> str:
    """What is to be said besides the pictures; empty for nothing."""
    told = [AGREEMENT_ONLY] if capture.truth_range_m is None else []
    told += sorted(
        {f"{each.remark(capture).capitalize()}." for each in ESTIMATORS.values()} - {"."}
    )
    if pictured < answered:
        told.append(f"Pictures of the first {pictured}; curves and table have all {answered}.")
    return " ".join(told)


def _percent(value: float) -> Cell:
    return share(value), value if math.isfinite(value) else None, ""


def _metres(value: float) -> Cell:
    return number(value, ""), value if math.isfinite(value) else None, ""


def _bias(value: float) -> Cell:
    return number(value, "", sign=True), abs(value) if math.isfinite(value) else None, ""
