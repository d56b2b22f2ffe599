"""What is drawn next: many pages one after the other, and on a page what the eye follows first."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from contextvars import Context, copy_context
from itertools import cycle

MESSAGES_FIRST = 6
"""Times the loop goes round between two turns, which cost next to nothing where there is nothing to
do. A message takes some ten: what hands move in the meantime arrives before the next pages are
drawn, and what it overtakes need not be drawn at all."""


class Turns:
    """A queue for the page's thread, which all sessions share.

    Without it each time round the loop draws every page that has something new. A message, which
    takes several times round, then waits for as many drawings of everyone, and values that have
    long been overtaken queue up before the newest.

    What was computed and everything else take turns: of the computed there are few at a time
    (`app.tasks.jobs.Places`), and the next are begun when these are drawn.
    """

    def __init__(self) -> None:
        self._computed: deque[tuple[Callable[[], None], Context]] = deque()
        self._others: deque[tuple[Callable[[], None], Context]] = deque()
        self._is_going_round = False

    @property
    def is_crowded(self) -> bool:
        """Whether someone waits."""
        return bool(self._computed or self._others)

    def ask(self, begin: Callable[[], None], is_computed: bool = False) -> None:
        """Have something begun when its turn comes; from the loop's own thread.

        It begins in the context of who asked: Panel's has the document that is worked on.
        """
        queue = self._computed if is_computed else self._others
        queue.append((begin, copy_context()))
        if not self._is_going_round:
            self._is_going_round = True
            self._task = asyncio.ensure_future(self._go_round())

    async def _go_round(self) -> None:
        loop = asyncio.get_running_loop()
        queues = cycle((self._computed, self._others))
        while self.is_crowded:
            begin, context = next(filter(None, queues)).popleft()
            loop.call_soon(begin, context=context)  # which logs a failure, and goes on
            for _ in range(MESSAGES_FIRST):
                await asyncio.sleep(0)
        self._is_going_round = False


TURNS = Turns()


class Soon:
    """Something to be done on a page, when called, soon: once for all calls until then.

    Parameters
    ----------
    on_page : callable
        As for `app.tasks.jobs.LatestWins`.
    act : callable
    """

    def __init__(self, on_page: Callable[[Callable[[], None]], None], act: Callable[[], None]):
        self._on_page = on_page
        self._act = act
        self._is_due = False

    def __call__(self) -> None:
        """Ask for it."""
        if not self._is_due:
            self._is_due = True
            self._on_page(self._do)

    def _do(self) -> None:
        self._is_due = False
        self._act()
