"""Every method on depths that do not favour any: random ones, from two bins on, and smooth ones.

A car in mid-gate favours methods that expect targets there. The depths of neighbouring pixels are
either independent, so that no method that uses neighbours can work, or those of oblique walls,
which are what such methods assume.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from core.estimators.likelihood import LikelihoodParameters
from core.metrics import Interval
from core.studies.outputs import Table, table
from core.studies.paper.figures import COMPARED, RECOMMENDED, WHOLE_BINS, in_whole_bins
from core.studies.trials import Condition, Method, Results, summary

SBRS = (0.06, 0.04, 0.03)

CONDITIONS = tuple(Condition("uniform", sbr) for sbr in SBRS)
WHOLE_GATE = tuple(Condition("uniform", sbr, depths_bin=(1.0, 94.0)) for sbr in SBRS)
EARLY = tuple(Condition("uniform", sbr, depths_bin=(1.0, 20.0)) for sbr in SBRS)
WALLS = tuple(Condition("wall", sbr) for sbr in SBRS)

EARLY_T_N = 3
SEARCHING_EARLY = Method(
    f"tracking, T_n = {EARLY_T_N}", "tracking", replace(in_whole_bins("recommended"), t_n=EARLY_T_N)
)
FROM_BIN_1 = [RECOMMENDED, SEARCHING_EARLY, *(m for m in COMPARED if m is not RECOMMENDED)]

BEST_WINDOW = [
    Method(f"{name}, window", name, LikelihoodParameters(rule="window"))
    for name in ("likelihood", "oracle")
]
"""They answer the delay with most probability within 3 bins, which this figure rewards."""
LATE = [*COMPARED, *BEST_WINDOW]

PLAN = {
    **dict.fromkeys(CONDITIONS, LATE),
    **dict.fromkeys((*WHOLE_GATE, *EARLY), FROM_BIN_1),
    **dict.fromkeys(WALLS, COMPARED),
}

EXPECTED: dict[str, Sequence[float]] = {
    "oracle": (0.994, 0.912, 0.734),
    "likelihood": (0.99, 0.905, 0.72),
    "coates": (0.98, 0.84, 0.47),
    "tracking": (0.97, 0.75, 0.41),
}
"""Restoration degrees measured independently, at each of `SBRS`."""


def tables(results: Results) -> list[Table]:
    """Return the restoration degrees on each kind of depths; `results` are those of `PLAN`."""
    return [uniform_table(results), whole_gate_table(results), wall_table(results)]


def uniform_table(results: Results) -> Table:
    """Return the restoration degree within 3 bins of each method at each SBR, and the cost.

    The cost is that of the delays alone; flux model and confidence are computed once per capture.
    """
    n_counts = CONDITIONS[0].capture(0).cube.size

    def ms(name: str) -> float:
        return float(np.median([summary(results[c, name]).milliseconds for c in CONDITIONS]))

    return table(
        "uniform",
        "Restoration degree within 3 bins, depths uniform over bins 20 to 94",
        [method.name for method in LATE],
        {
            "method": str,
            **_columns(results, CONDITIONS),
            "expected": lambda name: " / ".join(map(str, EXPECTED.get(name, ()))),
            "ms": ms,
            "ns per pixel and bin": lambda name: 1e6 * ms(name) / n_counts,
        },
        f"{WHOLE_BINS} Depths begin where tracking begins to search, T_n = 20, and are independent "
        "from pixel to pixel: no method that uses neighbours can work. Of methods that look at "
        "single pixels and expect delays anywhere in the gate, none exceeds 'oracle, window' in "
        "this figure on average; expecting them in bins 20 to 94 alone adds up to 0.012.",
        formats={"ms": ".1f", "ns per pixel and bin": ".0f"},
    )


def whole_gate_table(results: Results) -> Table:
    """Return the restoration degree with echoes from bin 1 on, and of the early ones alone."""
    return table(
        "whole_gate",
        "Restoration degree within 3 bins, depths uniform over bins 1 to 94",
        [method.name for method in FROM_BIN_1],
        {
            "method": str,
            **_columns(results, WHOLE_GATE),
            **_columns(results, EARLY, ", bins 1 to 20"),
        },
        f"{WHOLE_BINS} Tracking excludes bins before T_n = 20.",
    )


def wall_table(results: Results) -> Table:
    """Return the restoration degree on smooth depths through the gate."""
    return table(
        "wall",
        "Restoration degree within 3 bins, oblique walls over bins 20 to 94",
        [method.name for method in COMPARED],
        {"method": str, **_columns(results, WALLS)},
        f"{WHOLE_BINS} One wall per seed, without edges: neighbouring pixels differ by less than a "
        "tenth of a bin.",
    )


def _columns(
    results: Results, conditions: Sequence[Condition], of: str = ""
) -> dict[str, Callable[[str], Interval]]:
    def rd(name: str, condition: Condition) -> Interval:
        return summary(results[condition, name]).rd[2]

    return {f"SBR {each.sbr:g}{of}": partial(rd, condition=each) for each in conditions}
