"""How far an answer is from the truth.

Metrics look at target pixels, those with a finite truth. A target pixel without an answer counts as
not restored; errors and their means are over answered pixels, which is why `coverage` belongs
beside them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats
from core.checks import require

__all__ = [
    "Detection",
    "Interval",
    "Told",
    "bias_m",
    "calibration_error",
    "coverage",
    "errors_m",
    "estimator_variance_m2",
    "inlier_rmse_m",
    "mae_m",
    "median_error_m",
    "precision_recall",
    "rd_variance",
    "reliability",
    "restoration_degree",
    "restored",
    "rmse_m",
    "wilson",
]


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
    return _root_mean_square(_answered(range_m, truth_m))


def mae_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Mean absolute error in metres over answered target pixels; NaN where there are none."""
    return _mean(np.abs(_answered(range_m, truth_m)))


def inlier_rmse_m(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> float:
    """Root mean square error in metres over target pixels within `tolerance_m` of the truth.

    How well an echo is placed once it is found; `restoration_degree` says how often it is. NaN
    where no pixel is within the tolerance.
    """
    error = _answered(range_m, truth_m)
    return _root_mean_square(error[_within(error, tolerance_m)])


def bias_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Mean error in metres over answered target pixels; NaN where there are none.

    A few answers at the other end of the gate move it; `median_error_m` is the shift of the many.
    """
    return _mean(_answered(range_m, truth_m))


def median_error_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Median error in metres over answered target pixels; NaN where there are none."""
    error = _answered(range_m, truth_m)
    return float(np.median(error)) if error.size else math.nan


def coverage(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Share of target pixels that have an answer; NaN where there are no targets."""
    error = errors_m(range_m, truth_m)
    return float(np.mean(np.isfinite(error))) if error.size else math.nan


def restored(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> tuple[int, int]:
    """How many target pixels lie within `tolerance_m` of the truth, and how many there are."""
    error = errors_m(range_m, truth_m)
    return int(np.count_nonzero(_within(error, tolerance_m))), error.size


def restoration_degree(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> float:
    """Share of target pixels within `tolerance_m` metres of the truth (the paper's RD).

    The paper does not print its tolerance; 3 bins reproduce its tables. NaN without targets.
    """
    hits, targets = restored(range_m, truth_m, tolerance_m)
    return hits / targets if targets else math.nan


def rd_variance(rd_per_repetition: ArrayLike) -> float:
    """Variance of the restoration degree over Monte-Carlo repetitions.

    The paper does not define its "Var"; this reading fits the size of its numbers. Where pixels are
    independent and equally hard it is ``RD (1 - RD) / pixels``.

    Parameters
    ----------
    rd_per_repetition : array_like, shape (repetition,)
        At least 2.

    Raises
    ------
    ValueError
        If there are fewer.
    """
    rd = np.asarray(rd_per_repetition, float)
    require("rd_per_repetition", f"shape {rd.shape}", rd.ndim == 1 and rd.size >= 2, "2 or more")
    return float(np.var(rd, ddof=1))


def estimator_variance_m2(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Variance in square metres of a pixel's answers over repetitions, averaged over target pixels.

    Parameters
    ----------
    range_m : array_like, shape (repetition, row, col)
        Answers to captures of one scene that differ in their seed; NaN where there is none.
    truth_m : array_like, shape (row, col)
        NaN where there is no target.

    Returns
    -------
    float
        Pixels with fewer than 2 answers have no variance and are left out; NaN where all are.

    Raises
    ------
    ValueError
        If the shapes do not fit each other.
    """
    answer, truth = np.asarray(range_m, float), np.asarray(truth_m, float)
    fits = answer.ndim == truth.ndim + 1 and answer.shape[1:] == truth.shape
    require("range_m", f"shape {answer.shape}", fits, f"(repetition, *{truth.shape})")
    answer = answer[:, np.isfinite(truth)]
    answer = answer[:, np.isfinite(answer).sum(axis=0) >= 2]
    return _mean(np.nanvar(answer, axis=0, ddof=1))


@dataclass(frozen=True)
class Detection:
    """How well an estimator tells target from no target; NaN where a share is of nothing."""

    precision: float
    """Share of answered pixels that have a target."""
    recall: float
    """Share of target pixels that are answered."""
    false_alarm_rate: float
    """Share of pixels without a target that are answered."""


def precision_recall(valid: ArrayLike, truth_m: ArrayLike) -> Detection:
    """Judge the decision whether there is a target, not where.

    Parameters
    ----------
    valid : array_like of bool, shape (row, col)
        Where the estimator answers.
    truth_m : array_like, shape (row, col)
        NaN where there is no target.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    answered, target = np.asarray(valid, bool), np.isfinite(np.asarray(truth_m, float))
    fits = answered.shape == target.shape
    require("valid", f"shape {answered.shape}", fits, f"{target.shape}")
    return Detection(_mean(target[answered]), _mean(answered[target]), _mean(answered[~target]))


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
    z = float(scipy.special.ndtri(0.5 + level / 2))
    share = hits / trials
    centre = (share + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    half /= 1 + z * z / trials
    return Interval(share, min(max(centre - half, 0.0), share), max(min(centre + half, 1.0), share))


def _answered(range_m: ArrayLike, truth_m: ArrayLike) -> Floats:
    error = errors_m(range_m, truth_m)
    return error[np.isfinite(error)]


def _within(error_m: Floats, tolerance_m: float) -> NDArray[np.bool_]:
    # Half a micrometre of grace: a tolerance of whole bins is met by an error of whole bins.
    return np.asarray(np.abs(error_m) <= tolerance_m + 5e-7)


def _mean(values: NDArray[Any]) -> float:
    return float(np.mean(values)) if values.size else math.nan


def _root_mean_square(values: Floats) -> float:
    return math.sqrt(_mean(values**2))


@dataclass(frozen=True)
class Told:
    """The answers whose confidence falls in one tenth (of a reliability diagram)."""

    confidence: float
    """Their mean confidence."""
    right: Interval
    """Share of them within 3 bins of a surface."""
    count: int


def reliability(confidence: Floats, right: NDArray[np.bool_]) -> list[Told]:
    """Answers by tenths of confidence; tenths without answers are left out.

    Parameters
    ----------
    confidence : ndarray, shape (answer,)
        What was told, in [0, 1].
    right : ndarray of bool, shape (answer,)
    """
    tenth = np.minimum((confidence * 10).astype(int), 9)
    return [
        Told(
            float(confidence[tenth == k].mean()),
            wilson(int(right[tenth == k].sum()), int((tenth == k).sum())),
            int((tenth == k).sum()),
        )
        for k in range(10)
        if (tenth == k).any()
    ]


def calibration_error(told: Sequence[Told]) -> float:
    """Expected calibration error: mean distance of confidence from the share that is right."""
    count = sum(each.count for each in told)
    return sum(each.count * abs(each.confidence - each.right.value) for each in told) / count
