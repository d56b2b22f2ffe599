"""What the trade is measured on: built-in scenes, and what ranges them."""

from __future__ import annotations

from collections.abc import Sequence

import numba

from core.acquisition import Flux
from core.scene import scenes
from core.studies.tradeoff.acquisition import PULSES
from core.studies.tradeoff.measure import MERGES, Candidate, Source, candidates, variations
from core.studies.tradeoff.surrogate import Simulation
from core.studies.trials import as_they_come

MERGED_AT = (100, 10_000)
"""Numbers of pulses, besides the scene's own, with which bins are merged, too."""
THREADED = ("tracking", "likelihood")
THREADED_SIZE = 256
"""Rows and columns of the image on which threads are tried: of smaller ones kernels use one."""

Plan = list[tuple[Source, Sequence[Candidate]]]


def simulated(scene: str, sbr: float, signal: float, n_pulses: int | None = None) -> Simulation:
    """A built-in scene; with its own number of pulses where none is given."""
    built = scenes[scene]()
    simulation = Simulation(scene, built, built.acquisition, Flux(signal, sbr))
    return simulation if n_pulses is None else simulation.with_pulses(n_pulses)


def around(simulation: Simulation) -> list[Candidate]:
    """Everything that is tried on a scene at its own number of pulses."""
    return candidates() + variations(window=simulation.window)


def over_pulses(simulation: Simulation) -> Plan:
    """Every method at every number of pulses; with bins merged at some; all there is at its own."""
    own = simulation.acquisition.n_pulses
    plan: Plan = []
    for n_pulses in sorted({*PULSES, *([own] if own else [])}):
        ways = candidates(merges=MERGES if n_pulses in MERGED_AT else (1,))
        plan.append(
            (simulation.with_pulses(n_pulses), around(simulation) if n_pulses == own else ways)
        )
    return plan


def threaded(sbr: float, signal: float) -> Plan:
    """A large car, by 1 thread and by more."""
    built = scenes["car"](THREADED_SIZE)
    name = f"car, {THREADED_SIZE} x {THREADED_SIZE}"
    ways = [
        Candidate(method, threads=n)
        for method in as_they_come()
        if method.name in THREADED
        for n in range(1, numba.config.NUMBA_NUM_THREADS + 1)
    ]
    return [(Simulation(name, built, built.acquisition, Flux(signal, sbr)), ways)]
