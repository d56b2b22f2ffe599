"""The section of Inspect about the capture as a whole."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import FixedTicker, Range1d

from app.model.download_text import NOTHING_DRAWN
from app.model.exports import Curve, band
from app.model.state import ReductionSettings
from app.model.store import Answer
from app.model.text import COMPUTING
from app.pages.inspect import text
from app.pages.inspect.pixel import FACTS, framed, stage
from app.pages.inspect.results import SHARES, accuracy_steps, inspect_capture, with_gate
from app.pages.inspect.views import GatePlot, NamedLayers
from app.pages.session import Session
from app.pages.shared.section import Section
from app.pages.shared.studies import Study
from app.plots import elements as plots
from app.plots import inspect as inspect_plots
from app.tasks.scheduler import Step
from app.units import scale
from app.widgets.cards import button
from app.widgets.controls import Facts, Knob, Sentence
from app.widgets.figures import cover, pane_of
from core.inspection import Accuracy, CaptureReport

ADVICE = """
:host { display: flex !important; align-items: center; gap: 8px; flex: none !important; }
"""


class CaptureSection(Section):
    """Counts of all pixels, their flux, suggestions, and the accuracy from fewer pulses.

    Attributes
    ----------
    report : CaptureReport or None
        What is shown of the capture; None until it has been computed.
    accuracies : list of Accuracy
        What is shown of the accuracy so far.
    counts : GatePlot
    accuracy : NamedLayers
    study : Study
    facts : Facts
    flux : Sentence
    advice : list of Sentence
        Suggested gate; suggested T_n, shown for the method that has this setting.
    apply : list of pmui.Button
        Buttons that apply these.
    pulses : Knob
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self.report: CaptureReport | None = None
        self._reported: Answer | None = None
        self.accuracies: list[Accuracy] = []
        self._points: list[Curve] = []
        self._studied: Any = None
        self._count_jobs = session.tasks.latest()
        self._bins = Range1d(0, 1)
        self.counts = GatePlot(inspect_plots.aggregate(self._bins), {"Counts": "raw"}, has_top=True)
        self.accuracy = NamedLayers(inspect_plots.accuracy())
        self._painted = [self.counts, self.accuracy]
        self.study = Study(session, self._steps, "shares of the pulses")
        self.facts = Facts(stylesheets=[FACTS], sizing_mode="stretch_width")
        self.flux = Sentence(sizing_mode="stretch_width", margin=0)
        self.pulses = Knob.of_field(ReductionSettings(), "pulses")
        self.pulses.param.watch(lambda event: self._reduce(event.new), "value")
        self.advice = [Sentence(sizing_mode="stretch_width", margin=(2, 0)) for _ in range(2)]
        self.apply = [
            button("Apply the gate", text.GATE_HELP, self._apply_gate),
            button("Apply T_n", text.T_N_HELP, self._apply_t_n),
        ]
        session.state.param.watch(lambda *_: self._draw(), "unit")

    def layout(self) -> tuple[Any, Any]:
        """Return facts, suggestions and plots, and the controls that stand below the map."""
        counts, accuracy = (framed(pane_of(each.figure)) for each in (self.counts, self.accuracy))
        advice = [
            pn.Row(*pair, stylesheets=[ADVICE], sizing_mode="stretch_width", margin=0)
            for pair in zip(self.apply, self.advice, strict=True)
        ]
        main = stage(
            self.offer_facts(self.facts, self._facts_name),
            self.flux,
            *advice,
            self.offer_plot(counts, "counts", self.counts, "counts of all pixels"),
            self.offer_plot(accuracy, "accuracy", self.accuracy, "accuracy against pulses"),
        )
        below = pn.Column(self.pulses, *self.study.controls, sizing_mode="stretch_width", margin=0)
        return main, below

    def _facts_name(self) -> str:
        if self._reported is not self.session.answer:
            raise ValueError(NOTHING_DRAWN)
        return "numbers of the capture"

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        super().show(is_on_screen)
        self.study.show(is_on_screen)

    def refresh(self) -> None:
        """Compute the report on the capture, and the accuracy where its settings have changed."""
        if not self.is_on_screen:
            return
        answer = self.session.answer
        # The estimate may be that of an earlier setting.
        self.pulses.value = self.session.state.reduction.pulses
        shown = self._reported
        if shown is None or answer.request.source is not shown.request.source:
            self._clear()
        if shown is None or answer.capture is not shown.capture:
            self.flux.text = COMPUTING
        # Counts come at once, the flux later.
        counts, drawn = partial(answer.capture.cube.sum, axis=(0, 1)), self._draw_counts
        self._count_jobs.submit(counts, partial(drawn, answer), self.report_error)
        self.submit(partial(inspect_capture, answer), partial(self._arrived, answer), self._failed)
        if self._studied is not None and self._study_settings != self._studied:
            self.study.start()
        self._mark_present()

    # Actions of the user

    def _reduce(self, pulses: float) -> None:
        state = self.session.state
        if pulses != state.reduction.pulses:
            state.reduction = replace(state.reduction, pulses=pulses)

    def _apply_gate(self) -> None:
        if self.report is not None and self._reported is not None:
            reduction, t_n = with_gate(self._reported, self.report.suggestion)
            state = self.session.state
            state.param.update(reduction=reduction, tracking=replace(state.tracking, t_n=t_n))

    def _apply_t_n(self) -> None:
        if self.report is not None:
            state = self.session.state
            state.tracking = replace(state.tracking, t_n=self.report.suggestion.t_n)

    # Accuracy against pulses

    @property
    def _study_settings(self) -> Any:
        answer = self.session.answer
        reduction = replace(answer.request.reduction, pulses=1.0)
        return answer.whole, reduction, answer.method, answer.settings

    def _pulses_at(self, share: float) -> float:
        """Return the pulses of a share, as they are drawn; the share if their number is unknown."""
        n_pulses = self.session.answer.whole.acquisition.n_pulses
        return share if n_pulses is None else max(1, round(share * n_pulses))

    def _steps(self) -> list[Step[Accuracy]]:
        self._studied, self.accuracies = self._study_settings, []
        ticks = sorted(set(map(self._pulses_at, SHARES)))
        figure = self.accuracy.figure
        titles = text.accuracy_titles(self.session.answer.whole)
        figure.title.text, figure.xaxis.axis_label, figure.yaxis.axis_label = titles
        figure.xaxis.ticker = FixedTicker(ticks=ticks)
        figure.x_range.update(start=0.8 * ticks[0], end=1.25 * ticks[-1])
        self._mark_present()
        return [Step(work, self._add) for work in accuracy_steps(self.session.answer)]

    def _add(self, found: Accuracy) -> None:
        known = [(n, within) for n in (*self.accuracies, found) if (within := n.within) is not None]
        points = {
            "pulses": [self._pulses_at(each.share) for each, _ in known],
            "value": [within.value for _, within in known],
            "low": [within.low for _, within in known],
            "high": [within.high for _, within in known],
            "rmse_m": [each.rmse_m.value if each.rmse_m else np.nan for each, _ in known],
        }
        names, pulses = inspect_plots.NAMES, points["pulses"]
        interval, share = names["interval"], names["points"]
        self._points = [
            *band("interval", interval, pulses, points["low"], points["high"], share),
            Curve("points", share, pulses, points["value"]),
        ]
        with self.session.tasks.hold():
            self.accuracy.source("points").data = points
            self._mark_present()
        self.accuracies.append(found)

    def _mark_present(self) -> None:
        """Mark the number of pulses that is used at present."""
        present = self._pulses_at(self.session.answer.request.reduction.pulses)
        self.accuracy.mark("present", present)
        marks = plots.marks(inspect_plots.NAMES, present=present)
        self.accuracy.keep(self.accuracy.figure.xaxis.axis_label, self._points + marks)

    # Report

    def _draw_counts(self, answer: Answer, counts: Any, marks: Sequence[Curve] = ()) -> None:
        """Draw the sum of all pixels (bin,); `marks` are kept for a download."""
        if answer is not self.session.answer:
            return  # outdated
        gate = answer.gate
        with self.session.tasks.hold():
            cover(self._bins, gate.n_bins)
            self.counts.follow(self.session.state.unit, gate)
            curves = plots.bin_curves(inspect_plots.NAMES, "counts", raw=counts)
            self.counts.draw(gate, [*curves, *marks])
            self.counts.frame(counts)

    def _arrived(self, answer: Answer, report: CaptureReport) -> None:
        self.report, self._reported = report, answer
        self._draw()

    def _failed(self, error: Exception) -> None:
        """Remove what was known of another capture, and report why."""
        self._clear()
        self.report_error(error)

    def _clear(self) -> None:
        """Remove what was known of another capture."""
        self.report = self._reported = None
        with self.session.tasks.hold():
            self.facts.facts = []
            for sentence in (self.flux, *self.advice):
                sentence.text = ""
            for each in self.apply:
                each.disabled = True
            self.counts.source("window").data = {"left": [], "right": []}
            self.counts.source("suggested").data = {"x": [], "y": []}

    def _draw(self) -> None:
        answer, report = self._reported, self.report
        if not self.is_on_screen or answer is not self.session.answer or report is None:
            return
        gate, suggestion = answer.gate, report.suggestion
        has_t_n = answer.method == "tracking"
        positions = {"t_n": answer.request.tracking.t_n, "suggested": suggestion.t_n}
        first, end = suggestion.gate
        marks = plots.marks(inspect_plots.NAMES, window=suggestion.gate, **positions)
        with self.session.tasks.hold():
            self._draw_counts(answer, report.histogram, marks)
            self.counts.source("window").data = {"left": [first], "right": [end]}
            for layer, position in positions.items():
                self.counts.mark(layer, position)
                self.counts.show(layer, has_t_n)  # else its file does not have it either
            self.facts.facts = text.capture_facts(answer, report)
            self.flux.text = text.flux_sentence(report)
            along = scale(self.session.state.unit, gate)
            for sentence, advice in zip(self.advice, text.advice(report, along), strict=True):
                sentence.text = advice
            self.advice[1].visible = self.apply[1].visible = has_t_n
            self.apply[0].disabled = suggestion.gate == (0, gate.n_bins)
            self.apply[1].disabled = suggestion.t_n == answer.request.tracking.t_n
