"""How kernels are compiled and entered, in one place."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba

log = logging.getLogger(__name__)


def can_cache() -> bool:
    """Whether a folder for compiled kernels can be written; logs a warning if none can.

    Without one numba refuses to define a cached kernel at all: in a read-only checkout of a user
    without a home folder, nothing would start.
    """
    try:
        numba.njit(cache=True)(can_cache)  # looks for the folder, compiles nothing
    except RuntimeError:
        log.warning(
            "No folder for compiled kernels can be written, so that each start compiles them "
            "again (some 20 s): set NUMBA_CACHE_DIR to a folder of your own."
        )
        return False
    return True


# "contract" alone lets a multiply and an add fuse; full fastmath would drop NaN and infinity.
COMPILED: dict[str, Any] = {
    "cache": can_cache(),
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
