"""Whether the background work of a page takes long, for its progress bar."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import perf_counter
from typing import Protocol

from app.tasks.signals import Signal

BUSY_MS = 200
"""Time after which work counts as long."""


class _Timer(Protocol):
    """The part of `app.tasks.page.PageTasks` that runs callbacks later."""

    def call_later(self, wait_ms: int, act: Callable[[], None]) -> None:
        """Call a function after a delay."""

    def run_next(self, act: Callable[[], None]) -> None:
        """Run a callback on the page."""


class Busy:
    """Follows the requests that are under way on a page.

    Attributes
    ----------
    changed : Signal of bool
        Emitted with True when a request takes long, and with False when none is under way.
    """

    def __init__(self, page: _Timer) -> None:
        self.changed: Signal[bool] = Signal()
        self._page = page
        self._began_s: dict[object, float] = {}
        self._is_long = False

    def begin(self, work: object) -> None:
        """Count work as under way."""
        self._began_s[work] = perf_counter()
        self._page.call_later(BUSY_MS, self._check)

    def end(self, work: object) -> None:
        """Count work as done; what follows soon keeps the bar, which would flicker."""
        del self._began_s[work]
        if self._is_long and not self._began_s:
            self._page.call_later(BUSY_MS, partial(self._page.run_next, self._hide))

    def _check(self) -> None:
        oldest_s = min(self._began_s.values(), default=float("inf"))
        if not self._is_long and perf_counter() - oldest_s >= 0.9e-3 * BUSY_MS:
            self._is_long = True
            self._page.run_next(partial(self.changed.emit, True))

    def _hide(self) -> None:
        if self._is_long and not self._began_s:
            self._is_long = False
            self.changed.emit(False)
