"""Long work with its controls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

import panel as pn
import panel_material_ui as pmui

from app.model.text import progress, unfinished
from app.pages.session import Session
from app.tasks.scheduler import LongWork, Step, Work
from app.widgets.controls import Sentence

Result = TypeVar("Result")


class WorkControls:
    """Buttons that start and cancel long work, a progress bar, and a sentence on the progress."""

    def __init__(
        self,
        start: Callable[[], None],
        cancel: Callable[[], None],
        noun: str,
        label: str = "Compute",
        help: str = "Compute: starts again with the settings above.",
    ) -> None:
        self._noun = noun
        self._start = pmui.Button(
            label=label,
            description=help,
            size="small",
            margin=(6, 4, 6, 8),
        )
        self._cancel = pmui.Button(
            label="Cancel",
            description="Cancel: stops the work and keeps its results so far.",
            variant="outlined",
            size="small",
            disabled=True,
            margin=(6, 4),
        )
        self._bar = pmui.LinearProgress(
            variant="determinate", value=0, sizing_mode="stretch_width", margin=(4, 8)
        )
        self._sentence = Sentence(sizing_mode="stretch_width", margin=(0, 8, 8, 8))
        self._start.on_click(lambda _: start())
        self._cancel.on_click(lambda _: cancel())

    @property
    def layout(self) -> list[Any]:
        """Buttons, bar and sentence."""
        buttons = pn.Row(self._start, self._cancel, margin=0)
        return [buttons, self._bar, self._sentence]

    def show(self, work: LongWork) -> None:
        """Show the progress of the work."""
        self._cancel.disabled = not work.is_running
        self._bar.value = round(100 * work.done / max(work.of, 1))
        self._sentence.text = progress(work.done, work.of, self._noun, work.is_running)


class Study:
    """Long work in steps with its controls.

    It starts when it first comes on screen, and pauses while it is off screen.

    Parameters
    ----------
    session : Session
    steps : callable
        Returns the steps, from the present settings.
    noun : str
        What the steps are called.
    """

    def __init__(
        self, session: Session, steps: Callable[[], Sequence[Step[Any]]], noun: str
    ) -> None:
        self._session = session
        self._steps = steps
        fail = partial(session.failures.report, describe=unfinished, part=self)
        self._work = session.tasks.long_work(self._show_progress, fail)
        self._controls = WorkControls(self.start, self._work.cancel, noun)

    @property
    def controls(self) -> list[Any]:
        """Buttons, bar and sentence."""
        return self._controls.layout

    def start(self) -> None:
        """Start with the present settings, in place of the present work."""
        self._session.failures.resolve(self)
        self._work.start(self._steps())

    def show(self, is_on_screen: bool) -> None:
        """Start or continue on screen, and pause off screen."""
        self._work.pause(not is_on_screen)
        if is_on_screen and self._work.of == 0:
            self.start()

    def _show_progress(self) -> None:
        self._controls.show(self._work)


class OnePiece(Generic[Result]):
    """Long work of one piece with its controls.

    Parameters
    ----------
    session : Session
    work : callable
        Returns the work, from the present settings.
    draw : callable
        Shows the result on the page.
    noun : str
        What its progress counts.
    **start : str
        ``label`` and ``help`` of the button that starts it.
    """

    def __init__(
        self,
        session: Session,
        work: Callable[[], Work[Result]],
        draw: Callable[[Result], None],
        noun: str,
        **start: str,
    ) -> None:
        self._session = session
        self._make_work = work
        self._draw = draw
        fail = partial(session.failures.report, describe=unfinished, part=self)
        self._work = session.tasks.long_work(self._show_progress, fail)
        self._controls = WorkControls(self.start, self.cancel, noun, **start)

    @property
    def controls(self) -> list[Any]:
        """Buttons, bar and sentence."""
        return self._controls.layout

    def start(self, work: Work[Result] | None = None) -> None:
        """Start this work, or the button's, in place of the present work."""
        work = work or self._make_work()
        self._session.failures.resolve(self)
        self._work.start_piece(work, self._draw)

    def cancel(self) -> None:
        """Ask the work to end; its result is not drawn."""
        self._work.cancel()

    def _show_progress(self) -> None:
        self._controls.show(self._work)


def aside(explanation: str, *controls: Any) -> pn.Column:
    """Explanatory text above controls."""
    text = pmui.Typography(explanation, variant="body2", margin=(8, 8, 4, 8))
    return pn.Column(text, *controls, sizing_mode="stretch_width", margin=0)
