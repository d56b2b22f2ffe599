"""Plan of a study: candidates to measure on built-in scenes."""

from __future__ import annotations

from collections.abc import Sequence

import numba

from core.acquisition import Flux
from core.scene import scenes
from core.studies.tradeoff.acquisition import PULSES
from core.studies.tradeoff.measure import MERGES, Candidate, Source, candidates, variations
from core.studies.tradeoff.surrogate import Simulation
from core.studies.trials import default_methods

MERGED_AT = (100, 10_000)
"""Numbers of pulses, besides the scene's own, with which bins are merged."""
THREADED = ("tracking", "likelihood")
THREADED_SIZE = 256
"""Rows and columns of the image on which threads are compared; small images use one thread."""

Plan = list[tuple[Source, Sequence[Candidate]]]


def simulated(scene: str, sbr: float, signal: float, n_pulses: int | None = None) -> Simulation:
    """Return a built-in scene, with its own number of pulses where none is given."""
    built = scenes[scene]()
    simulation = Simulation(scene, built, built.acquisition, Flux(signal, sbr))
    return simulation if n_pulses is None else simulation.with_pulses(n_pulses)


def all_candidates(simulation: Simulation) -> list[Candidate]:
    """Return what is measured on a scene with its own number of pulses."""
    return candidates() + variations(simulation.window)


def plan_over_pulses(simulation: Simulation) -> Plan:
    """Return every method at every number of pulses, and all candidates at the scene's own."""
    own = simulation.acquisition.n_pulses
    return [
        (
            simulation.with_pulses(n_pulses),
            all_candidates(simulation)
            if n_pulses == own
            else candidates(merges=MERGES if n_pulses in MERGED_AT else (1,)),
        )
        for n_pulses in sorted({*PULSES, *([own] if own else [])})
    ]


def threaded(sbr: float, signal: float) -> Plan:
    """Return a large car, ranged on one thread and on more."""
    built = scenes["car"](THREADED_SIZE)
    name = f"car, {THREADED_SIZE} x {THREADED_SIZE}"
    configurations = [
        Candidate(method, threads=n)
        for method in default_methods()
        if method.name in THREADED
        for n in range(1, numba.config.NUMBA_NUM_THREADS + 1)
    ]
    return [(Simulation(name, built, built.acquisition, Flux(signal, sbr)), configurations)]
