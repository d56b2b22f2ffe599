"""Groups of successive pulses: what a capture keeps of the order of its pulses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.checks import require

USUAL_GROUPS = 40
"""Groups that resolve displacements of up to about as many bins."""


@dataclass(frozen=True, eq=False)
class PulseGroups:
    """Histograms of successive groups of pulses, which add up to those of a capture.

    Parameters
    ----------
    counts : ndarray, shape (group, row, col, bin)
        Unsigned counts of each group, in the order of time. Made read-only.
    n_pulses : tuple of int
        Pulses of each group.
    pulse_rate_hz : float, optional
        Pulses per second; None if unknown.

    Raises
    ------
    ValueError
        If shapes or types do not match, or a value is out of its range.
    """

    counts: NDArray[np.unsignedinteger]
    n_pulses: tuple[int, ...]
    pulse_rate_hz: float | None = None

    def __post_init__(self) -> None:
        counts, rate_hz = self.counts, self.pulse_rate_hz
        is_counts = counts.dtype.kind == "u" and counts.dtype.itemsize <= 4
        fits = counts.ndim == 4 and is_counts and min(counts.shape) > 0
        found = f"{counts.dtype} array of shape {counts.shape}"
        accepted = "uint8, uint16 or uint32 counts of shape (group, row, col, bin), none of them 0"
        require("counts", found, fits, accepted)
        fits = len(self.n_pulses) == len(counts) and min(self.n_pulses) > 0
        require("n_pulses", self.n_pulses, fits, f"{len(counts)} positive numbers, one a group")
        known = rate_hz is None or 0 < rate_hz < np.inf
        require("pulse_rate_hz", rate_hz, known, "pulses per second, positive, or None")
        counts.setflags(write=False)

    @cached_property
    def total(self) -> NDArray[np.uint32]:
        """Counts of all groups, shape (row, col, bin)."""
        return np.asarray(self.counts.sum(axis=0, dtype=np.uint32))

    @cached_property
    def middle(self) -> NDArray[np.float64]:
        """Middle of each group, from -0.5 at the first pulse to 0.5 after the last, (group,)."""
        end = np.cumsum(self.n_pulses)
        return np.asarray((end - np.asarray(self.n_pulses) / 2) / end[-1] - 0.5)

    def mapped(self, change: Callable[[NDArray[Any]], NDArray[Any]], **fields: Any) -> PulseGroups:
        """Return groups whose cubes (row, col, bin) are changed one by one, and other fields."""
        return replace(self, counts=np.stack([change(cube) for cube in self.counts]), **fields)

    def resized(self, n_pulses: int) -> PulseGroups:
        """Return the groups as parts of another number of pulses, sent in the same time.

        Raises
        ------
        ValueError
            If there are fewer pulses than groups.
        """
        n_groups, end = len(self.counts), np.cumsum(self.n_pulses, dtype=float)
        accepted = f"{n_groups} or more, a pulse for each group of pulses"
        require("n_pulses", n_pulses, n_pulses >= n_groups, accepted)
        # Between the ends, each group keeps a pulse at least.
        ends = np.rint(end * (n_pulses / end[-1])).astype(int)
        ends = np.maximum.accumulate(ends - np.arange(n_groups)) + np.arange(n_groups)
        ends = np.minimum(ends, n_pulses - np.arange(n_groups)[::-1])
        rate_hz = self.pulse_rate_hz and self.pulse_rate_hz * n_pulses / end[-1]
        return replace(
            self,
            n_pulses=tuple(np.diff(ends, prepend=0).tolist()),
            pulse_rate_hz=rate_hz and float(rate_hz),
        )


def group_sizes(n_pulses: int, n_groups: int) -> tuple[int, ...]:
    """Return the pulses of each of `n_groups` groups that are as equal as possible.

    Pulse ``j`` belongs to group ``j * n_groups // n_pulses``.

    Raises
    ------
    ValueError
        If there are more groups than pulses.
    """
    fits = 1 <= n_groups <= n_pulses
    require("groups of pulses", n_groups, fits, f"1 to {n_pulses}, the number of pulses")
    start = -(-np.arange(n_groups + 1) * n_pulses // n_groups)
    return tuple(np.diff(start).tolist())
