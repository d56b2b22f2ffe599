"""What each method answers and how right it is: runs `core` for many methods, knows no widget."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.model.budget import ranging
from app.model.state import Comparison
from app.model.store import Answer, is_wrong
from core import ESTIMATORS, Capture, RangeImage, TrackingParameters, estimate, limits, metrics, run

Array = NDArray[Any]

TOLERANCES_BINS = (1, 2, 3)

FEWEST = 20
"""Pixels that a tenth of confidence needs to say something."""


@dataclass(frozen=True)
class Task:
    """A method to be run, and how."""

    method: str
    settings: Any
    false_alarm: float = 1.0


def tasks_of(chosen: Comparison, tracking: TrackingParameters) -> dict[str, Task]:
    """What is compared, in the order of the registry."""
    settings = {**chosen.settings, "tracking": tracking}
    return {
        method: Task(method, settings[method], chosen.false_alarm)
        for method in ESTIMATORS
        if method in chosen.methods
    }


@dataclass(frozen=True)
class Verdict:
    """How right an answer is, besides the figures of its `core.Run`."""

    within: tuple[metrics.Interval, ...]
    """Share of target pixels within each of `TOLERANCES_BINS`, with its 95 % Wilson interval;
    empty where there is no target."""
    detection: metrics.Detection | None
    """None where every pixel has a target."""
    told: Array
    """Mean confidence of each step that holds enough pixels."""
    right: Array
    """Share of those pixels within 3 bins; one without a target is wrong."""


@dataclass(frozen=True)
class Result:
    """A method's answer, and what it is worth where the truth is known."""

    answer: Answer
    verdict: Verdict | None


@dataclass(frozen=True)
class Yardstick:
    """What all methods are measured by, besides the truth."""

    limit: limits.Limit | None
    """What physics allows; None where truth, light or number of pulses is not known."""
    likelihood: RangeImage | None
    """What answers are compared with where there is no truth."""
    failed: str = ""
    """Why neither could be found, where that has failed."""


def run_task(task: Task, explored: Answer) -> Result:
    """Range the capture of an answer by another method, or take that answer if it is the same."""
    capture, request = explored.capture, explored.request
    if task == Task("tracking", request.tracking):
        answer = explored
    else:
        with ranging(capture, task.method, task.settings, task.false_alarm):
            ranked = run(capture, task.method, task.settings, task.false_alarm)
        answer = replace(explored, run=ranked)
    return Result(answer, judge(answer))


def judge(answer: Answer) -> Verdict | None:
    """Compare an answer with the truth; None without one."""
    capture, image = answer.capture, answer.run.image
    truth_m, bin_m = capture.truth_range_m, capture.acquisition.bin_length_m
    if truth_m is None:
        return None
    restored = [metrics.restored(image.range_m, truth_m, n * bin_m) for n in TOLERANCES_BINS]
    has_empty = bool(np.isnan(truth_m).any())
    return Verdict(
        tuple(metrics.wilson(hits, of) for hits, of in restored if of),
        metrics.precision_recall(image.valid, truth_m) if has_empty else None,
        *reliability(answer),
    )


def reliability(answer: Answer) -> tuple[Array, Array]:
    """Mean confidence and share right of the answers in each tenth of confidence."""
    image, wrong = answer.run.image, is_wrong(answer)
    if wrong is None:
        return np.empty(0), np.empty(0)
    told = metrics.reliability(image.confidence[image.valid], ~wrong[image.valid])
    enough = [each for each in told if each.count >= FEWEST]
    return np.array([each.confidence for each in enough]), np.array(
        [each.right.value for each in enough]
    )


def yardstick(capture: Capture) -> Yardstick:
    """Find what all methods of a capture are measured by."""
    known = (capture.truth_range_m, capture.signal, capture.background)
    has_limit = all(each is not None for each in known) and capture.acquisition.n_pulses is not None
    with ranging(capture, "likelihood"):
        return Yardstick(
            limits.limit(capture) if has_limit else None,
            estimate(capture, "likelihood") if capture.truth_range_m is None else None,
        )


def agreement(image: RangeImage, other: RangeImage, tolerance_bins: float = 3.0) -> float:
    """Share of pixels that both answer in which they agree; NaN where there is no such pixel."""
    both = image.valid & other.valid
    close = np.abs(image.bin - other.bin)[both] <= tolerance_bins
    return float(close.mean()) if close.size else float("nan")


def score_curves(
    capture: Capture, tasks: Mapping[str, Task], row: int, col: int
) -> dict[str, Array]:
    """Each method's score of each bin, from 0 at its median over the bins to 1 at its maximum.

    Methods that cannot say, or whose curve is flat, are left out.
    """
    curves = {}
    for method, task in tasks.items():
        score = ESTIMATORS[method].curves(capture, row, col, task.settings)
        middle, top = float(np.median(score)), float(np.max(score))
        if np.isfinite(top - middle) and top > middle:
            curves[method] = (score - middle) / (top - middle)
    return curves
