"""The part of Inspect that looks into one pixel, or into a region's pixels added to one."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn

from app.model.download_text import NOTHING_DRAWN
from app.model.exports import facts_file, shown_table_file
from app.model.store import Answer
from app.model.text import COMPUTING, reason
from app.pages.inspect import text as inspector_words
from app.pages.inspect.results import Seen, pixel_lit, pixel_seen, region_seen
from app.pages.inspect.views import PixelPlots
from app.pages.navigation import View
from app.pages.session import Session
from app.pages.shared.downloads import (
    PLOT,
    TABLE,
    Shown,
    below,
    downloadable,
    downloadable_facts,
    explored,
    over_the_gate,
    pixel_on_show,
    region_on_show,
)
from app.theme import palette
from app.widgets.cards import card, column, unrolled
from app.widgets.controls import FACTS_PX, LINE_PX, Facts, Sentence, Table

BREAK_PX = 1100
"""As `app.widgets.cards.BREAK_PX`, of this page."""

FACTS = ".fact-list { grid-template-columns: repeat(auto-fill, minmax(140px, 1fr)) !important; }"
FILLING = ":host { flex: 1 1 0 !important; min-height: 0; min-width: 0; }" + unrolled(BREAK_PX)
COLUMN = column(6, BREAK_PX)
FRAME = unrolled(BREAK_PX, "330px")
NARROW = """
th, td { padding: 3px 6px !important; }
tbody th { min-width: 40px !important; }
"""

FACTS_ACROSS = 4
"""Beside each other on a laptop."""

TABLE_PX = 217
"""Height of a table of the most candidates, kept free from the start."""

AT_ONCE_BINS = 1000
"""Of a gate, up to which a pixel is looked at in less time than a worker's turn would cost: 6 ms at
200 bins, 13 ms at 1000."""


def framed(*content: Any) -> pn.Column:
    """A framed picture that keeps its height where the page's parts follow each other."""
    made = card(*content)
    made.stylesheets = [*made.stylesheets, FRAME]
    return made


def stage(*content: Any) -> pn.Column:
    """What stands beside the navigator, from top to bottom."""
    return pn.Column(*content, stylesheets=[COLUMN, FILLING], sizing_mode="stretch_both", margin=0)


class Sight:
    """Everything about the pixel on show, or about the region.

    Parameters
    ----------
    session : Session
    watched : str
        What of the state it shows: "pixel" or "region".
    """

    def __init__(self, session: Session, watched: str) -> None:
        self._session = session
        self._watched = watched
        self._jobs = session.tasks.latest()
        self._tell_soon = session.tasks.soon(self._tell)
        self._is_on_screen = self._is_behind = False
        self._drawn: tuple[Answer, Seen] | None = None
        self._plots = PixelPlots()
        self._cards = [
            downloadable(framed(pane), session, what, partial(self._shown, pane.object, what), PLOT)
            for pane, what in zip(
                self._plots.panes, ("counts", "rate", "residual and enhanced"), strict=True
            )
        ]
        self._facts = Facts(stylesheets=[FACTS], sizing_mode="stretch_width")
        self._remark = Sentence(
            live=True, min_height=LINE_PX, sizing_mode="stretch_width", margin=0
        )
        self._table = Table(
            title=inspector_words.CANDIDATES,
            stylesheets=[NARROW],
            min_height=TABLE_PX,
            sizing_mode="stretch_width",
            margin=0,
        )
        session.state.param.watch(lambda *_: self._ask(), [watched, "unit"])

    @property
    def view(self) -> View:
        """The part, for the navigation."""
        return View(
            stage(
                downloadable_facts(self._facts, self._session, self._numbers_shown),
                self._remark,
                *self._cards,
            ),
            downloadable(below(self._table), self._session, "table", self._table_shown, TABLE),
            show=self._show,
            follow=lambda _: self._ask(),
            paint=self._paint,
        )

    def _show(self, is_on_screen: bool) -> None:
        self._is_on_screen = is_on_screen
        self._ask()

    def _paint(self, dark: bool) -> None:
        self._plots.paint(palette(dark))

    def _shown(self, figure: Any, what: str) -> Shown:
        return self._named(over_the_gate(self._session, figure, what))

    def _table_shown(self) -> Shown:
        table = shown_table_file(self._table.columns, self._table.rows)
        return self._named(Shown(explored(self._session), "candidates", {"csv": table}))

    def _numbers_shown(self) -> Shown:
        table = facts_file(self._facts.facts)
        return self._named(Shown(explored(self._session), "numbers", {"csv": table}))

    def _named(self, shown: Shown) -> Shown:
        """The same, told which pixel or which region it is of, once that is drawn."""
        if self._is_behind:
            raise ValueError(NOTHING_DRAWN)
        session = self._session
        if self._watched == "pixel":
            return replace(shown, what=f"{shown.what} {pixel_on_show(session)}")
        subject = replace(shown.subject, part=region_on_show(session))
        return replace(shown, what=f"{shown.what} region", subject=subject)

    def _ask(self) -> None:
        session = self._session
        if not self._is_on_screen:
            return
        answer, state = session.answer, session.state
        if self._watched == "pixel":
            if answer.capture.acquisition.n_bins <= AT_ONCE_BINS:
                self._draw(answer, pixel_seen(answer, *state.pixel))
                return
            work = partial(pixel_lit, answer, *state.pixel)
        elif state.region:
            work = partial(region_seen, answer, state.region)
            self._remark.text = COMPUTING
        else:
            self._lack(inspector_words.NO_REGION)
            return
        self._is_behind = True
        self._jobs.submit(work, partial(self._draw, answer), self._failed)

    def _failed(self, error: Exception) -> None:
        self._lack(reason(error))
        if not isinstance(error, ValueError):
            self._session.failures.report(error, part=self)

    def _lack(self, why: str) -> None:
        """Say why there is nothing to see."""
        self._drawn = None
        with pn.io.hold(self._session.page):
            self._facts.facts, self._remark.text, self._table.rows = [], why, []
            for each in self._cards:
                each.visible = False

    def _draw(self, answer: Answer, found: Seen) -> None:
        self._session.failures.resolve(self)
        if not self._is_on_screen or answer is not self._session.answer:
            return  # the user has moved on
        unit = self._session.state.unit
        with pn.io.hold(self._session.page):
            self._plots.update(found.curves, unit, answer.capture.acquisition)
            for each in self._cards:
                each.visible = True
        self._drawn = answer, found
        self._is_behind = False
        self._tell_soon()

    def _tell(self) -> None:
        """All that is read, once the plots have gone: it would hold up what the eye follows."""
        if self._drawn is None:
            return
        (answer, found), self._drawn = self._drawn, None
        unit = self._session.state.unit
        facts = inspector_words.facts(answer, found, unit)
        rows = -(-len(facts) // FACTS_ACROSS)
        scales = inspector_words.both_scales(unit, answer)
        with pn.io.hold(self._session.page):
            self._facts.param.update(facts=facts, min_height=rows * FACTS_PX)
            self._remark.text = inspector_words.remark(found)
            self._table.param.update(
                columns=inspector_words.candidate_columns(unit),
                rows=inspector_words.candidate_rows(found.report.candidates, *scales),
            )
