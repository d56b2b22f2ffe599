"""Compilation options of kernels, and their threads."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

import numba

log = logging.getLogger(__name__)

T = TypeVar("T")


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
            "(minutes): set NUMBA_CACHE_DIR to a writable folder."
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
# Sums in any order can be vectorised.
SUMMING: dict[str, Any] = {**COMPILED, "fastmath": {"contract", "reassoc"}}

# Counts in a cube up to which threads cost more than they save.
SERIAL_BELOW = 2_000_000


def on_threads(kernel: Callable[..., None], n_blocks: int, work: int, *arguments: Any) -> None:
    """Call ``kernel(first, end, *arguments)`` for all blocks, in parts on threads if work is large.

    Numba's own threads (``parallel=True``) would compile a kernel three times, and abort the
    process if two Python threads ran such kernels at once.

    Parameters
    ----------
    kernel : callable
        Compiled with `COMPILED`; blocks may be rows, columns or pixels.
    n_blocks : int
    work : int
        About as much as a pass over so many counts: up to `SERIAL_BELOW`, threads would cost more
        than they save.
    *arguments
    """
    n_parts = min(numba.get_num_threads(), n_blocks) if work > SERIAL_BELOW else 1
    if n_parts <= 1:
        kernel(0, n_blocks, *arguments)
        return
    ends = pairwise(n_blocks * part // n_parts for part in range(n_parts + 1))
    each_on_threads(lambda part: kernel(*part, *arguments), list(ends))


def each_on_threads(call: Callable[[T], object], items: Sequence[T]) -> None:
    """Call a function that releases the GIL with each item, on the threads of kernels."""
    n_threads = min(numba.get_num_threads(), len(items))

    def call_each(some: Sequence[T]) -> None:
        for item in some:
            call(item)

    running = [_threads().submit(call_each, items[i::n_threads]) for i in range(1, n_threads)]
    try:
        call_each(items[::n_threads])
    finally:
        wait(running)
    for each in running:
        each.result()


@cache
def _threads() -> ThreadPoolExecutor:
    """Threads for parts of kernels, started once: that takes as long as a small part."""
    return ThreadPoolExecutor(max(1, numba.config.NUMBA_NUM_THREADS - 1), "kernels")


if hasattr(os, "register_at_fork"):  # threads do not survive in a child
    os.register_at_fork(after_in_child=_threads.cache_clear)
