"""Gain from neighbouring pixels: restoration degrees within 1 bin, in surfaces and at edges."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.estimators import estimate
from core.estimators.unmixing import smoothed
from core.inference.neighbours import pooled
from core.metrics import Interval
from core.studies.outputs import Table
from core.studies.statistics import mean_over_seeds
from core.studies.trials import Condition, mapped

SBRS = {
    "piecewise": (0.04, 0.03, 0.02, 0.015),
    "car": (0.04, 0.03, 0.02),
    "staircase": (0.03, 0.02, 0.015),
    "wall": (0.03, 0.02, 0.015),
    "uniform": (0.04, 0.03, 0.02),
}
"""Signal-to-background ratios by scene."""

POOLED = 5
"""Rows and columns whose counts are added for the pooled likelihood."""

_EDGE_BINS = 3.0
_TOLERANCE_BINS = 1.0


def at_edges(capture: Capture) -> NDArray[np.bool_]:
    """Return the pixels next to one that is more than 3 bins nearer or farther, or sees nothing."""
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    found = np.zeros(truth_bin.shape, bool)
    for image, edge in ((truth_bin, found), (truth_bin.T, found.T)):
        step = ~(np.abs(np.diff(image, axis=0)) <= _EDGE_BINS)
        edge[1:] |= step
        edge[:-1] |= step
    return found


def pooled_likelihood(capture: Capture) -> Floats:
    """Delays in bins by the likelihood of the counts of 5 x 5 pixels around each, (row, col)."""
    n_pulses = capture.acquisition.n_pulses
    acquisition = replace(capture.acquisition, n_pulses=n_pulses and n_pulses * POOLED**2)
    cube = pooled(capture.cube, POOLED)
    return estimate(
        replace(capture, cube=cube, acquisition=acquisition, signal=None), "likelihood"
    ).bin


def smoothed_likelihood(capture: Capture) -> Floats:
    """Delays in bins by the likelihood, smoothed by total variation, (row, col).

    An estimate is weighted by its confidence, as the reciprocal of its variance in bins squared.
    """
    image = estimate(capture, "likelihood")
    weight = np.where(image.valid, image.confidence, 0.0)
    return smoothed(np.nan_to_num(image.bin), weight, smoothness=1.0)


def _estimated(method: str, **settings: Any) -> Callable[[Capture], Floats]:
    return lambda capture: estimate(capture, method, **settings).bin


METHODS: dict[str, Callable[[Capture], Floats]] = {
    "image posterior": _estimated("image_posterior"),
    "likelihood": _estimated("likelihood"),
    f"likelihood, {POOLED} x {POOLED} pixels added": pooled_likelihood,
    "likelihood, smoothed": smoothed_likelihood,
    "unmixing": _estimated("unmixing"),
    "unmixing, 24 neighbours": _estimated("unmixing", censoring="24 neighbours"),
}

Shares = dict[str, tuple[float, float, float]]
"""Restoration degree over all pixels, inside surfaces and at edges, by method."""


def shares(piece: tuple[Condition, int]) -> Shares:
    """Return the restoration degrees of each method on one capture; NaN without such pixels."""
    condition, seed = piece
    capture = condition.capture(seed)
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    target, edge = np.isfinite(truth_bin), at_edges(capture)
    found = {}
    for name, method in METHODS.items():
        right = np.abs(method(capture) - truth_bin) <= _TOLERANCE_BINS + 1e-6
        parts = (right[target], right[target & ~edge], right[target & edge])
        every, inside, at_edge = (float(part.mean()) if part.size else np.nan for part in parts)
        found[name] = every, inside, at_edge
    return found


def tables(seeds: Sequence[int], processes: int = 1) -> Iterator[Table]:
    """Yield a table per scene; intervals are those of the mean over the seeds (95 %)."""
    for scene, sbrs in SBRS.items():
        conditions = [Condition(scene, sbr) for sbr in sbrs]
        pieces = [(condition, seed) for condition in conditions for seed in seeds]
        yield _table(scene, conditions, seeds, dict(mapped(shares, pieces, processes)))


def _table(
    scene: str,
    conditions: Sequence[Condition],
    seeds: Sequence[int],
    found: Mapping[tuple[Condition, int], Shares],
) -> Table:
    parts = ("all",) if scene == "uniform" else ("all", "inside", "at edges")

    def cell(condition: Condition, name: str, part: int) -> Interval:
        return mean_over_seeds(found, condition, seeds, lambda of: of[name][part])

    return Table(
        f"neighbours_{scene}",
        f"Restoration degree within 1 bin, scene {scene}",
        ("pixels", "method", *(f"SBR {condition.sbr:g}" for condition in conditions)),
        tuple(
            (of, name, *(cell(condition, name, part) for condition in conditions))
            for part, of in enumerate(parts)
            for name in METHODS
        ),
        f"Mean of {len(seeds)} captures, with 95 % intervals. A pixel is at an edge if one of its "
        "four neighbours is more than 3 bins nearer or farther, or sees nothing.",
    )
