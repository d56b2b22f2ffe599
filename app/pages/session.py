"""One user's session: connects what is chosen, what is computed and what is shown."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any

import numpy as np
import panel as pn
import param
from tornado.ioloop import IOLoop

from app.model import text as words
from app.model.address import Wanted, defaults, query_of
from app.model.colors import cloud_of, image_of
from app.model.state import CLOUD_COLORS, IMAGES, MAPS, NEED_TRUTH, Comparison, State, Viewing
from app.model.store import (
    Answer,
    Request,
    Source,
    compute,
    effort_of,
    inspect,
    same_pixels,
    same_view,
)
from app.tasks.jobs import LatestWins
from app.tasks.turns import TURNS, Soon
from app.theme import WRONG_COLOR, palette
from app.widgets.cloud import PointCloud
from app.widgets.controls import FACTS_PX, HEADLINE_PX, Facts, PixelKeys
from app.widgets.image_view import ImageView
from app.widgets.signal_plots import SignalPlots
from core.inspection import pixels_in

log = logging.getLogger(__name__)

WAIT_MS = 200
"""What takes longer than this is shown to be under way."""

COMPUTED_FROM = ("source", "light", "reading", "window", "less", "absent", "tracking")
"""Of the state, what an answer is computed from."""

BROUGHT = ("pixel", "pins", "region", "viewing", "comparison")
"""Of the state, what depends on the capture unless it is chosen."""

REST_MS = 60
"""Image and cloud are drawn this much after the pixel's plots, which are what the eye follows."""

REST_AT_MOST_S = 1.0
"""Where other pages wait for their turn, image and cloud wait too, but not longer than this."""


class Session:
    """State, answer and views of one page.

    Parameters
    ----------
    sources : mapping of str to Source
        What can be looked at; copied, so that an upload belongs to this session alone.
    wanted : Wanted, optional
        What the address of the page asks for.

    Attributes
    ----------
    own_field_of_view_deg : float
        The field of view that suits the present capture.
    refused : list of str
        A sentence on each thing that the address asked for in vain.
    announce : callable
        Called with each new answer, after its plots have been drawn.
    complain : callable
        Called with a sentence when something failed, and with an empty one when it works again.
    waiting : callable
        Called with True when an answer takes long, and with False when it is there.
    """

    def __init__(self, sources: Mapping[str, Source], wanted: Wanted | None = None) -> None:
        wanted = wanted or Wanted({})
        self.sources = dict(sources)
        key, first = next(iter(self.sources.items()))
        # Who brings a file wants to look into it.
        self._own = {"source": key, "page": "Explore" if first.is_scene else "Inspect"}
        self.state = State(**self._own)
        self.cloud = PointCloud(wrong_color=WRONG_COLOR, sizing_mode="stretch_both")
        self.figures = Facts(timed=True, min_height=HEADLINE_PX, sizing_mode="stretch_width")
        self.numbers = Facts(min_height=2 * FACTS_PX, sizing_mode="stretch_width")
        self.announce: Callable[[Answer], None] = lambda answer: None
        self.complain: Callable[[str], None] = lambda sentence: None
        self.waiting: Callable[[bool], None] = lambda is_waiting: None
        self.page = pn.state.curdoc
        self._served = self.is_served
        self._jobs: LatestWins[Answer] = LatestWins(self.on_page)
        self._loop = IOLoop.current() if self._served else None
        self._ask_pixel = Soon(self.on_page, self._draw_pixel)
        self._failures: dict[object, str] = {}
        self._rest_is_due = self._is_waiting = False
        self._rest_asked_s = 0.0
        self._asked_s: float | None = None
        self.answer = self._first_answer(wanted)
        self._is_hidden, self._is_outdated = self.state.page != "Explore", False
        self._show(self.answer, first=True)
        self._watch()
        self._return_to(wanted)

    @property
    def is_served(self) -> bool:
        """Whether there is a browser on the other side."""
        return self.page is not None and self.page.session_context is not None

    @property
    def is_gone(self) -> bool:
        """Whether there was a browser, and is none any more."""
        return self._served and not self.is_served

    # Plots that a page which opens elsewhere need not wait for.

    @cached_property
    def signals(self) -> SignalPlots:
        """The pixel's plots."""
        return SignalPlots()

    @cached_property
    def image(self) -> ImageView:
        """The range image."""
        return ImageView(self.choose_pixel)

    @cached_property
    def image_keys(self) -> PixelKeys:
        """The range image, with the keyboard."""
        made = PixelKeys(child=self.image.pane, sizing_mode="stretch_both")
        made.param.watch(lambda event: self.choose_pixel(*event.new), "pixel")
        return made

    def _first_answer(self, wanted: Wanted) -> Answer:
        """To what the address asks for; to less of it where that cannot be computed."""
        before = defaults() | self._own
        asked = wanted.of({name: before[name] for name in before if name not in BROUGHT})
        if asked.get("source", self._own["source"]) not in self.sources:
            wanted.refused.append(words.source_is_gone(asked["source"]))
            of_it = ("source", "reading", "window", "less")
            asked = {name: each for name, each in asked.items() if name not in of_it}
        plain = {n: each for n, each in asked.items() if n not in COMPUTED_FROM}
        here = {n: each for n, each in asked.items() if n == "source"}
        for attempt in (asked, plain | here, plain):
            self.state.param.update(before | attempt)
            try:
                return compute(self._request(), None)
            except Exception as error:  # whatever it is, the page must tell it
                log.warning("what the address asks for failed", exc_info=error)
                wanted.refused.append(words.reason(error))
        return compute(self._request(), None)

    def _return_to(self, wanted: Wanted) -> None:
        """To what the address asks for of what the capture brings, and tell what was refused."""
        rows, cols = self.answer.capture.shape
        before = defaults() | brought_by(self.answer)
        brought = wanted.of({name: before[name] for name in BROUGHT})
        asked, row_col = brought.get("pins", ()), brought.pop("pixel", self.state.pixel)
        brought["pins"] = tuple(pin for pin in asked if pin[0] < rows and pin[1] < cols)
        if brought["pins"] != asked:
            wanted.refused.append(words.pins_outside(rows, cols))
        self.choose_pixel(*row_col)
        self.state.param.update(brought)
        wanted.refuse_others()
        self.refused = wanted.refused

    def query(self) -> str:
        """What the address of a page says that shows what this one does."""
        return query_of(self.state, self._own | brought_by(self.answer))

    def _watch(self) -> None:
        watch = self.state.param.watch
        watch(lambda *_: self.renew(), list(COMPUTED_FROM))
        watch(lambda *_: self._ask_pixel(), ["pixel", "difference", "unit"])
        watch(lambda *_: self.on_page(self._draw_rest), ["image", "cloud_color", "viewing"])
        self.cloud.param.watch(lambda event: self.pick(event.new), "selected")

    def paint(self, dark: bool) -> None:
        """Follow the page from light to dark and back."""
        with pn.io.hold(self.page):
            self.signals.paint(palette(dark))
            self.image.paint(palette(dark))
            self.cloud.dark = dark

    def show(self, is_on_screen: bool) -> None:
        """Draw only what is on screen; what was missed is drawn when it comes back."""
        self._is_hidden = not is_on_screen
        if is_on_screen and self._is_outdated:
            self._is_outdated = False
            self._draw_pixel()
            self._draw_rest()

    def _request(self) -> Request:
        state = self.state
        source = self.sources[state.source]
        return Request(
            source,
            state.light,
            state.reading,
            state.tracking,
            state.less,
            state.absent,
            state.window,
        )

    def renew(self) -> None:
        """Answer anew: something else is asked for, or more has been read of what is looked at."""
        request = self._request()
        work = partial(compute, request, self.answer)
        failed = partial(self._failed, request)
        self._jobs.submit(work, self._show, failed, effort_of(request, self.answer))
        if self._asked_s is None:
            self._await()

    def _await(self) -> None:
        self._asked_s = perf_counter()
        self.wait(WAIT_MS, self._admit_waiting)

    def _admit_waiting(self) -> None:
        """Show that an answer is under way, if the oldest open request is that old."""
        if self._asked_s is not None and perf_counter() - self._asked_s >= 0.9e-3 * WAIT_MS:
            self._is_waiting = True
            self.tell(partial(self.waiting, True))

    def _end_waiting(self) -> None:
        """Show no more that an answer is under way, unless the next one is asked for already."""
        if self._asked_s is None and self._is_waiting:
            self._is_waiting = False
            self.waiting(False)

    def _settle(self, answer: Answer) -> None:
        self._asked_s = None
        if self._jobs.has_more:
            self._await()
        elif self._is_waiting:
            self.wait(WAIT_MS, partial(self.tell, self._end_waiting))
        self.announce(answer)

    def on_page(self, act: Callable[[], None], due: Callable[[], None] | None = None) -> None:
        """Do something on the page's thread, in turn with other pages, if it is still there.

        What was computed gives up its place by `due`, which is called when its turn has come, even
        if the page is gone.
        """
        give_up = due or (lambda: None)
        if self._loop is None:
            give_up()
            act()
            return

        def begin() -> None:
            give_up()
            self.tell(act)

        self._loop.add_callback(TURNS.ask, begin, is_computed=due is not None)

    def tell(self, act: Callable[[], None]) -> None:
        """Do something small on the page, on its thread, ahead of what waits for its turn."""
        if self.is_served:  # else the page is gone, and nobody left to see it
            self.page.add_next_tick_callback(self._told(act))

    def wait(self, wait_ms: int, act: Callable[[], None]) -> None:
        """Do something after a while, on the page's thread but not on the page: that is for `tell`.

        To come to the page costs a multiple of what most have to do that only look at the clock.
        """
        if self._loop is not None:
            self._loop.call_later(1e-3 * wait_ms, act)

    def _told(self, act: Callable[[], None]) -> Callable[[], None]:
        """The same, to be done once, its failure told by the page."""
        # Bokeh's callbacks hold themselves in a circle. An answer that stayed in there would live
        # until the collector of garbage comes by, which is seldom.
        once = [act]

        def attempt() -> None:
            try:
                once.pop()()
            except Exception as error:  # whatever it is, the page must tell it
                self.fail(error)

        return attempt

    def _failed(self, request: Request, error: Exception) -> None:
        """Return to what the picture shows, unless the user has moved on."""
        shown, state = self.answer.request, self.state
        if request == self._request():
            with param.discard_events(state):
                state.param.update(
                    source=self.key(shown.source),
                    reading=shown.reading,
                    less=shown.less,
                    absent=shown.absent,
                    window=shown.window,
                )
        self._settle(self.answer)
        self.fail(error)

    def fail(
        self,
        error: Exception,
        told: Callable[[Exception], str] = words.failure,
        of: object = None,
    ) -> None:
        """Tell the page of an error, and stay usable; `of` which part of the page, if of one."""
        log.warning("a request failed", exc_info=error)
        self._failures.pop(of, None)  # it is the latest again
        self._failures[of] = told(error)
        self.complain(self._failures[of])

    def recover(self, of: object) -> None:
        """Take back what the page was told of a part: it works again, or is retried."""
        if self._failures.pop(of, None) is not None:
            latest = next(reversed(self._failures.values()), None)
            self.complain(words.lack(self.answer) if latest is None else latest)

    def key(self, source: Source) -> str:
        """Of a source in the catalogue."""
        return next(key for key, known in self.sources.items() if known is source)

    def _show(self, answer: Answer, first: bool = False) -> None:
        previous, self.answer = self.answer, answer
        if self.state.less == answer.asked != answer.request.less:  # too much for one request
            with param.discard_events(self.state):
                self.state.less = answer.request.less
        if first or not same_view(answer.request, previous.request):
            self._enter(answer, previous)
        self._failures.clear()
        with pn.io.hold(self.page):  # all that follows from it arrives at once
            self.complain(words.lack(answer))
            self._draw_pixel()
            self._settle(answer)
        if first or not self.is_served:
            self._draw_rest()
        elif not self._rest_is_due:
            self._rest_is_due = True
            self._rest_asked_s = perf_counter()
            self.wait(REST_MS, self._ask_rest)

    def _enter(self, answer: Answer, previous: Answer) -> None:
        """Come to a capture of another kind: its own field of view, camera and, maybe, pixel."""
        has_truth = answer.capture.truth_range_m is not None
        for name, kinds in (("image", IMAGES), ("map", MAPS), ("cloud_color", CLOUD_COLORS)):
            possible = [kind for kind in kinds if has_truth or kind not in NEED_TRUTH]
            self.state.param[name].objects = possible
            if getattr(self.state, name) not in possible:
                setattr(self.state, name, possible[0])
        own, state = brought_by(answer), self.state
        self.own_field_of_view_deg = own["viewing"].field_of_view_deg
        as_wide = {"field_of_view_deg": self.own_field_of_view_deg}
        compared = replace(state.comparison.viewing, **as_wide)
        here = {"pixel": state.pixel, "pins": state.pins, "region": state.region}
        state.param.update(
            viewing=replace(state.viewing, **as_wide),
            comparison=replace(state.comparison, viewing=compared),
            **{"pixel": own["pixel"], "pins": (), "region": ()}
            | (carried(here, previous, answer) if answer is not previous else {}),
        )

    def choose_pixel(self, row: int, col: int) -> None:
        """Show another pixel; one outside the image means the nearest inside."""
        rows, cols = self.answer.capture.shape
        with pn.io.hold(self.page):  # all that follows it arrives at once
            self.state.pixel = (min(max(row, 0), rows - 1), min(max(col, 0), cols - 1))

    def pick(self, index: int) -> None:
        """Show the pixel of this place in the flattened image; -1 is none."""
        if index >= 0:
            self.choose_pixel(*divmod(index, self.answer.capture.shape[1]))

    def _ask_rest(self) -> None:
        """Draw image and cloud, unless others wait for what comes first."""
        if TURNS.is_crowded and perf_counter() - self._rest_asked_s < REST_AT_MOST_S:
            self.wait(REST_MS, self._ask_rest)
        else:
            self.on_page(self._draw_rest)

    def _draw_pixel(self) -> None:
        """The pixel's plots and numbers, and the frames that mark it."""
        if self._is_hidden:
            self._is_outdated = True
            return
        row, col = self.state.pixel
        pixel = inspect(self.answer, row, col)
        acquisition, state = self.answer.capture.acquisition, self.state
        numbers = words.pixel_numbers(self.answer, pixel, state.unit)
        with pn.io.hold(self.page):
            self.image.fit(*self.answer.capture.shape, self.answer.grid)
            self.signals.update(pixel, acquisition, state.difference, state.unit)
            self.image.mark(row, col)
            self.image_keys.shape = list(self.answer.capture.shape)
            self.image_keys.pixel = [row, col]
            self.cloud.selected = row * self.answer.capture.shape[1] + col
            self.numbers.facts = numbers
            self.figures.facts = words.figure_strip(self.answer)

    def _draw_rest(self) -> None:
        """The image and the cloud."""
        self._rest_is_due = False
        if self._is_hidden:
            self._is_outdated = True
            return
        answer, state = self.answer, self.state
        with pn.io.hold(self.page):
            self.image.update(*image_of(answer, state.image, state.viewing.least_confidence))
            self._draw_cloud()

    def _draw_cloud(self) -> None:
        answer, state = self.answer, self.state
        cloud, rgb, crosses = cloud_of(answer, state.cloud_color, state.viewing)
        self.cloud.draw(cloud, rgb, crosses, scene_id=self.scene_id())
        self.cloud.caption = words.cloud_caption(
            answer, cloud.n_points, None if crosses is None else int(crosses.sum())
        )

    def scene_id(self) -> str:
        """Changes when the camera should start anew."""
        answer, cutout = self.answer, self.answer.cutout
        acquisition = replace(answer.capture.acquisition, n_pulses=None)
        part = "" if cutout is None else f"{cutout.window} {cutout.read}"
        return f"{self.key(answer.request.source)} {answer.capture.shape} {acquisition} {part}"


def brought_by(answer: Answer) -> dict[str, Any]:
    """Values of the state that an answer brings with it; others have to be chosen."""
    as_wide = {"field_of_view_deg": float(f"{_field_of_view_deg(answer):.3g}")}
    comparison = Comparison()
    return {
        "pixel": _pixel_to_start_with(answer),
        "viewing": Viewing(**as_wide),
        "comparison": replace(comparison, viewing=replace(comparison.viewing, **as_wide)),
    }


def carried(here: Mapping[str, Any], before: Answer, answer: Answer) -> dict[str, Any]:
    """Pixel, pins and region of an answer as they are in another one, as far as they are in it."""
    if same_pixels(answer, before):
        return dict(here)
    files = [None if each.cutout is None else each.cutout.file for each in (before, answer)]
    if files[0] is None or files[0] is not files[1]:
        return {}

    def moved(row: int, col: int) -> tuple[int, int]:
        return answer.grid.pixel(*before.grid.place(row, col))

    def inside(pixel: tuple[int, int]) -> bool:
        return all(0 <= at < size for at, size in zip(pixel, answer.capture.shape, strict=True))

    pixel = moved(*here["pixel"])
    pins = filter(inside, dict.fromkeys(moved(*pin) for pin in here["pins"]))
    region = tuple(answer.grid.index(*before.grid.place(*each)) for each in here["region"])
    holds_some = bool(region) and pixels_in(region, answer.capture.shape).any()
    return {
        **({"pixel": pixel} if inside(pixel) else {}),
        "pins": tuple(pins),
        "region": region if holds_some else (),
    }


def _pixel_to_start_with(answer: Answer) -> tuple[int, int]:
    """The answered pixel nearest to the centre, among those that have a target if that is known."""
    truth_m = answer.capture.truth_range_m
    image = answer.run.image
    good = image.confidence >= 0.9 if truth_m is None else np.isfinite(truth_m)
    rows, cols = answer.capture.shape
    row, col = np.nonzero(good) if good.any() else np.nonzero(np.ones((rows, cols), bool))
    nearest = np.argmin((row - rows / 2) ** 2 + (col - cols / 2) ** 2)
    return int(row[nearest]), int(col[nearest])


def _field_of_view_deg(answer: Answer) -> float:
    """Width of the image as the capture states it; else so that it is about as wide as deep."""
    cols = answer.capture.shape[1]
    angle_rad = answer.capture.acquisition.pixel_angle_rad
    if angle_rad is None:
        image = answer.run.image
        range_m = image.range_m[image.confidence >= 0.9]
        range_m = range_m if range_m.size else answer.capture.acquisition.bin_to_range_m([0.0, 1.0])
        low, high = np.percentile(range_m, [5, 95])
        return float(np.clip(np.degrees((high - low) / max(high, 1e-3)), 0.001, 120.0))
    return float(np.degrees(2 * np.arctan(cols / 2 * np.tan(angle_rad))))
