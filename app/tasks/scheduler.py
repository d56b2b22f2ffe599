"""Background work of all sessions: the latest request of a channel wins, lanes limit the threads.

A session submits work to a channel (`Latest`). The work runs in a lane, either on the page's thread
or on one of a few threads that all sessions share, and its result is drawn when it is the page's
turn (`app.tasks.turns`). Long work (`LongWork`) reports its progress and can be cancelled.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from threading import Lock
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

from app.tasks.busy import Busy

Result = TypeVar("Result")
Act = Callable[[], None]
Failed = Callable[[Exception], None]
Work = Callable[[Callable[[int, int], None]], Result]
"""Long work that calls ``progress(done, of)`` now and then, which may raise `Cancelled`."""


class Cancelled(Exception):
    """Long work is to end early."""


class PageThread(Protocol):
    """The part of `app.tasks.page.PageTasks` that schedules work."""

    def queue(self, act: Act, due: Act | None = None) -> None:
        """Run `due` when the page's turn comes, then `act` unless the page is closed."""

    @property
    def is_at_hand(self) -> bool:
        """Whether the caller is on the page's thread and no other page is waiting."""

    def call_later(self, wait_ms: int, act: Act) -> None:
        """Call a function after a delay."""

    @property
    def is_gone(self) -> bool:
        """Whether the page's session has ended."""

    @property
    def is_away(self) -> bool:
        """Whether no browser has shown the page for some seconds."""


class Lane:
    """Threads, each taken from the start of a request until its result is about to be drawn.

    A thread that took the next request while its result waits for the page's thread would compute
    results that are outdated when they are drawn.

    Parameters
    ----------
    n_threads : int
        0 stands for the page's own thread.
    name : str
        Prefix of the threads' names.

    Attributes
    ----------
    is_closed : bool
        Whether the server is shutting down; long work checks it.
    """

    def __init__(self, n_threads: int, name: str) -> None:
        self._threads = ThreadPoolExecutor(max(n_threads, 1), name)
        self._lock = Lock()
        self._free = n_threads
        self._waiting: deque[tuple[Act, Failed]] = deque()
        self.is_closed = False

    def acquire(self, begin: Act, failed: Failed) -> None:
        """Run `begin` on a thread once one is free; call `failed` if that is impossible."""
        with self._lock:
            if self._free == 0:
                self._waiting.append((begin, failed))
                return
            self._free -= 1
        self._begin(begin, failed)

    def release(self) -> None:
        """Free a thread, or give it to the request that has waited longest."""
        with self._lock:
            if not self._waiting:
                self._free += 1
                return
            following = self._waiting.popleft()
        self._begin(*following)

    def _begin(self, begin: Act, failed: Failed) -> None:
        try:
            self._threads.submit(begin)
        except Exception as error:  # the system refuses another thread
            failed(error)


PAGE = Lane(0, "page")
"""Work shorter than drawing its result. On another thread it would compete with the page's thread
for the interpreter, which takes several times as long."""

SHORT = Lane(1, "firstphoton-short")
"""Some tens of milliseconds, one request at a time: parallel ones would slow each other down. Each
waits for its page's turn, as shorter ones do, so that a few pages do not slow down all others."""

GENERAL = Lane(4, "firstphoton")
"""Unknown cost, such as reading a file. Kernels that use all cores have a lock of their own."""

STUDIES = Lane(2, "firstphoton-study")
"""Long work, which must never delay a slider."""

FILES = Lane(2, "firstphoton-files")
"""Downloads; few at a time, since a large file takes much memory."""


class _Request(NamedTuple):
    work: Callable[[], Any]
    done: Callable[[Any], None]
    failed: Failed
    lane: Lane

    def run(self) -> Act:
        """Run the work; return a function that draws its result or reports its failure."""
        try:
            return partial(self.done, self.work())
        except Exception as error:  # the page reports any failure
            return partial(self.failed, error)
        except BaseException as error:  # a library may raise SystemExit
            return partial(self.failed, RuntimeError(f"{type(error).__name__}: {error}"))


class Latest:
    """A channel that runs the newest of its requests and drops the ones before it.

    Parameters
    ----------
    page : PageTasks
        Draws the results.
    lane : Lane
        Default lane of the requests.
    busy : Busy, optional
        Hears of each request.
    """

    def __init__(self, page: PageThread, lane: Lane = GENERAL, busy: Busy | None = None) -> None:
        self._page = page
        self._lane = lane
        self._busy = busy
        self._lock = Lock()
        self._newest: _Request | None = None
        self._is_busy = False

    def submit(
        self,
        work: Callable[[], Result],
        done: Callable[[Result], None],
        failed: Failed,
        lane: Lane | None = None,
    ) -> None:
        """Run `work` in its lane, then `done` or `failed` on the page.

        A request that has not started when the next one comes is dropped. The next one starts after
        `done` has drawn the last, so that neither requests nor results queue up.
        """
        with self._lock:
            self._newest = _Request(work, done, failed, lane or self._lane)
            if self._is_busy:
                return
            self._is_busy = True
        self._begin()

    @property
    def has_more(self) -> bool:
        """Whether another request waits behind the present one."""
        return self._newest is not None

    def _begin(self) -> None:
        if self._busy is not None:
            self._busy.begin(self)
        self._start()

    def _start(self) -> None:
        assert self._newest is not None
        lane = self._newest.lane
        begin = partial(self._attempt, PAGE) if lane is PAGE else partial(self._acquire, lane)
        if lane in (PAGE, SHORT) and not self._page.is_at_hand:
            self._page.queue(begin)
        else:
            begin()

    def _acquire(self, lane: Lane) -> None:
        lane.acquire(partial(self._attempt, lane), partial(self._refuse, lane))

    def _take(self) -> _Request:
        with self._lock:
            newest, self._newest = self._newest, None
        assert newest is not None
        return newest

    def _attempt(self, lane: Lane) -> None:
        assert self._newest is not None
        newest = self._newest.lane
        if newest is not lane:  # replaced by a request for another lane
            if lane is PAGE:  # its turn has come
                self._acquire(newest)
            else:
                lane.release()
                self._start()
            return
        request = self._take()
        draw = partial(self._finish, request.run(), request.failed)
        if lane is PAGE:
            draw()
        else:
            self._page.queue(draw, lane.release)

    def _refuse(self, lane: Lane, error: Exception) -> None:
        failed = self._take().failed
        self._page.queue(partial(self._finish, partial(failed, error), failed), lane.release)

    def _finish(self, draw: Act, failed: Failed) -> None:
        try:
            draw()
        except Exception as error:  # a result that cannot be drawn counts as a failure
            failed(error)
        finally:
            if self._busy is not None:
                self._busy.end(self)
            with self._lock:
                self._is_busy = self._newest is not None
            if self._is_busy:
                self._begin()


@dataclass(frozen=True)
class Step(Generic[Result]):
    """A piece of long work."""

    work: Callable[[], Result]
    """Runs on a thread."""
    draw: Callable[[Result], None]
    """Runs on the page, with the result of `work`."""


@dataclass(eq=False)
class _Run:
    """Progress of long work from one start to its end."""

    steps: Sequence[Step[Any]] = ()
    next_step: int = 0
    done: int = 0
    of: int = 0
    is_running: bool = False
    is_working: bool = False
    is_reporting: bool = False
    is_interrupted: bool = False


RETURN_MS = 1000
"""Interval at which a page that is away is checked for a browser."""


class LongWork:
    """Work in steps that can be paused in between, or in one piece that reports its progress.

    While the page is away, nothing is computed for it: no further step starts, and a step that can
    be cancelled ends early. Finished steps stay on the page, and the work resumes with the
    unfinished step once the page is back.

    Parameters
    ----------
    page : PageTasks
    changed : callable
        Called on the page when `done`, `of` or `is_running` has changed.
    failed : callable
        Called with the error that ended the work.
    """

    def __init__(self, page: PageThread, changed: Act, failed: Failed) -> None:
        self._page = page
        self._channel = Latest(page, STUDIES)
        self._changed = changed
        self._failed = failed
        self._run = _Run()
        self._is_paused = False

    @property
    def done(self) -> int:
        """Number of steps done, or the progress that one piece has reported."""
        return self._run.done

    @property
    def of(self) -> int:
        """Number of steps in all; 0 before the first start."""
        return self._run.of

    @property
    def is_running(self) -> bool:
        """Whether the work has neither ended nor been cancelled."""
        return self._run.is_running

    def start(self, steps: Sequence[Step[Any]]) -> None:
        """Run these steps one after the other, in place of the present work."""
        self._begin(_Run(list(steps), of=len(steps), is_running=bool(steps)))

    def start_piece(self, work: Work[Result], draw: Callable[[Result], None]) -> None:
        """Run work in one piece, in place of the present work, and draw its result."""
        run = _Run(is_running=True)
        run.steps = [Step(partial(work, partial(self._report, run)), draw)]
        self._begin(run)

    def cancel(self) -> None:
        """End the work; nothing more of it is drawn."""
        self._run.is_running = False
        self._changed()

    def pause(self, is_paused: bool) -> None:
        """Start no further step, or continue."""
        self._is_paused = is_paused
        self._continue(self._run)

    def _begin(self, run: _Run) -> None:
        self._run.is_running = False  # cancels the present work
        self._run = run
        self._changed()
        self._continue(run)

    def _continue(self, run: _Run) -> None:
        if run.is_running and not run.is_working and not self._is_paused:
            if self._page.is_away:
                self._page.call_later(RETURN_MS, partial(self._continue, run))
                return
            run.is_working, run.is_interrupted = True, False
            step = run.steps[run.next_step]
            self._channel.submit(
                step.work, partial(self._draw, run, step), partial(self._fail, run)
            )

    def _draw(self, run: _Run, step: Step[Any], result: Any) -> None:
        if not run.is_running:
            return
        step.draw(result)
        run.is_working = False
        run.next_step += 1
        run.is_running = run.next_step < len(run.steps)
        run.done = run.next_step if len(run.steps) == run.of else run.of
        self._changed()
        self._continue(run)

    def _fail(self, run: _Run, error: Exception) -> None:
        if run.is_interrupted and run.is_running:
            run.is_working = False
            self._continue(run)
        elif run.is_running:  # else it was cancelled
            self.cancel()
            self._failed(error)

    def _report(self, run: _Run, done: int, of: int) -> None:
        if self._is_cancelled(run):
            raise Cancelled
        run.done, run.of = done, of
        if not run.is_reporting:  # a busy page skips reports in between
            run.is_reporting = True
            self._page.queue(partial(self._show_report, run))

    def _show_report(self, run: _Run) -> None:
        run.is_reporting = False
        if run is self._run:
            self._changed()

    def _is_cancelled(self, run: _Run) -> bool:
        run.is_interrupted = run.is_interrupted or self._page.is_away
        is_over = not run.is_running or self._page.is_gone or STUDIES.is_closed
        return is_over or run.is_interrupted
