"""How fast the tracking estimator is: beside plain code, as captures grow, from a cold start."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Flux
from core.checks import require
from core.estimators import ESTIMATORS, estimate
from core.kernels.blocks import to_blocks
from core.kernels.parallel import SERIAL_BELOW
from core.metrics import Interval
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.outputs import Item, Plot, Table
from core.studies.performance.reference_implementations import (
    fused_loop,
    numpy_over_bins,
    plain_loop,
)
from core.studies.performance.roofline import Floors, floors, on_threads
from core.studies.performance.start import STAGES, first_image
from core.studies.timing import FEWEST_REPEATS, interleaved, machine, median_interval
from core.tracking import TrackingParameters, track, tracking_signals

SETTINGS = TrackingParameters()
FLUX = Flux(0.1041, 0.06)
ESTIMATOR = ESTIMATORS["tracking"]

PLAIN, FUSED = "plain numba loop over pixels", "the same, fused"
ONE_SHOT, LAYOUT, MOVE = "one shot: layout and tracking", "layout", "tracking, once laid out"
COLD, PUBLIC = "tracking, once laid out, caches cold", "core.estimate, light known"
ANEW = "core.estimate of a new capture: layout, light, confidence"
SIMULATION, IMAGE = "simulation of 1000 pulses", "process start to first range image"

MOST_MS = {ONE_SHOT: 0.4, MOVE: 0.25, SIMULATION: 10.0, IMAGE: 1000.0}
"""Asked of 64 x 64 x 100 counts on two cores."""
LEAST_RATIO = {ONE_SHOT: 25.0, PUBLIC: 10.0}
"""How many times faster than `PLAIN`."""

_IN_A_ROW = 10  # calls of what takes less than the clock and a cold cache blur
_BYTES_OF_A_COUNT = 2


INTRODUCTION = (
    "What tracking costs, and what stands beside it. All ways are called in turn, round by round, "
    "in an order drawn anew, so that what else the machine does meets all of them alike; the first "
    "round is not counted. Medians, with 95 % intervals from order statistics.",
    "Milliseconds are told as reached or missed; only ratios within this run make "
    "`python -m core speed` fail.",
)


@dataclass(frozen=True)
class Extent:
    """How far a study goes; the sizes are those of square images and of gates."""

    rounds: int = 21
    growth_rounds: int = 7
    starts: int = 7
    side: int = 64
    bins: int = 100
    sides: tuple[int, ...] = (64, 128, 256, 512, 1024)
    gates: tuple[int, ...] = (100, 256, 512, 1024, 2048, 4096)
    side_of_threads: int = 512
    floor_bytes: int = 2**28

    def __post_init__(self) -> None:
        for name in ("rounds", "growth_rounds", "starts"):
            repeats = getattr(self, name)
            require(name, repeats, repeats >= FEWEST_REPEATS, f"at least {FEWEST_REPEATS}")


@dataclass(frozen=True)
class Study:
    """What was found: to be shown, and to be warned of."""

    items: list[Item]
    regressions: list[str]


def study(extent: Extent, progress: Callable[[int, int], None] = lambda done, of: None) -> Study:
    """Measure everything.

    Parameters
    ----------
    extent : Extent
    progress : callable
        ``(pieces done, pieces in all)``.
    """
    all_threads = numba.get_num_threads()
    growths = [growth_of_pixels, growth_of_bins]
    if all_threads > 1:
        growths.append(growth_of_threads)
    pieces = 3 + len(growths)
    progress(0, pieces)
    known = {n: floors(n, extent.rounds, extent.floor_bytes) for n in sorted({1, all_threads})}
    progress(1, pieces)
    seconds = variants(extent)
    progress(2, pieces)
    grown = []
    for grow in growths:
        grown.append(grow(extent))
        progress(2 + len(grown), pieces)
    with tempfile.TemporaryDirectory() as folder:
        compiled = first_image(Path(folder))
        starts = np.array([first_image(Path(folder)) for _ in range(extent.starts)])
    progress(pieces, pieces)
    items: list[Item] = [
        machine(),
        asked_table(seconds, starts),
        floors_table(known.values()),
        variants_table(seconds, extent.side**2 * extent.bins, known[1]),
        start_table(starts, compiled),
        exponents_table(grown),
        *(growth_table(each, known) for each in grown),
        *(growth_plot(each, known) for each in grown if each.over != "threads"),
    ]
    return Study(items, regressions(seconds))


# -- 64 x 64 x 100 ---------------------------------------------------------------------------------


def variants(extent: Extent) -> dict[str, Floats]:
    """Seconds of each way to range one capture, shape (round,).

    What takes less than a millisecond is called ten times in a row, as a slider does that is
    dragged; `COLD` once, behind whatever came before it.
    """
    scene, acquisition = _scene(extent.side), _gate(extent.bins)
    capture = simulate(scene, acquisition, FLUX, seed=1)
    counts = capture.cube.reshape(-1, extent.bins)
    numbers, small_numbers = counts.astype(float), counts.astype(np.float32)
    blocks = to_blocks(counts)
    estimate(capture, "tracking")  # finds its light

    def anew() -> object:
        return estimate(replace(capture), "tracking")

    once: dict[str, Callable[[], object]] = {
        "numpy over bins": lambda: numpy_over_bins(numbers, SETTINGS),
        "numpy over bins, float32": lambda: numpy_over_bins(small_numbers, SETTINGS),
        PLAIN: lambda: plain_loop(numbers, SETTINGS),
        FUSED: lambda: fused_loop(numbers, SETTINGS),
        "all signals": lambda: tracking_signals(counts, SETTINGS),
        COLD: lambda: track(blocks, SETTINGS),
        ANEW: anew,
        SIMULATION: lambda: simulate(scene, acquisition, FLUX, seed=1),
    }
    in_a_row: dict[str, Callable[[], object]] = {
        ONE_SHOT: lambda: track(to_blocks(counts), SETTINGS),
        LAYOUT: lambda: to_blocks(counts),
        MOVE: lambda: track(blocks, SETTINGS),
        "Estimator.delays, light known": lambda: ESTIMATOR.delays(capture, SETTINGS),
        PUBLIC: lambda: estimate(capture, "tracking"),
    }
    taken = interleaved(once | {name: _ten(call) for name, call in in_a_row.items()}, extent.rounds)
    return {name: s / (_IN_A_ROW if name in in_a_row else 1) for name, s in taken.items()}


def _ten(call: Callable[[], object]) -> Callable[[], object]:
    def row() -> None:
        for _ in range(_IN_A_ROW):
            call()

    return row


def ratio(seconds: Mapping[str, Floats], name: str) -> Interval:
    """How many times faster than `PLAIN`, round by round."""
    return median_interval(seconds[PLAIN] / seconds[name])


def regressions(seconds: Mapping[str, Floats]) -> list[str]:
    """A sentence for each ratio that misses what is asked, even at the better end of its interval.

    Ratios of what is measured in turn within one run hold on any machine, loaded or not;
    milliseconds do not.
    """
    found = {name: ratio(seconds, name) for name in LEAST_RATIO}
    return [
        f"{name}: {each.value:.1f} times faster than a {PLAIN} (at most {each.high:.1f}), "
        f"{LEAST_RATIO[name]:g} times are asked."
        for name, each in found.items()
        if each.high < LEAST_RATIO[name]
    ]


def asked_table(seconds: Mapping[str, Floats], starts: Floats) -> Table:
    """What was to be reached, and what was; `starts` has the shape (start, stage)."""
    known = {**seconds, IMAGE: starts.sum(axis=1)}
    rows = []
    for name, most in MOST_MS.items():
        found = median_interval(1e3 * known[name])
        reached = "reached" if found.value <= most else "missed"
        rows.append((name, f"at most {most:g} ms", *_cells(found), reached))
    for name, least in LEAST_RATIO.items():
        found = ratio(seconds, name)
        reached = "reached" if found.value >= least else "missed"
        rows.append(
            (f"times faster than a {PLAIN}: {name}", f"at least {least:g}", *_cells(found), reached)
        )
    return Table(
        "asked",
        "Speeds asked, and measured",
        ("what", "asked", "measured", "95 % from", "to", "verdict"),
        tuple(rows),
        "Medians. Milliseconds are this machine's, under the load it had; ratios are taken round "
        "by round within the run.",
    )


def variants_table(seconds: Mapping[str, Floats], n_counts: int, floor: Floors) -> Table:
    """All variants beside each other, and beside one thread's square roots."""
    roots_s = _roots_s(n_counts, floor)
    rows = []
    for name, taken in seconds.items():
        found = median_interval(1e3 * taken)
        per_count = found.value * 1e6 / n_counts
        times = ratio(seconds, name).value
        rows.append((name, *_cells(found), per_count, times, found.value * 1e-3 / roots_s))
    return Table(
        "variants",
        "64 x 64 x 100 counts, dual-scale tracking",
        ("way", "ms", "95 % from", "to", "ns per pixel and bin", "plain loop / this", "of roots"),
        tuple(rows),
        "Float64 but for the fast kernel and where told; one thread, but for the simulation and "
        "the light of a new capture, which use all. 'Of roots': how many times as long as one "
        "thread takes for the two square roots of each pixel and bin alone.",
    )


# -- Floors ----------------------------------------------------------------------------------------


def floors_table(known: Iterable[Floors]) -> Table:
    """Square roots and memory, of one thread and of all."""
    rows = []
    for each in known:
        unit = "ns for a float32 square root"
        rows.append((unit, each.threads, *_cells(each.root_ns)))
        rows.append(("GB/s copied (read and written)", each.threads, *_cells(each.copied_gb_per_s)))
        rows.append(("GB/s read", each.threads, *_cells(each.read_gb_per_s)))
    return Table(
        "floors",
        "The machine's own floors",
        ("what", "threads", "median", "95 % from", "to"),
        tuple(rows),
        "Independent square roots of numbers in the nearest cache; memory far beyond the caches.",
    )


def _roots_s(n_counts: int, floor: Floors) -> float:
    """Time of the square roots alone: one for each pixel, bin and scale."""
    return 2e-9 * n_counts * floor.root_ns.value


def _memory_s(n_counts: int, floor: Floors) -> float:
    """Time to read each count once."""
    return _BYTES_OF_A_COUNT * n_counts / (1e9 * floor.read_gb_per_s.value)


# -- Growth ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Growth:
    """Times along one axis of size.

    Parameters
    ----------
    over : str
        What grows: pixels, bins or threads.
    sizes : ndarray of int, shape (size,)
    threads : sequence of int
        On which tracking works, for each size.
    n_counts : sequence of int
        Pixels times bins.
    seconds : mapping
        Of each step of the work, shape (size, round).
    """

    over: str
    sizes: NDArray[np.integer]
    threads: Sequence[int]
    n_counts: Sequence[int]
    seconds: Mapping[str, Floats]


def growth_of_pixels(extent: Extent) -> Growth:
    """Larger images."""
    n_counts = [side * side * extent.bins for side in extent.sides]
    works = [_work(side, _gate(extent.bins)) for side in extent.sides]
    pixels = np.array(extent.sides) ** 2
    return _grown("pixels", pixels, [_threads(n) for n in n_counts], n_counts, works, extent)


def growth_of_bins(extent: Extent) -> Growth:
    """Gates of more bins, which become narrower."""
    n_counts = [extent.side**2 * n_bins for n_bins in extent.gates]
    works = [_work(extent.side, _gate(n_bins)) for n_bins in extent.gates]
    bins = np.array(extent.gates)
    return _grown("bins", bins, [_threads(n) for n in n_counts], n_counts, works, extent)


def growth_of_threads(extent: Extent) -> Growth:
    """More threads on the same image."""
    some = range(1, numba.get_num_threads() + 1)
    work = _work(extent.side_of_threads, _gate(extent.bins))
    works = [{name: on_threads(n, call) for name, call in work.items()} for n in some]
    n_counts = [extent.side_of_threads**2 * extent.bins] * len(some)
    return _grown("threads", np.array(some), list(some), n_counts, works, extent)


def _threads(n_counts: int) -> int:
    """On how many threads tracking works."""
    return numba.get_num_threads() if n_counts > SERIAL_BELOW else 1


_Work = dict[str, Callable[[], object]]


def _work(side: int, acquisition: Acquisition) -> _Work:
    scene = _scene(side)
    cube = simulate(scene, acquisition, FLUX, seed=1).cube
    blocks = to_blocks(cube)
    return {
        "simulation": lambda: simulate(scene, acquisition, FLUX, seed=1),
        "layout": lambda: to_blocks(cube),
        "tracking": lambda: track(blocks, SETTINGS),
    }


def _grown(
    over: str,
    sizes: NDArray[np.integer],
    threads: Sequence[int],
    n_counts: Sequence[int],
    works: Sequence[_Work],
    extent: Extent,
) -> Growth:
    calls = {f"{name} {i}": call for i, work in enumerate(works) for name, call in work.items()}
    taken = interleaved(calls, extent.growth_rounds)
    seconds = {
        name: np.array([taken[f"{name} {i}"] for i in range(len(works))]) for name in works[0]
    }
    return Growth(over, sizes, threads, n_counts, seconds)


def exponent(sizes: NDArray[np.integer], seconds: Floats) -> tuple[Interval, float]:
    """Power of the size with which a time grows, by least squares of logarithms.

    Parameters
    ----------
    sizes : ndarray, shape (size,), at least two
    seconds : ndarray, shape (size, round)

    Returns
    -------
    exponent : Interval
        Median of the rounds' own exponents, with its 95 % interval.
    departure : float
        Largest relative distance of a size's median time from the power law: how little it is one.
    """
    x, y = np.log(sizes), np.log(seconds)
    slopes = np.polynomial.polynomial.polyfit(x, y, 1)[1]
    middle = np.median(y, axis=1)
    fitted = np.polynomial.Polynomial.fit(x, middle, 1)
    return median_interval(slopes), float(np.expm1(np.abs(middle - fitted(x)).max()))


def exponents_table(grown: Iterable[Growth]) -> Table:
    """How each step of the work grows along each axis."""
    rows = []
    for each in grown:
        for name, seconds in each.seconds.items():
            found, departure = exponent(each.sizes, seconds)
            first, last = int(each.sizes[0]), int(each.sizes[-1])
            rows.append((name, each.over, first, last, *_cells(found), f"{departure:.0%}"))
    return Table(
        "exponents",
        "How the cost grows: time as a power of the size",
        ("step", "over", "from", "to", "exponent", "95 % from", "to ", "largest departure"),
        tuple(rows),
        "1 is linear growth, 0 none, -1 an ideal gain by threads. Where the departure is large "
        "time is no power of the size: small work is all overhead, small captures fit the caches, "
        "and only larger ones are shared by threads.",
    )


def growth_table(grown: Growth, known: Mapping[int, Floors]) -> Table:
    """Every size of one axis, and its distance to the floors."""
    rows = []
    for i, (size, threads, n_counts) in enumerate(
        zip(grown.sizes, grown.threads, grown.n_counts, strict=True)
    ):
        for name, seconds in grown.seconds.items():
            found = median_interval(1e3 * seconds[i])
            row = (int(size), name, *_cells(found), found.value * 1e6 / n_counts)
            floor = known.get(threads) if name == "tracking" else None
            rows.append((*row, *_of_floors(1e-3 * found.value, n_counts, floor)))
    columns = ("ms", "95 % from", "to", "ns per pixel and bin", "of roots", "of memory")
    return Table(
        f"growth_{grown.over}",
        f"Cost over {grown.over}",
        (grown.over, "step", *columns),
        tuple(rows),
        "'Of roots', 'of memory': how many times as long as the two square roots of each pixel and "
        "bin, and reading its count, take on as many threads: one up to two million counts. "
        "Layout works on one thread, the simulation on all.",
    )


def _of_floors(
    seconds: float, n_counts: int, floor: Floors | None
) -> tuple[float | str, float | str]:
    if floor is None:
        return "", ""
    return seconds / _roots_s(n_counts, floor), seconds / _memory_s(n_counts, floor)


def growth_plot(grown: Growth, known: Mapping[int, Floors]) -> Plot:
    """Time for a pixel and bin over the size: level where the cost grows as the size does."""
    taken = {name: np.median(grown.seconds[name], axis=1) for name in ("layout", "tracking")}
    for name, floor_s in (("floor: roots", _roots_s), ("floor: memory", _memory_s)):
        at = zip(grown.n_counts, grown.threads, strict=True)
        taken[name] = np.array([floor_s(n, known[threads]) for n, threads in at])
    curves = {name: 1e9 * seconds / grown.n_counts for name, seconds in taken.items()}
    return Plot(
        f"growth_{grown.over}",
        f"Time for a pixel and bin over {grown.over}",
        f"{grown.over}, as a power of 2",
        "ns per pixel and bin",
        np.log2(grown.sizes),
        curves,
    )


# -- Start -----------------------------------------------------------------------------------------


def start_table(starts: Floats, compiled: Floats) -> Table:
    """Where the time of a start goes, with compiled kernels on disk and without."""
    rows = []
    whole = np.column_stack([starts, starts.sum(axis=1)])
    for name, taken, once in zip(
        (*STAGES, "all"), whole.T, (*compiled, compiled.sum()), strict=True
    ):
        rows.append((name, *_cells(median_interval(taken)), float(once)))
    return Table(
        "start",
        "From the start of a process to its first range image, in seconds",
        ("stage", "kernels on disk", "95 % from", "to", "kernels compiled"),
        tuple(rows),
        "What the last column is longer by is compilation, once on a new machine (one start).",
    )


# -- What they share -------------------------------------------------------------------------------


def _scene(side: int) -> Scene:
    return scenes["uniform"](size=side)


def _gate(n_bins: int) -> Acquisition:
    """The usual gate in so many bins."""
    usual = Acquisition()
    return replace(usual, n_bins=n_bins, bin_width_s=usual.bin_width_s * usual.n_bins / n_bins)


def _cells(found: Interval) -> tuple[float, float, float]:
    return found.value, found.low, found.high
