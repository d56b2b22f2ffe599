"""Fair turns of all pages on the thread that draws them."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from contextvars import Context, copy_context
from itertools import cycle

ROUNDS_BETWEEN = 6
"""Rounds of the event loop between two turns. Handling a message from a browser takes about ten; a
message that arrives in between may replace a value that would be computed and drawn for nothing. A
round without events costs next to nothing."""


class Turns:
    """A queue for the event loop's thread, which all sessions share.

    Without it, each round of the loop would draw every page that has changed, while messages, which
    take several rounds, pile up.

    Results from other threads and all other callbacks alternate: few results arrive at a time
    (`app.tasks.scheduler.Lane`), and the next computations start when these are drawn.
    """

    def __init__(self) -> None:
        self._results: deque[tuple[Callable[[], None], Context]] = deque()
        self._others: deque[tuple[Callable[[], None], Context]] = deque()
        self._is_running = False

    @property
    def is_crowded(self) -> bool:
        """Whether a callback is waiting."""
        return bool(self._results or self._others)

    def ask(self, begin: Callable[[], None], is_computed: bool = False) -> None:
        """Call a function when its turn comes; to be called on the loop's thread.

        It runs in the context of the caller, where Panel keeps the present document.
        """
        queue = self._results if is_computed else self._others
        queue.append((begin, copy_context()))
        if not self._is_running:
            self._is_running = True
            self._task = asyncio.ensure_future(self._run())

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        queues = cycle((self._results, self._others))
        while self.is_crowded:
            begin, context = next(filter(None, queues)).popleft()
            loop.call_soon(begin, context=context)  # logs a failure and continues
            for _ in range(ROUNDS_BETWEEN):
                await asyncio.sleep(0)
        self._is_running = False


TURNS = Turns()
