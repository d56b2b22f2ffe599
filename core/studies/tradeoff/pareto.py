"""What to choose of measured points: the Pareto front, the best in a time, the cheapest to reach.

Points are compared where they share their condition (`Point.condition`). Candidates that are told
the light, as the oracle is, are never chosen: no instrument knows it.
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
TELLS = 0.05
"""Who would have been chosen in a smaller share of the draws can be told from the best."""


def by_condition(
    points: Sequence[Point],
) -> dict[tuple[str, float | None, int | None], list[Point]]:
    """Points that can be compared with each other, in their order."""
    found: dict[tuple[str, float | None, int | None], list[Point]] = {}
    for point in points:
        found.setdefault(point.condition, []).append(point)
    return found


def with_light(points: Sequence[Point]) -> list[Point]:
    """The same points, the finding of the light counted in: what each image costs that is new."""
    return [
        replace(
            point,
            seconds=tuple(np.add(point.seconds, point.light_s).tolist()),
            light_s=(0.0,) * len(point.light_s),
        )
        for point in points
    ]


def front(points: Sequence[Point], tolerance_bins: int = 3) -> list[Point]:
    """Points that no other one beats: none is as fast and as often right, and better in either.

    Parameters
    ----------
    points : sequence of Point
        Of one condition.
    tolerance_bins : int
        A pixel is right within so many bins: 1, 2 or 3.

    Returns
    -------
    list of Point
        In rising order of time, and of restoration degree.
    """
    open_to_all = _choosable(points)
    cost = np.array(
        [(p.milliseconds.value, -p.rd(tolerance_bins).value) for p in open_to_all]
    ).reshape(-1, 2)
    no_worse = (cost[:, np.newaxis] <= cost).all(axis=2)
    better = (cost[:, np.newaxis] < cost).any(axis=2)
    unbeaten = np.flatnonzero(~(no_worse & better).any(axis=0))
    return sorted((open_to_all[i] for i in unbeaten), key=lambda p: p.milliseconds.value)


@dataclass(frozen=True)
class Recommendation:
    """A point, and how sure it is.

    Parameters
    ----------
    point : Point
    is_best : float
        Share of the draws in which it would have been chosen again.
    keeps : float
        Share of the draws in which it keeps to what was asked (the time, or the restoration
        degree).
    runners_up : tuple of (Point, float)
        Those that cannot be told from it, and the share of the draws in which each would have been
        chosen in its place; most often first.
    """

    point: Point
    is_best: float
    keeps: float
    runners_up: tuple[tuple[Point, float], ...]


def best_within(
    points: Sequence[Point], milliseconds: float, tolerance_bins: int = 3
) -> Recommendation | None:
    """The point that is right most often of those that take at most so long; of equals the fastest.

    Its uncertainty is that of a paired bootstrap (`DRAWS` draws): seeds are drawn anew, the same
    for all points, and so are rounds of timing, and the choice is made again.

    Parameters
    ----------
    points : sequence of Point
        Of one condition.
    milliseconds : float
        For an image; see `with_light` for what it includes.
    tolerance_bins : int
        As for `front`.

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

    def judged(seen: _Seen) -> tuple[Floats, NDArray[np.bool_]]:
        # Times only settle what is equal: two restoration degrees differ by more than 1e-9.
        loss = -seen.rd + 1e-9 * seen.milliseconds / seen.milliseconds.max()
        return loss, seen.milliseconds <= milliseconds

    return _chosen(points, tolerance_bins, judged)


def cheapest_reaching(
    points: Sequence[Point], rd: float, tolerance_bins: int = 3
) -> Recommendation | None:
    """The fastest point of those whose restoration degree is at least `rd`.

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


class _Seen(NamedTuple):
    """What a study found, or might have found: shape (draw, point) each."""

    rd: Floats
    milliseconds: Floats


def _choosable(points: Sequence[Point]) -> list[Point]:
    return [point for point in points if not point.candidate.is_told_the_light]


_Judge = Callable[[_Seen], tuple[Floats, NDArray[np.bool_]]]
"""Gives the loss of each point in each draw, and whether it keeps to what was asked."""


def _chosen(points: Sequence[Point], tolerance_bins: int, judged: _Judge) -> Recommendation | None:
    conditions = list(by_condition(points))
    require("points", conditions, len(conditions) <= 1, "points of one condition")
    open_to_all = _choosable(points)
    if not open_to_all:
        return None
    loss, is_open = (each[0] for each in judged(_found(open_to_all, tolerance_bins)))
    if not is_open.any():
        return None
    place = int(np.where(is_open, loss, np.inf).argmin())
    losses, are_open = judged(_drawn(open_to_all, tolerance_bins))
    winners = np.where(are_open, losses, np.inf).argmin(axis=1)[are_open.any(axis=1)]
    won = np.bincount(winners, minlength=len(open_to_all)) / DRAWS
    others = [i for i in np.argsort(-won, kind="stable") if i != place and won[i] >= TELLS]
    return Recommendation(
        open_to_all[place],
        float(won[place]),
        float(are_open[:, place].mean()),
        tuple((open_to_all[i], float(won[i])) for i in others),
    )


def _found(points: Sequence[Point], tolerance_bins: int) -> _Seen:
    """What was found, as one draw."""
    return _Seen(
        np.array([[point.rd(tolerance_bins).value for point in points]]),
        np.array([[point.milliseconds.value for point in points]]),
    )


def _drawn(points: Sequence[Point], tolerance_bins: int) -> _Seen:
    """What might have been found: seeds and rounds drawn with replacement, alike for all points."""
    rng = np.random.default_rng(0)
    hits = np.array([[s.restored[tolerance_bins - 1] for s in p.scores] for p in points])
    targets = np.array([[score.targets for score in point.scores] for point in points])
    n_seeds = hits.shape[1]
    times = rng.multinomial(n_seeds, np.full(n_seeds, 1 / n_seeds), size=DRAWS)
    seconds = np.array([point.seconds for point in points])
    rounds = rng.integers(seconds.shape[1], size=(DRAWS, seconds.shape[1]))
    milliseconds = np.stack([np.median(each[rounds], axis=1) for each in seconds], axis=1) * 1e3
    return _Seen((times @ hits.T) / (times @ targets.T), milliseconds)
