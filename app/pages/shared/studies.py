"""Long work with its controls: buttons that start and cancel it, a progress bar and a sentence."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

import panel as pn
import panel_material_ui as pmui

from app.model.text import progress, unfinished
from app.pages.session import Session
from app.tasks.scheduler import Step, Work
from app.widgets.cards import button
from app.widgets.controls import Sentence

Result = TypeVar("Result")


class _ControlledWork(ABC):
    """Base of long work with controls.

    Parameters
    ----------
    session : Session
    noun : str
        Unit of the progress.
    label, help : str
        Label and description of the button that starts it.

    Attributes
    ----------
    sentence : Sentence
        The progress.
    """

    def __init__(
        self,
        session: Session,
        noun: str,
        label: str = "Compute",
        help: str = "Compute: starts again with the settings above.",
    ) -> None:
        self._session, self._noun, self._label = session, noun, label
        self._work = session.tasks.long_work(self._show_progress, self._failed)
        self._start = button(label, help, self.start, margin=(6, 4, 6, 8))
        self._start.variant = "contained"
        cancel_help = "Cancel: stops the work and keeps its results so far."
        self._cancel = button("Cancel", cancel_help, self.cancel, margin=(6, 4))
        self._cancel.disabled = True
        self._bar = pmui.LinearProgress(
            variant="determinate", value=0, sizing_mode="stretch_width", margin=(4, 8)
        )
        self.sentence = Sentence(sizing_mode="stretch_width", margin=(0, 8, 8, 8))

    @property
    def controls(self) -> list[Any]:
        """Buttons, bar and sentence."""
        return [pn.Row(self._start, self._cancel, margin=0), self._bar, self.sentence]

    @abstractmethod
    def start(self) -> None:
        """Start with the present settings, in place of the present work."""

    def cancel(self) -> None:
        """Cancel the work."""
        self._work.cancel()

    def _failed(self, error: Exception) -> None:
        describe = partial(unfinished, button=self._label)
        self._session.failures.report(error, describe=describe, part=self)

    def _show_progress(self) -> None:
        work = self._work
        self._cancel.disabled = not work.is_running
        self._bar.value = round(100 * work.done / max(work.of, 1))
        self.sentence.text = progress(work.done, work.of, self._noun, work.is_running)


class Study(_ControlledWork):
    """Long work in steps, with controls.

    It starts when it first comes on screen, and pauses while it is off screen.

    Parameters
    ----------
    session : Session
    steps : callable
        Returns the steps for the present settings.
    noun : str
        Name of the steps.
    """

    def __init__(
        self, session: Session, steps: Callable[[], Sequence[Step[Any]]], noun: str
    ) -> None:
        super().__init__(session, noun)
        self._steps = steps

    def start(self) -> None:
        """Start with the present settings, in place of the present work."""
        self._session.failures.resolve(self)
        self._work.start(self._steps())

    def show(self, is_on_screen: bool) -> None:
        """Start or continue on screen, and pause off screen."""
        self._work.pause(not is_on_screen)
        if is_on_screen and self._work.of == 0:
            self.start()


class OnePiece(_ControlledWork, Generic[Result]):
    """Long work in one piece, with controls; a cancelled result is not drawn.

    Where `show` is called, the first work starts on screen by itself. Until it is done it costs
    nothing off screen: it is cancelled there, and starts again on screen.

    Parameters
    ----------
    session : Session
    work : callable
        Returns the work for the present settings.
    draw : callable
        Shows the result on the page.
    noun : str
        Unit of the progress.
    failed : callable
        Called after a failure has been reported.
    **start : str
        ``label`` and ``help`` of the button that starts it.

    Attributes
    ----------
    has_failed : bool
        Whether the last work failed.
    """

    def __init__(
        self,
        session: Session,
        work: Callable[[], Work[Result]],
        draw: Callable[[Result], None],
        noun: str,
        failed: Callable[[], None] = lambda: None,
        **start: str,
    ) -> None:
        super().__init__(session, noun, **start)
        self._make_work = work
        self._draw = draw
        self._after_failure = failed
        self._starts_by_itself, self.has_failed = True, False

    def start(self, work: Work[Result] | None = None) -> None:
        """Start this work, or that for the present settings, in place of the present work."""
        self.has_failed = False
        work = work or self._make_work()
        self._starts_by_itself = False
        self._session.failures.resolve(self)
        self._work.start_piece(work, self._draw)

    def cancel(self) -> None:
        """Cancel the work."""
        self._starts_by_itself = False
        super().cancel()

    def show(self, is_on_screen: bool) -> None:
        """Start the first work on screen; cancel it off screen."""
        if not self._starts_by_itself:
            return
        if not is_on_screen:
            self._work.cancel()
        elif not self._work.is_running:
            self._session.failures.resolve(self)
            self._work.start_piece(self._make_work(), self._draw_first)

    def retry(self) -> None:
        """Let work that has failed start by itself again: its subject has changed."""
        if self.has_failed:
            self._starts_by_itself, self.has_failed = True, False

    def _draw_first(self, result: Result) -> None:
        self._starts_by_itself = False
        self._draw(result)

    def _failed(self, error: Exception) -> None:
        self._starts_by_itself, self.has_failed = False, True
        super()._failed(error)
        self._after_failure()


def aside(explanation: str, *controls: Any) -> pn.Column:
    """Return explanatory text above controls."""
    text = pmui.Typography(explanation, variant="body2", margin=(8, 8, 4, 8))
    return pn.Column(text, *controls, sizing_mode="stretch_width", margin=0)
