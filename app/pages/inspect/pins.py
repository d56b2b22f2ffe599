"""The section of Inspect that compares pinned pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import Range1d

from app.model.exports import Curve
from app.model.state import MOST_PINS
from app.model.text import pixel_name
from app.pages.inspect import text
from app.pages.inspect.pixel import NARROW, framed, stage
from app.pages.inspect.results import Inspected, inspect_pixel_with_flux
from app.pages.inspect.views import GatePlot
from app.pages.session import Session
from app.pages.shared.echo_zoom import EchoZoom
from app.pages.shared.measure import distances
from app.pages.shared.section import Section
from app.plots import elements as plots
from app.plots import inspect as inspect_plots
from app.theme import palette
from app.widgets.controls import Sentence, Table
from app.widgets.figures import cover, fit, pane_of


class PinsSection(Section):
    """Histograms and scores of the pinned pixels, and a table.

    Attributes
    ----------
    found : list of Inspected
        The pixels that are shown.
    counts, score : GatePlot
    zoom : EchoZoom
    cards : list of pn.Column
        The plots in their frames, shown where there are pins.
    note : Sentence
        Distances of the pins from the first one, or what to do.
    table : Table
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, "pins", "unit")
        session.state.param.watch(lambda *_: self._write(), "viewing")
        self.found: list[Inspected] = []
        self._bins = Range1d(0, 1)
        self.counts, self.score = (
            GatePlot(inspect_plots.overlay(self._bins, title, unit), has_top=unit == "Counts")
            for title, unit in (
                ("Counts of the pinned pixels", "Counts"),
                ("Scores of the pinned pixels", "Score"),
            )
        )
        self._painted = [self.counts, self.score]
        self.cards = [
            self.offer_plot(framed(pane_of(plot.figure)), what, plot, f"pins {what}")
            for plot, what in ((self.counts, "counts"), (self.score, "scores"))
        ]
        self.zoom = EchoZoom(self._bins)
        self.cards[0].append(self.zoom.button)
        self.note = Sentence(text=text.NO_PINS, sizing_mode="stretch_width", margin=0)
        self.table = Table(
            title=text.PINS, stylesheets=[NARROW], sizing_mode="stretch_width", margin=0
        )

    def layout(self) -> tuple[Any, Any]:
        """Return the plots, and the table that stands below the map."""
        return stage(self.note, *self.cards), self.offer_table(self.table, "pins")

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        super().paint(dark)
        self.refresh()

    def refresh(self) -> None:
        """Inspect the pinned pixels."""
        if self.is_on_screen:
            answer, pins = self.session.answer, self.session.state.pins
            self.submit(lambda: [inspect_pixel_with_flux(answer, *pin) for pin in pins], self._draw)

    def _draw(self, found: list[Inspected]) -> None:
        unit, answer = self.session.state.unit, self.session.answer
        gate = answer.gate
        colors = pin_colors(self.is_dark)[: len(found)]
        names = [pixel_name((each.pixel.row, each.pixel.col), answer.grid) for each in found]
        cover(self._bins, gate.n_bins)
        self.zoom.follow(answer.capture, *(each.pixel.answer_bin for each in found))
        bins = plots.centres(gate.n_bins)
        for plot, quantity, curves in (
            (self.counts, "counts", [each.pixel.histogram for each in found]),
            (self.score, "score", [each.pixel.score for each in found]),
        ):
            plot.follow(unit, gate)
            named = zip(names, curves, strict=True)
            plot.keep(gate, [Curve("lines", n, bins, y, quantity) for n, y in named])
            plot.source("lines").data = {
                "xs": [bins.astype(np.float32)] * len(found),
                "ys": [np.asarray(curve, np.float32) for curve in curves],
                "color": list(colors),
                "label": names,
            }
        self.counts.frame(*(each.pixel.histogram for each in found), np.zeros(1))
        if found:
            lows, highs = zip(*(plots.score_ends(each.pixel.score) for each in found), strict=True)
            fit(self.score.figure, min(lows), max(highs))
        for each in self.cards:
            each.visible = bool(found)
        self.found = found
        self._write()

    def _write(self) -> None:
        """Write distances and table, which leave out what is not confident enough to be shown."""
        found, state = self.found, self.session.state
        viewing = state.viewing
        pixels = [each.pixel for each in found]
        self.note.text = distances(found[0].answer, pixels, viewing) if found else text.NO_PINS
        if not found:
            self.table.param.update(columns=[], rows=[])
            return
        scales = text.both_scales(state.unit, found[0].answer)
        self.table.param.update(
            columns=text.pin_columns(scales[0]),
            rows=[
                text.pin_row(each, color, *scales, viewing.least_confidence)
                for each, color in zip(found, pin_colors(self.is_dark), strict=False)
            ],
        )


def pin_colors(dark: bool) -> tuple[str, ...]:
    """Return a colour for each pin."""
    return palette(dark).methods[:MOST_PINS]
