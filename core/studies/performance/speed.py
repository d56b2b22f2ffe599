"""Speed of the tracking estimator: against plain code, over sizes, from a cold start.

Only ratios of calls that were timed in turn make the study fail: they hold on any machine, loaded
or not, which milliseconds do not.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import perf_counter

import numba
import numpy as np

from core.acquisition import Acquisition, Floats, Flux
from core.capture import Capture
from core.checks import require
from core.estimators import ESTIMATORS, estimate
from core.inference import flux_model_of, tolerance_probability
from core.kernels.blocks import to_blocks
from core.kernels.parallel import SERIAL_BELOW
from core.metrics import Interval
from core.scene import scenes
from core.simulation import simulate
from core.studies.outputs import Table, table
from core.studies.performance.reference_implementations import (
    numpy_over_bins,
    plain_loop,
    take_roots,
)
from core.studies.performance.start import STAGES, first_image
from core.studies.statistics import MIN_REPEATS, median_interval
from core.studies.timing import interleaved, machine
from core.tracking import TrackingParameters, track, tracking_signals

SETTINGS = TrackingParameters(refine="none")  # as the plain loop
FLUX = Flux(0.1041, 0.06)

PLAIN = "plain numba loop over pixels"
ONE_SHOT, MOVE = "one shot: block layout and tracking", "tracking, once in blocks"
PUBLIC, NEW = "core.estimate, flux known", "core.estimate of a new capture"
SIMULATION, FIRST_IMAGE = "simulation of 1000 pulses", "process start to first range image"

MAX_MS = {ONE_SHOT: 0.4, MOVE: 0.25, NEW: 5.0, SIMULATION: 10.0, FIRST_IMAGE: 1000.0}
"""Targets for 64 x 64 x 100 counts on two cores."""
MIN_SPEEDUP = {ONE_SHOT: 25.0, PUBLIC: 10.0, NEW: 1.0}
"""Targets, over `PLAIN`."""

INTRODUCTION = (
    "Calls are timed in turn, in a random order in each round; the first round is not counted. "
    "Medians with 95 % intervals from order statistics.",
    "Missed milliseconds are reported; only ratios within this run make `python -m core speed` "
    "fail.",
)
_IN_A_ROW = 10  # short calls are repeated, as when a slider is dragged
_ROW, _ROOTS = 4096, 5000  # float32 numbers that stay in the nearest cache; roots of each


@dataclass(frozen=True)
class Extent:
    """Extent of the measurement: rounds of timing, starts, sides of square images, gates."""

    rounds: int = 21
    starts: int = 7
    side: int = 64
    bins: int = 100
    sizes: tuple[tuple[int, int], ...] = (
        (64, 100),
        (256, 100),
        (1024, 100),
        (64, 1024),
        (64, 4096),
    )
    """Side and bins of the captures over which the cost per count is compared."""
    fresh: tuple[tuple[int, int], ...] = ((64, 100), (256, 200))
    """Side and bins of the new captures whose estimate is timed stage by stage."""

    def __post_init__(self) -> None:
        for name in ("rounds", "starts"):
            repeats = getattr(self, name)
            require(name, repeats, repeats >= MIN_REPEATS, f"at least {MIN_REPEATS}")


def study(
    extent: Extent, progress: Callable[[int, int], None] = lambda done, of: None
) -> tuple[list[Table], list[str]]:
    """Measure everything; return the tables and a sentence for each speed-up that was lost."""
    progress(0, 5)
    root_ns = square_root_ns(extent.rounds)
    progress(1, 5)
    seconds = variants(extent)
    progress(2, 5)
    sizes = sizes_table(extent, root_ns)
    progress(3, 5)
    fresh = fresh_table(extent)
    progress(4, 5)
    compiled, starts = _starts(extent.starts)
    progress(5, 5)
    return [
        targets_table(seconds, starts),
        variants_table(seconds, extent.side**2 * extent.bins, root_ns),
        sizes,
        fresh,
        start_table(starts, compiled),
        machine(),
    ], regressions(seconds)


# -- Variants --------------------------------------------------------------------------------------


def variants(extent: Extent) -> dict[str, Floats]:
    """Return the seconds of each way to range one capture, shape (round,)."""
    scene, acquisition = scenes["uniform"](size=extent.side), _gate(extent.bins)
    capture = simulate(scene, acquisition, FLUX, seed=1)
    counts = capture.cube.reshape(-1, extent.bins)
    numbers, blocks, estimator = counts.astype(float), to_blocks(counts), ESTIMATORS["tracking"]
    estimate(capture, "tracking", SETTINGS)  # estimates its flux
    once: dict[str, Callable[[], object]] = {
        "numpy over bins": lambda: numpy_over_bins(numbers, SETTINGS),
        PLAIN: lambda: plain_loop(numbers, SETTINGS),
        "all signals": lambda: tracking_signals(counts, SETTINGS),
        "tracking, once in blocks, caches cold": lambda: track(blocks, SETTINGS),
        NEW: lambda: estimate(replace(capture), "tracking", SETTINGS),
        SIMULATION: lambda: simulate(scene, acquisition, FLUX, seed=1),
    }
    in_a_row: dict[str, Callable[[], object]] = {
        ONE_SHOT: lambda: track(to_blocks(counts), SETTINGS),
        "block layout": lambda: to_blocks(counts),
        MOVE: lambda: track(blocks, SETTINGS),
        "Estimator.delays, flux known": lambda: estimator.delays(capture, SETTINGS),
        PUBLIC: lambda: estimate(capture, "tracking", SETTINGS),
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


def variants_table(seconds: Mapping[str, Floats], n_counts: int, root_ns: Interval) -> Table:
    """Compare all variants with each other and with the square roots that they need."""
    return table(
        "variants",
        "64 x 64 x 100 counts, dual-scale tracking",
        seconds,
        {
            "variant": str,
            "ms [95 %]": lambda name: median_interval(1e3 * seconds[name]),
            "speed-up": lambda name: speedup(seconds, name).value,
            **_per_count(lambda name: (float(np.median(seconds[name])), n_counts), root_ns),
        },
        "One thread, except for simulation, flux and confidence of a new capture. Speed-up: over "
        f"the {PLAIN}. {_ROOFLINE}",
        _FORMATS,
    )


def sizes_table(extent: Extent, root_ns: Interval) -> Table:
    """Compare the cost of tracking over image sizes and gates."""
    calls, n_counts = {}, {}
    for side, bins in extent.sizes:
        name = f"{side} x {side} x {bins}"
        capture = simulate(scenes["uniform"](size=side), _gate(bins), FLUX, seed=1)
        calls[name] = partial(track, to_blocks(capture.cube), SETTINGS)
        n_counts[name] = capture.cube.size
    seconds = interleaved(calls, extent.rounds)
    return table(
        "sizes",
        f"Tracking over sizes, on up to {numba.get_num_threads()} threads",
        seconds,
        {
            "counts": str,
            "ms [95 %]": lambda name: median_interval(1e3 * seconds[name]),
            **_per_count(lambda name: (float(np.median(seconds[name])), n_counts[name]), root_ns),
        },
        f"Up to {SERIAL_BELOW / 1e6:.0f} million counts are ranged on one thread. {_ROOFLINE}",
        _FORMATS,
    )


FRESH_STAGES = ("capture", "block layout", "fluxes", "positions", "confidence", "total")
"""Stages of `core.estimate` with tracking, in order; positions include lag and refinement."""


def fresh_table(extent: Extent) -> Table:
    """Show where the estimate of a new capture takes its time."""
    columns = {}
    for side, bins in extent.fresh:
        capture = simulate(scenes["uniform"](size=side), _gate(bins), FLUX, seed=1)
        taken = np.array([stage_seconds(capture) for _ in range(extent.rounds + 1)])[1:]
        taken = np.column_stack([taken, taken.sum(axis=1)])
        columns[f"{side} x {side} x {bins}, ms [95 %]"] = map(median_interval, 1e3 * taken.T)
    return Table(
        "fresh",
        "core.estimate of a new capture, stage by stage",
        ("stage", *columns),
        tuple(zip(FRESH_STAGES, *columns.values(), strict=True)),
        "The time of fluxes does not depend on the number of pixels; the other stages grow "
        "with the counts, confidence also with the levels and bins of an echo.",
        dict.fromkeys(columns, ".3g"),
    )


def stage_seconds(capture: Capture) -> list[float]:
    """Return the seconds of each of `FRESH_STAGES`, but for their total."""
    marks = [perf_counter()]
    new = replace(capture)
    marks.append(perf_counter())
    new.blocks  # noqa: B018 - cached
    marks.append(perf_counter())
    flux_model_of(new)
    marks.append(perf_counter())
    bins, _ = ESTIMATORS["tracking"].delays(new, TrackingParameters())
    marks.append(perf_counter())
    tolerance_probability(new, bins)
    marks.append(perf_counter())
    return [after - before for before, after in pairwise(marks)]


_ROOFLINE = "Roofline: time of the two float32 square roots of each count on one thread."
_FORMATS = {"ms [95 %]": ".3g", "ns per count": ".3g", "speed-up": ".2f", "over roofline": ".2f"}


def _per_count(
    cost: Callable[[str], tuple[float, int]], root_ns: Interval
) -> dict[str, Callable[[str], float]]:
    """Return the columns that divide a time by a number of counts."""

    def ns(name: str) -> float:
        seconds, n_counts = cost(name)
        return 1e9 * seconds / n_counts

    return {"ns per count": ns, "over roofline": lambda name: ns(name) / (2 * root_ns.value)}


def square_root_ns(rounds: int) -> Interval:
    """Return the time of one independent float32 square root in the nearest cache."""
    numbers = np.random.default_rng(0).uniform(1, 2, _ROW).astype(np.float32)
    (seconds,) = interleaved({"": lambda: take_roots(numbers, _ROOTS)}, rounds).values()
    return median_interval(1e9 * seconds / (_ROW * _ROOTS))


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
