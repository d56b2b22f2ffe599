"""Plots and tables of the trade-off study."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from core.acquisition import Floats
from core.checks import require
from core.inference.limits import ACCURACY, ASSUMES
from core.metrics import Interval
from core.scene import PARTS, further_parts_of
from core.studies.outputs import Item, Plot, Scatter, Table, as_text, table
from core.studies.statistics import mean_interval, median_interval
from core.studies.timing import machine
from core.studies.tradeoff import acquisition
from core.studies.tradeoff.acquisition import Sweep
from core.studies.tradeoff.measure import Candidate, Point
from core.studies.tradeoff.pareto import (
    Recommendation,
    best_within,
    by_condition,
    cheapest_reaching,
    pareto_front,
)
from core.studies.tradeoff.surrogate import Simulation

TIMES_MS = (2.0, 5.0, 10.0, 20.0, 50.0)
DEGREES = (0.5, 0.9, 0.95, 0.99, 0.999)

_Columns = dict[str, Callable[[Any], Any]]
_FORMATS = {"ms": ".2f", "flux, ms": ".1f", "ns per pixel and bin": ".1f", "peak memory, MB": ".1f"}


def items(
    points: Sequence[Point],
    sweeps: Sequence[AcquisitionSweeps],
    times_ms: Sequence[float] = TIMES_MS,
    degrees: Sequence[float] = DEGREES,
    tolerance_bins: int = 3,
) -> list[Item]:
    """Return everything that is shown: recommendations first, then plots, then all numbers."""
    return [
        recommendations(points, times_ms, degrees, tolerance_bins),
        *front_items(points, tolerance_bins),
        fronts_table(points, tolerance_bins),
        differences(points),
        *acquisition_items(sweeps),
        points_table(points),
        machine(),
    ]


# -- Pareto front ----------------------------------------------------------------------------------


def front_items(points: Sequence[Point], tolerance_bins: int = 3) -> Iterator[Item]:
    """Plot the points of each source and SBR with their front, and the fronts of all pulses."""
    for group in _by_source_and_sbr(points):
        largest = _most_varied(group)
        chosen = pareto_front(largest, tolerance_bins)
        source, sbr, n_pulses = largest[0].condition
        methods: dict[str, list[Point]] = {}
        for point in largest:
            methods.setdefault(point.candidate.method.name, []).append(point)
        x, y = _coordinates(chosen, tolerance_bins)
        axes = _time_label(group), f"Targets not within {_bins(tolerance_bins)} (share)"
        yield Scatter(
            _key("front", source, sbr, n_pulses),
            f"{_subject(source, sbr)}, {_pulses(n_pulses)}: error rate against time per image",
            *axes,
            {name: _coordinates(some, tolerance_bins) for name, some in methods.items()},
            (x[0], y[0], [str(point.candidate) for point in chosen]),
            "Pareto front",
            "Bars are 95 % intervals. A share of 0 is drawn at half a target. The oracle knows the "
            "true flux and is never on the front. Gates cut to some bins require that the targets "
            "are known to be there.",
        )
        fronts = {
            f"{n} pulses": _coordinates(pareto_front(some, tolerance_bins), tolerance_bins)
            for (_, _, n), some in by_condition(group).items()
        }
        if len(fronts) > 1:
            yield Scatter(
                _key("fronts", source, sbr),
                f"{_subject(source, sbr)}: Pareto fronts by number of pulses",
                *axes,
                fronts,
                (np.empty(0), np.empty(0), ()),
                "",
            )


def _by_source_and_sbr(points: Sequence[Point]) -> list[list[Point]]:
    found: dict[tuple[str, float | None], list[Point]] = {}
    for point in points:
        found.setdefault((point.source, point.sbr), []).append(point)
    return list(found.values())


def _most_varied(points: Sequence[Point]) -> list[Point]:
    """Return the points of the number of pulses with most candidates."""
    return max(by_condition(points).values(), key=len)


def _time_label(points: Sequence[Point]) -> str:
    if any(point.flux_ms.value for point in points):
        return "Time to reduce and range an image, flux model known (ms)"
    return "Time to reduce an image, estimate its flux model and range it (ms)"


def _coordinates(points: Sequence[Point], tolerance_bins: int) -> tuple[Floats, Floats]:
    """Return milliseconds and error rates, (3, n) each, above zero for the logarithmic axis."""
    x = np.array([astuple(point.milliseconds) for point in points]).reshape(-1, 3).T
    y = 1 - np.array([astuple(point.rd(tolerance_bins)) for point in points]).reshape(-1, 3).T
    least = [0.5 / sum(score.targets for score in point.scores) for point in points]
    return x, np.maximum(y, least)


# -- Tables ----------------------------------------------------------------------------------------

_CONDITION: _Columns = {
    "source": lambda point: point.source,
    "SBR": lambda point: _number(point.sbr),
    "pulses": lambda point: _number(point.n_pulses),
}
_CONFIGURATION: _Columns = _CONDITION | {"configuration": lambda point: str(point.candidate)}
_RESULTS: _Columns = {
    "ms": lambda point: point.milliseconds,
    "flux, ms": lambda point: point.flux_ms.value,
    "ns per pixel and bin": lambda point: point.ns_per_pixel_bin,
    "RD 3 bins": lambda point: point.rd(3),
    "RD 1 bin": lambda point: point.rd(1),
    "RMSE m": lambda point: point.rmse_m,
    "peak memory, MB": lambda point: point.peak_bytes / 1e6,
}
_MAX_NAMED = 4


def _of_first(columns: _Columns) -> _Columns:
    """Return columns of records whose first element is the point."""
    return {name: (lambda row, cell=cell: cell(row[0])) for name, cell in columns.items()}  # type: ignore[misc]


def recommendations(
    points: Sequence[Point],
    times_ms: Sequence[float],
    degrees: Sequence[float],
    tolerance_bins: int = 3,
) -> Table:
    """Return the best configuration within each time and the fastest for each degree."""
    found: list[tuple[Point, str, Recommendation | None]] = []
    for some in map(_most_varied, _by_source_and_sbr(points)):
        for each in times_ms:
            best = best_within(some, each, tolerance_bins)
            found.append((some[0], f"best within {each:g} ms", best))
        for each in degrees:
            best = cheapest_reaching(some, each, tolerance_bins)
            found.append((some[0], f"fastest with RD ≥ {each:g}", best))

    def of_best(cell: Callable[[Recommendation], Any]) -> Callable[[Any], Any]:
        return lambda row: "" if row[2] is None else cell(row[2])

    def runners_up(best: Recommendation) -> str:
        others = [f"{point.candidate} ({share:.2f})" for point, share in best.runners_up]
        more = len(others) - _MAX_NAMED
        return "; ".join(others[:_MAX_NAMED] + ([f"{more} more"] if more > 0 else []))

    return table(
        "recommendations",
        "Recommended configurations",
        found,
        {
            **_of_first(_CONDITION),
            "limit": lambda row: row[1],
            "configuration": lambda row: "none" if row[2] is None else str(row[2].point.candidate),
            "ms": of_best(lambda best: best.point.milliseconds),
            f"RD, {_bins(tolerance_bins)}": of_best(lambda best: best.point.rd(tolerance_bins)),
            "optimism": of_best(lambda best: best.optimism),
            "P(best)": of_best(lambda best: best.is_best),
            "P(limit kept)": of_best(lambda best: best.keeps),
            "runners-up": of_best(runners_up),
        },
        "Probabilities are those of a paired bootstrap over seeds (or parts of a capture) and "
        "rounds of timing. Runners-up are chosen in 5 % of the draws or more. A configuration is "
        "chosen and measured on the same seeds: the best of many is too good by about the optimism "
        "(of RD, by the same bootstrap), and P(limit kept) likewise too high, with 8 seeds 0.94 "
        "instead of 0.91. Gates cut to some bins require that the targets are known to be there.",
        _FORMATS | {"optimism": ".4f", "P(best)": ".2f", "P(limit kept)": ".2f"},
    )


def fronts_table(points: Sequence[Point], tolerance_bins: int = 3) -> Table:
    """Return the Pareto fronts of all conditions."""
    return table(
        "fronts",
        "Pareto fronts",
        (
            point
            for some in by_condition(points).values()
            for point in pareto_front(some, tolerance_bins)
        ),
        _CONFIGURATION | _RESULTS,
        "Milliseconds are those of reducing the capture and ranging it with its flux model known; "
        "estimating that model, once per capture, is a separate column, or included and shown as "
        "0; searching for several returns includes it. Where pixels see two surfaces, RD is the "
        "share of surfaces that are found; a return more than there are surfaces counts as one "
        "that is not. Memory is the peak of numpy's allocations beyond the capture. Errors are "
        "those of the whole image at the capture's own bin width: pixels that are left out take "
        "the estimate of their neighbour.",
        _FORMATS,
    )


def differences(points: Sequence[Point]) -> Table:
    """Compare each variation with the same method on the whole capture, paired."""
    pairs = []
    for some in map(_most_varied, _by_source_and_sbr(points)):
        plain = {
            (each.candidate.method, each.candidate.threads): each
            for each in some
            if each.candidate == Candidate(each.candidate.method, threads=each.candidate.threads)
        }
        for point in some:
            method = point.candidate.method
            base = plain.get((method, None), plain.get((method, 1)))
            if base is not None and base is not point:
                pairs.append((point, base))

    def flux_ratio(pair: tuple[Point, Point]) -> float:
        point, base = pair
        return point.flux_ms.value / base.flux_ms.value if base.flux_ms.value else math.nan

    def rd_difference(n: int) -> Callable[[tuple[Point, Point]], Interval]:
        return lambda pair: mean_interval(
            np.array(
                [
                    one.restored[n - 1] / one.targets - other.restored[n - 1] / other.targets
                    for one, other in zip(pair[0].scores, pair[1].scores, strict=True)
                ]
            ),
            -1.0,
            1.0,
        )

    return table(
        "differences",
        "Effect of one change, against the same method on the whole capture",
        pairs,
        {
            **_of_first(_CONFIGURATION),
            "time, ratio": lambda pair: median_interval(
                np.divide(pair[0].seconds, pair[1].seconds)
            ),
            "flux, ratio": flux_ratio,
            "RD 3 bins, difference": rd_difference(3),
            "RD 1 bin, difference": rd_difference(1),
            "memory, MB more": lambda pair: (pair[0].peak_bytes - pair[1].peak_bytes) / 1e6,
        },
        "Paired: ratios of the same rounds of timing, differences on the same seeds.",
        {"time, ratio": ".2f", "flux, ratio": ".2f", "memory, MB more": "+.1f"},
    )


def points_table(points: Sequence[Point]) -> Table:
    """Return every measured point."""
    return table(
        "points",
        "All measurements",
        points,
        {**_CONFIGURATION, **_RESULTS, "note": lambda point: point.note},
        "points.json, in the same folder, holds the settings that reproduce each of them.",
    )


def write_settings(points: Sequence[Point], folder: Path) -> None:
    """Write ``points.json``: settings and figures of each point."""
    records = [
        {
            "configuration": str(point.candidate),
            **point.settings,
            "milliseconds": astuple(point.milliseconds),
            "rd_3_bins": astuple(point.rd(3)),
            "rd_1_bin": astuple(point.rd(1)),
        }
        for point in points
    ]
    (folder / "points.json").write_text(json.dumps(records, indent=1), encoding="utf-8")


# -- How to acquire --------------------------------------------------------------------------------


class AcquisitionSweeps(NamedTuple):
    """Sweeps of a simulation."""

    simulation: Simulation
    pulses: Sweep
    exposure: Sweep
    gate: Sweep


def acquisition_sweeps(
    simulations: Sequence[Simulation],
    seeds: Sequence[int],
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[AcquisitionSweeps]:
    """Vary pulses, exposure and gate of each simulation.

    Raises
    ------
    ValueError
        If one does not hold the first photons of a known number of pulses.
    """
    for each in simulations:
        name = f"acquisition of {each.name}"
        what = each.detection, each.acquisition.n_pulses
        require(name, what, each.holds_first_photons, "first photons of a known number of pulses")
    varied: list[tuple[Sequence[float], Sequence[Simulation]]] = []
    for each in simulations:
        gates = acquisition.over_gates(each)
        varied += [
            (acquisition.PULSES, acquisition.simulated_over_pulses(each, acquisition.PULSES)),
            (acquisition.EXPOSURES, acquisition.over_exposures(each, acquisition.EXPOSURES)),
            ([gate.acquisition.n_bins for gate in gates], gates),
        ]
    found = acquisition.sweeps(varied, seeds=seeds, processes=processes, progress=progress)
    return [
        AcquisitionSweeps(each, *found[3 * i : 3 * i + 3]) for i, each in enumerate(simulations)
    ]


def acquisition_items(sweeps: Sequence[AcquisitionSweeps]) -> Iterator[Item]:
    """Return the sweeps as curves, and the required pulses as a table."""
    for simulation, pulses, exposure, gate in sweeps:
        n_pulses, bins = _pulses(simulation.acquisition.n_pulses), simulation.acquisition.n_bins
        factor = acquisition.exposure(simulation)
        best = {f"best by theory: {factor:.2f}": factor, "present": 1.0}
        for name, sweep, x_label, marks in (
            ("pulses", pulses, "Pulses", {}),
            (
                "exposure",
                exposure,
                f"Factor on both fluxes ({n_pulses})",
                best,
            ),
            (
                "gate",
                gate,
                f"Gate (bins; {n_pulses}, the same background in each bin)",
                {f"present: {bins}": float(bins)},
            ),
        ):
            yield _sweep_plot(name, simulation, sweep, x_label, marks)
    if sweeps:
        yield _required_pulses(sweeps)


# Deprecated names, to be removed after the next release.
acquired, acquiring_items = acquisition_sweeps, acquisition_items


_THEORY = f"Theory: {ASSUMES}, {ACCURACY}. Other methods may exceed it."


def _theory_of(*simulations: Simulation) -> str:
    """State what the theory assumes, and which parts of the scenes it leaves out."""
    further = {part for each in simulations for part in further_parts_of(each.scene)}
    left_out = ", ".join(title for part, title in PARTS.items() if part in further)
    return f"{_THEORY} It leaves out: {left_out}." if left_out else _THEORY


def _sweep_plot(
    name: str, simulation: Simulation, sweep: Sweep, x_label: str, marks: dict[str, float]
) -> Plot:
    source, sbr = simulation.name, simulation.flux.sbr
    ends = {
        f"{method}, simulated": np.array([astuple(each) for each in intervals]).T
        for method, intervals in sweep.simulated.items()
    }
    return Plot(
        _key(name, source, sbr),
        f"Restoration degree against {name}: {_subject(source, sbr)}",
        x_label,
        "Restoration degree within 3 bins",
        sweep.x,
        {"theory, flux known": sweep.theory, **{key: each[0] for key, each in ends.items()}},
        marks,
        f"{_theory_of(simulation)} Bands: 95 % sampling error.",
        bands={key: (each[1], each[2]) for key, each in ends.items()},
        x_is_log=True,
    )


def _required_pulses(sweeps: Sequence[AcquisitionSweeps]) -> Table:
    def whole(n_pulses: float, swept: Floats) -> str:
        if n_pulses < swept[0]:
            return f"< {swept[0]:g}"
        return f"> {swept[-1]:g}" if n_pulses > swept[-1] else str(math.ceil(n_pulses))

    def simulated(method: str) -> Callable[[tuple[AcquisitionSweeps, float]], str]:
        def text(row: tuple[AcquisitionSweeps, float]) -> str:
            swept, rd = row[0].pulses, row[1]
            if method not in swept.simulated:
                return ""
            found = astuple(acquisition.pulses_by_simulation(swept, method, rd))
            value, low, high = (whole(n, swept.x) for n in found)
            return f"{value} [{low}, {high}]"

        return text

    methods = [
        name
        for name in acquisition.METHODS
        if any(name in each.pulses.simulated for each in sweeps)
    ]
    theory = _theory_of(*(each.simulation for each in sweeps))
    return table(
        "required_pulses",
        "Pulses required for a restoration degree within 3 bins",
        [(each, rd) for each in sweeps for rd in DEGREES],
        {
            "source": lambda row: row[0].simulation.name,
            "SBR": lambda row: _number(row[0].simulation.flux.sbr),
            "RD": lambda row: f"{row[1]:g}",
            "theory, flux known": lambda row: whole(
                acquisition.pulses_by_theory(row[0].simulation, row[1]), row[0].pulses.x
            ),
            **{f"{name}, simulated [95 %]": simulated(name) for name in methods},
        },
        f"{theory} Simulated: interpolated between the numbers of pulses of the sweep.",
    )


# -- Text ------------------------------------------------------------------------------------------


def _key(what: str, *of: object) -> str:
    """Return a file name."""
    parts = "_".join(f"{each:g}" if isinstance(each, float) else str(each) for each in of if each)
    return re.sub(r"[^\w.]+", "_", f"{what}_{parts}")[:80]


def _subject(source: str, sbr: float | None) -> str:
    return source if sbr is None else f"{source} at SBR {sbr:.3g}"


def _pulses(n_pulses: int | None) -> str:
    return "number of pulses unknown" if n_pulses is None else f"{n_pulses} pulses"


def _bins(n: int) -> str:
    return f"{n} bin" if n == 1 else f"{n} bins"


def _number(value: float | None) -> str:
    return "" if value is None else as_text(value, ".3g")
