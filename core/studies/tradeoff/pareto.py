"""Choices among measured points: the Pareto front, the best within a time, the fastest for an RD.

Only points of one condition (`Point.condition`) are compared. Candidates that know the true flux,
such as the oracle, or the true ranges, such as a gate cut to the targets, are never chosen: no
instrument knows either.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.checks import require
from core.studies.tradeoff.measure import Point

DRAWS = 1000
MIN_SHARE = 0.05
"""A point that is chosen in a smaller share of the draws is distinguishable from the best."""


def by_condition(
    points: Sequence[Point],
) -> dict[tuple[str, float | None, int | None], list[Point]]:
    """Group points that can be compared with each other, in their order."""
    found: dict[tuple[str, float | None, int | None], list[Point]] = {}
    for point in points:
        found.setdefault(point.condition, []).append(point)
    return found


def including_flux_time(points: Sequence[Point]) -> list[Point]:
    """Add the time to estimate the flux model, as for an image that is new each time."""
    return [
        replace(
            point,
            seconds=tuple(np.add(point.seconds, point.flux_s).tolist()),
            flux_s=(0.0,) * len(point.flux_s),
        )
        for point in points
    ]


def pareto_front(points: Sequence[Point], tolerance_bins: int = 3) -> list[Point]:
    """Return the points that no other beats in time or restoration degree without losing in both.

    Parameters
    ----------
    points : sequence of Point
        Points of one condition.
    tolerance_bins : int
        Tolerance of the restoration degree: 1, 2 or 3.

    Returns
    -------
    list of Point
        In rising order of time, and of restoration degree.
    """
    eligible = _eligible(points)
    cost = np.array([(p.milliseconds.value, -p.rd(tolerance_bins).value) for p in eligible])
    cost = cost.reshape(-1, 2)
    no_worse = (cost[:, np.newaxis] <= cost).all(axis=2)
    better = (cost[:, np.newaxis] < cost).any(axis=2)
    unbeaten = np.flatnonzero(~(no_worse & better).any(axis=0))
    return sorted((eligible[i] for i in unbeaten), key=lambda p: p.milliseconds.value)


# Deprecated names, to be removed after the next release.
front, with_light = pareto_front, including_flux_time


@dataclass(frozen=True)
class Recommendation:
    """A chosen point with its uncertainty.

    Parameters
    ----------
    point : Point
    is_best : float
        Share of the bootstrap draws in which it is chosen again.
    keeps : float
        Share of the draws in which it satisfies the limit (time or restoration degree).
    runners_up : tuple of (Point, float)
        Points that are chosen instead in `MIN_SHARE` of the draws or more, each with its share, in
        falling order.
    optimism : float
        Mean over the draws by which the restoration degree of what is chosen exceeds that over all
        seeds: about as much too high is that of `point` on the seeds from which it was chosen
        (Efron 1983).
    """

    point: Point
    is_best: float
    keeps: float
    runners_up: tuple[tuple[Point, float], ...]
    optimism: float


def best_within(
    points: Sequence[Point], milliseconds: float, tolerance_bins: int = 3
) -> Recommendation | None:
    """Return the point with the highest restoration degree within a time; of equals the fastest.

    Its uncertainty is that of a paired bootstrap (`DRAWS` draws): seeds are resampled, the same for
    all points, and so are rounds of timing, and the choice is made again.

    Parameters
    ----------
    points : sequence of Point
        Points of one condition.
    milliseconds : float
        Per image; see `including_flux_time` for what it includes.
    tolerance_bins : int
        As for `pareto_front`.

    Returns
    -------
    Recommendation or None
        None where no point is as fast.

    Raises
    ------
    ValueError
        If points have different conditions, or the time is not positive.
    """
    require("milliseconds", milliseconds, milliseconds > 0, "a positive time")

    def judge(seen: _Outcomes) -> tuple[Floats, NDArray[np.bool_]]:
        # Times only break ties: two restoration degrees differ by more than 1e-9.
        loss = -seen.rd + 1e-9 * seen.milliseconds / seen.milliseconds.max()
        return loss, seen.milliseconds <= milliseconds

    return _chosen(points, tolerance_bins, judge)


def cheapest_reaching(
    points: Sequence[Point], rd: float, tolerance_bins: int = 3
) -> Recommendation | None:
    """Return the fastest point whose restoration degree is at least `rd`.

    Its uncertainty is found as that of `best_within`.

    Returns
    -------
    Recommendation or None
        None where no point reaches it.

    Raises
    ------
    ValueError
        If points have different conditions, or `rd` is not a share.
    """
    require("rd", rd, 0 < rd <= 1, "a share of the pixels, above 0 and up to 1")
    return _chosen(points, tolerance_bins, lambda seen: (seen.milliseconds, seen.rd >= rd))


class _Outcomes(NamedTuple):
    """Measured or resampled figures, shape (draw, point) each."""

    rd: Floats
    milliseconds: Floats


_Judge = Callable[[_Outcomes], tuple[Floats, NDArray[np.bool_]]]
"""Returns the loss of each point in each draw, and whether it satisfies the limit."""


def _eligible(points: Sequence[Point]) -> list[Point]:
    return [point for point in points if not point.candidate.is_bound]


def _chosen(points: Sequence[Point], tolerance_bins: int, judge: _Judge) -> Recommendation | None:
    conditions = list(by_condition(points))
    require("points", conditions, len(conditions) <= 1, "points of one condition")
    eligible = _eligible(points)
    if not eligible:
        return None
    measured = _Outcomes(
        np.array([[point.rd(tolerance_bins).value for point in eligible]]),
        np.array([[point.milliseconds.value for point in eligible]]),
    )
    loss, allowed = (each[0] for each in judge(measured))
    if not allowed.any():
        return None
    index = int(np.where(allowed, loss, np.inf).argmin())
    resampled = _resampled(eligible, tolerance_bins)
    losses, allowed = judge(resampled)
    draws = np.flatnonzero(allowed.any(axis=1))
    winners = np.where(allowed, losses, np.inf).argmin(axis=1)[draws]
    won = np.bincount(winners, minlength=len(eligible)) / DRAWS
    others = [i for i in np.argsort(-won, kind="stable") if i != index and won[i] >= MIN_SHARE]
    return Recommendation(
        eligible[index],
        float(won[index]),
        float(allowed[:, index].mean()),
        tuple((eligible[i], float(won[i])) for i in others),
        float((resampled.rd[draws, winners] - measured.rd[0, winners]).mean()),
    )


def _resampled(points: Sequence[Point], tolerance_bins: int) -> _Outcomes:
    """Resample seeds and rounds with replacement, alike for all points."""
    rng = np.random.default_rng(0)
    hits = np.array([[s.restored[tolerance_bins - 1] for s in p.scores] for p in points])
    targets = np.array([[score.targets for score in point.scores] for point in points])
    n_seeds = hits.shape[1]
    times = rng.multinomial(n_seeds, np.full(n_seeds, 1 / n_seeds), size=DRAWS)
    seconds = np.array([point.seconds for point in points])
    rounds = rng.integers(seconds.shape[1], size=(DRAWS, seconds.shape[1]))
    milliseconds = np.stack([np.median(each[rounds], axis=1) for each in seconds], axis=1) * 1e3
    return _Outcomes((times @ hits.T) / (times @ targets.T), milliseconds)
