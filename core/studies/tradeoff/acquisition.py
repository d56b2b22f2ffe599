"""How to acquire: how many pulses, how much light, how long a gate reach a wanted accuracy.

Two answers side by side. The limit's theory (`core.limits`) says how often a pixel can be right at
all with signal and background known, in milliseconds for an image; simulated captures say how
often the exact likelihood is, told the light (oracle) or estimating it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import logit

from core.acquisition import Floats, Flux
from core.estimators import ESTIMATORS
from core.inference.limits import best_exposure, right_bin_probability
from core.metrics import Interval
from core.studies.tradeoff.measure import Candidate, Piece, scored
from core.studies.tradeoff.surrogate import Simulation
from core.studies.trials import Method, Score, computed, summary

METHODS = ("oracle", "likelihood")
PULSES = (50, 100, 200, 500, 1000, 2000, 5000, 10_000)
EXPOSURES = tuple(np.geomspace(0.01, 4, 10).round(3).tolist())
GATES = 7
"""Lengths of gate that are tried, from one that just holds the targets to `LONGEST` times it."""
LONGEST = 16
_PIXELS = 64  # of which the theory is computed: its tables are quicker for few
_MOST_PULSES = 1e8


@dataclass(frozen=True, eq=False)
class Sweep:
    """One knob of the acquisition, everything else as it is.

    Parameters
    ----------
    x : ndarray, shape (place,)
        The knob.
    theory : ndarray, shape (place,)
        Mean over the targets of the probability of the right bin (within 3.2 bins for the paper's
        pulse), signal and background known.
    simulated : mapping
        For each of `METHODS` the restoration degree within 3 bins, with 95 % intervals.
    """

    x: Floats
    theory: Floats
    simulated: Mapping[str, tuple[Interval, ...]]


def over_pulses(simulation: Simulation, n_pulses: Sequence[int]) -> list[Simulation]:
    """The simulation with other numbers of pulses."""
    return [simulation.with_pulses(n) for n in n_pulses]


def over_exposures(simulation: Simulation, factors: Sequence[float]) -> list[Simulation]:
    """The simulation with signal and background times a factor: attenuated below 1."""
    flux = simulation.flux
    return [replace(simulation, flux=Flux(flux.signal * each, flux.sbr)) for each in factors]


def over_gates(simulation: Simulation) -> list[Simulation]:
    """The simulation with gates of several lengths, the targets in their middle.

    The background's rate in each bin stays what it is, so that a longer gate has more of it before
    and behind the targets.
    """
    acquisition, flux = simulation.acquisition, simulation.flux
    first, end = simulation.window
    # No gate opens before its pulse leaves.
    most_before = first + max(0, math.floor(acquisition.gate_delay_s / acquisition.bin_width_s))
    gates = []
    for length in np.geomspace(end - first, LONGEST * (end - first), GATES):
        before = min(round((length - (end - first)) / 2), most_before)
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
    """Mean over the targets of `core.limits.right_bin_probability`, of some of them if many."""
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


def exposure(simulation: Simulation, most: float = EXPOSURES[-1]) -> float:
    """Factor on the light, up to `most`, that tells most: median over the targets, of some if many.

    By `core.limits.best_exposure`.
    """
    (brightest,) = over_exposures(simulation, [most])
    onset, signal = _targets(brightest)
    background, pulse = brightest.flux.background, brightest.pulse
    factor = best_exposure(onset, signal, background, pulse, brightest.acquisition)
    return most * float(np.median(factor))


def _targets(simulation: Simulation) -> tuple[Floats, Floats]:
    """Delays in bins and signals of targets, evenly taken in the order of their delays."""
    onset = simulation.acquisition.range_m_to_bin(simulation.scene.range_m).ravel()
    reflectivity = simulation.scene.reflectivity
    signal = np.full(onset.size, simulation.flux.signal)
    if reflectivity is not None:
        signal = signal * np.ravel(reflectivity)
    order = np.argsort(onset)[: np.isfinite(onset).sum()]  # NaN last
    some = order[np.linspace(0, order.size - 1, min(_PIXELS, order.size)).round().astype(int)]
    return onset[some], signal[some]


Knob = tuple[Sequence[float], Sequence[Simulation]]
"""Places of a knob, and the simulation at each."""


def sweeps(
    knobs: Sequence[Knob],
    *,
    seeds: Sequence[int],
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Sweep]:
    """Theory and simulation at each place of each knob.

    Parameters
    ----------
    knobs : sequence
        Of simulations of first photons.
    seeds : sequence of int
        At least 2, the same for all places.
    processes : int
    progress : callable
        ``(captures ranged, captures in all)``.
    """
    ways = tuple(Candidate(Method(name, name, ESTIMATORS[name].parameters())) for name in METHODS)
    places = [simulation for _, simulations in knobs for simulation in simulations]
    pieces = [Piece(at, each, ways, seed) for at, each in enumerate(places) for seed in seeds]
    scores: dict[str, list[list[Score]]] = {name: [[] for _ in places] for name in METHODS}
    for done, (piece, found) in enumerate(computed(scored, pieces, processes)):
        for name, each in zip(METHODS, found, strict=True):
            scores[name][piece.place] += each
        progress(done + 1, len(pieces))
    ends = np.cumsum([len(x) for x, _ in knobs])
    return [
        Sweep(
            np.asarray(x, float),
            np.array([theory(each) for each in simulations]),
            {
                name: tuple(summary(s).rd[2] for s in scores[name][end - len(x) : end])
                for name in METHODS
            },
        )
        for (x, simulations), end in zip(knobs, ends, strict=True)
    ]


def pulses_by_theory(simulation: Simulation, rd: float) -> float:
    """Pulses with which the theory reaches a restoration degree; infinite where no number does."""

    def excess(log_pulses: float) -> float:
        return theory(simulation.with_pulses(round(math.exp(log_pulses)))) - rd

    most = math.log(_MOST_PULSES)
    if excess(most) < 0:
        return math.inf
    return math.exp(brentq(excess, 0.0, most, xtol=1e-3)) if excess(0.0) < 0 else 1.0


def pulses_by_simulation(found: Sweep, method: str, rd: float) -> Interval:
    """Pulses with which a method reaches a restoration degree, between those of a sweep.

    Interpolated on the logarithm of the pulses and the log odds of the degree; the interval is
    where the interval of the degree reaches it. 0 where the fewest pulses of the sweep are enough,
    infinite where the most are not.
    """
    intervals = found.simulated[method]

    def reaching(degrees: Sequence[float]) -> float:
        # More pulses do not tell less: what goes down is chance.
        rising = np.maximum.accumulate(degrees)
        if rising[0] >= rd:
            return 0.0
        if rising[-1] < rd:
            return math.inf
        behind = int(np.argmax(rising >= rd))
        pair = slice(behind - 1, behind + 1)
        odds = logit(np.clip(rising[pair], 1e-9, 1 - 1e-9))
        log_pulses = np.interp(logit(min(rd, 1 - 1e-9)), odds, np.log(found.x[pair]))
        return math.exp(log_pulses)

    return Interval(
        reaching([each.value for each in intervals]),
        reaching([each.high for each in intervals]),
        reaching([each.low for each in intervals]),
    )
