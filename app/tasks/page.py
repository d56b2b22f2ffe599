"""Callbacks on the thread of a page: in fair turns, at once, or after a delay."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import panel as pn
from tornado.ioloop import IOLoop

from app.tasks.busy import Busy
from app.tasks.scheduler import GENERAL, Act, Lane, Latest, LongWork
from app.tasks.signals import Signal
from app.tasks.turns import TURNS

AWAY_S = 5.0
"""Time without a connection after which a page counts as away; a lost one is back sooner."""


class PageTasks:
    """Runs callbacks on the thread of the page that is being built, and its work elsewhere.

    Without a browser, as in tests, callbacks run at once, and delayed ones never.

    Attributes
    ----------
    document : bokeh.document.Document or None
        The page's document.
    failed : Signal of Exception
        Emitted when a callback raises.
    busy : Busy
        Whether a request takes long; long work has progress of its own.
    """

    def __init__(self) -> None:
        self.document = pn.state.curdoc
        self.failed: Signal[Exception] = Signal()
        self.busy = Busy(self)
        self._was_served = self.is_served
        self._loop = IOLoop.current() if self._was_served else None

    @property
    def is_served(self) -> bool:
        """Whether a browser shows the page, or is about to."""
        return self.document is not None and self.document.session_context is not None

    @property
    def is_gone(self) -> bool:
        """Whether the page's session has ended."""
        return self._was_served and not self.is_served

    @property
    def is_away(self) -> bool:
        """Whether the page has had no connection for some seconds: closed, reloaded, or offline."""
        session = self.document.session_context.session if self.is_served else None
        if session is None or session.connection_count:
            return False
        return bool(session.milliseconds_since_last_unsubscribe > 1000 * AWAY_S)

    @property
    def is_at_hand(self) -> bool:
        """Whether the caller is on the page's thread and no other page is waiting."""
        return self._loop is not None and pn.state.curdoc is self.document and not TURNS.is_crowded

    def hold(self) -> AbstractContextManager[Any]:
        """Send all changes of a block to the browser in one message."""
        held: AbstractContextManager[Any] = pn.io.hold(self.document)
        return held

    def queue(self, act: Act, due: Act | None = None) -> None:
        """Run a callback on the page in turn with other pages, unless the page is gone.

        `due` is called when the turn has come, even if the page is gone.
        """
        if self._loop is None:
            if due is not None:
                due()
            act()
            return

        def begin() -> None:
            if due is not None:
                due()
            self.run_next(act)

        self._loop.add_callback(TURNS.ask, begin, is_computed=due is not None)

    def run_next(self, act: Act) -> None:
        """Run a small callback on the page ahead of those that wait for their turn."""
        if self.is_served:
            self.document.add_next_tick_callback(self._once(act))

    def call_later(self, wait_ms: int, act: Act) -> None:
        """Call a function after a delay, on the page's thread but without its document.

        Entering the document costs more than most timers; a callback that needs it uses `run_next`.
        """
        if self._loop is not None:
            self._loop.call_later(1e-3 * wait_ms, act)

    def soon(self, act: Act) -> Callable[..., None]:
        """Return a trigger that queues a callback; further calls before it runs have no effect."""
        is_due = False

        def run() -> None:
            nonlocal is_due
            is_due = False
            act()

        def trigger(*_: Any) -> None:
            nonlocal is_due
            if not is_due:
                is_due = True
                self.queue(run)

        return trigger

    def latest(self, lane: Lane = GENERAL) -> Latest:
        """Return a channel for work of which only the newest request counts."""
        return Latest(self, lane, self.busy)

    def long_work(self, changed: Act, failed: Callable[[Exception], None]) -> LongWork:
        """Return long work of the page; see `app.tasks.scheduler.LongWork`."""
        return LongWork(self, changed, failed)

    def _once(self, act: Act) -> Act:
        # Bokeh's callbacks are part of reference cycles: a result held by one would stay in memory
        # until the next full garbage collection.
        once = [act]

        def attempt() -> None:
            try:
                once.pop()()
            except Exception as error:  # the page reports any failure
                self.failed.emit(error)

        return attempt
