"""Compilation options of kernels, and the lock under which parallel ones run."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numba

log = logging.getLogger(__name__)


def can_cache() -> bool:
    """Return whether compiled kernels can be cached on disk; log a warning if not.

    Without a writable folder numba refuses to define a cached kernel, so that nothing would start
    in a read-only checkout of a user without a home folder.
    """
    try:
        numba.njit(cache=True)(can_cache)  # looks for the folder without compiling
    except RuntimeError:
        log.warning(
            "No folder for compiled kernels is writable, so that each start compiles them again "
            "(about 20 s): set NUMBA_CACHE_DIR to a writable folder."
        )
        return False
    return True


# "contract" fuses multiply and add; full fastmath would not respect NaN and infinity.
COMPILED: dict[str, Any] = {
    "cache": can_cache(),
    "nogil": True,
    "fastmath": {"contract"},
    "error_model": "numpy",  # a division by zero gives infinity or NaN, as in numpy
}
PARALLEL: dict[str, Any] = {**COMPILED, "parallel": True}
# Sums in any order can be vectorised.
SUMMING: dict[str, Any] = {**COMPILED, "fastmath": {"contract", "reassoc"}}

# Without OpenMP, numba's threading layer aborts the process if two Python threads run parallel
# kernels at once.
KERNEL_LOCK = threading.Lock()

# Counts in a cube up to which threads cost more than they save.
SERIAL_BELOW = 2_000_000


@contextmanager
def entering(n_counts: int) -> Iterator[None]:
    """Hold the lock of parallel kernels; use one thread for small work.

    On a busy machine, synchronising threads takes longer than small work itself.
    """
    with KERNEL_LOCK:
        threads = numba.get_num_threads()
        numba.set_num_threads(threads if n_counts > SERIAL_BELOW else 1)
        try:
            yield
        finally:
            numba.set_num_threads(threads)
