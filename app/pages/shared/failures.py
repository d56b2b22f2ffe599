"""Failures of the parts of a page, of which the page shows one."""

from __future__ import annotations

import logging
from collections.abc import Callable

from app.model.text import failure
from app.tasks.signals import Signal
from core import CaptureError

log = logging.getLogger(__name__)


class FailureLog:
    """Error sentences by the part of the page that failed.

    Attributes
    ----------
    shown : Signal of str
        Emitted with the sentence to show; empty where everything works.
    """

    def __init__(self) -> None:
        self.shown: Signal[str] = Signal()
        self._sentences: dict[object, str] = {}
        self._shown = self._otherwise = self._remark = ""

    def report(
        self,
        error: Exception,
        describe: Callable[[Exception], str] = failure,
        part: object = None,
    ) -> None:
        """Log an error and show a sentence about it, until its part works again."""
        if isinstance(error, CaptureError):  # which says all that there is to know
            log.warning("%s", error)
        else:
            log.warning("a request failed", exc_info=error)
        self.put(describe(error), part)

    def put(self, sentence: str, part: object = None) -> None:
        """Show a sentence about a part, until it works again."""
        self._sentences.pop(part, None)  # the latest failure comes last
        self._sentences[part] = sentence
        self.shown.emit(sentence)

    def resolve(self, part: object) -> None:
        """Remove the failure of a part that works again, or is tried again."""
        if self._sentences.pop(part, None) is not None:
            self._show_latest()

    def clear(self, otherwise: str = "") -> None:
        """Remove all sentences but the remark; show another one as long as there are none."""
        self._sentences.clear()
        self._shown, self._otherwise = "", otherwise
        self._show_latest()

    def remark(self, sentence: str) -> None:
        """Show a sentence whenever there is no other one, until the next remark."""
        if sentence != self._remark:
            self._remark = sentence
            self._show_latest()

    def show(self, sentence: str) -> None:
        """Show a sentence that belongs to no part, until the next one or `clear`."""
        self._shown = sentence
        self.shown.emit(sentence)

    def _show_latest(self) -> None:
        otherwise = self._shown or self._otherwise or self._remark
        self.shown.emit(next(reversed(self._sentences.values()), otherwise))
