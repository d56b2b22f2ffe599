"""The Inspect page: a map to choose from, and everything known about what was chosen."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.colors import legend, map_of
from app.model.state import Viewing
from app.model.store import Answer
from app.model.text import pixel_name
from app.pages.inspect import text
from app.pages.inspect.capture import CaptureSection
from app.pages.inspect.pair import PairSection
from app.pages.inspect.pins import PinsSection, pin_colors
from app.pages.inspect.pixel import (
    BREAK_PX,
    COLUMN,
    FILLING,
    NARROW,
    PixelSection,
    framed,
    is_immediate,
)
from app.pages.inspect.profile import ProfileSection
from app.pages.inspect.results import Corners
from app.pages.inspect.views import Navigator, Pixels, rectangle
from app.pages.navigation import Page, Pages
from app.pages.session import Session
from app.pages.shared.crop import CropSection
from app.pages.shared.downloads import IMAGE_AND_REPORT, Shown, image_on_show
from app.pages.shared.large_view import LargeView
from app.pages.shared.measure import pin_pixel
from app.pages.shared.section import Section
from app.tasks import scheduler
from app.widgets.cards import (
    CHOICE_PX,
    FIELD_PX,
    SELECT_PX,
    board,
    button,
    choice,
    part,
    steady,
    unrolled,
)
from app.widgets.component import until_session_ends
from app.widgets.controls import (
    KNOB_PX,
    Chips,
    PixelKeys,
    Sentence,
    SettingsPanel,
    Table,
    legend_line,
)
from app.widgets.image_view import CONTAINER
from core.checks import require
from core.inference import fit_of, has_fit
from core.inspection import FaultyPixel, faulty_pixels, maps
from core.io import ColorScale, RangeColors

# The map with a table below on the left, plots on the right.
BOARD = board(600, 88, BREAK_PX)
# The map keeps its size, whatever is said below it: the table takes what is left.
MAP = steady(46, BREAK_PX)
TABLES = """
:host { flex: 1 1 0 !important; min-height: 96px; min-width: 0; overflow-y: auto; }
""" + unrolled(BREAK_PX)
MAP_DELAY_MS = 60
"""The map is drawn this long after the pixel's plots, which the eye follows."""

LISTED = ".scroll { max-height: 232px; overflow-y: auto; }"
"""Style of a list in the sidebar: it scrolls."""

SELECT = {"flex": "1 1 118px", "max-width": "150px"}
"""Style of the list of maps: on a phone it is narrower, so that the buttons stay beside it."""

ROW = ":host { display: flex !important; flex-wrap: wrap; align-items: center; gap: 4px 6px; }"


class Inspect(Section):
    """The page: the map, and sections about the pixel, the region, the pins and the capture.

    Attributes
    ----------
    navigator : Navigator
        The map.
    keys : PixelKeys
        The keyboard of the map.
    place, span : list of pmui.TextInput
        Row and column of the pixel, rows and columns of a region.
    crop : CropSection
        The box to which the cloud is cropped.
    chips : Chips
        The pinned pixels.
    legend : Sentence
        The number of pixels hidden on the map.
    least_confidence : Knob
        Estimates of less confidence are hidden.
    faulty : Table
        The hot and dead pixels that differ most from their neighbours.
    n_faulty : Sentence
        How many there are.
    refusal : Sentence
        Why the last action was refused.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        state = session.state
        self.navigator = Navigator(session.choose_pixel, self._select, self._join)
        self._painted = [self.navigator]
        self._large = LargeView(session, self.navigator.figure)
        self.keys = PixelKeys(
            label="Map. Arrow keys move the pixel, with Shift by eight; P pins it.",
            letters="p",
            width=0,
            height=0,
            margin=0,
            styles={"position": "absolute"},
        )
        self.legend = legend_line()
        self._viewing = SettingsPanel(Viewing(), partial(setattr, state, "viewing"))
        self.least_confidence = self._viewing.controls["least_confidence"]
        self.least_confidence.min_height = KNOB_PX
        self.refusal = Sentence(warning=True, sizing_mode="stretch_width", margin=0)
        self.n_faulty = Sentence(sizing_mode="stretch_width", margin=(4, 8))
        self.faulty = Table(
            title=text.FAULTY, stylesheets=[NARROW, LISTED], sizing_mode="stretch_width", margin=0
        )
        # Sent and drawn only where there are such pixels.
        self._faulty_part = part(text.FAULTY, self.n_faulty, self.faulty, is_shown=False)
        self.crop = CropSection(session)
        self.chips = Chips(label="Pinned pixels", sizing_mode="stretch_width", margin=0)
        self._map = pmui.Select.from_param(
            state.param.map,
            label="Map",
            description=text.MAP_HELP,
            size="small",
            sizing_mode="stretch_width",
            styles=SELECT,
            min_height=SELECT_PX,
            margin=(6, 0, 0, 0),
        )
        self._mode = pmui.RadioButtonGroup(
            options=list(self.navigator.drags),
            value=next(iter(self.navigator.drags)),
            label="",
            description=text.MODE_HELP,
            size="small",
            min_height=CHOICE_PX,
            margin=0,
        )
        self.place = [_field(name, "0") for name in ("Row", "Column")]
        self.span = [_field(name, "10-20") for name in ("Rows", "Columns")]
        self._pin, self._add, self._clear = (
            button(label, help, act, margin=(6, 0, 0, 0))
            for label, help, act in (
                ("Pin this pixel", text.PIN_HELP, self._pin_pixel),
                ("Select region", text.SELECT_HELP, self._select_rectangle),
                ("Clear region", text.CLEAR_HELP, lambda: self._select(())),
            )
        )
        self._sections = Pages(
            session,
            {
                "Pixel": partial(PixelSection, subject="pixel"),
                "Region": partial(PixelSection, subject="region"),
                "Pins": PinsSection,
                "Profile": ProfileSection,
                "A/B": PairSection,
                "Capture": CaptureSection,
            },
            label="",
            help=text.SUBJECT_HELP,
            first=state.subject,
        )
        self._sections.choice.link(state, value="subject", bidirectional=True)
        self._plot = choice(text.PLOT_HELP, state.param.plot)
        self._plot.margin = (2, 0)
        self._marks = {"pixel": self._mark, "pins": self._frame_pins, "region": self._outline}
        self._write_place_soon = session.tasks.soon(self._write_place)
        self._listen()

    def _listen(self) -> None:
        session, state = self.session, self.session.state
        self.keys.param.watch(lambda event: session.choose_pixel(*event.new), "pixel")
        self.keys.param.watch(lambda _: self._pin_pixel(), "pressed")
        drags = {"toolbar": self.navigator.figure.toolbar, "drags": self.navigator.drags}
        # In the browser, since a drag may begin before the server has heard of the choice.
        choose = "toolbar.active_drag = drags[source.value]"
        until_session_ends(self._mode.jscallback(value=choose, args=drags))
        for axis, field in enumerate(self.place):
            field.param.watch(lambda event, axis=axis: self._go_to(axis, event.new), "value")
        self.faulty.param.watch(lambda event: self._inspect(event.new[0]), "acted")
        self.chips.param.watch(lambda event: session.choose_pixel(*event.new[0]), "chosen")
        self.chips.param.watch(lambda event: self._unpin(event.new[0]), "removed")
        for name, draw in self._marks.items():
            state.param.watch(lambda _, draw=draw: self._draw_mark(draw), name)
        state.param.watch(lambda *_: self._draw_mark(self._frame_pins), "subject")
        state.param.watch(lambda *_: self._request_map(), ["map", "viewing"])
        state.param.watch(lambda *_: self._offer_plots(), "subject")
        self._offer_plots()

    def layout(self) -> tuple[Any, Any]:
        """Return the two columns of the page, and its part of the sidebar."""
        sections = self._sections
        framed_map = framed(self.navigator.pane, self.keys)
        framed_map.stylesheets = [*framed_map.stylesheets, CONTAINER]
        for main, below in zip(sections.mains.values(), sections.asides.values(), strict=True):
            main.param.update(stylesheets=[FILLING], sizing_mode="stretch_both", margin=0)
            below.param.update(stylesheets=[TABLES], sizing_mode="stretch_width", margin=0)
        map_card = self.offer(framed_map, "map", self._map_shown, IMAGE_AND_REPORT)
        map_card.stylesheets = [*map_card.stylesheets, MAP]
        left = (
            _row(self._map, self._mode),
            map_card,
            self.legend,
            self.least_confidence,
            self._large.layout,
            _row(*self.place, self._pin),
            _row(*self.span, self._add, self._clear),
            self.refusal,
            self.chips,
            *sections.asides.values(),
        )
        columns = (
            pn.Column(*content, stylesheets=[COLUMN], sizing_mode="stretch_both", margin=0)
            for content in (left, (_row(sections.choice, self._plot), *sections.mains.values()))
        )
        main = pn.Column(*columns, stylesheets=[BOARD], sizing_mode="stretch_both", margin=0)
        colors = [self._viewing.controls[each.name] for each in fields(RangeColors)]
        return main, [
            self._faulty_part,
            part("View", *colors, self._viewing.doubts, is_open=False),
            self.crop.part,
        ]

    def _offer_plots(self) -> None:
        self._plot.visible = self.session.state.subject in ("Pixel", "Region")

    def _map_shown(self) -> Shown:
        kind = self.session.state.map
        return image_on_show(self.session, kind, self.navigator.figure, f"map {kind}")

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        self.is_on_screen = is_on_screen
        if is_on_screen:
            self._enter()
            self._request_map()
        self._large.show(is_on_screen)
        self.crop.show(is_on_screen)
        self._sections.show(is_on_screen)

    def follow(self, answer: Answer) -> None:
        """Show another estimate of the session."""
        self._large.follow(answer)
        self.crop.refresh()
        if self.is_on_screen:
            self._enter()
            self._sections.follow(answer)
            tasks = self.session.tasks
            tasks.call_later(MAP_DELAY_MS, partial(tasks.run_next, self._request_map))

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        super().paint(dark)
        self._sections.paint(dark)
        self._draw_mark(self._frame_pins)

    # Actions of the user

    def _attempt(self, act: Callable[[], None]) -> None:
        """Do something, or show why it is refused."""
        try:
            act()
        except ValueError as error:
            self.refusal.text = str(error).capitalize()
        else:
            self.refusal.text = ""

    def _go_to(self, axis: int, typed: str) -> None:
        grid = self.session.answer.grid
        place = list(grid.place(*self.session.state.pixel))
        if typed == str(place[axis]):
            return  # written by the page, not typed

        def go() -> None:
            place[axis] = _integer(self.place[axis].label.lower(), typed, *self._ends(axis))
            self.session.choose_pixel(*grid.pixel(*place))

        self._attempt(go)

    def _select_rectangle(self) -> None:
        def select() -> None:
            rows, cols = (
                _span(field.label.lower(), field.value, *self._ends(axis))
                for axis, field in enumerate(self.span)
            )
            grid = self.session.answer.grid
            self._select(tuple(grid.index(*corner) for corner in rectangle(rows, cols)))

        self._attempt(select)

    def _select(self, region: Corners) -> None:
        state = self.session.state
        state.region = region
        if region:
            state.subject = "Region"
        elif state.subject == "Region":
            state.subject = "Pixel"

    def _join(self, pixels: Pixels) -> None:
        """Pin the pixels that a line joins, and show the profile along it."""
        if len(pixels) > 1:
            self.session.state.param.update(pins=pixels, subject="Profile")

    def _inspect(self, pixel: list[int]) -> None:
        """Choose a pixel and show what is known about it."""
        self.session.choose_pixel(*pixel)
        self.session.state.subject = "Pixel"

    def _pin_pixel(self) -> None:
        self._attempt(partial(pin_pixel, self.session))

    def _unpin(self, pixel: list[int]) -> None:
        state = self.session.state
        state.pins = tuple(pin for pin in state.pins if pin != tuple(pixel))
        self.refusal.text = ""

    # Drawing

    def _enter(self) -> None:
        """Fit the map to the present capture."""
        answer = self.session.answer
        self.keys.shape = list(answer.capture.shape)
        self.navigator.fit(*answer.capture.shape, answer.grid)
        for draw in self._marks.values():
            self._draw_mark(draw)

    def _ends(self, axis: int) -> tuple[int, int]:
        """Return the first and last row (or column) of the file that can be chosen."""
        answer = self.session.answer
        last = answer.grid.place(*(size - 1 for size in answer.capture.shape))
        return answer.grid.first[axis], last[axis]

    def _draw_mark(self, draw: Callable[[], None]) -> None:
        if self.is_on_screen:
            with self.session.tasks.hold():
                draw()

    def _mark(self) -> None:
        pixel = self.session.state.pixel
        self.navigator.mark(*pixel)
        self.keys.pixel = list(pixel)
        self._write_place_soon()

    def _write_place(self) -> None:
        pixel, grid = self.session.state.pixel, self.session.answer.grid
        with self.session.tasks.hold():
            for field, at in zip(self.place, grid.place(*pixel), strict=True):
                field.value = str(at)

    def _frame_pins(self) -> None:
        pins, colors = self.session.state.pins, pin_colors(self.is_dark)
        self.navigator.pin(pins, colors)
        self.navigator.join_pins(pins if self.session.state.subject == "Profile" else ())
        self.chips.chips = [
            [list(pin), pixel_name(pin, self.session.answer.grid), color]
            for pin, color in zip(pins, colors, strict=False)
        ]

    def _outline(self) -> None:
        region = self.session.state.region
        self.navigator.outline(region)
        self._clear.disabled = not region

    def _request_map(self) -> None:
        if self.is_on_screen:
            answer, state = self.session.answer, self.session.state
            kind, viewing = state.map, state.viewing
            self._viewing.show(viewing)

            def work() -> tuple[tuple[Any, ColorScale], list[FaultyPixel]]:
                fit_of(answer.capture)  # stated by the legend
                return map_of(answer, kind, viewing), faulty_pixels(answer.capture)

            def draw(found: tuple[tuple[Any, ColorScale], list[FaultyPixel]]) -> None:
                drawn, faulty = found
                self.navigator.update(*drawn)
                self.legend.text = legend(answer, kind, viewing, *drawn)
                self._list_faulty(answer, faulty)

            self.submit(work, draw, lane=_map_lane(answer, kind))

    def _list_faulty(self, answer: Answer, faulty: list[FaultyPixel]) -> None:
        """Mark and list the hot and dead pixels."""
        self.navigator.mark_faulty(faulty)
        listed = text.listed(faulty)
        self._faulty_part.visible = bool(faulty)
        self.n_faulty.text = text.faulty_sentence(faulty, len(listed))
        self.faulty.param.update(
            columns=text.FAULTY_COLUMNS if listed else [],
            rows=[text.faulty_row(each, answer.grid) for each in listed],
        )


def _map_lane(answer: Answer, kind: str) -> scheduler.Lane:
    """Return where to make a map: one that takes less time than drawing it comes with the page."""
    is_quick = is_immediate(answer) and has_fit(answer.capture) and kind not in maps
    return scheduler.PAGE if is_quick else scheduler.GENERAL


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


def _integer(name: str, text: str, first: int, last: int) -> int:
    """Parse a row or column."""
    text = text.strip()
    inside = text.isdecimal() and first <= int(text) <= last
    require(name, text, inside, f"a whole number from {first} to {last}")
    return int(text)


def _span(name: str, text: str, first: int, last: int) -> tuple[int, int]:
    """Parse a range of rows or columns."""
    ends = [int(each) for each in re.findall(r"\d+", text)]
    inside = len(ends) in (1, 2) and first <= min(ends) and max(ends) <= last
    require(name, text, inside, f"two whole numbers from {first} to {last}, such as 10-20")
    return min(ends), max(ends)


PAGE = Page(
    "Inspect",
    Inspect,
    "shows everything known about a pixel, a region or the capture",
    text.EXPLANATION,
)
