"""Long work with its controls, and how controls stand beside what they control."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

import panel as pn
import panel_material_ui as pmui

from app.model.text import progress, unfinished
from app.pages.session import Session
from app.tasks.jobs import LONG, InSteps, LatestWins, Step
from app.widgets.controls import Sentence

Result = TypeVar("Result")


class WorkControls:
    """Buttons that start and cancel long work, a bar, and a sentence on how far it is."""

    def __init__(
        self,
        start: Callable[[], None],
        cancel: Callable[[], None],
        noun: str,
        label: str = "Compute",
        help: str = "Compute: begins anew with the settings above.",
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
            description="Cancel: stops, and keeps what there is.",
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

    def tell(self, done: int, of: int, is_running: bool) -> None:
        """Show how far the work is."""
        self._cancel.disabled = not is_running
        self._bar.value = round(100 * done / max(of, 1))
        self._sentence.text = progress(done, of, self._noun, is_running)


class Study:
    """Long work in steps with its controls.

    It begins when it first comes on screen, and pauses while it is not.

    Parameters
    ----------
    steps : callable
        The work, by the controls of that moment.
    noun : str
        What the steps are called.
    """

    def __init__(
        self, session: Session, steps: Callable[[], Sequence[Step[Any]]], noun: str
    ) -> None:
        self._session = session
        self._steps = steps
        fail = partial(session.fail, told=unfinished, of=self)
        self._work = InSteps(session.on_page, self._tell, fail)
        self._controls = WorkControls(self.start, self._work.cancel, noun)

    @property
    def controls(self) -> list[Any]:
        """Buttons, bar and sentence."""
        return self._controls.layout

    def start(self) -> None:
        """Begin anew."""
        self._session.recover(self)
        self._work.start(self._steps())

    def show(self, is_on_screen: bool) -> None:
        """Begin or go on when it comes on screen, and pause when it leaves."""
        self._work.pause(not is_on_screen)
        if is_on_screen and self._work.of == 0:
            self.start()

    def _tell(self) -> None:
        self._controls.tell(self._work.done, self._work.of, self._work.is_running)


Work = Callable[[Callable[[int, int], None], Callable[[], bool]], Result]
"""Long work that calls ``progress(done, of)`` now and then, and raises once ``cancelled()``."""


class OnePiece(Generic[Result]):
    """Long work of one piece with its controls.

    Parameters
    ----------
    work : callable
        The work, by the controls of that moment.
    draw : callable
        Shows, on the page, what came out.
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
        self._work = work
        self._draw = draw
        self._jobs: LatestWins[Result] = LatestWins(session.on_page, LONG)
        self._controls = WorkControls(self.start, self.cancel, noun, **start)
        self._run = _Run()

    @property
    def controls(self) -> list[Any]:
        """Buttons, bar and sentence."""
        return self._controls.layout

    def start(self, work: Work[Result] | None = None) -> None:
        """Begin anew, with other work than the button's if told; what is under way ends."""
        work, page = work or self._work(), self._session
        self.cancel()
        page.recover(self)
        run = self._run = _Run(is_running=True)

        def told(done: int, of: int) -> None:
            run.done, run.of = done, of
            if not run.is_telling:  # a page that is busy is not told of every step in between
                run.is_telling = True
                page.on_page(partial(self._tell, run))

        def cancelled() -> bool:
            return not run.is_running or page.is_gone or LONG.is_closed

        self._tell(run)
        self._jobs.submit(
            partial(work, told, cancelled), partial(self._done, run), partial(self._ended, run)
        )

    def cancel(self) -> None:
        """Ask it to end, and draw nothing of it."""
        self._run.is_running = False
        self._tell(self._run)

    def _tell(self, run: _Run) -> None:
        run.is_telling = False
        if run is self._run:
            self._controls.tell(run.done, run.of, run.is_running)

    def _done(self, run: _Run, result: Result) -> None:
        if run.is_running:
            self._draw(result)
            run.is_running, run.done = False, run.of
            self._tell(run)

    def _ended(self, run: _Run, error: Exception) -> None:
        if run.is_running:  # else this is what it was asked for
            self.cancel()
            self._session.fail(error, unfinished, self)


@dataclass
class _Run:
    """How far one run is."""

    is_running: bool = False
    is_telling: bool = False
    done: int = 0
    of: int = 0


def aside(words: str, *controls: Any) -> pn.Column:
    """What there is to see, and the controls of it."""
    text = pmui.Typography(words, variant="body2", margin=(8, 8, 4, 8))
    return pn.Column(text, *controls, sizing_mode="stretch_width", margin=0)
