"""Images (row, col) of numbers in a file, listed before one of them is read, and true ranges."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats
from core.capture import Capture


class Map(NamedTuple):
    """Image in a file."""

    name: str
    """Empty where the file names none."""
    shape: tuple[int, ...]
    """Rows and columns."""
    load: Callable[[], NDArray[Any]]
    """Reads the numbers."""
    unit: str = ""
    """Unit that the file states; empty where it states none."""

    def __str__(self) -> str:
        rows, cols = self.shape
        return f"{self.name or 'the image'} ({rows} x {cols})"


def gate_m(acquisition: Acquisition) -> tuple[float, float]:
    """Return the ranges between which the gate lies."""
    low_m, high_m = acquisition.bin_to_range_m([0, acquisition.n_bins]).tolist()
    return low_m, high_m


def are_in_gate(truth_m: Floats, acquisition: Acquisition) -> NDArray[np.bool_]:
    """Return whether each target, NaN aside, is within the gate, shape (target,)."""
    known = truth_m[np.isfinite(truth_m)]
    low_m, high_m = gate_m(acquisition)
    return np.asarray((known >= low_m) & (known <= high_m))


def with_own_truth(capture: Capture, truth_m: Floats | None) -> Capture:
    """Return a capture with the truth of its own file; its source says if that does not fit."""
    if truth_m is None or not np.isfinite(truth_m).any():
        return replace(capture, truth_range_m=truth_m)
    low_m, high_m = gate_m(capture.acquisition)
    remark = f"truth: no target within the gate, {low_m:.6g} to {high_m:.6g} m"
    fits = are_in_gate(truth_m, capture.acquisition).any() or remark in capture.source
    source = capture.source if fits else f"{capture.source}; {remark}"
    return replace(capture, truth_range_m=truth_m, source=source)
