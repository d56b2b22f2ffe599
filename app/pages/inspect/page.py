"""The Inspect page: any pixel of any capture, understood, and believed or not."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.colors import Look, map_of
from app.model.state import MOST_PINS
from app.model.store import Answer
from app.pages.inspect import text as inspector_words
from app.pages.inspect.capture import Whole
from app.pages.inspect.pins import Pins, pin_colors
from app.pages.inspect.pixel import BREAK_PX, COLUMN, FILLING, Sight, framed
from app.pages.inspect.views import Corners, Navigator, rectangle
from app.pages.navigation import Page, Pages, View
from app.pages.session import Session
from app.pages.shared.downloads import CORNER_PX, IMAGE, Shown, downloadable, image_on_show
from app.pages.shared.large_view import LargeView
from app.theme import palette
from app.widgets.cards import CHOICE_PX, FIELD_PX, SELECT_PX, board, button, part
from app.widgets.controls import Chips, PixelKeys, Sentence
from core.checks import require

# The navigator with a table below on the left, plots on the right.
BOARD = board(600, 92, BREAK_PX)
TABLES = f"""
:host {{ flex: 0 1 auto !important; min-height: 0; min-width: 0; max-height: 34%;
  overflow-y: auto; }}
@media (max-width: {BREAK_PX}px) {{ :host {{ max-height: none }} }}
"""
PICTURES_MS = 60
"""The map is drawn this long after the pixel's plots, which the eye follows."""

ROW = ":host { display: flex !important; flex-wrap: wrap; align-items: center; gap: 4px 6px; }"


class Inspector:
    """The page around one session: a navigator, and what is looked at.

    Parameters
    ----------
    session : Session
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._jobs = session.tasks.latest()
        self._name_place_soon = session.tasks.soon(self._name_place)
        self._is_on_screen = self._dark = False
        self._navigator = Navigator(session.choose_pixel, self._select)
        self._navigator.figure.min_border_top = CORNER_PX  # else the button hides a number
        self._large = LargeView(session, self._navigator.figure)
        self._keys = PixelKeys(
            label="Picture to navigate by. Arrow keys move the pixel, with Shift by eight; "
            "P pins it.",
            letters="p",
            width=0,
            height=0,
            margin=0,
            styles={"position": "absolute"},
        )
        self._refusal = Sentence(warning=True, sizing_mode="stretch_width", margin=0)
        self._chips = Chips(label="Pinned pixels", sizing_mode="stretch_width", margin=0)
        self._make_controls()
        # What shows each part of the state on the picture.
        self._marks = {"pixel": self._mark, "pins": self._frame_pins, "region": self._outline}
        self._subjects = Pages(
            {
                "Pixel": lambda: Sight(session, "pixel").view,
                "Region": lambda: Sight(session, "region").view,
                "Pins": lambda: Pins(session).view,
                "Capture": lambda: Whole(session).view,
            },
            label="",
            help=inspector_words.SUBJECT_HELP,
            first=session.state.subject,
        )
        self._subjects.choice.link(session.state, value="subject", bidirectional=True)
        self._listen()

    @property
    def view(self) -> View:
        """The page."""
        explanation = pmui.Typography(inspector_words.EXPLANATION, margin=8)
        return View(
            self._board(),
            part("How to read this page", explanation, is_open=False),
            self._show,
            self._follow,
            self._paint,
        )

    # Controls

    def _make_controls(self) -> None:
        state = self._session.state
        self._map = pmui.Select.from_param(
            state.param.map,
            label="Map",
            description=inspector_words.MAP_HELP,
            size="small",
            width=118,
            min_height=SELECT_PX,
            margin=(6, 0, 0, 0),
        )
        self._mode = pmui.RadioButtonGroup(
            options=list(self._navigator.drags),
            value=next(iter(self._navigator.drags)),
            label="",
            description=inspector_words.MODE_HELP,
            size="small",
            min_height=CHOICE_PX,
            margin=0,
        )
        self._place = [_field(name, "0") for name in ("Row", "Column")]
        self._span = [_field(name, "10-20") for name in ("Rows", "Columns")]
        self._pin, self._add, self._clear = (
            button(label, help, act, margin=(6, 0, 0, 0))
            for label, help, act in (
                ("Pin this pixel", inspector_words.PIN_HELP, self._pin_pixel),
                ("Select region", inspector_words.SELECT_HELP, self._select_rectangle),
                ("Clear region", inspector_words.CLEAR_HELP, lambda: self._select(())),
            )
        )

    def _listen(self) -> None:
        state = self._session.state
        self._keys.param.watch(lambda event: self._session.choose_pixel(*event.new), "pixel")
        self._keys.param.watch(lambda _: self._pin_pixel(), "pressed")
        drags = {"toolbar": self._navigator.figure.toolbar, "drags": self._navigator.drags}
        # In the browser, where a hand drags before the server has heard of it.
        self._mode.jscallback(value="toolbar.active_drag = drags[source.value]", args=drags)
        for axis, field in enumerate(self._place):
            field.param.watch(lambda event, at=axis: self._go_to_typed(at, event.new), "value")
        self._chips.param.watch(lambda event: self._session.choose_pixel(*event.new[0]), "chosen")
        self._chips.param.watch(lambda event: self._unpin(event.new[0]), "removed")
        for name, draw in self._marks.items():
            state.param.watch(lambda _, draw=draw: self._draw_mark(draw), name)
        state.param.watch(lambda *_: self._ask_map(), ["map", "viewing"])

    def _board(self) -> pn.Column:
        subjects = self._subjects
        for main, below in zip(subjects.mains.values(), subjects.asides.values(), strict=True):
            main.param.update(stylesheets=[FILLING], sizing_mode="stretch_both", margin=0)
            below.param.update(stylesheets=[TABLES], sizing_mode="stretch_width", margin=0)
        left = pn.Column(
            _row(self._map, self._mode, self._clear),
            downloadable(
                framed(self._navigator.pane, self._keys), self._session, "map", self._shown, IMAGE
            ),
            self._large.layout,
            _row(*self._place, self._pin),
            _row(*self._span, self._add),
            self._refusal,
            self._chips,
            *subjects.asides.values(),
            stylesheets=[COLUMN],
            sizing_mode="stretch_both",
            margin=0,
        )
        right = pn.Column(
            subjects.choice,
            *subjects.mains.values(),
            stylesheets=[COLUMN],
            sizing_mode="stretch_both",
            margin=0,
        )
        return pn.Column(left, right, stylesheets=[BOARD], sizing_mode="stretch_both", margin=0)

    # What the app tells the page

    def _show(self, is_on_screen: bool) -> None:
        self._is_on_screen = is_on_screen
        if is_on_screen:
            self._enter()
            self._ask_map()
        self._large.show(is_on_screen)
        self._subjects.show(is_on_screen)

    def _follow(self, answer: Answer) -> None:
        self._large.follow(answer)
        if self._is_on_screen:
            self._enter()
            self._subjects.follow(answer)
            # As on Explore: the eye follows the plots.
            tasks = self._session.tasks
            tasks.call_later(PICTURES_MS, partial(tasks.run_next, self._ask_map))

    def _paint(self, dark: bool) -> None:
        self._dark = dark
        self._navigator.paint(palette(dark))
        self._subjects.paint(dark)
        self._draw_mark(self._frame_pins)

    # What the user does

    def _refusing(self, act: Callable[[], None]) -> None:
        """Do something, or say why not."""
        try:
            act()
        except ValueError as error:
            self._refusal.text = str(error).capitalize()
        else:
            self._refusal.text = ""

    def _go_to_typed(self, axis: int, typed: str) -> None:
        state = self._session.state

        def go() -> None:
            place = list(here)
            name = self._place[axis].label.lower()
            place[axis] = _whole(name, typed, *self._ends(axis))
            self._session.choose_pixel(*grid.pixel(*place))

        grid = self._session.answer.grid
        here = grid.place(*state.pixel)
        if typed != str(here[axis]):  # else it was not typed
            self._refusing(go)

    def _select_rectangle(self) -> None:
        def select() -> None:
            rows, cols = (
                _span(field.label.lower(), field.value, *self._ends(axis))
                for axis, field in enumerate(self._span)
            )
            grid = self._session.answer.grid
            self._select(tuple(grid.index(*corner) for corner in rectangle(rows, cols)))

        self._refusing(select)

    def _select(self, region: Corners) -> None:
        state = self._session.state
        state.region = region
        if region:
            state.subject = "Region"
        elif state.subject == "Region":
            state.subject = "Pixel"

    def _pin_pixel(self) -> None:
        state = self._session.state

        def pin() -> None:
            if state.pixel not in state.pins:
                if len(state.pins) >= MOST_PINS:
                    raise ValueError(inspector_words.TOO_MANY_PINS)
                state.pins = (*state.pins, state.pixel)

        self._refusing(pin)

    def _unpin(self, pixel: list[int]) -> None:
        state = self._session.state
        state.pins = tuple(pin for pin in state.pins if pin != tuple(pixel))
        self._refusal.text = ""

    def _shown(self) -> Shown:
        """The map, as it is taken away."""
        kind = self._session.state.map
        return image_on_show(self._session, kind, self._navigator.figure, f"map {kind}")

    # What is drawn

    def _enter(self) -> None:
        """Come to the capture that is shown now."""
        answer = self._session.answer
        self._keys.shape = list(answer.capture.shape)
        self._navigator.fit(*answer.capture.shape, answer.grid)
        for draw in self._marks.values():
            self._draw_mark(draw)

    def _ends(self, axis: int) -> tuple[int, int]:
        """First and last row of the file that can be chosen here, or column."""
        answer = self._session.answer
        last = answer.grid.place(*(size - 1 for size in answer.capture.shape))
        return answer.grid.first[axis], last[axis]

    def _draw_mark(self, draw: Callable[[], None]) -> None:
        if self._is_on_screen:
            with pn.io.hold(self._session.page):
                draw()

    def _mark(self) -> None:
        pixel = self._session.state.pixel
        self._navigator.mark(*pixel)
        self._keys.pixel = list(pixel)
        self._name_place_soon()

    def _name_place(self) -> None:
        pixel, grid = self._session.state.pixel, self._session.answer.grid
        with pn.io.hold(self._session.page):
            for field, at in zip(self._place, grid.place(*pixel), strict=True):
                field.value = str(at)

    def _frame_pins(self) -> None:
        pins, colors = self._session.state.pins, pin_colors(self._dark)
        self._navigator.pin(pins, colors)
        self._chips.chips = [
            [list(pin), inspector_words.pixel_name(pin, self._session.answer.grid), color]
            for pin, color in zip(pins, colors, strict=False)
        ]

    def _outline(self) -> None:
        region = self._session.state.region
        self._navigator.outline(region)
        self._clear.disabled = not region

    def _ask_map(self) -> None:
        if self._is_on_screen:
            session, state = self._session, self._session.state
            work = partial(map_of, session.answer, state.map, state.viewing.least_confidence)
            fail = partial(session.failures.report, part=self)
            self._jobs.submit(work, partial(self._draw_map, session.answer), fail)

    def _draw_map(self, answer: Answer, drawn: tuple[Any, Look]) -> None:
        self._session.failures.resolve(self)
        if answer is self._session.answer:
            with pn.io.hold(self._session.page):
                self._navigator.update(*drawn)


def _row(*content: Any) -> pn.Row:
    return pn.Row(*content, stylesheets=[ROW], sizing_mode="stretch_width", margin=0)


def _field(label: str, example: str) -> pmui.TextInput:
    return pmui.TextInput(
        label=label,
        placeholder=example,
        size="small",
        width=86,
        min_height=FIELD_PX,
        margin=(6, 0, 0, 0),
    )


def _whole(name: str, text: str, first: int, last: int) -> int:
    """A row or column that was typed."""
    text = text.strip()
    inside = text.isdecimal() and first <= int(text) <= last
    require(name, text, inside, f"a whole number from {first} to {last}")
    return int(text)


def _span(name: str, text: str, first: int, last: int) -> tuple[int, int]:
    """From which row to which, or column, as typed."""
    ends = [int(each) for each in re.findall(r"\d+", text)]
    inside = len(ends) in (1, 2) and first <= min(ends) and max(ends) <= last
    require(name, text, inside, f"two whole numbers from {first} to {last}, such as 10-20")
    return min(ends), max(ends)


PAGE = Page("Inspect", Inspector, "into any pixel of a capture")
