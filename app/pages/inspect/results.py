"""Data of the Inspect page, computed by `core`, without widgets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.model.budget import spending
from app.model.colors import shown
from app.model.state import ReductionSettings, Viewing
from app.model.store import Answer, Pixel, inspect, reduced
from core import inspection
from core.cost import predicted_fit_time, predicted_flux_time
from core.geometry import pixel_angle_of
from core.inference import Predictive, fit_p_values_of, predictive_of
from core.inspection import (
    Accuracy,
    CaptureReport,
    LineProfile,
    PixelReport,
    RegionReport,
    Suggestion,
)
from core.metrics import Interval, wilson

Array = NDArray[Any]

Corners = tuple[tuple[float, float], ...]
"""Corners (row, col) of a polygon."""

SHARES = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)
"""Shares of the pulses for which the accuracy is computed."""


@dataclass(frozen=True)
class Inspected:
    """A pixel, or a region's pixels summed to one histogram."""

    answer: Answer
    """The estimate that it belongs to."""
    pixel: Pixel
    report: PixelReport
    pixels: NDArray[np.intp]
    """Flat indices of its pixels, (pixel,)."""
    region: RegionReport | None = None
    """None for a pixel."""


def inspect_pixel(answer: Answer, row: int, col: int) -> Inspected:
    """Inspect one pixel; its flux is estimated when it is first used."""
    chosen = answer.method, answer.settings
    report = inspection.pixel_report(answer.capture, answer.run.image, row, col, *chosen)
    here = np.array([row * answer.capture.shape[1] + col])
    return Inspected(answer, inspect(answer, row, col, report), report, here)


def inspect_pixel_with_flux(answer: Answer, row: int, col: int) -> Inspected:
    """Inspect one pixel and estimate its flux, for a worker thread."""
    n_bins = answer.capture.acquisition.n_bins
    with spending((1, 1, n_bins), "flux", predicted_flux_time(1, n_bins)):
        found = inspect_pixel(answer, row, col)
        _ = found.report.flux, found.report.surfaces_text
        return found


def inspect_region(answer: Answer, region: Corners) -> Inspected:
    """Inspect the pixels within a polygon.

    Raises
    ------
    ValueError
        If no pixel lies in it.
    """
    mask = inspection.pixels_in(region, answer.capture.shape)
    n_pixels, n_bins = int(np.count_nonzero(mask)), answer.capture.acquisition.n_bins
    with spending((1, n_pixels, n_bins), "flux", predicted_flux_time(n_pixels, n_bins)):
        chosen = answer.method, answer.settings
        report = inspection.region_report(answer.capture, answer.run.image, mask, *chosen)
    of_sum = replace(answer, run=replace(answer.run, capture=report.summed, image=report.image))
    summed = inspect(of_sum, 0, 0, report.pixel)
    return Inspected(answer, summed, report.pixel, np.flatnonzero(mask), report)


@dataclass(frozen=True)
class Prediction:
    """Counts that the model expects of a pixel or a region."""

    counts: Predictive
    p_value: float
    """Goodness of fit of a pixel; NaN for a region, which has `RegionReport.fit` instead."""


def predict(found: Inspected) -> Prediction:
    """Predict the counts of a pixel or a region, for a worker thread."""
    capture, pixels = found.answer.capture, found.pixels
    shape = (1, pixels.size, capture.acquisition.n_bins)
    with spending(shape, "expected counts", predicted_fit_time(*shape[1:])):
        is_pixel = found.region is None
        p_value = float(fit_p_values_of(capture, pixels)[0]) if is_pixel else np.nan
        return Prediction(predictive_of(capture, pixels), p_value)


def profile_of(answer: Answer, pins: Sequence[tuple[int, int]], viewing: Viewing) -> LineProfile:
    """Return the visible ranges along the line that joins pixels."""
    angle_rad = pixel_angle_of(answer.field_of_view_deg(viewing), answer.capture.shape[1])
    image = answer.run.image.confident(viewing.least_confidence)
    return inspection.line_profile(answer.capture, image, pins, angle_rad)


def inspect_capture(answer: Answer) -> CaptureReport:
    """Inspect the capture of an estimate as a whole."""
    rows, cols, n_bins = answer.capture.cube.shape
    with spending((rows, cols, n_bins), "flux", predicted_flux_time(rows * cols, n_bins)):
        return inspection.capture_report(answer.capture)


def accuracy_steps(answer: Answer) -> Sequence[Callable[[], Accuracy]]:
    """Return one function for each of `SHARES`, to be called in this order."""
    started: list[Iterator[Accuracy]] = []

    def step() -> Accuracy:
        if not started:  # on the worker thread, since restoring all pulses may take long
            request, chosen = answer.request, (answer.method, answer.settings)
            all_pulses = replace(request, reduction=replace(request.reduction, pulses=1.0))
            capture = reduced(answer.whole, all_pulses)
            started.append(inspection.accuracy_over_pulses(capture, SHARES, *chosen))
        return next(started[0])

    return [step] * len(SHARES)


def with_gate(answer: Answer, suggestion: Suggestion) -> tuple[ReductionSettings, int]:
    """Return the reduction that crops to the suggested gate, and T_n at its old place."""
    reduction, n_bins = answer.request.reduction, answer.whole.acquisition.n_bins
    opens, _ = reduction.gate(n_bins)
    first, end = (opens + reduction.merge * edge for edge in suggestion.gate)
    t_n = max(answer.request.tracking.t_n - suggestion.gate[0], 0)
    return reduction.with_gate(first, min(end, n_bins), n_bins), t_n


@dataclass(frozen=True)
class Pair:
    """Two estimates of as many pixels, A and B."""

    a: Answer
    b: Answer
    shown: tuple[Array, Array]
    """Pixels (row, col) of each that are confident enough to be shown."""
    difference_m: Array
    """B minus A (row, col), NaN where one is not shown."""

    def within(self, n_bins: float) -> Interval:
        """Return the share of pixels in both whose ranges differ by at most some bins of B."""
        known = self.difference_m[np.isfinite(self.difference_m)]
        limit_m = n_bins * self.b.capture.acquisition.bin_length_m
        return wilson(int((np.abs(known) <= limit_m).sum()), known.size)


def pair_of(a: Answer, b: Answer, least_confidence: float) -> Pair:
    """Compare two estimates.

    Raises
    ------
    ValueError
        If their images differ in shape.
    """
    if a.capture.shape != b.capture.shape:
        sizes = [" × ".join(map(str, each.capture.shape)) for each in (a, b)]
        raise ValueError("A has {} pixels, and B {}: their sizes must be equal.".format(*sizes))
    in_a, in_b = shown(a, least_confidence), shown(b, least_confidence)
    difference_m = b.run.image.range_m - a.run.image.range_m
    return Pair(a, b, (in_a, in_b), np.where(in_a & in_b, difference_m, np.nan))
