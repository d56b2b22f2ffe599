"""Errors of range images against the truth, and intervals of shares.

Metrics consider target pixels, those with a finite true range. A target pixel without an estimate
counts as not restored; errors and their means are over estimated pixels, so quote `coverage` with
them. Ranges and truth are array_like of the same shape (row, col), in metres; NaN means no estimate
or no target. All functions raise ``ValueError`` if the shapes differ, a range is infinite, or a
tolerance is negative or NaN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats
from core.checks import require

__all__ = [
    "Detection",
    "DetectionRates",
    "Interval",
    "ReliabilityBin",
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
    "surface_errors_m",
    "surfaces_found",
    "wilson",
]


def errors_m(range_m: ArrayLike, truth_m: ArrayLike) -> Floats:
    """Errors in metres of all target pixels, flat; NaN where a target has no estimate."""
    found, truth = np.asarray(range_m, float), np.asarray(truth_m, float)
    require("range_m", f"shape {found.shape}", found.shape == truth.shape, f"{truth.shape}")
    _require_not_infinite(found)
    target = np.isfinite(truth)
    return np.asarray(found[target] - truth[target])


def rmse_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Root mean square error in metres over estimated target pixels; NaN without any."""
    return _root_mean_square(_found_errors_m(range_m, truth_m))


def mae_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Mean absolute error in metres over estimated target pixels; NaN without any."""
    return _mean(np.abs(_found_errors_m(range_m, truth_m)))


def inlier_rmse_m(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> float:
    """Root mean square error in metres over target pixels within `tolerance_m` of the truth.

    This is the precision of echoes that are found; `restoration_degree` is the share that is. NaN
    if no pixel is within the tolerance.
    """
    error = _found_errors_m(range_m, truth_m)
    return _root_mean_square(error[_within(error, tolerance_m)])


def bias_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Mean error in metres over estimated target pixels; NaN without any.

    A few estimates at the other end of the gate move it; `median_error_m` is robust to them.
    """
    return _mean(_found_errors_m(range_m, truth_m))


def median_error_m(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Median error in metres over estimated target pixels; NaN without any."""
    error = _found_errors_m(range_m, truth_m)
    return float(np.median(error)) if error.size else math.nan


def coverage(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Share of target pixels that have an estimate; NaN without targets."""
    error = errors_m(range_m, truth_m)
    return float(np.mean(np.isfinite(error))) if error.size else math.nan


def restored(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> tuple[int, int]:
    """Number of target pixels within `tolerance_m` of the truth, and number of target pixels."""
    error = errors_m(range_m, truth_m)
    return int(np.count_nonzero(_within(error, tolerance_m))), error.size


def restoration_degree(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> float:
    """Share of target pixels within `tolerance_m` metres of the truth (the paper's RD).

    The paper does not state its tolerance; 3 bins reproduce its tables. NaN without targets.
    """
    hits, targets = restored(range_m, truth_m, tolerance_m)
    return hits / targets if targets else math.nan


def surfaces_found(range_m: ArrayLike, truth_m: ArrayLike, tolerance_m: float) -> tuple[int, int]:
    """Number of surfaces found within `tolerance_m`, and the number that it is to be divided by.

    For several surfaces and several returns of a pixel, which are matched one to one. The second
    number is that of the surfaces of each target pixel, or of its returns where these are more: a
    false return costs as much as a surface that is missed. With one surface and at most one return
    in each pixel, both numbers are those of `restored`.

    Parameters
    ----------
    range_m : array_like, shape (return, row, col)
        NaN where a pixel has fewer returns.
    truth_m : array_like, shape (surface, row, col)
        NaN where a pixel has fewer surfaces.
    """
    found, truth = _targets(range_m, truth_m)
    # The longest common subsequence: matched in order of range, no two pairs cross.
    pairs = np.zeros((len(found) + 1, len(truth) + 1, truth.shape[1]), int)
    for i, return_m in enumerate(found, 1):
        for j, surface_m in enumerate(truth, 1):
            matched = pairs[i - 1, j - 1] + _within(return_m - surface_m, tolerance_m)
            pairs[i, j] = np.maximum(matched, np.maximum(pairs[i - 1, j], pairs[i, j - 1]))
    most = np.maximum(*(np.isfinite(each).sum(axis=0) for each in (found, truth)))
    return int(pairs[-1, -1].sum()), int(most.sum())


def surface_errors_m(range_m: ArrayLike, truth_m: ArrayLike) -> Floats:
    """Errors in metres of the returns nearest to each surface of their pixels, flat.

    NaN where the pixel has no return; parameters as for `surfaces_found`.
    """
    found, truth = _targets(range_m, truth_m)
    error = found[:, np.newaxis] - truth
    nearest = np.where(np.isnan(error), np.inf, np.abs(error)).argmin(axis=0)
    return np.asarray(np.take_along_axis(error, nearest[np.newaxis], axis=0)[0, np.isfinite(truth)])


def rd_variance(rd_per_repetition: ArrayLike) -> float:
    """Variance of the restoration degree over Monte-Carlo repetitions.

    The paper does not define its "Var"; this definition matches its magnitude. For independent
    pixels of equal difficulty it is ``RD (1 - RD) / pixels``.

    Parameters
    ----------
    rd_per_repetition : array_like, shape (repetition,)
        At least 2 values.

    Raises
    ------
    ValueError
        If there are fewer.
    """
    rd = np.asarray(rd_per_repetition, float)
    require("rd_per_repetition", f"shape {rd.shape}", rd.ndim == 1 and rd.size >= 2, "2 or more")
    return float(np.var(rd, ddof=1))


def estimator_variance_m2(range_m: ArrayLike, truth_m: ArrayLike) -> float:
    """Variance over repetitions of a pixel's estimates, averaged over target pixels, in m².

    Parameters
    ----------
    range_m : array_like, shape (repetition, row, col)
        Estimates from captures of one scene with different seeds; NaN where there is none.
    truth_m : array_like, shape (row, col)
        NaN where there is no target.

    Returns
    -------
    float
        Pixels with fewer than 2 estimates have no variance and are left out; NaN if all are.

    Raises
    ------
    ValueError
        If the shapes do not match.
    """
    found, truth = np.asarray(range_m, float), np.asarray(truth_m, float)
    fits = found.ndim == truth.ndim + 1 and found.shape[1:] == truth.shape
    require("range_m", f"shape {found.shape}", fits, f"(repetition, *{truth.shape})")
    _require_not_infinite(found)
    found = found[:, np.isfinite(truth)]
    found = found[:, np.isfinite(found).sum(axis=0) >= 2]
    return _mean(np.nanvar(found, axis=0, ddof=1))


@dataclass(frozen=True)
class DetectionRates:
    """Quality of the decision whether there is a target; NaN where no pixel is of that kind."""

    precision: float
    """Share of estimated pixels that have a target."""
    recall: float
    """Share of target pixels with an estimate."""
    false_alarm_rate: float
    """Share of pixels without a target with an estimate."""


def precision_recall(valid: ArrayLike, truth_m: ArrayLike) -> DetectionRates:
    """Evaluate the decision whether there is a target, regardless of its range.

    Parameters
    ----------
    valid : array_like of bool, shape (row, col)
        Where the estimator gives a range.
    truth_m : array_like, shape (row, col)
        NaN where there is no target.
    """
    found, target = np.asarray(valid, bool), np.isfinite(np.asarray(truth_m, float))
    require("valid", f"shape {found.shape}", found.shape == target.shape, f"{target.shape}")
    return DetectionRates(_mean(target[found]), _mean(found[target]), _mean(found[~target]))


@dataclass(frozen=True)
class Interval:
    """An estimate with its interval."""

    value: float
    low: float
    high: float

    @property
    def decimals(self) -> int | None:
        """Decimals that give half its width two significant digits; None without a width."""
        half = (self.high - self.low) / 2
        return max(0, 1 - math.floor(math.log10(half))) if 0 < half < math.inf else None

    def scaled(self, factor: float) -> Interval:
        """Return the interval of the estimate multiplied by a positive `factor`."""
        return Interval(self.value * factor, self.low * factor, self.high * factor)

    def joined(self, other: Interval) -> Interval:
        """Return the estimate with an interval that includes another one."""
        return Interval(self.value, min(self.low, other.low), max(self.high, other.high))

    def overlaps(self, other: Interval) -> bool:
        """Return whether both have a value in common."""
        return self.low <= other.high and other.low <= self.high


def wilson(hits: int, trials: int, level: float = 0.95) -> Interval:
    """Wilson score interval of a share (Wilson 1927).

    Parameters
    ----------
    hits, trials : int
        ``0 <= hits <= trials``, at least one trial.
    level : float
        Probability that the interval covers the true share.

    Raises
    ------
    ValueError
        If an argument is out of its range.
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


def _targets(range_m: ArrayLike, truth_m: ArrayLike) -> tuple[Floats, Floats]:
    """Return the ranges and surfaces (n, pixel) of pixels with a surface, the nearest first."""
    found, truth = (np.sort(np.asarray(each, float), axis=0) for each in (range_m, truth_m))
    of = found.shape[1:]
    require("range_m", f"shape (n, {of})", of == truth.shape[1:], f"(n, {truth.shape[1:]})")
    _require_not_infinite(found)
    target = np.isfinite(truth[0])
    return found[:, target], truth[:, target]


def _found_errors_m(range_m: ArrayLike, truth_m: ArrayLike) -> Floats:
    error = errors_m(range_m, truth_m)
    return error[np.isfinite(error)]


def _require_not_infinite(range_m: Floats) -> None:
    n_infinite = int(np.count_nonzero(np.isinf(range_m)))
    accepted = "finite ranges, and NaN where there is no estimate"
    require("range_m", f"{n_infinite:,} infinite ranges", n_infinite == 0, accepted)


def _within(error_m: Floats, tolerance_m: float) -> NDArray[np.bool_]:
    require("tolerance_m", tolerance_m, tolerance_m >= 0, "a non-negative number of metres")
    # Half a micrometre of slack, so that an error of whole bins meets a tolerance of whole bins.
    return np.asarray(np.abs(error_m) <= tolerance_m + 5e-7)


def _mean(values: NDArray[Any]) -> float:
    return float(np.mean(values)) if values.size else math.nan


def _root_mean_square(values: Floats) -> float:
    return math.sqrt(_mean(values**2))


@dataclass(frozen=True)
class ReliabilityBin:
    """Estimates whose confidence falls in one tenth, a point of a reliability diagram."""

    confidence: float
    """Mean confidence."""
    right: Interval
    """Share within 3 bins of a surface."""
    count: int

    @property
    def tenth(self) -> int:
        """Index of the tenth, 0 to 9."""
        return min(int(self.confidence * 10), 9)

    @property
    def gap(self) -> Interval:
        """Share of right estimates minus mean confidence; positive if confidence is too low."""
        return Interval(*(each - self.confidence for each in astuple(self.right)))


# Deprecated names, to be removed after the next release.
Told, Detection = ReliabilityBin, DetectionRates


def reliability(confidence: Floats, right: NDArray[np.bool_]) -> list[ReliabilityBin]:
    """Group estimates by tenths of confidence; empty tenths are left out.

    Parameters
    ----------
    confidence : ndarray, shape (estimate,)
        From 0 to 1.
    right : ndarray of bool, shape (estimate,)
        Whether the estimate lies within 3 bins of a surface.

    Raises
    ------
    ValueError
        If a confidence is not a probability, or the shapes differ.
    """
    require("right", f"shape {right.shape}", right.shape == confidence.shape, f"{confidence.shape}")
    for extreme in (confidence.min(initial=1.0), confidence.max(initial=0.0)):
        require("confidence", float(extreme), 0 <= extreme <= 1, "probabilities, 0 to 1")
    tenth = np.minimum((confidence * 10).astype(int), 9)
    found = []
    for members in (tenth == k for k in np.unique(tenth)):
        count = int(members.sum())
        share = wilson(int(right[members].sum()), count)
        found.append(ReliabilityBin(float(confidence[members].mean()), share, count))
    return found


def calibration_error(bins: Sequence[ReliabilityBin]) -> float:
    """Expected calibration error: mean distance between confidence and share of right estimates.

    NaN without estimates.
    """
    count = sum(each.count for each in bins)
    if not count:
        return math.nan
    return sum(each.count * abs(each.confidence - each.right.value) for each in bins) / count
