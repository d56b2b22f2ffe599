"""Controls below a picture of a file larger than memory: the window that is shown."""

from __future__ import annotations

import math
import re
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.large import Cutout, LargeFile, Progress
from app.model.store import Answer
from app.pages.session import Session
from app.pages.shared.studies import OnePiece
from app.tasks.scheduler import Work
from app.widgets.cards import button, sent_when_visible
from app.widgets.controls import Sentence
from core import Window
from core.checks import require

Bounds = tuple[int, int]
"""First row or column, and the one behind the last."""


class LargeView:
    """Controls of the window that is shown; hidden for a capture that fits into memory.

    Parameters
    ----------
    session : Session
    figure : bokeh.plotting.figure
        The picture, its axes in rows and columns of the file.
    """

    def __init__(self, session: Session, figure: Any) -> None:
        self._session = session
        self._cutout: Cutout | None = None
        self._begun: LargeFile | None = None
        self._shown: tuple[Bounds, ...] = ()
        self._is_on_screen = False
        self._sentence = Sentence(live=True, sizing_mode="stretch_width", margin=(2, 8))
        self._bounds = {
            name: pmui.TextInput(
                label=label,
                description=f"{label}: first to last. Zooming the picture sets them.",
                size="small",
                sizing_mode="stretch_width",
                margin=(6, 4, 2, 8),
            )
            for name, label in (("rows", "Rows shown"), ("cols", "Columns shown"))
        }
        self._work = OnePiece(
            session,
            self._reading,
            self._arrived,
            "parts read",
            label="Read window",
            help="Read window: reads these rows and columns at the highest resolution possible.",
        )
        whole = "Show all: all rows and columns; reads those that are missing."
        buttons, *rest = self._work.controls
        buttons.append(button("Show all", whole, self._go_back, margin=(6, 4)))
        self.layout = sent_when_visible(
            pn.Column(
                self._sentence,
                pn.Row(*self._bounds.values(), sizing_mode="stretch_width", margin=0),
                buttons,
                *rest,
                visible=False,
                sizing_mode="stretch_width",
                margin=0,
            )
        )
        for ranges in (figure.x_range, figure.y_range):
            for end in ("start", "end"):
                ranges.on_change(end, lambda _name, _old, _new: self._zoomed())
        self._figure = figure
        self.follow(session.answer)

    # Events of the session and the page

    def follow(self, answer: Answer) -> None:
        """Show the window of an estimate; continue to read an unfinished preview."""
        cutout, previous = answer.cutout, self._cutout
        self._cutout = cutout
        self.layout.visible = cutout is not None
        if previous is not None and (cutout is None or cutout.file is not previous.file):
            self._stop()
        if cutout is None:
            return
        self._sentence.text = describe(cutout)
        if previous is None or cutout.window != previous.window:
            self._show_bounds(cutout.window.rows, cutout.window.cols)
        self._begin()

    def show(self, is_on_screen: bool) -> None:
        """Continue to read a preview on screen, and stop off screen."""
        self._is_on_screen = is_on_screen
        if is_on_screen:
            self._begin()
        elif self._begun is not None:
            self._stop()

    def _stop(self) -> None:
        self._begun = None
        self._work.cancel()

    def _begin(self) -> None:
        """Read the rest of a preview, once for each file unless requested again."""
        cutout = self._cutout
        if cutout is None or not self._is_on_screen or not cutout.is_preview or cutout.is_final:
            return
        if self._begun is not cutout.file:
            self._begun = cutout.file
            self._work.start(self._reading_on(cutout.file))

    def _zoomed(self) -> None:
        """Write the window to which the picture is zoomed into the fields."""
        if self._cutout is None:
            return
        across, down = self._figure.x_range, self._figure.y_range
        if all(map(_is_number, (across.start, across.end, down.start, down.end))):
            window = self._cutout.window
            self._show_bounds(
                _within(down, window.rows, window.step), _within(across, window.cols, window.step)
            )

    def _show_bounds(self, *bounds: Bounds) -> None:
        if bounds == self._shown:
            return  # keep what was typed since then
        self._shown = bounds
        for name, (first, end) in zip(self._bounds, bounds, strict=True):
            self._bounds[name].value = f"{first} to {end - 1}"

    # Actions of the user

    def _go_back(self) -> None:
        self._begun = None
        if self._session.state.window is None:
            self._begin()
        self._session.state.window = None

    def _reading(self) -> Work[Window | None]:
        """Return the work that reads the window in the fields."""
        assert self._cutout is not None
        file = self._cutout.file
        rows, cols = (
            bounds_of(name, field.value, getattr(file.whole, name)[1])
            for name, field in self._bounds.items()
        )
        window = file.fitting(rows, cols)
        return lambda progress: file.cutout(window, progress).window

    def _reading_on(self, file: LargeFile) -> Work[Window | None]:
        """Return the work that reads the rest of the preview and shows it from time to time."""

        def work(progress: Progress) -> Window | None:
            while not file.read_on(progress):
                self._session.tasks.queue(self._session.estimate.refresh)
            return None

        return work

    def _arrived(self, window: Window | None) -> None:
        """Show the window that has been read; None stands for the preview."""
        if window is None:
            self._session.estimate.refresh()
        else:
            self._session.state.window = window


def describe(cutout: Cutout) -> str:
    """Return a sentence on the part of the file that is shown."""
    window, (_, rows), (_, cols) = cutout.window, cutout.file.whole.rows, cutout.file.whole.cols
    if not cutout.is_preview:
        return f"Shown: {window}, of {rows} × {cols} pixels."
    sentence = (
        f"Preview of {rows} × {cols} pixels, 1 of each {window.step} × {window.step}. Zoom into "
        "the picture, then press Read window."
    )
    if cutout.read < 1:
        sentence += f" {cutout.read:.0%} has been read; blank pixels have not."
    return sentence


def bounds_of(name: str, text: str, size: int) -> Bounds:
    """Return the rows or columns of a text such as "10 to 20".

    Raises
    ------
    ValueError
        If the text has another form, or exceeds the file.
    """
    found = re.fullmatch(r"\s*(\d{1,12})\s*(?:to|[-–:])\s*(\d{1,12})\s*", text)
    first, last = (int(each) for each in found.groups()) if found else (1, 0)
    require(name, text, first <= last < size, f"first to last, of 0 to {size - 1}")
    return first, last + 1


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _within(axis: Any, bounds: Bounds, step: int) -> Bounds:
    """Return the rows or columns of a window between the ends of an axis."""
    low, high = sorted((axis.start, axis.end))
    first = min(max(math.floor(low + 0.5), bounds[0]), bounds[1] - 1)
    end = max(math.ceil(high + 0.5), first + 1)
    # The picture of a preview ends before its last rows and columns.
    return first, bounds[1] if end > bounds[1] - step else end
