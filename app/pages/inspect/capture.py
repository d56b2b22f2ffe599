"""The part of Inspect that looks at the capture as a whole."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import partial
from typing import Any, cast

import numpy as np
import panel as pn
from bokeh.models import FixedTicker, Range1d

from app.model.download_text import NOTHING_DRAWN
from app.model.exports import facts_file, plot_file
from app.model.state import Less
from app.model.store import Answer
from app.model.text import COMPUTING
from app.pages.inspect import text as inspector_words
from app.pages.inspect.pixel import FACTS, framed, stage
from app.pages.inspect.results import SHARES, accuracy_steps, capture_known, with_gate
from app.pages.inspect.views import GatePlot, Marked
from app.pages.navigation import View
from app.pages.session import Session
from app.pages.shared.downloads import (
    PLOT,
    Shown,
    downloadable,
    downloadable_facts,
    explored,
    over_the_gate,
)
from app.pages.shared.studies import Study
from app.plots import elements as plots
from app.plots import inspect as inspector_plots
from app.tasks.scheduler import Step
from app.theme import palette
from app.units import scale
from app.widgets.cards import button
from app.widgets.controls import Facts, Knob, Sentence
from app.widgets.figures import cover, pane_of
from core.inspection import Accuracy, CaptureReport
from core.parameters import Number, spec_of

ADVICE = """
:host { display: flex !important; align-items: center; gap: 8px; flex: none !important; }
"""


class Whole:
    """Counts of all pixels, the light they tell of, and what fewer pulses would have told.

    Parameters
    ----------
    session : Session
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._jobs = session.tasks.latest()
        self._count_jobs = session.tasks.latest()
        self._is_on_screen = False
        self._report: CaptureReport | None = None
        self._reported: Answer | None = None
        self._accuracies: list[Accuracy] = []
        self._studied: Any = None
        self._bins = Range1d(0, 1)
        self._counts = GatePlot(
            inspector_plots.aggregate(self._bins), {"Counts": "raw"}, has_top=True
        )
        self._accuracy = Marked(inspector_plots.accuracy())
        self._study = Study(session, self._steps, "shares of the pulses")
        self._facts = Facts(stylesheets=[FACTS], sizing_mode="stretch_width")
        self._light = Sentence(sizing_mode="stretch_width", margin=0)
        (pulses,) = (each for each in fields(Less) if each.name == "pulses")
        self._pulses = Knob.of(cast(Number, spec_of(pulses)), 1.0, inspector_words.PULSES_HELP)
        self._pulses.param.watch(lambda event: self._take(event.new), "value")
        self._advice = [Sentence(sizing_mode="stretch_width", margin=(2, 0)) for _ in range(2)]
        self._apply = [
            button("Apply the gate", inspector_words.GATE_HELP, self._apply_gate),
            button("Apply T_n", inspector_words.T_N_HELP, self._apply_t_n),
        ]
        session.state.param.watch(lambda *_: self._draw(), "unit")

    @property
    def view(self) -> View:
        """The part, for the navigation."""
        session = self._session
        counts, accuracy = (framed(pane_of(plot.figure)) for plot in (self._counts, self._accuracy))
        all_counts = partial(over_the_gate, session, self._counts.figure, "counts of all pixels")
        drawn = [
            downloadable(counts, session, "counts", all_counts, PLOT),
            downloadable(accuracy, session, "accuracy", self._accuracy_shown, PLOT),
        ]
        advice = [
            pn.Row(*pair, stylesheets=[ADVICE], sizing_mode="stretch_width", margin=0)
            for pair in zip(self._apply, self._advice, strict=True)
        ]
        below = pn.Column(
            self._pulses, *self._study.controls, sizing_mode="stretch_width", margin=0
        )
        return View(
            stage(
                downloadable_facts(self._facts, session, self._numbers_shown),
                self._light,
                *advice,
                *drawn,
            ),
            below,
            show=self._show,
            follow=lambda _: self._follow(),
            paint=self._paint,
        )

    def _numbers_shown(self) -> Shown:
        if self._reported is not self._session.answer:
            raise ValueError(NOTHING_DRAWN)
        table = facts_file(self._facts.facts)
        return Shown(explored(self._session), "numbers of the capture", {"csv": table})

    def _accuracy_shown(self) -> Shown:
        table = plot_file(self._accuracy.figure)
        return Shown(explored(self._session), "accuracy against pulses", {"csv": table})

    # What the app tells the part

    def _show(self, is_on_screen: bool) -> None:
        self._is_on_screen = is_on_screen
        if is_on_screen:
            self._follow()
        self._study.show(is_on_screen)

    def _follow(self) -> None:
        if not self._is_on_screen:
            return
        answer, fail = self._session.answer, partial(self._session.failures.report, part=self)
        # Not the answer's, which may be to what was chosen before.
        self._pulses.value = self._session.state.less.pulses
        if self._reported is None or answer.capture is not self._reported.capture:
            self._light.text = COMPUTING
        # Counts at once: to find the light takes a while.
        counts = partial(answer.capture.cube.sum, axis=(0, 1))
        self._count_jobs.submit(counts, partial(self._draw_counts, answer), fail)
        report = partial(capture_known, answer)
        self._jobs.submit(report, partial(self._arrived, answer), self._unknown)
        request = answer.request
        studied = (answer.whole, replace(request.less, pulses=1.0), request.tracking)
        if self._studied is not None and studied != self._studied:
            self._study.start()
        self._mark_present()

    def _paint(self, dark: bool) -> None:
        for plot in (self._counts, self._accuracy):
            plot.paint(palette(dark))

    # What the user does

    def _take(self, pulses: float) -> None:
        state = self._session.state
        if pulses != state.less.pulses:
            state.less = replace(state.less, pulses=pulses)

    def _apply_gate(self) -> None:
        if self._report is not None and self._reported is not None:
            less, t_n = with_gate(self._reported, self._report.suggestion)
            state = self._session.state
            state.param.update(less=less, tracking=replace(state.tracking, t_n=t_n))

    def _apply_t_n(self) -> None:
        if self._report is not None:
            state = self._session.state
            state.tracking = replace(state.tracking, t_n=self._report.suggestion.t_n)

    # What is computed and drawn

    def _steps(self) -> list[Step[Accuracy]]:
        answer = self._session.answer
        request = answer.request
        self._studied = (answer.whole, replace(request.less, pulses=1.0), request.tracking)
        self._accuracies = []
        n_pulses = self._all_pulses
        ticks = [share * n_pulses for share in SHARES]
        figure = self._accuracy.figure
        figure.xaxis.ticker = FixedTicker(ticks=ticks)
        figure.x_range.update(start=0.8 * ticks[0], end=1.25 * ticks[-1])
        self._mark_present()
        return [Step(work, self._add) for work in accuracy_steps(answer)]

    def _add(self, found: Accuracy) -> None:
        self._accuracies.append(found)
        known = [(each, within) for each in self._accuracies if (within := each.within) is not None]
        title, across, up = inspector_words.accuracy_titles(found)
        with pn.io.hold(self._session.page):
            self._accuracy.source("points").data = {
                "pulses": [each.share * self._all_pulses for each, _ in known],
                "value": [within.value for _, within in known],
                "low": [within.low for _, within in known],
                "high": [within.high for _, within in known],
                "rmse_m": [each.rmse_m.value if each.rmse_m else np.nan for each, _ in known],
            }
            figure = self._accuracy.figure
            figure.title.text = title
            figure.xaxis.axis_label, figure.yaxis.axis_label = across, up
            self._mark_present()

    @property
    def _all_pulses(self) -> int:
        """What all pulses count on the axis: their number; 1 where it is not known."""
        return self._session.answer.whole.acquisition.n_pulses or 1

    def _mark_present(self) -> None:
        """Where the pulses stand that are taken at present."""
        share = self._session.answer.request.less.pulses
        x, y = plots.marker_line(share * self._all_pulses, 1.0)
        self._accuracy.source("answer").data = {"x": x, "y": y}

    def _draw_counts(self, answer: Answer, counts: Any) -> None:
        if answer is not self._session.answer:
            return  # the user has moved on
        acquisition = answer.capture.acquisition
        with pn.io.hold(self._session.page):
            cover(self._bins, acquisition.n_bins)
            self._counts.follow(self._session.state.unit, acquisition)
            self._counts.show_curves(raw=counts)
            self._counts.frame(counts)

    def _arrived(self, answer: Answer, report: CaptureReport) -> None:
        self._session.failures.resolve(self)
        if answer is self._session.answer:
            self._report, self._reported = report, answer
            self._draw()

    def _unknown(self, error: Exception) -> None:
        """Say no longer what was known of another capture, and tell why."""
        self._report = self._reported = None
        with pn.io.hold(self._session.page):
            self._facts.facts = []
            for sentence in (self._light, *self._advice):
                sentence.text = ""
            for each in self._apply:
                each.disabled = True
            self._counts.source("window").data = {"left": [], "right": []}
            self._counts.source("suggested").data = {"x": [], "y": []}
        self._session.failures.report(error, part=self)

    def _draw(self) -> None:
        answer, report = self._reported, self._report
        if not self._is_on_screen or answer is None or report is None:
            return
        acquisition, unit = answer.capture.acquisition, self._session.state.unit
        advice = report.suggestion
        with pn.io.hold(self._session.page):
            self._draw_counts(answer, report.histogram)
            first, end = advice.gate
            self._counts.source("window").data = {"left": [first], "right": [end]}
            for layer, at in (("t_n", answer.request.tracking.t_n), ("suggested", advice.t_n)):
                x, y = plots.marker_line(at, 1.0)
                self._counts.source(layer).data = {"x": x, "y": y}
            self._facts.facts = inspector_words.capture_facts(answer, report)
            self._light.text = inspector_words.light_told(report)
            along = scale(unit, acquisition)
            self._advice[0].text = inspector_words.gate_advice(report, along)
            self._advice[1].text = inspector_words.t_n_advice(report)
            self._apply[0].disabled = advice.gate == (0, acquisition.n_bins)
            self._apply[1].disabled = advice.t_n == answer.request.tracking.t_n
