"""Gain from settings chosen for each capture (`core.tuned`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from core.estimators import settings_of
from core.metrics import Interval, wilson
from core.studies.outputs import Table, table
from core.studies.trials import Condition, mapped
from core.tuning import right_targets, tuned

METHOD = "tracking"
CONDITIONS = tuple(
    Condition(scene, sbr)
    for scene in ("uniform", "car", "piecewise")
    for sbr in (0.08, 0.06, 0.04, 0.03, 0.02)
)


@dataclass(frozen=True)
class Gain:
    """Restored targets of one capture."""

    default: int
    chosen: int
    best: int
    """With the best settings that were tried; to know them requires the truth."""
    targets: int
    is_default: bool
    """Whether the default settings were kept."""


def gain(piece: tuple[Condition, int]) -> Gain:
    """Choose settings for the capture of a condition and a seed, and compare them."""
    condition, seed = piece
    capture = condition.capture(seed)
    found, default = tuned(capture, METHOD), settings_of(METHOD)
    right = {
        settings: right_targets(capture, METHOD, settings)
        for settings in {default, *(each.settings for each in found.trials)}
    }
    restored = {settings: int(each.sum()) for settings, each in right.items()}
    best = max(restored.values())
    chosen = found.settings
    return Gain(restored[default], restored[chosen], best, right[chosen].size, found.is_default)


def tuned_table(
    seeds: Sequence[int], processes: int, conditions: Sequence[Condition] = CONDITIONS
) -> Table:
    """Compare default and chosen settings of tracking over several seeds."""
    pieces = [(condition, seed) for condition in conditions for seed in seeds]
    found: dict[Condition, list[Gain]] = {condition: [] for condition in conditions}
    for (condition, _), each in mapped(gain, pieces, processes):
        found[condition].append(each)

    def rd(condition: Condition, name: str) -> Interval:
        gains = found[condition]
        return wilson(
            sum(getattr(each, name) for each in gains), sum(each.targets for each in gains)
        )

    def worst(condition: Condition) -> float:
        return min((each.chosen - each.default) / each.targets for each in found[condition])

    columns: dict[str, Callable[[Condition], Any]] = {
        "scene": lambda condition: condition.scene,
        "SBR": lambda condition: condition.sbr,
        "default": partial(rd, name="default"),
        "chosen": partial(rd, name="chosen"),
        "best tried": partial(rd, name="best"),
        "kept": lambda condition: float(np.mean([each.is_default for each in found[condition]])),
        "worst change": worst,
    }
    return table(
        "tuned",
        "Restoration degree of tracking with settings chosen for each capture",
        conditions,
        columns,
        f"Within 3 bins, {len(seeds)} captures a row; whole bins. Best tried: the settings of the "
        "search that restore most of each capture itself, which requires its truth. Kept: share "
        "of the captures for which the defaults were kept. Worst change: of the restoration degree "
        "of one capture.",
        {"kept": ".2f", "worst change": "+.4f"},
    )
