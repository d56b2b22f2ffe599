"""Work off the page's thread: of each session's requests the latest wins."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Lock
from typing import Generic, TypeVar

Result = TypeVar("Result")

# A session has one request under way; a file being read does not hold up the others. Kernels that
# use all cores take turns by a lock of their own.
_WORKERS = ThreadPoolExecutor(max_workers=4, thread_name_prefix="firstphoton")


class LatestWins(Generic[Result]):
    """Runs the newest request of one session and forgets those it overtook.

    Parameters
    ----------
    on_page : callable
        Runs a function on the session's page thread, soon.
    """

    def __init__(self, on_page: Callable[[Callable[[], None]], None]) -> None:
        self._on_page = on_page
        self._lock = Lock()
        self._waiting: Callable[[], None] | None = None
        self._busy = False

    def submit(
        self,
        work: Callable[[], Result],
        done: Callable[[Result], None],
        failed: Callable[[Exception], None],
    ) -> None:
        """Run `work` on the worker, then `done` or `failed` on the page.

        A request that has not started when the next one comes is dropped. The next one starts after
        `done` has drawn the last: neither computed nor drawn answers queue up.
        """

        def attempt() -> None:
            try:
                outcome = partial(done, work())
            except Exception as error:  # whatever it is, the page must tell it
                outcome = partial(failed, error)
            self._on_page(partial(self._finish, outcome, failed))

        with self._lock:
            if self._busy:
                self._waiting = attempt
                return
            self._busy = True
        _WORKERS.submit(attempt)

    @property
    def has_more(self) -> bool:
        """Whether another request waits for its turn."""
        return self._waiting is not None

    def _finish(self, draw: Callable[[], None], failed: Callable[[Exception], None]) -> None:
        try:
            draw()
        except Exception as error:  # an answer that cannot be drawn is told like one that is none
            failed(error)
        finally:
            with self._lock:
                following, self._waiting = self._waiting, None
                self._busy = following is not None
            if following is not None:
                _WORKERS.submit(following)
