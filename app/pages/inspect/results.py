"""What the Inspect page shows of an answer: runs `core`, knows no widget."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.model.budget import spending
from app.model.state import Less
from app.model.store import Answer, Pixel, inspect, reduced
from app.pages.inspect.views import Corners, Curves
from core import inspection
from core.cost import predicted_flux_time
from core.inspection import Accuracy, CaptureReport, PixelReport, RegionReport, Suggestion

SHARES = (1 / 64, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)
"""Of the pulses, for which it is found how good answers are."""


@dataclass(frozen=True)
class Seen:
    """A pixel, or a region's pixels added to one, with all that is known of it."""

    pixel: Pixel
    report: PixelReport
    region: RegionReport | None = None
    """None for a pixel."""

    @property
    def curves(self) -> Curves:
        """What its plots show."""
        pixel, signals = self.pixel, self.pixel.signals
        return Curves(
            raw=signals.raw,
            expected=pixel.expected,
            small=signals.small,
            large=signals.large,
            rate=self.report.rate,
            rate_unit=self.report.rate_unit,
            residual=signals.residual,
            enhanced=signals.enhanced,
            truth_bin=pixel.truth_bin,
            answer_bin=pixel.answer_bin,
            candidate_bins=[each.bin for each in self.report.candidates],
        )


def pixel_seen(answer: Answer, row: int, col: int) -> Seen:
    """All that is known of one pixel of an answer."""
    report = inspection.pixel_report(
        answer.capture, answer.run.image, row, col, "tracking", answer.request.tracking
    )
    return Seen(inspect(answer, row, col), report)


def pixel_lit(answer: Answer, row: int, col: int) -> Seen:
    """The same, its light found: on a worker, where to find it would hold up the page."""
    n_bins = answer.capture.acquisition.n_bins
    with spending((1, 1, n_bins), "light", predicted_flux_time(1, n_bins)):
        seen = pixel_seen(answer, row, col)
        _ = seen.report.flux
        return seen


def region_seen(answer: Answer, region: Corners) -> Seen:
    """All that is known of a region of an answer's pixels."""
    mask = inspection.pixels_in(region, answer.capture.shape)
    n_pixels, n_bins = int(np.count_nonzero(mask)), answer.capture.acquisition.n_bins
    with spending((1, n_pixels, n_bins), "light", predicted_flux_time(n_pixels, n_bins)):
        report = inspection.region_report(
            answer.capture, answer.run.image, mask, "tracking", answer.request.tracking
        )
    of_sum = replace(answer, run=replace(answer.run, capture=report.summed, image=report.image))
    return Seen(inspect(of_sum, 0, 0), report.pixel, report)


def capture_known(answer: Answer) -> CaptureReport:
    """All that is known of the capture of an answer."""
    rows, cols, n_bins = answer.capture.cube.shape
    with spending((rows, cols, n_bins), "light", predicted_flux_time(rows * cols, n_bins)):
        return inspection.capture_report(answer.capture)


def accuracy_steps(answer: Answer) -> Sequence[Callable[[], Accuracy]]:
    """How good answers to each of `SHARES` of the pulses are, a piece of work each."""
    started: list[Iterator[Accuracy]] = []

    def step() -> Accuracy:
        if not started:  # on the worker: to have all pulses again may take a while
            request = answer.request
            every = replace(request, less=replace(request.less, pulses=1.0))
            capture = reduced(answer.whole, every)
            started.append(
                inspection.accuracy_over_pulses(capture, SHARES, "tracking", request.tracking)
            )
        return next(started[0])

    return [step] * len(SHARES)


def with_gate(answer: Answer, suggestion: Suggestion) -> tuple[Less, int]:
    """The reduction of an answer with the suggested gate instead, and T_n at its old place."""
    less, n_bins = answer.request.less, answer.whole.acquisition.n_bins
    opens, _ = less.reduction(n_bins).gate or (0, n_bins)
    first, end = (opens + less.merge * each for each in suggestion.gate)
    t_n = max(answer.request.tracking.t_n - suggestion.gate[0], 0)
    return replace(less, gate_from=first / n_bins, gate_to=min(end / n_bins, 1.0)), t_n
