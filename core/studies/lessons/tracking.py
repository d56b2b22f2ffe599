"""The tracking differentiator: its scales (lesson 4) and its settings (lesson 5)."""

from __future__ import annotations

import math
from functools import lru_cache

from core.capture import Capture
from core.estimators import ESTIMATORS
from core.studies import range_prior
from core.studies.lessons.bench import SIDE, Bench, flat_target
from core.studies.outputs import Plot
from core.studies.paper.figures import pixel_signals


def both_scales(bench: Bench) -> Plot:
    """Plot the two scales of a pixel with an echo."""
    return pixel_signals(bench.onset_bin, bench.tracking, bench.flux)


def both_scales_without_echo(bench: Bench) -> Plot:
    """Plot the two scales of a pixel without an echo."""
    return pixel_signals(math.nan, bench.tracking, bench.flux)


@lru_cache(maxsize=16)
def estimates_without_echo(bench: Bench) -> Plot:
    """Plot where estimates lie in pixels without an echo, and which echoes are found."""

    def simulated(range_m: float) -> Capture:
        return flat_target(bench, range_m, 2 * SIDE)

    return range_prior.range_prior(simulated, "tracking", bench.tracking)


def share_without_echo(bench: Bench, first: float, end: float) -> float:
    """Share of the estimates in pixels without an echo that lie in some bins, by simulation."""
    bins = ESTIMATORS["tracking"].delays(flat_target(bench, math.nan, 64), bench.tracking)[0]
    return float(((bins >= first) & (bins < end)).mean())
