"""What the machine can do at all: square roots and bytes, the floors beneath every kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numba
import numpy as np
from numba import njit, prange

from core.kernels.parallel import PARALLEL
from core.metrics import Interval
from core.studies.timing import interleaved, median_interval

_ROW = 4096  # float32, which stay in the nearest cache
_ROOTS_OF_EACH = 500
_ROWS = 16  # of roots, as many for each of several threads


class Floors(NamedTuple):
    """What one or more threads reach together."""

    threads: int
    root_ns: Interval
    """Time of one independent float32 square root."""
    copied_gb_per_s: Interval
    """Bytes read and bytes written, both counted."""
    read_gb_per_s: Interval


def floors(threads: int, rounds: int, n_bytes: int) -> Floors:
    """Measure the floors on some threads.

    Parameters
    ----------
    threads, rounds : int
    n_bytes : int
        Of memory that is read and copied: several times what the caches hold.
    """
    numbers = np.random.default_rng(0).uniform(1, 2, (_ROWS, _ROW)).astype(np.float32)
    source = np.ones((n_bytes // (8 * _ROW), _ROW), np.uint64)
    target, sums = np.zeros_like(source), np.empty(len(source), np.uint64)
    calls: dict[str, Callable[[], object]] = {
        "roots": lambda: _take_roots(numbers, _ROOTS_OF_EACH),
        "copy": lambda: _copy(source, target),
        "read": lambda: _read(source, sums),
    }
    calls = {name: on_threads(threads, call) for name, call in calls.items()}
    taken = interleaved(calls, rounds)
    giga = source.nbytes / 1e9
    return Floors(
        threads,
        median_interval(taken["roots"] * 1e9 / (numbers.size * _ROOTS_OF_EACH)),
        median_interval(2 * giga / taken["copy"]),
        median_interval(giga / taken["read"]),
    )


def on_threads(threads: int, call: Callable[[], object]) -> Callable[[], object]:
    """The call, its kernels on so many threads."""

    def limited() -> object:
        before = numba.get_num_threads()
        numba.set_num_threads(threads)
        try:
            return call()
        finally:
            numba.set_num_threads(before)

    return limited


@njit(**PARALLEL)
def _take_roots(numbers, times):  # type: ignore[no-untyped-def]
    for row in prange(numbers.shape[0]):
        x = numbers[row]
        for _ in range(times):
            for i in range(x.size):
                x[i] = math.sqrt(x[i])


@njit(**PARALLEL)
def _copy(source, target):  # type: ignore[no-untyped-def]
    for row in prange(source.shape[0]):
        for i in range(source.shape[1]):
            target[row, i] = source[row, i]


@njit(**PARALLEL)
def _read(source, sums):  # type: ignore[no-untyped-def]
    for row in prange(source.shape[0]):
        total = np.uint64(0)
        for i in range(source.shape[1]):
            total += source[row, i]
        sums[row] = total
