"""The section of Inspect about the ranges along the line through the pinned pixels."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import panel as pn
from numpy.typing import NDArray

from app.model.download_text import NOTHING_DRAWN
from app.model.exports import Curve, Write, band
from app.model.large import Grid
from app.model.text import COMPUTING, cause
from app.pages.inspect import text
from app.pages.inspect.pixel import framed, stage
from app.pages.inspect.results import profile_of
from app.pages.inspect.views import NamedLayers
from app.pages.session import Session
from app.pages.shared.downloads import CORNER_PX, Shown, viewed
from app.pages.shared.section import Section
from app.plots import inspect as inspect_plots
from app.widgets.controls import LINE_PX, Sentence
from app.widgets.figures import fit, pane_of
from core.inspection import LineProfile

MARGIN = 0.06
"""Share of the ranges' spread that the axis leaves free on either side."""


class ProfileSection(Section):
    """Range against the distance along the line, with its 95 % interval.

    Attributes
    ----------
    found : LineProfile or None
        What is shown.
    plot : NamedLayers
    note : Sentence
        Where the line runs, or what to do.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, "pins", "viewing")
        self.found: LineProfile | None = None
        self.plot = NamedLayers(inspect_plots.profile())
        self.plot.figure.min_border_top = CORNER_PX  # else the button hides the legend
        self._painted = [self.plot]
        self.note = Sentence(live=True, min_height=LINE_PX, sizing_mode="stretch_width", margin=0)
        self._card = self.offer_plot(
            framed(pane_of(self.plot.figure)), "profile", self.plot, "profile"
        )

    def layout(self) -> tuple[Any, Any]:
        """Return the plot; nothing stands below the map."""
        return stage(self.note, self._card), pn.Column(margin=0)

    def saved(self, what: str, csv: Write) -> Shown:
        """Return the plot as it is saved, with the confidence and the field of view it rests on."""
        if self.found is None:
            raise ValueError(NOTHING_DRAWN)
        shown, session = super().saved(what, csv), self.session
        return Shown(viewed(session, shown.subject, session.state.viewing), what, shown.files)

    def refresh(self) -> None:
        """Compute the profile, if there is a line."""
        if not self.is_on_screen:
            return
        answer, state = self.session.answer, self.session.state
        if len(state.pins) < 2:
            self._show_nothing(text.NO_PROFILE)
            return
        if self.found is None:
            self.note.text = COMPUTING
        work = partial(profile_of, answer, state.pins, state.viewing)
        self.submit(work, self._draw, lambda error: self._show_nothing(cause(error)))

    def _show_nothing(self, why: str) -> None:
        self.found, self.note.text, self._card.visible = None, why, False

    def _draw(self, found: LineProfile) -> None:
        session = self.session
        if len(session.state.pins) < 2:
            return  # outdated
        sentence = text.profile_sentence(session.answer, found, session.state.viewing)
        if not np.isfinite(found.distance_m).any():
            self._show_nothing(sentence)
            return
        self.found, self.note.text, self._card.visible = found, sentence, True
        columns = _columns(found, session.answer.grid)
        self.plot.source("points").data = columns
        self.plot.keep(inspect_plots.DISTANCE_LABEL, _curves(columns))
        self.plot.show("truth", found.truth_m is not None)
        limits_m = [columns[name] for name in ("low", "high", "range", "truth")]
        low_m, high_m = np.nanmin(limits_m), np.nanmax(limits_m)
        free_m = MARGIN * (high_m - low_m)
        fit(self.plot.figure, float(low_m - free_m), float(high_m + free_m))
        half_m = columns["width"][[0, -1]] / 2
        start, end = found.distance_m[[0, -1]] + half_m * [-1, 1]
        self.plot.figure.x_range.update(start=start, end=end, reset_start=start, reset_end=end)


def _columns(found: LineProfile, grid: Grid) -> dict[str, NDArray[Any]]:
    """Return the data of the plot, one element a pixel."""
    row, col = grid.place(found.row, found.col)
    nothing = np.full(found.row.size, np.nan)
    ranges_m = zip(found.range_m, found.low_m, found.high_m, strict=True)
    return {
        "distance": found.distance_m,
        "width": np.gradient(found.distance_m),
        "range": found.range_m,
        "low": found.low_m,
        "high": found.high_m,
        "truth": nothing if found.truth_m is None else found.truth_m,
        "confidence": found.confidence,
        "row": row,
        "col": col,
        "text": np.array([text.range_text(*each) for each in ranges_m]),
    }


def _curves(columns: Mapping[str, NDArray[Any]]) -> list[Curve]:
    """Return the columns of the plot's file."""
    x, name = columns["distance"], inspect_plots.NAMES["interval"]
    return [
        Curve("points", "range", x, columns["range"], "m"),
        *band("interval", name, x, columns["low"], columns["high"], "m"),
        Curve("truth", "truth", x, columns["truth"], "m"),
        *(Curve("points", each, x, columns[each]) for each in ("confidence", "row", "col")),
    ]
