"""Pulses, exposure and gate length required for a restoration degree.

Two predictions: by theory (`core.limits`), in milliseconds, for known fluxes and uniform depths;
and by simulated captures, ranged by the likelihood with known (oracle) and with estimated flux.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Floats, Flux
from core.inference.limits import best_exposure, right_bin_probability
from core.metrics import Interval
from core.scene import further_parts_of
from core.simulation import echoes
from core.studies.tradeoff.measure import Candidate, Piece, scored
from core.studies.tradeoff.surrogate import Simulation
from core.studies.trials import Score, default_methods, mapped, summary

METHODS = ("oracle", "likelihood")
PULSES = (50, 100, 200, 500, 1000, 2000, 5000, 10_000)
EXPOSURES = tuple(np.geomspace(0.01, 4, 10).round(3).tolist())
GATES = 7
"""Number of gate lengths, from one that just holds the targets to `MAX_GATE` times it."""
MAX_GATE = 16
_PIXELS = 64  # for which the theory is computed
_MAX_PULSES = 1e8


@dataclass(frozen=True, eq=False)
class Sweep:
    """One quantity of the acquisition varied, all others fixed.

    Parameters
    ----------
    x : ndarray, shape (value,)
    theory : ndarray, shape (value,)
        Probability of the right bin (within 3.2 bins for the paper's pulse), mean over the targets,
        with known signal and background.
    simulated : mapping
        Restoration degree within 3 bins of each of `methods_for`, with 95 % intervals.
    """

    x: Floats
    theory: Floats
    simulated: Mapping[str, tuple[Interval, ...]]


def simulated_over_pulses(simulation: Simulation, n_pulses: Sequence[int]) -> list[Simulation]:
    """Return the simulation with other numbers of pulses."""
    return [simulation.with_pulses(n) for n in n_pulses]


def over_exposures(simulation: Simulation, factors: Sequence[float]) -> list[Simulation]:
    """Return the simulation with signal and background times each factor."""
    flux = simulation.flux
    return [replace(simulation, flux=Flux(flux.signal * each, flux.sbr)) for each in factors]


def over_gates(simulation: Simulation) -> list[Simulation]:
    """Return the simulation with gates of several lengths around the targets.

    The background rate per bin is kept, so that a longer gate has more background.
    """
    acquisition, flux = simulation.acquisition, simulation.flux
    first, end = simulation.window
    # No gate opens before its pulse is emitted.
    max_before = first + max(0, math.floor(acquisition.gate_delay_s / acquisition.bin_width_s))
    gates = []
    for length in np.geomspace(end - first, MAX_GATE * (end - first), GATES):
        before = min(round((length - (end - first)) / 2), max_before)
        n_bins = max(round(length), end - first)
        opens = first - before
        delay_s = acquisition.gate_delay_s + opens * acquisition.bin_width_s
        background = flux.background * n_bins / acquisition.n_bins
        gates.append(
            replace(
                simulation,
                acquisition=replace(acquisition, n_bins=n_bins, gate_delay_s=delay_s),
                flux=Flux(flux.signal, flux.signal / background if background else math.inf),
            )
        )
    return gates


def theory(simulation: Simulation) -> float:
    """Return `core.limits.right_bin_probability`, mean over (a sample of) the targets."""
    onset, signal = _targets(simulation)
    return float(
        right_bin_probability(
            onset,
            signal,
            simulation.flux.background,
            simulation.pulse,
            simulation.acquisition,
        ).mean()
    )


def exposure(simulation: Simulation) -> float:
    """Return the most informative factor on the flux, at most the largest of `EXPOSURES`.

    It is the median of `core.limits.best_exposure` over (a sample of) the targets.
    """
    most: float = EXPOSURES[-1]
    (brightest,) = over_exposures(simulation, [most])
    onset, signal = _targets(brightest)
    background, pulse = brightest.flux.background, brightest.pulse
    factor = best_exposure(onset, signal, background, pulse, brightest.acquisition)
    return most * float(np.median(factor))


def _targets(simulation: Simulation) -> tuple[Floats, Floats]:
    """Return delays in bins and signals of a sample of the targets, even in their delay."""
    range_m, signal = (each.ravel() for each in next(echoes(simulation.scene, simulation.flux)))
    onset = simulation.acquisition.range_m_to_bin(range_m)
    order = np.argsort(onset)[: np.isfinite(onset).sum()]  # NaN last
    sample = order[np.linspace(0, order.size - 1, min(_PIXELS, order.size)).round().astype(int)]
    return onset[sample], signal[sample]


def methods_for(simulation: Simulation) -> tuple[str, ...]:
    """Return those of `METHODS` that apply: the oracle needs fluxes that the captures state."""
    return METHODS[1:] if further_parts_of(simulation.scene) else METHODS


def sweeps(
    varied: Sequence[tuple[Sequence[float], Sequence[Simulation]]],
    *,
    seeds: Sequence[int],
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Sweep]:
    """Compute theory and simulation for each value of each quantity.

    Parameters
    ----------
    varied : sequence
        For each quantity its values, and the simulation of first photons at each.
    seeds : sequence of int
        At least 2, the same for all values.
    processes : int
    progress : callable
        ``(captures ranged, captures in all)``.
    """
    candidates = {each.name: Candidate(each) for each in default_methods() if each.name in METHODS}
    all_simulations = [each for _, simulations in varied for each in simulations]
    chosen = [methods_for(each) for each in all_simulations]
    pieces = [
        Piece(place, simulation, tuple(candidates[name] for name in chosen[place]), seed)
        for place, simulation in enumerate(all_simulations)
        for seed in seeds
    ]
    scores: list[dict[str, list[Score]]] = [{name: [] for name in names} for names in chosen]
    for done, (piece, found) in enumerate(mapped(scored, pieces, processes)):
        for name, each in zip(chosen[piece.place], found, strict=True):
            scores[piece.place][name] += each
        progress(done + 1, len(pieces))
    ends = np.cumsum([len(x) for x, _ in varied])
    return [
        Sweep(
            np.asarray(x, float),
            np.array([theory(each) for each in simulations]),
            {
                name: tuple(summary(each[name]).rd[2] for each in scores[end - len(x) : end])
                for name in chosen[end - 1]
            },
        )
        for (x, simulations), end in zip(varied, ends, strict=True)
    ]


def pulses_by_theory(simulation: Simulation, rd: float) -> float:
    """Return the pulses with which the theory reaches a restoration degree, or infinity."""

    def excess(log_pulses: float) -> float:
        return theory(simulation.with_pulses(round(math.exp(log_pulses)))) - rd

    most = math.log(_MAX_PULSES)
    if excess(most) < 0:
        return math.inf
    return math.exp(scipy.optimize.brentq(excess, 0.0, most, xtol=1e-3)) if excess(0.0) < 0 else 1.0


def pulses_by_simulation(found: Sweep, method: str, rd: float) -> Interval:
    """Return the pulses with which a method reaches a restoration degree in a sweep.

    Interpolated between log pulses and log odds of the degree; the interval is where the degree's
    interval reaches it. 0 where the fewest pulses suffice, infinite where the most do not.
    """

    def reaching(degrees: Sequence[float]) -> float:
        rising = np.maximum.accumulate(degrees)  # a decrease is chance
        if rising[0] >= rd:
            return 0.0
        if rising[-1] < rd:
            return math.inf
        behind = int(np.argmax(rising >= rd))
        pair = slice(behind - 1, behind + 1)
        odds = scipy.special.logit(np.clip(rising[pair], 1e-9, 1 - 1e-9))
        log_pulses = np.interp(scipy.special.logit(min(rd, 1 - 1e-9)), odds, np.log(found.x[pair]))
        return math.exp(log_pulses)

    intervals = found.simulated[method]
    return Interval(*(reaching([getattr(i, end) for i in intervals]) for end in _ENDS))


_ENDS = ("value", "high", "low")  # a higher degree needs fewer pulses
