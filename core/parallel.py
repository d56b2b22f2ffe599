"""How kernels are compiled and entered, in one place."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba

# "contract" alone lets a multiply and an add fuse; full fastmath would drop NaN and infinity.
COMPILED: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "fastmath": {"contract"},
    "error_model": "numpy",  # a division by zero gives infinity or NaN, as in numpy
}
PARALLEL: dict[str, Any] = {**COMPILED, "parallel": True}
# Sums may be added up in any order, and so several numbers at a time.
SUMMING: dict[str, Any] = {**COMPILED, "fastmath": {"contract", "reassoc"}}

# Where OpenMP is missing numba falls back to a threading layer that aborts the process when two
# Python threads enter parallel kernels at once.
KERNEL_LOCK = threading.Lock()

# Counts in a cube below which starting threads costs more than it saves.
SERIAL_BELOW = 2_000_000


@contextmanager
def entering(n_counts: int) -> Iterator[None]:
    """Alone in a parallel kernel, on one thread where the work is small.

    Threads that wait for each other cost a multiple of small work as soon as the machine is busy.
    """
    with KERNEL_LOCK:
        threads = numba.get_num_threads()
        numba.set_num_threads(threads if n_counts > SERIAL_BELOW else 1)
        try:
            yield
        finally:
            numba.set_num_threads(threads)
