"""What the trade looks like: its answers, its pictures, its tables."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from core.acquisition import Floats
from core.metrics import Interval
from core.studies.outputs import Item, Plot, Scatter, Table
from core.studies.timing import machine, median_interval
from core.studies.tradeoff import acquisition as acquiring
from core.studies.tradeoff.acquisition import Sweep
from core.studies.tradeoff.measure import Candidate, Point
from core.studies.tradeoff.pareto import (
    Recommendation,
    best_within,
    by_condition,
    cheapest_reaching,
    front,
)
from core.studies.tradeoff.surrogate import Simulation

WITHIN_MS = (2.0, 5.0, 10.0, 20.0, 50.0)
REACHED = (0.5, 0.9, 0.95, 0.99, 0.999)


def items(
    points: Sequence[Point],
    found: Sequence[Acquiring],
    within_ms: Sequence[float] = WITHIN_MS,
    reached: Sequence[float] = REACHED,
    tolerance_bins: int = 3,
) -> list[Item]:
    """Everything that is shown: answers first, then pictures, then numbers."""
    return [
        answers(points, within_ms, reached, tolerance_bins),
        *front_items(points, tolerance_bins),
        fronts_table(points, tolerance_bins),
        differences(points),
        *acquiring_items(found),
        points_table(points),
        machine(),
    ]


# -- the front -------------------------------------------------------------------------------------


def front_items(points: Sequence[Point], tolerance_bins: int = 3) -> Iterator[Item]:
    """The points of each source and SBR with their front, and the fronts of all pulses."""
    for some in _by_light(points):
        yield _scatter(_fullest(some), tolerance_bins)
        fronts = {n: front(each, tolerance_bins) for (_, _, n), each in by_condition(some).items()}
        if len(fronts) > 1:
            source, sbr, _ = some[0].condition
            yield Scatter(
                _key("fronts", source, sbr),
                f"{_told(source, sbr)}: the fronts of all numbers of pulses",
                _time_label(some),
                _missed_label(tolerance_bins),
                {f"{n} pulses": _places(each, tolerance_bins) for n, each in fronts.items()},
                (np.empty(0), np.empty(0), ()),
                "",
                note="Only points that no other one of as many pulses beats.",
            )


def _by_light(points: Sequence[Point]) -> list[list[Point]]:
    """Points by source and SBR, whatever the pulses."""
    found: dict[tuple[str, float | None], list[Point]] = {}
    for point in points:
        found.setdefault((point.source, point.sbr), []).append(point)
    return list(found.values())


def _fullest(points: Sequence[Point]) -> list[Point]:
    """Those of the number of pulses with most to choose from."""
    return max(by_condition(points).values(), key=len)


def _time_label(points: Sequence[Point]) -> str:
    if any(point.light_ms.value for point in points):
        return "Time to reduce and range an image, its light known (ms)"
    return "Time to reduce an image, find its light and range it (ms)"


def _missed_label(tolerance_bins: int) -> str:
    return f"Targets not within {_bins(tolerance_bins)} (share)"


def _bins(n: int) -> str:
    return f"{n} bin" if n == 1 else f"{n} bins"


def _scatter(points: Sequence[Point], tolerance_bins: int) -> Scatter:
    """All points of a condition, by method, and their front."""
    chosen = front(points, tolerance_bins)
    source, sbr, n_pulses = points[0].condition
    groups: dict[str, list[Point]] = {}
    for point in points:
        groups.setdefault(point.candidate.method.name, []).append(point)
    x, y = _places(chosen, tolerance_bins)
    return Scatter(
        _key("front", source, sbr, n_pulses),
        f"{_told(source, sbr)}, {_pulses(n_pulses)}: what each way costs, how often it errs",
        _time_label(points),
        _missed_label(tolerance_bins),
        {name: _places(some, tolerance_bins) for name, some in groups.items()},
        (x[0], y[0], [str(point.candidate) for point in chosen]),
        "not beaten by any",
        note="Bars are 95 % intervals. A share of 0 is drawn where half a target would be. The "
        "oracle is told the light, which no instrument knows: it is never on the front. A gate cut "
        "to some bins is for who knows that the targets are there.",
    )


def _places(points: Sequence[Point], tolerance_bins: int) -> tuple[Floats, Floats]:
    """Milliseconds and missed shares, (3, n) each, kept above what a logarithm cannot show."""
    x = np.array([_ends(point.milliseconds) for point in points]).reshape(-1, 3).T
    y = 1 - np.array([_ends(point.rd(tolerance_bins)) for point in points]).reshape(-1, 3).T
    least = [0.5 / sum(score.targets for score in point.scores) for point in points]
    return x, np.maximum(y, least)


def _ends(interval: Interval) -> tuple[float, float, float]:
    return interval.value, interval.low, interval.high


# -- answers ---------------------------------------------------------------------------------------


def answers(
    points: Sequence[Point],
    within_ms: Sequence[float],
    reached: Sequence[float],
    tolerance_bins: int = 3,
) -> Table:
    """Both questions for each source and SBR, with how sure the answers are."""
    rows: list[tuple[Any, ...]] = []
    for some in map(_fullest, _by_light(points)):
        where = _where(some[0])
        for each in within_ms:
            best = best_within(some, each, tolerance_bins)
            rows.append((*where, f"best within {each:g} ms", *_answer(best, tolerance_bins)))
        for each in reached:
            best = cheapest_reaching(some, each, tolerance_bins)
            rows.append((*where, f"cheapest with RD ≥ {each:g}", *_answer(best, tolerance_bins)))
    return Table(
        "answers",
        "Which way to take",
        (
            *_WHERE,
            "asked",
            "answer",
            "ms",
            f"RD, {_bins(tolerance_bins)}",
            "the best, probability",
            "keeps to what was asked, probability",
            "others that may be the best",
        ),
        tuple(rows),
        note="Probabilities are those of a paired bootstrap over seeds (or parts of a capture) and "
        "rounds of timing. The others named would have been chosen in 5 % of the draws or more. A "
        "gate cut to some bins is for who knows that the targets are there.",
    )


_MOST_NAMED = 4


def _answer(found: Recommendation | None, tolerance_bins: int) -> tuple[Any, ...]:
    if found is None:
        return "none", "", "", "", "", ""
    others = [f"{point.candidate} ({share:.2f})" for point, share in found.runners_up]
    more = len(others) - _MOST_NAMED
    others = others[:_MOST_NAMED] + ([f"{more} more"] if more > 0 else [])
    return (
        str(found.point.candidate),
        _interval(found.point.milliseconds, 2),
        _interval(found.point.rd(tolerance_bins), 4),
        f"{found.is_best:.2f}",
        f"{found.keeps:.2f}",
        "; ".join(others),
    )


# -- tables ----------------------------------------------------------------------------------------


def fronts_table(points: Sequence[Point], tolerance_bins: int = 3) -> Table:
    """The fronts of all conditions, as people read them."""
    rows = tuple(
        (
            *_where(point),
            str(point.candidate),
            _interval(point.milliseconds, 2),
            f"{point.light_ms.value:.1f}",
            f"{point.ns_per_pixel_bin:.1f}",
            _interval(point.rd(3), 4),
            _interval(point.rd(1), 4),
            _interval(point.rmse_m, 3),
            f"{point.peak_bytes / 1e6:.1f}",
        )
        for some in by_condition(points).values()
        for point in front(some, tolerance_bins)
    )
    intervals = ("RD, 3 bins [95 %]", "RD, 1 bin [95 %]", "RMSE, m [95 %]")
    costs = ("ms [95 %]", "light, ms", "ns per pixel and bin")
    columns = (*_WHERE, "way", *costs, *intervals, "peak memory, MB")
    return Table("fronts", "What no other way beats", columns, rows, note=_WHAT_IS_TIMED)


_WHAT_IS_TIMED = (
    "Milliseconds are those of reducing the capture and ranging it, the light that it tells of "
    "being known (a capture keeps it); finding that light, once for each capture, stands beside "
    "them, or is counted in and stands as 0. Memory is what numpy holds at most meanwhile, beyond "
    "the capture. Errors are those of the whole image at the capture's own bin width: pixels that "
    "are left out take their neighbour's answer."
)


def differences(points: Sequence[Point]) -> Table:
    """What leaving something out, or doing it otherwise, changes of a method; paired."""
    rows = []
    for some in map(_fullest, _by_light(points)):
        plain = {
            (each.candidate.method, each.candidate.threads): each
            for each in some
            if each.candidate == Candidate(each.candidate.method, threads=each.candidate.threads)
        }
        for point in some:
            candidate = point.candidate
            base = plain.get((candidate.method, None), plain.get((candidate.method, 1)))
            if base is None or base is point:
                continue
            ratio = median_interval(np.divide(point.seconds, base.seconds))
            light = point.light_ms.value / base.light_ms.value if base.light_ms.value else math.nan
            rows.append(
                (
                    *_where(point),
                    str(candidate),
                    _interval(ratio, 2),
                    f"{light:.2f}",
                    *(_interval(_more_restored(point, base, n), 4) for n in (3, 1)),
                    f"{(point.peak_bytes - base.peak_bytes) / 1e6:+.1f}",
                )
            )
    degrees = [f"RD, {_bins(n)}, difference [95 %]" for n in (3, 1)]
    return Table(
        "differences",
        "What one change does, against the same method on the whole capture",
        (*_WHERE, "way", "time, ratio [95 %]", "light, ratio", *degrees, "memory, MB more"),
        tuple(rows),
        note="Paired: ratios of the same rounds of timing, differences on the same seeds.",
    )


def _more_restored(point: Point, base: Point, tolerance_bins: int) -> Interval:
    """Mean difference of the restoration degree over seeds, with Student's 95 % interval."""
    more = [
        (mine.restored[tolerance_bins - 1] - theirs.restored[tolerance_bins - 1]) / mine.targets
        for mine, theirs in zip(point.scores, base.scores, strict=True)
    ]
    mean, count = float(np.mean(more)), len(more)
    half = float(stdtrit(count - 1, 0.975) * np.std(more, ddof=1) / math.sqrt(count))
    return Interval(mean, mean - half, mean + half)


def points_table(points: Sequence[Point]) -> Table:
    """Everything that was measured, as numbers."""
    ends = ("", ", low", ", high")
    measured = [
        f"{name}{end}" for name in ("ms", "RD 3 bins", "RD 1 bin", "RMSE m") for end in ends
    ]
    rows = [
        (
            *_where(point),
            str(point.candidate),
            *_ends(point.milliseconds),
            *_ends(point.rd(3)),
            *_ends(point.rd(1)),
            *_ends(point.rmse_m),
            point.light_ms.value,
            point.ns_per_pixel_bin,
            point.peak_bytes / 1e6,
            point.note,
        )
        for point in points
    ]
    more = ("light, ms", "ns per pixel and bin", "peak memory, MB", "note")
    return Table(
        "points",
        "Everything that was measured",
        (*_WHERE, "way", *measured, *more),
        tuple(rows),
        note="points.json, beside this page, holds the settings that make each of them again.",
    )


def write_settings(points: Sequence[Point], folder: Path) -> None:
    """``points.json``: of each point the settings and the figures."""
    told = [
        {
            "way": str(point.candidate),
            **point.settings,
            "milliseconds": _ends(point.milliseconds),
            "rd_3_bins": _ends(point.rd(3)),
            "rd_1_bin": _ends(point.rd(1)),
        }
        for point in points
    ]
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "points.json").write_text(json.dumps(told, indent=1), encoding="utf-8")


# -- how to acquire --------------------------------------------------------------------------------


class Acquiring(NamedTuple):
    """Sweeps of a simulation."""

    simulation: Simulation
    pulses: Sweep
    exposure: Sweep
    gate: Sweep


def acquired(
    simulations: Sequence[Simulation],
    seeds: Sequence[int],
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Acquiring]:
    """All three sweeps of each simulation."""
    knobs: list[acquiring.Knob] = []
    for each in simulations:
        gates = acquiring.over_gates(each)
        knobs += [
            (acquiring.PULSES, acquiring.over_pulses(each, acquiring.PULSES)),
            (acquiring.EXPOSURES, acquiring.over_exposures(each, acquiring.EXPOSURES)),
            ([gate.acquisition.n_bins for gate in gates], gates),
        ]
    found = acquiring.sweeps(knobs, seeds=seeds, processes=processes, progress=progress)
    return [Acquiring(each, *found[3 * i : 3 * i + 3]) for i, each in enumerate(simulations)]


def acquiring_items(found: Sequence[Acquiring]) -> Iterator[Item]:
    """The sweeps as curves, and the pulses that are needed as a table."""
    for each in found:
        simulation, pulses = each.simulation, _pulses(each.simulation.acquisition.n_pulses)
        bins = simulation.acquisition.n_bins
        factor = acquiring.exposure(simulation)
        yield _curves("pulses", each, each.pulses, "Pulses", {})
        yield _curves(
            "exposure",
            each,
            each.exposure,
            f"Factor on signal and background ({pulses}; attenuated below 1)",
            {f"best by theory: {factor:.2f}": factor, "as it is": 1.0},
        )
        yield _curves(
            "gate",
            each,
            each.gate,
            f"Gate (bins; {pulses}, the same background in each bin)",
            {f"as it is: {bins}": float(bins)},
        )
    if found:
        yield _needed(found)


_SAID = {
    "pulses": "how many pulses reach a restoration degree",
    "exposure": "how much light reaches a restoration degree",
    "gate": "how long a gate still reaches a restoration degree",
}


def _curves(
    key: str, found: Acquiring, sweep: Sweep, x_label: str, marks: dict[str, float]
) -> Plot:
    source, sbr = found.simulation.name, found.simulation.flux.sbr
    ends = {
        f"{name}, simulated": np.array([_ends(each) for each in intervals]).T
        for name, intervals in sweep.simulated.items()
    }
    return Plot(
        _key(key, source, sbr),
        f"{_told(source, sbr)}: {_SAID[key]}",
        x_label,
        "Restoration degree within 3 bins",
        sweep.x,
        {"theory, light known": sweep.theory, **{name: each[0] for name, each in ends.items()}},
        marks,
        bands={name: (each[1], each[2]) for name, each in ends.items()},
        x_is_log=True,
    )


def _needed(found: Sequence[Acquiring]) -> Table:
    """Pulses with which each degree of `REACHED` is reached."""
    rows = []
    for each in found:
        few, many = int(each.pulses.x[0]), int(each.pulses.x[-1])
        for rd in REACHED:
            simulated = [
                acquiring.pulses_by_simulation(each.pulses, name, rd) for name in acquiring.METHODS
            ]
            rows.append(
                (
                    each.simulation.name,
                    _number(each.simulation.flux.sbr),
                    f"{rd:g}",
                    _whole(acquiring.pulses_by_theory(each.simulation, rd), few, many),
                    *(
                        f"{_whole(n.value, few, many)} "
                        f"[{_whole(n.low, few, many)}, {_whole(n.high, few, many)}]"
                        for n in simulated
                    ),
                )
            )
    return Table(
        "needed",
        "Pulses needed for a restoration degree within 3 bins",
        (
            "source",
            "SBR",
            "RD",
            "theory, light known",
            *(f"{name}, simulated [95 %]" for name in acquiring.METHODS),
        ),
        tuple(rows),
        note="Theory: the probability that the exact likelihood with known light peaks within 3.2 "
        "bins, its scores taken as Gaussian; it is too high below 0.9. Simulated: interpolated "
        "between the numbers of pulses of the sweep.",
    )


def _whole(n_pulses: float, few: int, many: int) -> str:
    """A number of pulses as far as a sweep from few to many pulses knows it."""
    if n_pulses < few:
        return f"< {few}"
    return f"> {many}" if n_pulses > many else str(math.ceil(n_pulses))


# -- words -----------------------------------------------------------------------------------------


def _key(what: str, *of: object) -> str:
    """A file's name."""
    told = "_".join(f"{each:g}" if isinstance(each, float) else str(each) for each in of if each)
    return re.sub(r"[^\w.]+", "_", f"{what}_{told}")[:80]


def _told(source: str, sbr: float | None) -> str:
    return source if sbr is None else f"{source} at SBR {sbr:.3g}"


def _pulses(n_pulses: int | None) -> str:
    return "pulses not known" if n_pulses is None else f"{n_pulses} pulses"


_WHERE = ("source", "SBR", "pulses")


def _where(point: Point) -> tuple[str, str, str]:
    return point.source, _number(point.sbr), _number(point.n_pulses)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def _interval(found: Interval, digits: int) -> str:
    return f"{found.value:.{digits}f} [{found.low:.{digits}f}, {found.high:.{digits}f}]"
