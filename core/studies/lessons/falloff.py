"""Signal and background of a surface that is moved away (lesson 11)."""

from __future__ import annotations

import numpy as np

from core.effects import Falloff
from core.studies.lessons.bench import Bench
from core.studies.outputs import Plot

BENCH_RANGE_M = 50.0
"""Range to which the fluxes of a bench refer."""


def fluxes_by_range(bench: Bench) -> Plot:
    """Plot signal and background of a surface that moves away; at 50 m they are the bench's."""
    range_m = np.geomspace(40.0, 400.0, 60)
    signal = bench.exposure * bench.signal * Falloff(BENCH_RANGE_M).transmission(range_m)
    return Plot(
        "fluxes_by_range",
        "Signal and background against range",
        "Range (m)",
        "Photons per pulse",
        range_m,
        {
            "signal": signal,
            "background": np.full(range_m.size, bench.exposure * bench.background),
        },
        {"50 m": BENCH_RANGE_M},
        "A surface that fills the pixel, in sunlight. The background is that of the whole gate.",
        x_is_log=True,
    )


def signal_at(bench: Bench, range_m: float) -> float:
    """Signal of the surface at another range than 50 m."""
    share = Falloff(BENCH_RANGE_M).transmission(np.array(range_m))
    return float(bench.exposure * bench.signal * share)
