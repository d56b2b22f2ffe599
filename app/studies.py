"""Long work with its controls, and how controls stand beside what they control."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.controls import Sentence
from app.jobs import InSteps, Step
from app.session import Session
from app.words import progress


class Study:
    """Long work with its controls: start, cancel, a bar, a sentence.

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
        self._steps = steps
        self._noun = noun
        self._work = InSteps(session.on_page, self._tell, session.fail)
        self._start = pmui.Button(
            label="Compute",
            description="Compute: begins anew with the settings above.",
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
        self._start.on_click(lambda _: self.start())
        self._cancel.on_click(lambda _: self._work.cancel())

    @property
    def controls(self) -> list[Any]:
        """Buttons, bar and sentence."""
        buttons = pn.Row(self._start, self._cancel, margin=0)
        return [buttons, self._bar, self._sentence]

    def start(self) -> None:
        """Begin anew."""
        self._work.start(self._steps())

    def show(self, is_on_screen: bool) -> None:
        """Begin or go on when it comes on screen, and pause when it leaves."""
        self._work.pause(not is_on_screen)
        if is_on_screen and self._work.of == 0:
            self.start()

    def _tell(self) -> None:
        work = self._work
        self._cancel.disabled = not work.is_running
        self._bar.value = round(100 * work.done / max(work.of, 1))
        self._sentence.text = progress(work.done, work.of, self._noun, work.is_running)


def aside(words: str, *controls: Any) -> pn.Column:
    """What there is to see, and the controls of it."""
    text = pmui.Typography(words, variant="body2", margin=(8, 8, 4, 8))
    return pn.Column(text, *controls, sizing_mode="stretch_width", margin=0)
