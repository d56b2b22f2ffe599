"""95 % intervals of medians and means."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from scipy.special import bdtr, stdtrit

from core.acquisition import Floats
from core.checks import require
from core.metrics import Interval

Key = TypeVar("Key")
Result = TypeVar("Result")

MIN_REPEATS = 6
"""With fewer values even the range from smallest to largest covers the median in less than 95 %."""


def median_interval(values: Floats) -> Interval:
    """Return the median with its 95 % interval from order statistics, for any distribution.

    The interval from the j-th smallest to the j-th largest of n values misses the median only where
    fewer than j of them lie on one side of it: twice a binomial tail.

    Raises
    ------
    ValueError
        If there are fewer than `MIN_REPEATS` values.
    """
    n = len(values)
    require("repeats", n, n >= MIN_REPEATS, f"at least {MIN_REPEATS}")
    tail = 2 * bdtr(np.arange(n // 2), n, 0.5)  # of 0, 1, ... values on one side
    outermost = int(np.count_nonzero(tail <= 0.05))
    ordered = np.sort(values)
    low, high = ordered[outermost - 1], ordered[n - outermost]
    return Interval(float(np.median(ordered)), float(low), float(high))


def mean_interval(values: Floats, least: float = -math.inf, most: float = math.inf) -> Interval:
    """Return the mean with Student's 95 % interval, NaN where there are fewer than two values.

    The interval is cut to the means that are possible, from `least` to `most`.
    """
    n = len(values)
    if n < 2:
        return Interval(math.nan, math.nan, math.nan)
    mean = float(np.mean(values))
    half = float(stdtrit(n - 1, 0.975) * np.std(values, ddof=1) / math.sqrt(n))
    return Interval(mean, max(mean - half, least), min(mean + half, most))


def mean_over_seeds(
    found: Mapping[tuple[Key, int], Result],
    key: Key,
    seeds: Sequence[int],
    value: Callable[[Result], float],
    most: float = 1.0,
) -> Interval:
    """Return the `mean_interval` of a value, from 0 to `most`, of the results of all seeds."""
    return mean_interval(np.array([value(found[key, seed]) for seed in seeds]), 0.0, most)
