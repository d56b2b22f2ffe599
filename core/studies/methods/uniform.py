"""Every method on depths that are uniform over bins 20 to 94, where no range prior helps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from core.studies.outputs import Table
from core.studies.paper.figures import COMPARED
from core.studies.trials import Condition, Results, summary

SBRS = (0.06, 0.04, 0.03)

CONDITIONS = tuple(Condition("uniform", sbr) for sbr in SBRS)

PLAN = dict.fromkeys(CONDITIONS, COMPARED)

TO_REACH: dict[str, Sequence[float]] = {
    "oracle": (0.994, 0.912, 0.734),
    "likelihood": (0.99, 0.905, 0.72),
    "coates": (0.98, 0.84, 0.47),
    "tracking": (0.97, 0.75, 0.41),
}
"""What the methods are known to reach, at each of `SBRS`: measured before this was written."""


def table(results: Results) -> Table:
    """Restoration degree within 3 bins of each method at each SBR, with 95 % intervals, and cost.

    The cost is that of the delays alone; light and confidence are found once for each capture.
    """
    gate = CONDITIONS[0].capture(0).cube
    rows = []
    for method in COMPARED:
        found = [summary(results[condition, method.name]) for condition in CONDITIONS]
        cells = [f"{s.rd[2].value:.4f} [{s.rd[2].low:.4f}, {s.rd[2].high:.4f}]" for s in found]
        known = TO_REACH.get(method.name)
        milliseconds = float(np.median([s.milliseconds for s in found]))
        rows.append(
            (
                method.name,
                *cells,
                " / ".join(map(str, known)) if known else "",
                f"{milliseconds:.1f}",
                f"{milliseconds * 1e6 / gate.size:.0f}",
            )
        )
    return Table(
        "uniform",
        "Restoration degree within 3 bins, depths uniform over bins 20 to 94",
        ("method", *(f"SBR {sbr:g}" for sbr in SBRS), "expected", "ms", "ns per pixel and bin"),
        tuple(rows),
    )
