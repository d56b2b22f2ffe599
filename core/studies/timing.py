"""Timing whose results can be compared: interleaved calls on a described machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import numba
import numpy as np
import psutil
from llvmlite import binding

from core.acquisition import Floats
from core.metrics import Interval
from core.studies.outputs import Table
from core.studies.statistics import MIN_REPEATS, median_interval


def interleaved(
    calls: Mapping[str, Callable[[], object]], repeats: int, warm_up: int = 1
) -> dict[str, Floats]:
    """Time several calls in turn, so that other load on the machine affects all of them alike.

    Parameters
    ----------
    calls : mapping
        What to time, by name.
    repeats : int
        Rounds, each of which makes every call once in a new random order (of a fixed seed), so that
        none always follows the same other.
    warm_up : int
        Untimed rounds before: compilation, caches, first touch of memory pages.

    Returns
    -------
    dict
        Seconds, shape (repeats,).
    """
    names = list(calls)
    seconds = {name: np.empty(repeats) for name in names}
    rng = np.random.default_rng(0)
    for i in range(-warm_up, repeats):
        for name in rng.permutation(names):
            started = perf_counter()
            calls[name]()
            taken = perf_counter() - started
            if i >= 0:
                seconds[name][i] = taken
    return seconds


def time_ratio(
    one: Callable[[], object], other: Callable[[], object], repeats: int = MIN_REPEATS + 3
) -> Interval:
    """Return the median ratio of two times, taken in turn."""
    seconds = interleaved({"one": one, "other": other}, repeats)
    return median_interval(seconds["one"] / seconds["other"])


@contextmanager
def kernel_threads(n_threads: int | None) -> Iterator[None]:
    """Run compiled kernels on this number of threads; None changes nothing."""
    before = numba.get_num_threads()
    numba.set_num_threads(n_threads or before)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def machine() -> Table:
    """Return processor, memory, system and versions."""
    rows = [
        ("processor", _processor()),
        ("compiled for", binding.get_host_cpu_name()),
        ("cores", str(os.cpu_count())),
        ("threads of kernels", str(numba.get_num_threads())),
        ("memory GiB", f"{psutil.virtual_memory().total / 2**30:.1f}"),
        ("system", platform.platform()),
        ("Python", platform.python_version()),
        *((name, version(name)) for name in ("numpy", "numba", "llvmlite", "scipy", "firstphoton")),
    ]
    return Table("machine", "Machine and versions", ("item", "value"), tuple(rows))


def _processor() -> str:
    cpu_info = Path("/proc/cpuinfo")  # on Linux, where `platform` does not name the model
    lines = cpu_info.read_text(encoding="utf-8").splitlines() if cpu_info.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
