"""Compare memory and time of estimates with what `core.cost` predicts.

``python -m core.studies.performance.costs [method ...]``
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from time import process_time

import numpy as np

from core.acquisition import Acquisition
from core.capture import Capture
from core.cost import Cost, predicted
from core.estimators import ESTIMATORS, estimate

SHAPES = (
    (1, 1, 1_000_000),
    (8, 8, 100_000),
    (3000, 3000, 1),
    (1000, 1000, 10),
    (64, 64, 100),
    (256, 256, 200),
    (256, 256, 1024),
)
"""Rows, columns and bins."""


def measured(shape: tuple[int, int, int], method: str) -> Cost:
    """Range random counts; return working memory and processor time.

    The memory is that of this process, which should do nothing else, from ``/proc``; 0 where that
    does not exist (outside Linux).
    """
    estimate(_random(8, 8, 50), method)  # loads and compiles the kernels
    capture = _random(*shape)
    before, started = _reset_peak_bytes(), process_time()
    estimate(capture, method)
    return Cost(_status_bytes("VmHWM") - before, process_time() - started)


def _random(rows: int, cols: int, n_bins: int) -> Capture:
    cube = np.empty((rows, cols, n_bins), np.uint16)
    rng = np.random.default_rng(0)
    for row in cube:
        row[:] = rng.random((cols, n_bins), np.float32) < min(0.3, 200 / n_bins)
    cube[:, :, n_bins // 2] += 5
    acquisition = Acquisition(n_bins, 1e-9, n_pulses=int(cube.sum(axis=2).max()) + 1000)
    return Capture(cube, acquisition, signal=np.full((rows, cols), 0.05), background=0.5)


def _reset_peak_bytes() -> int:
    """Reset the peak memory of this process; return its present memory."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return 0
    return _status_bytes("VmRSS")


def _status_bytes(name: str) -> int:
    try:
        with open("/proc/self/status") as file:
            return next(1024 * int(line.split()[1]) for line in file if line.startswith(name))
    except (OSError, StopIteration):
        return 0


def main(arguments: list[str]) -> None:
    """Compare all methods on all shapes, each in a process of its own."""
    if arguments and "x" in arguments[-1]:
        method, text = arguments
        rows, cols, n_bins = map(int, text.split("x"))
        costs = (f((rows, cols, n_bins), method) for f in (measured, predicted))
        cells = (f"{each.working_bytes / 1e6:8.0f} MB {each.seconds:8.2f} s" for each in costs)
        print(f"{method:20} {text:>14}", *cells, flush=True)
        return
    print(f"{'method':20} {'shape':>14}   measured              predicted, on one thread")
    for shape in SHAPES:
        for method in arguments or ESTIMATORS:
            text = "x".join(map(str, shape))
            command = [sys.executable, "-m", "core.studies.performance.costs", method, text]
            subprocess.run(command, check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
