"""Limits of the machine: time of a square root and of a byte read from memory."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np
from numba import njit, prange

from core.kernels.parallel import PARALLEL
from core.metrics import Interval
from core.studies.outputs import Table
from core.studies.statistics import median_interval
from core.studies.timing import interleaved, kernel_threads

_ROW = 4096  # float32 numbers that stay in the nearest cache
_ROOTS_OF_EACH = 500
_ROWS = 16
_BYTES_OF_A_COUNT = 2


@dataclass(frozen=True)
class Roofline:
    """Limits of one thread and of all threads, by number of threads."""

    root_ns: dict[int, Interval]
    """Time of one independent float32 square root."""
    read_gb_per_s: dict[int, Interval]

    def seconds(self, n_counts: int, threads: int) -> float:
        """Return the time of tracking's two square roots per count, or of reading the counts."""
        threads = threads if threads in self.root_ns else 1
        roots_s = 2e-9 * n_counts * self.root_ns[threads].value
        read_s = _BYTES_OF_A_COUNT * n_counts / (1e9 * self.read_gb_per_s[threads].value)
        return max(roots_s, read_s)

    def table(self) -> Table:
        """Return the limits as a table."""
        rows = [
            (name, threads, each)
            for name, known in (
                ("ns per float32 square root", self.root_ns),
                ("GB/s read from memory", self.read_gb_per_s),
            )
            for threads, each in known.items()
        ]
        columns = ("limit", "threads", "median [95 %]")
        return Table("roofline", "Roofline of this machine", columns, tuple(rows))


def roofline(rounds: int, n_bytes: int) -> Roofline:
    """Measure the limits; `n_bytes` should be several times what the caches hold."""
    numbers = np.random.default_rng(0).uniform(1, 2, (_ROWS, _ROW)).astype(np.float32)
    source = np.ones((n_bytes // (8 * _ROW), _ROW), np.uint64)
    sums = np.empty(len(source), np.uint64)
    root_ns, read_gb_per_s = {}, {}
    for threads in sorted({1, numba.get_num_threads()}):
        calls: dict[str, Callable[[], object]] = {
            "roots": partial(take_roots, numbers, _ROOTS_OF_EACH),
            "read": partial(add_rows, source, sums),
        }
        with kernel_threads(threads):
            taken = interleaved(calls, rounds)
        one_root_ns = taken["roots"] * 1e9 / (numbers.size * _ROOTS_OF_EACH)
        root_ns[threads] = median_interval(one_root_ns)
        read_gb_per_s[threads] = median_interval(source.nbytes / 1e9 / taken["read"])
    return Roofline(root_ns, read_gb_per_s)


@njit(**PARALLEL)
def take_roots(numbers, times):  # type: ignore[no-untyped-def]
    """Replace each number by its root, a number of times."""
    for row in prange(numbers.shape[0]):
        x = numbers[row]
        for _ in range(times):
            for i in range(x.size):
                x[i] = math.sqrt(x[i])


@njit(**PARALLEL)
def add_rows(source, sums):  # type: ignore[no-untyped-def]
    """Sum each row of unsigned integers."""
    for row in prange(source.shape[0]):
        total = np.uint64(0)
        for i in range(source.shape[1]):
            total += source[row, i]
        sums[row] = total
