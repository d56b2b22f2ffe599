"""Limits on the work of a server: memory and time of one request, memory of all at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from itertools import product
from typing import Any

import psutil

from core import Capture
from core.checks import require
from core.cost import Cost, cost_of, needs
from core.reductions import Reduction

REQUEST_BYTES = 2**30
"""Most working memory of one request, unless `REQUEST_SHARE` of the free memory is less."""

REQUEST_SHARE = 1 / 8
REQUEST_S = 25.0
"""Longest estimated time of one request on one thread."""

SERVER_REQUESTS = 4
"""Requests of the largest size that may be computed at once."""

FREE_BYTES = 2**26
"""Requests below this size are not counted and never wait."""

MOST_FACTOR = 8
"""Largest factor by which `fitting` merges bins, or skips rows and columns."""

REMEDY = (
    "Crop the gate, merge bins or keep fewer pixels under Data reduction; or range all of it "
    "without this page: python -m core estimate"
)


def most_bytes() -> int:
    """Return the working memory that one request may take now."""
    free = psutil.virtual_memory().available
    return max(FREE_BYTES, min(REQUEST_BYTES, int(REQUEST_SHARE * free)))


def fits(cost: Cost) -> bool:
    """Whether one request may take this much."""
    return cost.working_bytes <= most_bytes() and cost.seconds <= REQUEST_S


def require_fitting(shape: tuple[int, ...], what: str, cost: Cost) -> None:
    """Refuse a computation on a capture that exceeds the limits of a request.

    Raises
    ------
    ValueError
        With the cost, the limit and a remedy.
    """
    memory = needs(shape, what)
    for name, cost_, limit, unit in (
        (memory, cost.working_bytes / 1e6, most_bytes() / 1e6, "MB"),
        (memory.replace("working memory", "estimated time"), cost.seconds, REQUEST_S, "s"),
    ):
        accepted = f"at most {limit:,.0f} {unit} on this server. {REMEDY}"
        require(name, f"{cost_:,.0f} {unit}", cost_ <= limit, accepted)


class Budget:
    """Working memory that all requests share; a request waits until there is enough."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._taken_bytes = 0

    @contextmanager
    def spending(self, n_bytes: int) -> Iterator[None]:
        """Take memory for a block; blocks the thread until there is enough."""
        if n_bytes < FREE_BYTES:
            yield
            return
        with self._changed:
            # A single request always runs: its size was checked before.
            self._changed.wait_for(lambda: self._has_room_for(n_bytes))
            self._taken_bytes += n_bytes
        try:
            yield
        finally:
            with self._changed:
                self._taken_bytes -= n_bytes
                self._changed.notify_all()

    def _has_room_for(self, n_bytes: int) -> bool:
        taken = self._taken_bytes
        return taken == 0 or taken + n_bytes <= SERVER_REQUESTS * most_bytes()


BUDGET = Budget()


@contextmanager
def spending(shape: tuple[int, ...], what: str, cost: Cost) -> Iterator[None]:
    """Compute something within the limits of a request and of all requests together.

    Raises
    ------
    ValueError
        As `require_fitting`, before anything is computed.
    """
    require_fitting(shape, what, cost)
    with BUDGET.spending(cost.working_bytes):
        yield


def ranging(
    capture: Capture, method: str, settings: Any = None, false_alarm: float | None = None
) -> AbstractContextManager[None]:
    """Compute an estimate within the limits; see `spending`."""
    cost = cost_of(capture, method, settings, false_alarm)
    return spending(capture.cube.shape, method, cost)


def fitting(
    shape: tuple[int, int, int],
    cost: Callable[[tuple[int, int, int]], Cost],
    least: Reduction,
) -> tuple[int, int] | None:
    """Find the weakest merging of bins and skipping of pixels with which a capture fits.

    Parameters
    ----------
    shape : tuple of int
        Rows, columns and bins of the capture.
    cost : callable
        Predicts the cost of an estimate of a capture of a shape.
    least : Reduction
        Reduction that is applied in any case.

    Returns
    -------
    tuple of int
        ``merge`` and ``skip``; None where no reduction is strong enough.
    """
    factors = product(range(least.merge, MOST_FACTOR + 1), range(least.skip, MOST_FACTOR + 1))
    for merge, skip in sorted(factors, key=lambda each: (each[0] * each[1] ** 2, each[1])):
        reduction = replace(least, merge=merge, skip=skip)
        if reduction.fits(shape) and fits(cost(reduction.shape(shape))):
            return merge, skip
    return None
