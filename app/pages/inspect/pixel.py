"""The section of Inspect about one pixel, or about a region's pixels summed to one histogram."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn

from app.model.download_text import NOTHING_DRAWN
from app.model.exports import Write
from app.model.state import NEIGHBOURS
from app.model.store import Answer
from app.model.text import COMPUTING, reason
from app.pages.inspect import text
from app.pages.inspect.results import (
    Inspected,
    Prediction,
    inspect_pixel,
    inspect_pixel_with_flux,
    inspect_region,
    predict,
)
from app.pages.inspect.views import GatePlot, PixelPlots
from app.pages.session import Session
from app.pages.shared.downloads import Shown, pixel_on_show, region_on_show
from app.pages.shared.echo_zoom import EchoZoom
from app.pages.shared.section import Section
from app.plots.gate_cut import Cut
from app.widgets.cards import card, column, unrolled
from app.widgets.controls import FACTS_PX, LINE_PX, Facts, Sentence, Table
from app.widgets.figures import pane_of

BREAK_PX = 1100
"""Width below which the parts of this page follow each other."""

FACTS = """
.fact-list { display: flex !important; flex-wrap: wrap; }
.fact-list div { flex: 0 0 max(140px, 25% - 10px); min-width: max-content; }
.leading div:first-child dd { font-size: 16px !important; }
"""
FILLING = ":host { flex: 1 1 0 !important; min-height: 0; min-width: 0; }" + unrolled(BREAK_PX)
COLUMN = column(6, BREAK_PX)
FRAME = unrolled(BREAK_PX, "330px")
NARROW = """
th, td { padding: 3px 6px !important; }
tbody th { min-width: 40px !important; }
"""

FACTS_ACROSS, FACT_ROWS = 4, 3
"""Facts in a row on a laptop, and rows of them that are reserved from the start."""

TABLE_PX = 217
"""Height of the table with the largest number of candidates, reserved from the start."""

BUTTONS = {
    "counts": "counts",
    "rate": "rate",
    "stages": "residual and enhanced",
    "score": "score",
    "evidence": "pixel and neighbours",
    "residuals": "residuals of the fit",
}
"""Names of the plots of `PixelPlots` on their download buttons, by attribute."""

IMMEDIATE_BINS = 1000
"""Gate up to which a pixel is inspected where the event arrives: 6 ms at 200 bins, 13 ms at 1000;
a worker thread would cost more."""

IMMEDIATE_PIXELS = 2**18
"""Likewise for the image, in which the first report looks for hot and dead pixels: 30 ms."""


def framed(*content: Any) -> pn.Column:
    """Return a card that keeps its height where the page's parts follow each other."""
    made = card(*content)
    made.stylesheets = [*made.stylesheets, FRAME]
    return made


def stage(*content: Any) -> pn.Column:
    """Return the column to the right of the map."""
    return pn.Column(*content, stylesheets=[COLUMN, FILLING], sizing_mode="stretch_both", margin=0)


def is_immediate(answer: Answer) -> bool:
    """Return whether a pixel is inspected where the event arrives."""
    capture = answer.capture
    is_short = capture.acquisition.n_bins <= IMMEDIATE_BINS
    return is_short and capture.counts.size <= IMMEDIATE_PIXELS


class PixelSection(Section):
    """Everything known about the chosen pixel, or about the region.

    Parameters
    ----------
    session : Session
    subject : {"pixel", "region"}
        The parameter of the state that is shown.

    Attributes
    ----------
    found : Inspected or None
        What is shown; None while there is nothing to show.
    plots : PixelPlots
    zoom : EchoZoom
    cards : dict of str to pn.Column
        The plots that have been shown, in their frames, by the attribute of `plots`.
    facts : Facts
    remark, explanation : Sentence
        What is to be said of the pixel or region, and of its fit while that is shown.
    table : Table
    """

    def __init__(self, session: Session, subject: str) -> None:
        super().__init__(session, subject, "unit")
        self._subject = subject
        self.found: Inspected | None = None
        self._is_outdated = False
        self._write_soon = session.tasks.soon(self._write)
        self._drawn: Inspected | None = None
        self._fit_jobs = session.tasks.latest()
        session.state.param.watch(lambda *_: self._change_plot(), "plot")
        self.plots = PixelPlots()
        self.plots.cut.dragged.subscribe(session.cut_gate)
        self._painted = [self.plots]
        self.cards: dict[str, pn.Column] = {}
        self.zoom = EchoZoom(self.plots.bins)
        height = FACT_ROWS * FACTS_PX
        self.facts = Facts(
            leading=True, stylesheets=[FACTS], min_height=height, sizing_mode="stretch_width"
        )
        self.remark = Sentence(live=True, min_height=LINE_PX, sizing_mode="stretch_width", margin=0)
        self.explanation = Sentence(visible=False, sizing_mode="stretch_width", margin=0)
        self.table = Table(
            title=text.CANDIDATES,
            stylesheets=[NARROW],
            min_height=TABLE_PX,
            sizing_mode="stretch_width",
            margin=0,
        )
        self._stage = stage()
        self._add_card("counts").append(self.zoom.button)

    def layout(self) -> tuple[Any, Any]:
        """Return facts and plots, and the table that stands below the map."""
        facts = self.offer_facts(self.facts, lambda: "numbers")
        self._stage[:] = [facts, self.remark, self.explanation, *self.cards.values()]
        return self._stage, self.offer_table(self.table, "candidates")

    def _add_card(self, name: str) -> pn.Column:
        plot: GatePlot = getattr(self.plots, name)
        what = BUTTONS[name]
        made = self.offer_plot(framed(pane_of(plot.figure)), what, plot, what)
        self.cards[name] = made
        self._stage.append(made)
        return made

    def saved(self, what: str, csv: Write) -> Shown:
        """Return a plot or a table as it is saved, named after the pixel or the region."""
        if self._is_outdated:
            raise ValueError(NOTHING_DRAWN)
        shown = super().saved(what, csv)
        if self._subject == "pixel":
            return replace(shown, what=f"{what} {pixel_on_show(self.session)}")
        subject = replace(shown.subject, part=region_on_show(self.session))
        return replace(shown, what=f"{what} region", subject=subject)

    def refresh(self) -> None:
        """Inspect what is chosen now."""
        if not self.is_on_screen:
            return
        answer, state = self.session.answer, self.session.state
        if self._subject == "pixel":
            if is_immediate(answer):
                with self.session.tasks.hold():
                    self._draw(inspect_pixel(answer, *state.pixel))
                self.session.failures.resolve(self)
                return
            work = partial(inspect_pixel_with_flux, answer, *state.pixel)
        elif state.region:
            work = partial(inspect_region, answer, state.region)
            self.remark.text = COMPUTING
        else:
            self._clear(text.NO_REGION)
            return
        self._is_outdated = True
        self.submit(work, self._draw, self._failed)

    def _failed(self, error: Exception) -> None:
        self._clear(reason(error))
        if not isinstance(error, ValueError):
            self.report_error(error)

    def _clear(self, why: str) -> None:
        """Show a sentence in place of facts and plots."""
        self._drawn = self.found = None
        with self.session.tasks.hold():
            self.facts.param.update(facts=[], min_height=0)
            self.remark.text, self.table.rows = why, []
            self.explanation.visible = False
            for each in self.cards.values():
                each.visible = False

    def _draw(self, found: Inspected) -> None:
        state = self.session.state
        with_fit = state.plot == "Fit"
        self.plots.cut.update(Cut.of(found.answer, state.reduction))
        below = self.plots.update(found, state.unit, state.plot)
        self.zoom.follow(found.answer.capture, found.pixel.answer_bin)
        if below not in self.cards:
            self._add_card(below)
        for name, each in self.cards.items():
            each.visible = name in ("counts", below)
        self._drawn, self._is_outdated = found, False
        is_without = state.plot == NEIGHBOURS and found.report.evidence is None
        self.explanation.visible = with_fit or is_without
        if is_without:
            self.explanation.text = text.NO_EVIDENCE
        if with_fit:
            self.explanation.text = text.fit_explanation(math.nan)
            self._fit_jobs.submit(
                partial(predict, found), partial(self._draw_fit, found), self.report_error
            )
        # Facts and table follow once the plots, which the eye follows, are on their way.
        self._write_soon()

    def _draw_fit(self, found: Inspected, prediction: Prediction) -> None:
        if found is self._drawn and self.explanation.visible:
            with self.session.tasks.hold():
                self.plots.draw_fit(found, prediction.counts)
                self.explanation.text = text.fit_explanation(prediction.p_value)

    def _change_plot(self) -> None:
        """Show another plot below the histogram."""
        if self.is_on_screen and self._drawn is not None:
            with self.session.tasks.hold():
                self._draw(self._drawn)

    def _write(self) -> None:
        found = self._drawn
        if found is None:
            return
        unit = self.session.state.unit
        facts = text.facts(found, unit)
        rows = -(-len(facts) // FACTS_ACROSS)
        scales = text.both_scales(unit, found.answer)
        with self.session.tasks.hold():
            self.facts.param.update(facts=facts, min_height=rows * FACTS_PX)
            self.remark.text = text.remark(found)
            self.table.param.update(
                columns=text.candidate_columns(scales[0]),
                rows=text.candidate_rows(
                    found.report.candidates, found.answer.capture.acquisition, *scales
                ),
            )
        self.found = found
