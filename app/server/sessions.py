"""Limits on the sessions of a server: number, memory, and time without a browser.

Panel builds a session for each request of a page, whether or not a browser connects to it. A
connected session lasts as long as its connection and `app.widgets.connection.LINGER_S` longer, so
that a page can be reloaded; one to which no browser connects ends much sooner.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from time import monotonic
from weakref import WeakSet

import psutil
from bokeh.server.contexts import ApplicationContext
from bokeh.server.session import ServerSession
from tornado.ioloop import PeriodicCallback

POLL_S = 0.1
"""Interval at which a waiting page checks whether it can be built."""

PAUSE = 0.5
"""Pause after a page was built, as a share of the time that took; open pages respond in it."""


@dataclass(frozen=True)
class Bounds:
    """Limits on the sessions of a server.

    Parameters
    ----------
    sessions : int
        Most sessions.
    unconnected : int
        Most sessions without a browser; the next page waits until one is connected or has ended.
    unconnected_s : float
        Seconds after which a session without a browser ends.
    check_s : float
        Seconds between two searches for such sessions.
    retry_s : int
        Seconds after which a browser that found the server full asks again.
    queued : int
        Most pages that wait to be built.
    memory_bytes : int
        Resident memory of the server beyond which it opens no further session; half of the
        machine's by default.
    """

    sessions: int = 100
    unconnected: int = 6
    unconnected_s: float = 20.0
    check_s: float = 2.0
    retry_s: int = 10
    queued: int = 30
    memory_bytes: int = field(default_factory=lambda: psutil.virtual_memory().total // 2)


def resident_bytes() -> int:
    """Return the resident memory of this process."""
    return int(psutil.Process().memory_info().rss)


class Sessions:
    """The sessions of an application within limits.

    Parameters
    ----------
    context : ApplicationContext
        Holds Bokeh's sessions.
    bounds : Bounds, optional
    memory : callable
        Returns the bytes in use.
    clock : callable
        Returns the time in seconds.
    """

    def __init__(
        self,
        context: ApplicationContext,
        bounds: Bounds | None = None,
        memory: Callable[[], int] = resident_bytes,
        clock: Callable[[], float] = monotonic,
    ) -> None:
        self._context = context
        self.bounds = bounds or Bounds()
        self._memory, self._clock = memory, clock
        self._connected: WeakSet[ServerSession] = WeakSet()
        self._n_opening = 0
        self._building, self._next_build_s = asyncio.Lock(), clock()
        self._checked_s = clock()
        self._checks = PeriodicCallback(self.check, 1000 * self.bounds.check_s)

    def start(self) -> None:
        """Start to end sessions without a browser."""
        self._checks.start()

    def has(self, session_id: str) -> bool:
        """Whether there is a session of this name."""
        return any(session.id == session_id for session in self._context.sessions)

    def connected(self, session: ServerSession) -> None:
        """Record that a browser has connected."""
        self._connected.add(session)

    @contextmanager
    def opening(self, session_id: str | None) -> Iterator[bool]:
        """Reserve room for a session while its page is built; yield whether there is room.

        An existing session needs no further room.
        """
        if session_id is not None and self.has(session_id):
            yield True
            return
        has_room = self._has_room()
        self._n_opening += has_room
        try:
            yield has_room
        finally:
            self._n_opening -= has_room

    @asynccontextmanager
    async def building(self) -> AsyncIterator[None]:
        """Build pages one at a time, with pauses in between."""
        async with self._building:
            await asyncio.sleep(max(0.0, self._next_build_s - self._clock()))
            while len(self._unconnected()) >= self.bounds.unconnected:
                await asyncio.sleep(POLL_S)
            begun_s = self._clock()
            try:
                yield
            finally:
                now_s = self._clock()
                self._next_build_s = now_s + PAUSE * (now_s - begun_s)

    def check(self) -> None:
        """End the sessions that have waited too long for their browser."""
        now_s = self._clock()
        is_late = now_s - self._checked_s > 2 * self.bounds.check_s
        self._checked_s = now_s
        if is_late:  # the server was busy, and connections may not be accepted yet
            return
        for session in self._unconnected():
            if session.milliseconds_since_last_unsubscribe > 1000 * self.bounds.unconnected_s:
                session.request_expiration()

    def _unconnected(self) -> list[ServerSession]:
        return [each for each in self._context.sessions if each not in self._connected]

    def _has_room(self) -> bool:
        """Whether one more session fits, after ending sessions whose page was closed."""
        bounds = self.bounds
        closed = [
            each
            for each in self._context.sessions
            if each in self._connected and each.connection_count == 0
        ]
        closed.sort(key=lambda each: each.milliseconds_since_last_unsubscribe, reverse=True)
        surplus = len(list(self._context.sessions)) + self._n_opening + 1 - bounds.sessions
        is_out_of_memory = self._memory() > bounds.memory_bytes
        for each in closed[: None if is_out_of_memory else max(surplus, 0)]:
            each.request_expiration()
        return surplus <= len(closed) and self._n_opening < bounds.queued and not is_out_of_memory
