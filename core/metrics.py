"""How far an answer is from the truth.

Metrics look at target pixels, those with a finite truth. A target pixel without an answer counts as
not restored; the root mean square and the bias are over answered pixels, which is why `coverage`
belongs beside them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

from core.acquisition import Floats
from core.checks import require


def errors_m(range_m: ArrayLike, truth_m: ArrayLike) -> Floats:
    """Errors in metres of all target pixels, flat; NaN where a target has no answer.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    answer, truth = np.asarray(range_m, float), np.asarray(truth_m, float)
    require("range_m", f"shape {answer.shape}", answer.shape == truth.shape, f"{truth.shape}")
    target = np.isfinite(truth)
    return np.asarray(answer[target] - truth[target])


def rmse_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Root mean square error in metres over answered target pixels; NaN where there are none."""
    error = errors_m(range_m, truth_m)
    error = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(error**2))) if error.size else math.nan


def bias_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Median error in metres over answered target pixels; NaN where there are none."""
    error = errors_m(range_m, truth_m)
    error = error[np.isfinite(error)]
    return float(np.median(error)) if error.size else math.nan


def coverage(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Share of target pixels that have an answer; NaN where there are no targets."""
    error = errors_m(range_m, truth_m)
    return float(np.mean(np.isfinite(error))) if error.size else math.nan


def restored(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> tuple[int, int]:
    """How many target pixels lie within `tolerance_m` of the truth, and how many there are."""
    error = errors_m(range_m, truth_m)
    # Half a micrometre of grace: a tolerance of whole bins is met by an error of whole bins.
    return int(np.count_nonzero(np.abs(error) <= tolerance_m + 5e-7)), error.size


def restoration_degree(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> float:
    """Share of target pixels within `tolerance_m` metres of the truth (the paper's RD).

    The paper does not print its tolerance; 3 bins reproduce its tables. NaN without targets.
    """
    hits, targets = restored(range_m, truth_m, tolerance_m)
    return hits / targets if targets else math.nan


@dataclass(frozen=True)
class Interval:
    """An estimate and where it may lie."""

    value: float
    low: float
    high: float


def wilson(hits: int, trials: int, level: float = 0.95) -> Interval:
    """Wilson score interval of a share (Wilson 1927).

    Parameters
    ----------
    hits, trials : int
        ``0 <= hits <= trials``, at least one trial.
    level : float
        Probability that the interval covers the true share.
    """
    require("trials", trials, trials >= 1, "at least 1")
    require("hits", hits, 0 <= hits <= trials, f"0 to {trials}")
    require("level", level, 0 < level < 1, "between 0 and 1")
    z = float(ndtri(0.5 + level / 2))
    share = hits / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    half /= 1 + z * z / trials
    return Interval(share, min(max(centre - half, 0.0), share), max(min(centre + half, 1.0), share))
