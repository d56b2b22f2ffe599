"""Times that can be compared: taken in turn, with intervals, and on which machine."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping
from importlib.metadata import version
from pathlib import Path
from time import perf_counter

import numba
import numpy as np
import psutil
from llvmlite import binding
from scipy.special import bdtr

from core.acquisition import Floats
from core.checks import require
from core.metrics import Interval
from core.studies.outputs import Table

FEWEST_REPEATS = 6
"""Below, not even the fastest and the slowest hold the median between them with 95 %."""


def interleaved(
    calls: Mapping[str, Callable[[], object]], repeats: int, warm_up: int = 1
) -> dict[str, Floats]:
    """Time some calls in turn, so that what else the machine does meets all of them alike.

    Parameters
    ----------
    calls : mapping
        What to time, by name.
    repeats : int
        Rounds; each calls each once, in an order drawn anew (by a fixed seed), so that none always
        follows the same other.
    warm_up : int
        Rounds before, which are not timed: compilation, caches, pages that are touched first.

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


def median_interval(seconds: Floats) -> Interval:
    """Median with its 95 % interval from order statistics, whatever the distribution.

    Between the j-th smallest and the j-th largest of n values lies the median but where fewer than
    j of them fall on one of its sides: twice a binomial tail.

    Raises
    ------
    ValueError
        If there are fewer than `FEWEST_REPEATS` values.
    """
    n = len(seconds)
    require("repeats", n, n >= FEWEST_REPEATS, f"at least {FEWEST_REPEATS}")
    tail = 2 * bdtr(np.arange(n // 2), n, 0.5)  # of 0, 1, ... values on one side
    outermost = int(np.count_nonzero(tail <= 0.05))
    ordered = np.sort(seconds)
    low, high = ordered[outermost - 1], ordered[n - outermost]
    return Interval(float(np.median(ordered)), float(low), float(high))


def machine() -> Table:
    """What was measured on, and with which versions."""
    memory_gib = psutil.virtual_memory().total / 2**30
    rows = [
        ("processor", _processor()),
        ("compiled for", binding.get_host_cpu_name()),
        ("cores", str(os.cpu_count())),
        ("threads of kernels", str(numba.get_num_threads())),
        ("memory GiB", f"{memory_gib:.1f}"),
        ("system", platform.platform()),
        ("Python", platform.python_version()),
        *((name, version(name)) for name in ("numpy", "numba", "llvmlite", "scipy", "firstphoton")),
    ]
    return Table("machine", "The machine and the versions", ("what", "which"), tuple(rows))


def _processor() -> str:
    told = Path("/proc/cpuinfo")  # where Linux keeps what `platform` does not tell there
    lines = told.read_text(encoding="utf-8").splitlines() if told.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()
