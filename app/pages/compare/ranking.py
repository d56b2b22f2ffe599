"""Results of several methods and their accuracy, computed by `core`, without widgets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.model.budget import ranging
from app.model.state import Comparison
from app.model.store import Answer, Request, is_wrong, judged
from core import ESTIMATORS, Capture, RangeImage, estimate, limits, metrics, run
from core.estimators import JUDGES, Judge
from core.inference import fit_of
from core.inspection import CONFIDENT

Array = NDArray[Any]

TOLERANCES_BINS = (1, 2, 3)

MIN_PIXELS = 20
"""Pixels that a tenth of confidence needs to be drawn."""


@dataclass(frozen=True)
class Task:
    """A method to run, its settings, and what determines its confidence."""

    method: str
    settings: Any
    false_alarm: float = 1.0
    judged_by: Judge = JUDGES[0]


def tasks_of(chosen: Comparison, request: Request) -> dict[str, Task]:
    """Return the chosen methods with the settings of a request, in the order of the registry."""
    return {
        method: Task(method, request.settings_of(method), chosen.false_alarm, request.judged_by)
        for method in ESTIMATORS
        if method in chosen.methods
    }


@dataclass(frozen=True)
class Accuracy:
    """The accuracy of an estimate, besides the figures of its `core.Run`."""

    within: tuple[metrics.Interval, ...]
    """Share of target pixels within each of `TOLERANCES_BINS`, with its 95 % Wilson interval;
    empty without targets."""
    detection: metrics.DetectionRates | None
    """None where every pixel has a target."""
    confidence: Array
    """Mean confidence of each tenth with enough pixels."""
    correct: Array
    """Share of those pixels within 3 bins; pixels without a target are wrong."""


@dataclass(frozen=True)
class Result:
    """A method's estimate, and its accuracy where the truth is known."""

    answer: Answer
    accuracy: Accuracy | None


@dataclass(frozen=True)
class Reference:
    """Reference that methods are compared with, besides the truth."""

    limit: limits.Limit | None
    """The single-pixel limit; None where truth, flux or number of pulses is not known."""
    likelihood: RangeImage | None
    """The likelihood's confident estimates, for captures without truth."""
    failure: str = ""
    """Why neither could be computed."""


def run_task(task: Task, explored: Answer) -> Result:
    """Run a method on the capture of an estimate, or take that estimate if it is the same."""
    capture = explored.capture
    if task == Task(explored.method, explored.settings, judged_by=explored.request.judged_by):
        answer = explored
    else:
        with ranging(capture, task.method, task.settings, task.false_alarm):
            ran = run(capture, task.method, task.settings, task.false_alarm)
        answer = replace(explored, run=judged(ran, task.judged_by))
    fit_of(capture)  # stated by the remarks
    return Result(answer, accuracy_of(answer))


def accuracy_of(answer: Answer) -> Accuracy | None:
    """Compare an estimate with the truth; None without one."""
    capture, image = answer.capture, answer.run.image
    truth_m, bin_m = capture.truth_range_m, capture.acquisition.bin_length_m
    if truth_m is None:
        return None
    restored = [metrics.restored(image.range_m, truth_m, n * bin_m) for n in TOLERANCES_BINS]
    has_empty = bool(np.isnan(truth_m).any())
    return Accuracy(
        tuple(metrics.wilson(hits, of) for hits, of in restored if of),
        metrics.precision_recall(image.valid, truth_m) if has_empty else None,
        *reliability(answer),
    )


def reliability(answer: Answer) -> tuple[Array, Array]:
    """Return mean confidence and share of correct estimates for each tenth of confidence."""
    image, wrong = answer.run.image, is_wrong(answer)
    if wrong is None:
        return np.empty(0), np.empty(0)
    tenths = metrics.reliability(image.confidence[image.valid], ~wrong[image.valid])
    enough = [each for each in tenths if each.count >= MIN_PIXELS]
    return (
        np.array([each.confidence for each in enough]),
        np.array([each.right.value for each in enough]),
    )


def reference_of(capture: Capture) -> Reference:
    """Compute what the methods are compared with."""
    known = (capture.truth_range_m, capture.signal, capture.background)
    has_limit = all(each is not None for each in known) and capture.acquisition.n_pulses is not None
    with ranging(capture, "likelihood"):
        return Reference(
            limits.limit(capture) if has_limit else None,
            estimate(capture, "likelihood").confident(CONFIDENT)
            if capture.truth_range_m is None
            else None,
        )


def agreement(image: RangeImage, other: RangeImage) -> float:
    """Share of the estimates of another image with which one agrees in 3 bins; NaN without any.

    A pixel in which only the other has an estimate counts as disagreement.
    """
    close = (np.abs(image.bin - other.bin) <= TOLERANCES_BINS[-1])[other.valid]
    return float(close.mean()) if close.size else float("nan")


def score_curves(
    capture: Capture, tasks: Mapping[str, Task], row: int, col: int
) -> dict[str, Array]:
    """Each method's score of each bin, scaled to 0 at its median and 1 at its maximum.

    Methods whose score is flat or not finite are left out.
    """
    curves = {}
    for method, task in tasks.items():
        score = ESTIMATORS[method].curves(capture, row, col, task.settings)
        middle, top = float(np.median(score)), float(np.max(score))
        if np.isfinite(top - middle) and top > middle:
            curves[method] = (score - middle) / (top - middle)
    return curves
