"""Every method on depths that are uniform over bins 20 to 94, where no range prior helps."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from core.metrics import Interval
from core.studies.outputs import Table, table
from core.studies.paper.figures import COMPARED, WHOLE_BINS
from core.studies.trials import Condition, Results, summary

SBRS = (0.06, 0.04, 0.03)

CONDITIONS = tuple(Condition("uniform", sbr) for sbr in SBRS)

PLAN = dict.fromkeys(CONDITIONS, COMPARED)

EXPECTED: dict[str, Sequence[float]] = {
    "oracle": (0.994, 0.912, 0.734),
    "likelihood": (0.99, 0.905, 0.72),
    "coates": (0.98, 0.84, 0.47),
    "tracking": (0.97, 0.75, 0.41),
}
"""Restoration degrees measured independently, at each of `SBRS`."""


def uniform_table(results: Results) -> Table:
    """Return the restoration degree within 3 bins of each method at each SBR, and the cost.

    The cost is that of the delays alone; flux model and confidence are computed once per capture.
    """
    n_counts = CONDITIONS[0].capture(0).cube.size

    def rd(name: str, condition: Condition) -> Interval:
        return summary(results[condition, name]).rd[2]

    def ms(name: str) -> float:
        return float(np.median([summary(results[c, name]).milliseconds for c in CONDITIONS]))

    return table(
        "uniform",
        "Restoration degree within 3 bins, depths uniform over bins 20 to 94",
        [method.name for method in COMPARED],
        {
            "method": str,
            **{f"SBR {each.sbr:g}": partial(rd, condition=each) for each in CONDITIONS},
            "expected": lambda name: " / ".join(map(str, EXPECTED.get(name, ()))),
            "ms": ms,
            "ns per pixel and bin": lambda name: 1e6 * ms(name) / n_counts,
        },
        WHOLE_BINS,
        formats={"ms": ".1f", "ns per pixel and bin": ".0f"},
    )
