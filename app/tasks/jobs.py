"""Work off the page's thread: of each session's requests the latest wins."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import Enum, auto
from functools import partial
from threading import Lock
from typing import Any, Generic, NamedTuple, TypeVar

Result = TypeVar("Result")


class Effort(Enum):
    """What a request takes, which decides where it is computed."""

    QUICK = auto()
    """Less than to draw its outcome: on the page, in turn. A thread would have to take turns with
    the page's at the interpreter, which costs both of them a multiple of that."""
    SHORT = auto()
    """Some tens of milliseconds: on a thread, one of all sessions after the other, since several at
    once would only slow each other down, and the page."""
    ANY = auto()
    """Who knows: on one of some threads."""


Act = Callable[[], None]
Failed = Callable[[Exception], None]
OnPage = Callable[[Act, Act | None], None]


class Asked(NamedTuple):
    """A request."""

    work: Callable[[], Any]
    done: Callable[[Any], None]
    failed: Failed
    effort: Effort


class Places:
    """Threads, each taken from the beginning of a request until its answer is about to be drawn.

    Were a thread free again while its answer waits for the page's thread, answers to all sessions
    would queue up there, each of them older when it is drawn than what its session asks by then.

    Parameters
    ----------
    number : int
    name : str
        Of the threads.

    Attributes
    ----------
    is_closed : bool
        Whether the program ends, and waits for its threads: what runs here asks now and then.
    """

    def __init__(self, number: int, name: str) -> None:
        self._threads = ThreadPoolExecutor(number, name)
        self._lock = Lock()
        self._free = number
        self._waiting: deque[tuple[Act, Failed]] = deque()
        self.is_closed = False

    def ask(self, begin: Act, failed: Failed) -> None:
        """Have `begin` run on a thread once there is a place, or `failed` where it cannot."""
        with self._lock:
            if self._free == 0:
                self._waiting.append((begin, failed))
                return
            self._free -= 1
        self._begin(begin, failed)

    def leave(self) -> None:
        """Give up a place that was taken, to whoever has waited longest."""
        with self._lock:
            if not self._waiting:
                self._free += 1
                return
            following = self._waiting.popleft()
        self._begin(*following)

    def _begin(self, begin: Act, failed: Failed) -> None:
        try:
            self._threads.submit(begin)
        except Exception as error:  # no thread can be had
            failed(error)


# A session has one request under way; a file being read does not hold up the others. Kernels that
# use all cores take turns by a lock of their own.
_PLACES = Places(4, "firstphoton")
_SHORT = Places(1, "firstphoton-short")

# Where studies wait for each other, and nobody's slider for them.
LONG = Places(2, "firstphoton-long")


class LatestWins(Generic[Result]):
    """Runs the newest request of one session and forgets those it overtook.

    Parameters
    ----------
    on_page : callable
        Runs its first argument on the session's page thread, soon, unless the page is gone. When it
        comes to that it first runs its second argument, if there is one, in any case and on
        whatever thread.
    places : Places
        Shared with all sessions.
    """

    def __init__(self, on_page: OnPage, places: Places = _PLACES) -> None:
        self._on_page = on_page
        self._places = places
        self._lock = Lock()
        self._newest: Asked | None = None
        self._is_busy = False

    def submit(
        self,
        work: Callable[[], Result],
        done: Callable[[Result], None],
        failed: Failed,
        effort: Effort = Effort.ANY,
    ) -> None:
        """Run `work`, on a thread unless it is quick, then `done` or `failed` on the page.

        A request that has not started when the next one comes is dropped. The next one starts after
        `done` has drawn the last: neither computed nor drawn answers queue up.
        """
        with self._lock:
            self._newest = Asked(work, done, failed, effort)
            if self._is_busy:
                return
            self._is_busy = True
        self._go_on()

    @property
    def has_more(self) -> bool:
        """Whether another request waits for its turn."""
        return self._newest is not None

    def _places_for(self, effort: Effort) -> Places | None:
        return {Effort.QUICK: None, Effort.SHORT: _SHORT, Effort.ANY: self._places}[effort]

    def _go_on(self) -> None:
        assert self._newest is not None
        places = self._places_for(self._newest.effort)
        if places is None:
            self._on_page(partial(self._attempt, None), None)
        else:
            places.ask(partial(self._attempt, places), partial(self._refuse, places))

    def _take(self) -> Asked:
        with self._lock:
            newest, self._newest = self._newest, None
        assert newest is not None
        return newest

    def _attempt(self, places: Places | None) -> None:
        assert self._newest is not None
        if self._places_for(self._newest.effort) is not places:  # another kind has overtaken it
            if places is not None:
                places.leave()
            self._go_on()
            return
        asked = self._take()
        draw = partial(self._finish, _outcome(asked), asked.failed)
        if places is None:
            draw()
        else:
            self._on_page(draw, places.leave)

    def _refuse(self, places: Places, error: Exception) -> None:
        failed = self._take().failed
        self._on_page(partial(self._finish, partial(failed, error), failed), places.leave)

    def _finish(self, draw: Act, failed: Failed) -> None:
        try:
            draw()
        except Exception as error:  # an answer that cannot be drawn is told like one that is none
            failed(error)
        finally:
            with self._lock:
                self._is_busy = self._newest is not None
            if self._is_busy:
                self._go_on()


def _outcome(asked: Asked) -> Act:
    """What draws the outcome of a request, or tells of its failure."""
    try:
        return partial(asked.done, asked.work())
    except Exception as error:  # whatever it is, the page must tell it
        return partial(asked.failed, error)
    except BaseException as error:  # as a library may raise that ends the program
        return partial(asked.failed, RuntimeError(f"{type(error).__name__}: {error}"))


@dataclass(frozen=True)
class Step(Generic[Result]):
    """A piece of long work."""

    work: Callable[[], Result]
    """Runs on the worker."""
    draw: Callable[[Result], None]
    """Runs on the page, with what `work` returned."""


class InSteps:
    """Work too long for one request, step by step: between steps it can pause, or end.

    All but the steps' work belongs to the page's thread.

    Parameters
    ----------
    on_page : callable
        As for `LatestWins`.
    told : callable
        Called when something of the following has changed.
    failed : callable
        Called with what went wrong in a step; the steps behind it are not done.

    Attributes
    ----------
    done : int
        Steps done so far.
    is_running : bool
        Whether there are steps to do and nobody has cancelled them.
    """

    def __init__(
        self,
        on_page: OnPage,
        told: Act,
        failed: Failed,
    ) -> None:
        self._jobs: LatestWins[Any] = LatestWins(on_page, LONG)
        self._told = told
        self._failed = failed
        self._steps: Sequence[Step[Any]] = ()
        self._asked = 0
        self._is_paused = False
        self.done = 0
        self.is_running = False

    @property
    def of(self) -> int:
        """Steps in all."""
        return len(self._steps)

    def start(self, steps: Sequence[Step[Any]]) -> None:
        """Begin with the first of these steps; what else was to be done is forgotten."""
        self._steps = list(steps)  # a list of its own tells this start from others
        self.done = self._asked = 0
        self.is_running = bool(steps)
        self._told()
        self._go_on()

    def cancel(self) -> None:
        """Do no further step, and draw none."""
        self.is_running = False
        self._told()

    def pause(self, is_paused: bool) -> None:
        """Begin no step for a while, or go on."""
        self._is_paused = is_paused
        self._go_on()

    def _go_on(self) -> None:
        # One step at a time: the next is asked for when the last has been drawn.
        if self.is_running and not self._is_paused and self._asked == self.done:
            self._asked += 1
            step, steps = self._steps[self.done], self._steps
            self._jobs.submit(
                step.work, partial(self._arrived, steps, step), partial(self._ended, steps)
            )

    def _arrived(self, steps: Sequence[Step[Any]], step: Step[Any], result: Any) -> None:
        if steps is not self._steps or not self.is_running:
            return  # cancelled, or overtaken by another start
        step.draw(result)
        self.done += 1
        self.is_running = self.done < self.of
        self._told()
        self._go_on()

    def _ended(self, steps: Sequence[Step[Any]], error: Exception) -> None:
        if steps is self._steps and self.is_running:
            self.cancel()
            self._failed(error)
