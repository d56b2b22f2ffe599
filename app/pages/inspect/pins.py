"""The part of Inspect that compares pinned pixels."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import Range1d

from app.model.exports import shown_table_file
from app.model.state import MOST_PINS
from app.pages.inspect import text as inspector_words
from app.pages.inspect.pixel import NARROW, framed, stage
from app.pages.inspect.results import Seen, pixel_lit
from app.pages.inspect.views import GatePlot
from app.pages.navigation import View
from app.pages.session import Session
from app.pages.shared.downloads import (
    PLOT,
    TABLE,
    Shown,
    below,
    downloadable,
    explored,
    over_the_gate,
)
from app.plots import elements as plots
from app.plots import inspect as inspector_plots
from app.theme import palette
from app.widgets.controls import Sentence, Table
from app.widgets.figures import cover, pane_of


class Pins:
    """Histograms and enhanced signals of the pinned pixels over each other, and a table.

    Parameters
    ----------
    session : Session
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._jobs = session.tasks.latest()
        self._is_on_screen = self._dark = False
        self._found: list[Seen] = []
        bins = Range1d(0, 1)
        self._bins = bins
        self._counts = GatePlot(
            inspector_plots.overlay(bins, "Counts of the pinned pixels", "Counts"), has_top=True
        )
        self._enhanced = GatePlot(
            inspector_plots.overlay(bins, "Their enhanced signals", "Counts × weight")
        )
        self._note = Sentence(text=inspector_words.NO_PINS, sizing_mode="stretch_width", margin=0)
        self._table = Table(
            title=inspector_words.PINS, stylesheets=[NARROW], sizing_mode="stretch_width", margin=0
        )
        session.state.param.watch(lambda *_: self._ask(), ["pins", "unit"])

    @property
    def view(self) -> View:
        """The part, for the navigation."""
        session = self._session
        drawn = [
            downloadable(
                framed(pane_of(plot.figure)),
                session,
                what,
                partial(over_the_gate, session, plot.figure, f"pins {what}"),
                PLOT,
            )
            for plot, what in zip(self._plots, ("counts", "enhanced"), strict=True)
        ]
        return View(
            stage(self._note, *drawn),
            downloadable(below(self._table), session, "table", self._table_shown, TABLE),
            show=self._show,
            follow=lambda _: self._ask(),
            paint=self._paint,
        )

    @property
    def _plots(self) -> tuple[GatePlot, GatePlot]:
        return self._counts, self._enhanced

    def _table_shown(self) -> Shown:
        table = shown_table_file(self._table.columns, self._table.rows)
        return Shown(explored(self._session), "pins", {"csv": table})

    def _show(self, is_on_screen: bool) -> None:
        self._is_on_screen = is_on_screen
        self._ask()

    def _paint(self, dark: bool) -> None:
        self._dark = dark
        for plot in self._plots:
            plot.paint(palette(dark))
        self._ask()

    def _ask(self) -> None:
        if self._is_on_screen:
            session = self._session
            answer, pins = session.answer, session.state.pins
            self._jobs.submit(
                lambda: [pixel_lit(answer, *pin) for pin in pins],
                partial(self._draw, answer, pins),
                partial(session.failures.report, part=self),
            )

    def _draw(self, answer: Any, pins: Any, found: list[Seen]) -> None:
        session = self._session
        session.failures.resolve(self)
        if answer is not session.answer or pins != session.state.pins:
            return  # the user has moved on
        unit, acquisition = session.state.unit, answer.capture.acquisition
        colors = pin_colors(self._dark)[: len(found)]
        names = [inspector_words.pixel_name(pin, answer.grid) for pin in pins]
        scales = inspector_words.both_scales(unit, answer)
        with pn.io.hold(session.page):
            n_bins = acquisition.n_bins
            cover(self._bins, n_bins)
            for plot, curves in (
                (self._counts, [each.pixel.signals.raw for each in found]),
                (self._enhanced, [each.pixel.signals.enhanced for each in found]),
            ):
                plot.follow(unit, acquisition)
                plot.source("lines").data = {
                    "xs": [plots.centres(n_bins).astype(np.float32)] * len(found),
                    "ys": [np.asarray(curve, np.float32) for curve in curves],
                    "color": list(colors),
                    "label": names,
                }
                plot.frame(*curves, np.zeros(1))
            self._note.text = "" if pins else inspector_words.NO_PINS
            self._table.param.update(
                columns=inspector_words.pin_columns(unit) if pins else [],
                rows=[
                    inspector_words.pin_row(each, name, color, *scales)
                    for each, name, color in zip(found, names, colors, strict=True)
                ],
            )


def pin_colors(dark: bool) -> tuple[str, ...]:
    """One for each pin."""
    return palette(dark).methods[:MOST_PINS]
