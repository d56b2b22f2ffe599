"""Limits on the work of a server: memory and time of one request, memory of all at once."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any

import psutil

from core import Capture
from core.checks import require
from core.cost import Cost, cost_of, needs, predicted
from core.reductions import Reduction

REQUEST_BYTES = 2**30
"""Working memory of one request at most, if `REQUEST_SHARE` of what is free is no less."""

REQUEST_SHARE = 1 / 8
REQUEST_S = 25.0
"""Estimated time of one request at most, on one thread."""

SERVER_REQUESTS = 4
"""Requests of the largest size that may be computed at once."""

FREE_BYTES = 2**26
"""A request that needs less is not counted: it never waits for others."""

REMEDY = (
    "Crop the gate, merge bins or keep fewer pixels under Less data, faster; or range all of it "
    "without this page: python -m core estimate"
)


def most_bytes() -> int:
    """Working memory that one request may take now."""
    free = psutil.virtual_memory().available
    return max(FREE_BYTES, min(REQUEST_BYTES, int(REQUEST_SHARE * free)))


def fits(cost: Cost) -> bool:
    """Whether one request may take this much."""
    return cost.working_bytes <= most_bytes() and cost.seconds <= REQUEST_S


def require_fitting(shape: tuple[int, ...], what: str, cost: Cost) -> None:
    """Refuse a computation on a capture that takes more memory or time than one request may.

    Raises
    ------
    ValueError
        If it does: says how much it would take, how much it may, and what to do.
    """
    most = most_bytes()
    name, needed = needs(shape, what), cost.working_bytes
    accepted = f"at most {most / 1e6:,.0f} MB on this server. {REMEDY}"
    require(name, f"{needed / 1e6:,.0f} MB", needed <= most, accepted)
    name = name.replace("working memory", "estimated time")
    accepted = f"at most {REQUEST_S:.0f} s on this server. {REMEDY}"
    require(name, f"{cost.seconds:,.0f} s", cost.seconds <= REQUEST_S, accepted)


class Budget:
    """Working memory that all requests together may take at once; others wait for their turn."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._taken_bytes = 0

    @contextmanager
    def spending(self, n_bytes: int) -> Iterator[None]:
        """Compute something, once there is memory for it; on a worker, for this may wait."""
        if n_bytes < FREE_BYTES:
            yield
            return
        with self._changed:
            # Alone, any request may run: it was checked before.
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
    """Compute something within the limits of a request, and within what all may take at once.

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
    """`spending` of an estimate."""
    cost = cost_of(capture, method, settings, false_alarm)
    return spending(capture.cube.shape, method, cost)


def fitting(
    shape: tuple[int, int, int], method: str, least: Reduction, most: int = 8
) -> tuple[int, int] | None:
    """Bins to merge and pixels to skip, so that a capture fits; as few as will do.

    Parameters
    ----------
    shape : tuple of int
        Rows, columns and bins of the capture.
    method : str
    least : Reduction
        What is left out of it in any case.
    most : int
        Largest factor of either.

    Returns
    -------
    tuple of int
        ``merge`` and ``skip``; None where no such reduction is enough.
    """
    tried = sorted(
        ((merge, skip) for merge in range(1, most + 1) for skip in range(1, most + 1)),
        key=lambda each: (each[0] * each[1] ** 2, each[1]),
    )
    for merge, skip in tried:
        if merge < least.merge or skip < least.skip:
            continue
        reduction = replace(least, merge=merge, skip=skip)
        if reduction.fits(shape) and fits(predicted(reduction.shape(shape), method)):
            return merge, skip
    return None
