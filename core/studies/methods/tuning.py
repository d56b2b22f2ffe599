"""The same search for the settings of every method, on seeds that no table reports.

`core.tuning.searched` from the defaults, for what restores most pixels on average over `SBRS`.
Depths are random for methods that look at single pixels, and those of oblique
walls for methods that use neighbours. What is found is then compared with the defaults on other
seeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from core.capture import Capture
from core.estimators import ESTIMATORS
from core.metrics import Interval
from core.scripts import literal
from core.studies.methods.uniform import SBRS
from core.studies.outputs import Table, table
from core.studies.paper.figures import LITERAL, RECOMMENDED, WHOLE_BINS
from core.studies.paper.recommend import SEEDS
from core.studies.trials import Condition, Method, default_methods, score, summary
from core.tuning import free_fields, searched

SEARCHED = SEEDS[:4]
MOST_ROUNDS = 3
METHODS = [RECOMMENDED, LITERAL] + [
    each
    for each in default_methods()
    if each.estimator not in ("tracking", "oracle") and fields(each.settings)
]
"""All methods with settings that an instrument could choose."""


@dataclass(frozen=True)
class Tuned:
    """The result of the search for one method.

    Parameters
    ----------
    method : Method
        With its default settings.
    scene : str
        Built-in scene on which it was searched.
    settings : object
        The best settings.
    n_tried : int
        Settings tried.
    """

    method: Method
    scene: str
    settings: Any
    n_tried: int


def scene_of(method: Method) -> str:
    """Return the scene whose depths a method assumes."""
    estimator = ESTIMATORS[method.estimator]
    has_neighbours = estimator.whole_image or estimator.window_size(method.settings) > 1
    return "wall" if has_neighbours else "uniform"


def search(method: Method, seeds: Sequence[int] = SEARCHED) -> Tuned:
    """Search the settings of a method."""
    scene = scene_of(method)
    captures = [Condition(scene, sbr).capture(seed) for sbr in SBRS for seed in seeds]
    free = free_fields(method.estimator)
    if method.name == LITERAL.name:
        free = [each for each in free if each.name == "l"]
    known: dict[Any, float] = {}

    def restored(settings: Any) -> float:
        if settings not in known:
            known[settings] = _mean_rd(captures, replace(method, settings=settings))
        return known[settings]

    best = searched(method.settings, free, restored, MOST_ROUNDS)
    return Tuned(method, scene, best, len(known))


def _mean_rd(captures: Sequence[Capture], method: Method) -> float:
    """Return the restoration degree within 3 bins over captures of equally many targets."""
    scores = [score(capture, method) for capture in captures]
    return float(np.mean([each.restored[2] / each.targets for each in scores]))


def tuning_table(
    seeds: Sequence[int],
    methods: Sequence[Method] = METHODS,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Table:
    """Search the settings of methods and compare what is found with the defaults.

    Parameters
    ----------
    seeds : sequence of int
        Seeds on which defaults and what is found are compared, at least 2; none of `SEARCHED`.
    methods : sequence of Method
    progress : callable
        ``(methods searched, methods in all)``.
    """
    found: list[Tuned] = []
    for each in methods:
        progress(len(found), len(methods))
        found.append(search(each))
    progress(len(found), len(methods))

    def rd(tuned: Tuned, sbr: float, *, is_found: bool) -> Interval:
        settings = tuned.settings if is_found else tuned.method.settings
        method = replace(tuned.method, settings=settings)
        captures = (Condition(tuned.scene, sbr).capture(seed) for seed in seeds)
        return summary([score(capture, method) for capture in captures]).rd[2]

    columns: dict[str, Callable[[Tuned], Any]] = {
        "method": lambda tuned: tuned.method.name,
        "depths": lambda tuned: tuned.scene,
        "tried": lambda tuned: tuned.n_tried,
        "found": _changes,
    }
    for sbr in SBRS:
        columns[f"SBR {sbr:g}, default"] = partial(rd, sbr=sbr, is_found=False)
        columns[f"SBR {sbr:g}, found"] = partial(rd, sbr=sbr, is_found=True)
    return table(
        "tuning",
        "Restoration degree within 3 bins with default settings and with those of a search",
        found,
        columns,
        f"{WHOLE_BINS} All other tables use the default settings. Searched on seeds "
        f"{SEARCHED[0]} to {SEARCHED[-1]}, compared on seeds {seeds[0]} to {seeds[-1]}.",
    )


def _changes(tuned: Tuned) -> str:
    """Return the settings that differ from the default."""
    values = {
        each.name: (getattr(tuned.settings, each.name), getattr(tuned.method.settings, each.name))
        for each in fields(tuned.settings)
    }
    changed = (
        f"{name} {_short(new)} (default {_short(old)})"
        for name, (new, old) in values.items()
        if new != old
    )
    return ", ".join(changed) or "the default"


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else literal(value).strip('"')
