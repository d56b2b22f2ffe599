"""Speed of the tracking estimator: against plain code, as captures grow, from a cold start.

Only ratios of calls that were timed in turn make the study fail: they hold on any machine, loaded
or not, which milliseconds do not.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numba
import numpy as np

from core.acquisition import Acquisition, Floats, Flux
from core.checks import require
from core.estimators import ESTIMATORS, estimate
from core.kernels.blocks import to_blocks
from core.kernels.parallel import SERIAL_BELOW
from core.metrics import Interval
from core.scene import scenes
from core.simulation import simulate
from core.studies.outputs import Table, table
from core.studies.performance.reference_implementations import (
    fused_loop,
    numpy_over_bins,
    plain_loop,
)
from core.studies.performance.roofline import Roofline, roofline
from core.studies.performance.start import STAGES, first_image
from core.studies.statistics import MIN_REPEATS, median_interval
from core.studies.timing import interleaved, kernel_threads, machine
from core.tracking import TrackingParameters, track, tracking_signals

SETTINGS = TrackingParameters()
FLUX = Flux(0.1041, 0.06)

PLAIN = "plain numba loop over pixels"
ONE_SHOT, MOVE = "one shot: block layout and tracking", "tracking, once in blocks"
PUBLIC = "core.estimate, flux known"
SIMULATION, FIRST_IMAGE = "simulation of 1000 pulses", "process start to first range image"

MAX_MS = {ONE_SHOT: 0.4, MOVE: 0.25, SIMULATION: 10.0, FIRST_IMAGE: 1000.0}
"""Targets for 64 x 64 x 100 counts on two cores."""
MIN_SPEEDUP = {ONE_SHOT: 25.0, PUBLIC: 10.0}
"""Targets, over `PLAIN`."""

INTRODUCTION = (
    "Calls are timed in turn, in a random order in each round; the first round is not counted. "
    "Medians with 95 % intervals from order statistics.",
    "Missed milliseconds are reported; only ratios within this run make `python -m core speed` "
    "fail.",
)
_IN_A_ROW = 10  # short calls are repeated, as when a slider is dragged


@dataclass(frozen=True)
class Extent:
    """What is measured: rounds, square images of `side` pixels, gates of `bins`."""

    rounds: int = 21
    growth_rounds: int = 7
    starts: int = 7
    side: int = 64
    bins: int = 100
    sides: tuple[int, ...] = (64, 128, 256, 512, 1024)
    gates: tuple[int, ...] = (100, 256, 512, 1024, 2048, 4096)
    side_of_threads: int = 512
    roofline_bytes: int = 2**28

    def __post_init__(self) -> None:
        for name in ("rounds", "growth_rounds", "starts"):
            repeats = getattr(self, name)
            require(name, repeats, repeats >= MIN_REPEATS, f"at least {MIN_REPEATS}")


def study(
    extent: Extent, progress: Callable[[int, int], None] = lambda done, of: None
) -> tuple[list[Table], list[str]]:
    """Measure everything; return the tables and a sentence for each speed-up that was lost."""
    progress(0, 4)
    limit = roofline(extent.rounds, extent.roofline_bytes)
    progress(1, 4)
    seconds = variants(extent)
    progress(2, 4)
    grown = list(growth(extent))
    progress(3, 4)
    compiled, starts = _starts(extent.starts)
    progress(4, 4)
    return [
        targets_table(seconds, starts),
        variants_table(seconds, extent.side**2 * extent.bins, limit),
        growth_table(grown, limit),
        start_table(starts, compiled),
        limit.table(),
        machine(),
    ], regressions(seconds)


# -- Variants --------------------------------------------------------------------------------------


def variants(extent: Extent) -> dict[str, Floats]:
    """Return the seconds of each way to range one capture, shape (round,)."""
    scene, acquisition = scenes["uniform"](size=extent.side), _gate(extent.bins)
    capture = simulate(scene, acquisition, FLUX, seed=1)
    counts = capture.cube.reshape(-1, extent.bins)
    numbers, numbers_32 = counts.astype(float), counts.astype(np.float32)
    blocks, estimator = to_blocks(counts), ESTIMATORS["tracking"]
    estimate(capture, "tracking")  # estimates its flux
    once: dict[str, Callable[[], object]] = {
        "numpy over bins": lambda: numpy_over_bins(numbers, SETTINGS),
        "numpy over bins, float32": lambda: numpy_over_bins(numbers_32, SETTINGS),
        PLAIN: lambda: plain_loop(numbers, SETTINGS),
        "the same, fused": lambda: fused_loop(numbers, SETTINGS),
        "all signals": lambda: tracking_signals(counts, SETTINGS),
        "tracking, once in blocks, caches cold": lambda: track(blocks, SETTINGS),
        "core.estimate of a new capture": lambda: estimate(replace(capture), "tracking"),
        SIMULATION: lambda: simulate(scene, acquisition, FLUX, seed=1),
    }
    in_a_row: dict[str, Callable[[], object]] = {
        ONE_SHOT: lambda: track(to_blocks(counts), SETTINGS),
        "block layout": lambda: to_blocks(counts),
        MOVE: lambda: track(blocks, SETTINGS),
        "Estimator.delays, flux known": lambda: estimator.delays(capture, SETTINGS),
        PUBLIC: lambda: estimate(capture, "tracking"),
    }
    repeated = {name: _repeated(call) for name, call in in_a_row.items()}
    taken = interleaved(once | repeated, extent.rounds)
    return {name: s / (_IN_A_ROW if name in in_a_row else 1) for name, s in taken.items()}


def _repeated(call: Callable[[], object]) -> Callable[[], object]:
    def repeat() -> None:
        for _ in range(_IN_A_ROW):
            call()

    return repeat


def speedup(seconds: Mapping[str, Floats], name: str) -> Interval:
    """Return how many times faster a variant is than `PLAIN`, compared round by round."""
    return median_interval(seconds[PLAIN] / seconds[name])


def regressions(seconds: Mapping[str, Floats]) -> list[str]:
    """Return a sentence for each speed-up whose whole interval lies below its target."""
    found = {name: speedup(seconds, name) for name in MIN_SPEEDUP}
    return [
        f"{name}: {each.value:.1f} times faster than a {PLAIN} (at most {each.high:.1f}); "
        f"the target is {MIN_SPEEDUP[name]:g}."
        for name, each in found.items()
        if each.high < MIN_SPEEDUP[name]
    ]


def targets_table(seconds: Mapping[str, Floats], starts: Floats) -> Table:
    """Compare medians with the targets; `starts` has the shape (start, stage)."""
    known = {**seconds, FIRST_IMAGE: starts.sum(axis=1)}
    rows: list[tuple[str, str, Interval, str]] = []
    for name, most in MAX_MS.items():
        ms = median_interval(1e3 * known[name])
        rows.append((name, f"at most {most:g} ms", ms, "met" if ms.value <= most else "missed"))
    for name, least in MIN_SPEEDUP.items():
        times = speedup(seconds, name)
        reached = "met" if times.value >= least else "missed"
        rows.append((f"over a {PLAIN}: {name}", f"at least {least:g}", times, reached))
    columns = ("quantity", "target", "measured [95 %]", "")
    return Table("targets", "Targets", columns, tuple(rows), formats={columns[2]: ".3g"})


def variants_table(seconds: Mapping[str, Floats], n_counts: int, limit: Roofline) -> Table:
    """Compare all variants with each other and with the roofline of one thread."""
    return table(
        "variants",
        "64 x 64 x 100 counts, dual-scale tracking",
        seconds,
        {
            "variant": str,
            "ms [95 %]": lambda name: median_interval(1e3 * seconds[name]),
            "ns per count": lambda name: 1e9 * float(np.median(seconds[name])) / n_counts,
            "speed-up": lambda name: speedup(seconds, name).value,
            "over roofline": lambda name: (
                float(np.median(seconds[name])) / limit.seconds(n_counts, 1)
            ),
        },
        "One thread, except for the simulation and the flux of a new capture. Speed-up: over the "
        f"{PLAIN}. Roofline: the time of the two float32 square roots of each count.",
        {"ms [95 %]": ".3g", "ns per count": ".3g", "speed-up": ".2f", "over roofline": ".2f"},
    )


# -- Growth ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Growth:
    """Times of one step of the work along one axis, shape (size, round)."""

    step: str
    axis: str
    sizes: Sequence[int]
    n_counts: Sequence[int]
    threads: Sequence[int]
    seconds: Floats


def growth(extent: Extent) -> Iterator[Growth]:
    """Time simulation, block layout and tracking over pixels, bins and threads."""
    most = numba.get_num_threads()
    side, bins = extent.side, extent.bins
    axes = {
        "pixels": [(s * s, s, bins, most) for s in extent.sides],
        "bins": [(n, side, n, most) for n in extent.gates],
        "threads": [(n, extent.side_of_threads, bins, n) for n in range(1, most + 1)],
    }
    for axis, cases in axes.items():
        if len(cases) < 2:
            continue
        calls = {(step, i): f for i, case in enumerate(cases) for step, f in _work(*case[1:])}
        taken = interleaved({f"{s} {i}": f for (s, i), f in calls.items()}, extent.growth_rounds)
        n_counts = [side * side * n_bins for _, side, n_bins, _ in cases]
        # Small captures are ranged on one thread.
        threads = [n if c > SERIAL_BELOW else 1 for c, (*_, n) in zip(n_counts, cases, strict=True)]
        for step in dict.fromkeys(step for step, _ in calls):
            seconds = np.array([taken[f"{step} {i}"] for i in range(len(cases))])
            yield Growth(step, axis, [case[0] for case in cases], n_counts, threads, seconds)


def _work(side: int, n_bins: int, threads: int) -> list[tuple[str, Callable[[], object]]]:
    scene, acquisition = scenes["uniform"](size=side), _gate(n_bins)
    cube = simulate(scene, acquisition, FLUX, seed=1).cube
    blocks = to_blocks(cube)

    def tracked() -> None:
        with kernel_threads(threads):
            track(blocks, SETTINGS)

    def simulated() -> None:
        with kernel_threads(threads):
            simulate(scene, acquisition, FLUX, seed=1)

    return [
        ("simulation", simulated),
        ("block layout", lambda: to_blocks(cube)),
        ("tracking", tracked),
    ]


def exponent(sizes: Sequence[int], seconds: Floats) -> Interval:
    """Return the power of the size with which a time (size, round) grows, by least squares."""
    slopes = np.polynomial.polynomial.polyfit(np.log(sizes), np.log(seconds), 1)[1]
    return median_interval(slopes)


def growth_table(grown: Sequence[Growth], limit: Roofline) -> Table:
    """Show the exponent of each step along each axis, and the cost at both ends."""

    def cost(each: Growth, i: int) -> float:
        return 1e9 * float(np.median(each.seconds[i])) / each.n_counts[i]

    def over_roofline(each: Growth) -> float | str:
        if each.step != "tracking":
            return ""
        seconds = float(np.median(each.seconds[-1]))
        return seconds / limit.seconds(each.n_counts[-1], each.threads[-1])

    return table(
        "growth",
        "Growth: time as a power of the size",
        grown,
        {
            "step": lambda each: each.step,
            "over": lambda each: each.axis,
            "from": lambda each: each.sizes[0],
            "to": lambda each: each.sizes[-1],
            "exponent [95 %]": lambda each: exponent(each.sizes, each.seconds),
            "ns per count at first": lambda each: cost(each, 0),
            "at last": lambda each: cost(each, -1),
            "over roofline at last": over_roofline,
        },
        "1 is linear growth, 0 none, -1 an ideal gain by threads. Up to two million counts are "
        "ranged on one thread. Block layout always takes one thread.",
        {"exponent [95 %]": ".2f", "ns per count at first": ".3g", "at last": ".3g"},
    )


# -- Start -----------------------------------------------------------------------------------------


def _starts(n: int) -> tuple[Floats, Floats]:
    """Return the seconds of each stage of a start with an empty cache, and of n more starts."""
    with tempfile.TemporaryDirectory() as folder:
        compiled = first_image(Path(folder))
        return compiled, np.array([first_image(Path(folder)) for _ in range(n)])


def start_table(starts: Floats, compiled: Floats) -> Table:
    """Show the stages of a start with cached kernels, and of one that compiles them."""
    whole = np.column_stack([starts, starts.sum(axis=1)])
    rows = zip(
        (*STAGES, "total"),
        map(median_interval, whole.T),
        [*compiled.tolist(), float(compiled.sum())],
        strict=True,
    )
    columns = ("stage", "cached kernels [95 %]", "compiled kernels")
    title = "Process start to the first range image, in seconds"
    return Table("start", title, columns, tuple(rows), formats=dict.fromkeys(columns, ".3g"))


def _gate(n_bins: int) -> Acquisition:
    """Return the default gate divided into a number of bins."""
    default = Acquisition()
    width_s = default.bin_width_s * default.n_bins / n_bins
    return replace(default, n_bins=n_bins, bin_width_s=width_s)
