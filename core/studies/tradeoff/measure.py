"""Speed against accuracy: what each way to range an image costs, and how near it comes.

A `Candidate` is a way to range: a method with its settings, on the whole capture or on less of it.
`study` measures candidates on simulations or captures and gives one `Point` for each: its errors on
the same captures as all others', and its times, taken in turn with all others'. The points are what
`core.studies.tradeoff.pareto` chooses from.

Errors are always those of the whole image at the capture's own bin width: what a reduced capture
leaves out takes its neighbour's answer.
"""

from __future__ import annotations

import copy
import math
import tracemalloc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any, NamedTuple

import numba
import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.checks import require
from core.estimators import ESTIMATORS, Estimator
from core.estimators.cfar import CfarParameters
from core.inference.flux import flux_model_of
from core.inference.flux_model import FluxModel
from core.metrics import Interval
from core.reductions import Reduction
from core.studies.timing import FEWEST_REPEATS, interleaved, median_interval
from core.studies.tradeoff.surrogate import Simulation, like
from core.studies.trials import (
    Method,
    Score,
    Summary,
    apart,
    as_they_come,
    compared,
    computed,
    summary,
)
from core.tracking import TrackingParameters, tracking_signals

Source = Simulation | Capture

TILES = 16
"""Parts into which the targets of a measured capture are shared out, in reading order: what seeds
are to a simulation."""

MOST_COUNTS = 2**21
"""Counts of a capture that is studied; of a larger one the middle of the image is."""


def _all_signals(
    capture: Capture, light: FluxModel, parameters: TrackingParameters
) -> tuple[Floats, Floats]:
    signals = tracking_signals(capture.cube, parameters, capture.gated_pulses)
    return signals.position_bin, signals.enhanced.max(axis=2)


KERNELS: Mapping[str, Mapping[str, Estimator]] = {
    "": ESTIMATORS,
    # The equations as written, some rows of pixels at a time: what is between stays in the cache.
    "float64, by rows": {"tracking": replace(ESTIMATORS["tracking"], locate=None)},
    "float64, signals kept": {"tracking": replace(ESTIMATORS["tracking"], locate=_all_signals)},
}
"""Ways to compute the same: as the registry does (for tracking float32, nothing kept between), and
others, for the methods that have any."""


@dataclass(frozen=True)
class Candidate:
    """One way to range an image.

    Parameters
    ----------
    method : Method
    reduction : Reduction
        What is left out of the capture first.
    kernel : str
        A key of `KERNELS`.
    threads : int, optional
        Threads of kernels; as many as numba is told to use where None.

    Raises
    ------
    ValueError
        If the method cannot be computed in that way.
    """

    method: Method
    reduction: Reduction = field(default_factory=Reduction)
    kernel: str = ""
    threads: int | None = None

    def __post_init__(self) -> None:
        known = [kernel for kernel, of in KERNELS.items() if self.method.estimator in of]
        require("kernel", self.kernel, self.kernel in known, " or ".join(map(repr, known)))

    @property
    def estimator(self) -> Estimator:
        """What ranges."""
        return KERNELS[self.kernel][self.method.estimator]

    @property
    def settings(self) -> Any:
        """The method's settings as they are for the reduced capture."""
        return fitted(self.method.settings, self.reduction)

    @property
    def is_told_the_light(self) -> bool:
        """Whether it rests on what no instrument knows, as the oracle does."""
        return self.estimator.flux_model is not flux_model_of

    def answer(
        self, reduced: Capture, shape: tuple[int, int], flux: FluxModel | None = None
    ) -> Floats:
        """Ranges in metres at full resolution `shape` from the reduced capture.

        A flux model that is given is not estimated again; the oracle keeps the true one.
        """
        estimator = self.estimator
        if flux is not None and not self.is_told_the_light:
            estimator = replace(estimator, flux_model=lambda _: flux)
        with _threads(self.threads):
            bins, _ = estimator.delays(reduced, self.settings)
        return self.reduction.spread(reduced.acquisition.bin_to_range_m(bins), shape)

    def __str__(self) -> str:
        plural = "" if self.threads == 1 else "s"
        threads = "" if self.threads is None else f"{self.threads} thread{plural}"
        reduction = "" if self.reduction == Reduction() else str(self.reduction)
        return ", ".join(filter(None, (self.method.name, reduction, self.kernel, threads)))


def fitted(settings: Any, reduction: Reduction) -> Any:
    """Settings for a capture as they are for the reduced one, whose bins are others.

    The tracking differentiators keep their motion in time: with bins F times as wide, an
    acceleration per square bin is F² times as large, and so is ``l``; T_n stays where it is. So do
    the lengths of the CFAR. The widths by which other methods smooth stay what they are in bins:
    made F times smaller they would smooth less than a bin, and at an SBR of 0.06 that costs Shi a
    fifth of its right answers with 2 bins merged.
    """
    factor, first = reduction.merge, reduction.gate[0] if reduction.gate else 0
    if isinstance(settings, TrackingParameters):
        t_n = max(0, math.ceil((settings.t_n - first) / factor))
        return replace(settings, l=settings.l * factor**2, t_n=t_n)
    if isinstance(settings, CfarParameters):
        return CfarParameters(
            settings.smoothing_bins / factor,
            math.ceil(settings.guard_bins / factor),
            math.ceil(settings.training_bins / factor),
        )
    return settings


@contextmanager
def _threads(n_threads: int | None) -> Iterator[None]:
    before = numba.get_num_threads()
    numba.set_num_threads(before if n_threads is None else n_threads)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@dataclass(frozen=True)
class Point:
    """A candidate, measured under one condition.

    Parameters
    ----------
    source : str
        The scene's name, or what a capture says of itself.
    sbr, signal : float or None
        The light, where it is known.
    n_pulses : int or None
    shape : tuple of int
        Rows, columns and bins of the image, before anything is left out.
    candidate : Candidate
    scores : tuple of Score
        One for each seed, or each of `TILES` parts of a measured capture; the same seeds (parts)
        for all points of a condition, which makes differences paired.
    seconds : tuple of float
        To reduce a capture and range it, the light that it tells of being known; one for each
        round, the same rounds for all points of a condition.
    light_s : tuple of float
        To find that light in the reduced capture, which is done once for each capture.
    peak_bytes : int
        Most that was held at once to reduce and range, beyond the capture itself, in a process of
        one thread.
    note : str
        What to know of these errors.
    """

    source: str
    sbr: float | None
    signal: float | None
    n_pulses: int | None
    shape: tuple[int, int, int]
    candidate: Candidate
    scores: tuple[Score, ...]
    seconds: tuple[float, ...]
    light_s: tuple[float, ...]
    peak_bytes: int
    note: str = ""

    @property
    def condition(self) -> tuple[str, float | None, int | None]:
        """What points must share to be compared: source, SBR and pulses."""
        return self.source, self.sbr, self.n_pulses

    @cached_property
    def summary(self) -> Summary:
        """Every figure of its errors."""
        return summary(self.scores)

    def rd(self, tolerance_bins: int = 3) -> Interval:
        """Restoration degree within 1, 2 or 3 bins of the capture, with a 95 % interval."""
        return self.summary.rd[tolerance_bins - 1]

    @property
    def rmse_m(self) -> Interval:
        """Root mean square error, with a 95 % interval."""
        return self.summary.rmse_m

    @cached_property
    def milliseconds(self) -> Interval:
        """Median of `seconds`, with a 95 % interval."""
        return _milliseconds(self.seconds)

    @cached_property
    def light_ms(self) -> Interval:
        """Median of `light_s`, with a 95 % interval."""
        return _milliseconds(self.light_s)

    @property
    def ns_per_pixel_bin(self) -> float:
        """Of the whole image, whatever is left out of it."""
        return self.milliseconds.value * 1e6 / math.prod(self.shape)

    @property
    def settings(self) -> dict[str, Any]:
        """What makes it again: words and numbers only, as JSON takes them."""
        return {
            "source": self.source,
            "sbr": self.sbr,
            "signal": self.signal,
            "n_pulses": self.n_pulses,
            "method": self.candidate.method.estimator,
            "parameters": asdict(self.candidate.settings),
            **asdict(self.candidate.reduction),
            "kernel": self.candidate.kernel,
            "threads": self.candidate.threads,
        }


def _milliseconds(seconds: Sequence[float]) -> Interval:
    found = median_interval(np.asarray(seconds))
    return Interval(found.value * 1e3, found.low * 1e3, found.high * 1e3)


class Cancelled(Exception):
    """Somebody no longer wants to know."""


MERGES = (1, 2, 4)
VARIED = ("tracking", "cfar", "coates", "likelihood")
"""Methods of which more is tried than merged bins: those that fronts are made of."""


def candidates(methods: Sequence[Method] = (), merges: Sequence[int] = MERGES) -> list[Candidate]:
    """Methods, all registered ones where none is given, with bins merged."""
    return [
        Candidate(method, Reduction(merge=merge))
        for method in methods or as_they_come()
        for merge in merges
    ]


def variations(
    methods: Sequence[Method] = (), window: tuple[int, int] | None = None
) -> list[Candidate]:
    """Methods, those `VARIED` where none is given, with one thing left out or done otherwise.

    Parameters
    ----------
    methods : sequence of Method
    window : tuple of int, optional
        First bin and end to which the gate is cut, as who knows where the targets are can cut it.
    """
    reductions = [Reduction(skip=2), Reduction(skip=4), Reduction(pool=2)]
    reductions += [Reduction(merge=2, pool=2), Reduction(merge=4, pool=2)]
    if window is not None:
        reductions += [Reduction(gate=window), Reduction(gate=window, merge=2)]
    chosen = methods or [each for each in as_they_come() if each.name in VARIED]
    return [Candidate(method, each) for method in chosen for each in reductions] + [
        Candidate(method, kernel=kernel)
        for method in chosen
        for kernel, of in KERNELS.items()
        if kernel and method.estimator in of
    ]


def study(
    plan: Sequence[tuple[Source, Sequence[Candidate]]],
    *,
    seeds: Sequence[int] = range(8),
    repeats: int = 9,
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> list[Point]:
    """Measure candidates.

    Parameters
    ----------
    plan : sequence
        What is looked at, and what ranges it. A `Simulation` is drawn with each seed. A `Capture`
        with a truth is scored by parts (`TILES`). One without is stood for by a simulation like it
        (`core.studies.tradeoff.surrogate.like`), and its points say so. Of a capture above
        `MOST_COUNTS` the middle is taken, and its points say so. Candidates are left out that must
        be told the light where it is not known, or that leave out more than there is.
    seeds : sequence of int
        At least 2.
    repeats : int
        Rounds of timing, at least `FEWEST_REPEATS`, in each of which every candidate of a source
        has its turn.
    processes : int
        That share the scoring. Memory is measured in a process of its own in any case, so a script
        that calls this needs its ``if __name__ == "__main__"``. Times are taken afterwards, in this
        process alone.
    progress : callable
        ``(images ranged, images in all)``.
    cancelled : callable
        Asked whenever `progress` is told.

    Returns
    -------
    list of Point
        In the order of the plan.

    Raises
    ------
    ValueError
        If there is no target, or the seeds or repeats are too few.
    Cancelled
        If `cancelled` said so.
    """
    require("seeds", len(seeds), len(seeds) >= 2, "at least 2")
    require("repeats", repeats, repeats >= FEWEST_REPEATS, f"at least {FEWEST_REPEATS}")
    known = [_known(source, ways) for source, ways in plan]
    pieces = [
        Piece(place, source, tuple(ways), seed)
        for place, (source, ways) in enumerate(known)
        for seed in (seeds if isinstance(source, Simulation) else seeds[:1])
    ]
    timed = sum((repeats + 2) * len(ways) for _, ways in known)  # a warm-up, and one for the memory
    of = sum(len(piece.candidates) for piece in pieces) + timed
    done = 0

    def told(n: int) -> None:
        nonlocal done
        if cancelled():
            raise Cancelled
        done += n
        progress(done, of)

    told(0)
    scores: dict[tuple[int, int], list[list[Score]]] = {}
    for piece, found in computed(scored, pieces, processes):
        scores[piece.place, piece.seed] = found
        told(len(piece.candidates))
    peaks: dict[int, list[int]] = {}
    firsts = [piece for piece in pieces if piece.seed == seeds[0]]
    for piece, held in apart(held_bytes, firsts):
        peaks[piece.place] = held
        told(len(piece.candidates))
    points = []
    for place, (source, ways) in enumerate(known):
        per_seed = [found for (at, _), found in sorted(scores.items()) if at == place]
        times = _times(_Untouched(_drawn(source, seeds[0]), ways), ways, repeats, told)
        for i, (candidate, taken) in enumerate(zip(ways, times, strict=True)):
            each = tuple(score for found in per_seed for score in found[i])
            points.append(_point(source, candidate, each, taken, peaks[place][i]))
    return points


def studied(capture: Capture) -> Source:
    """What a study looks at in a capture's place: itself, its middle, or its likeness.

    Raises
    ------
    ValueError
        If it has no truth, and nothing in it is clear enough to stand for one.
    """
    middle = _middle(capture)
    return like(middle, middle.source) if middle.truth_range_m is None else middle


def _known(source: Source, ways: Sequence[Candidate]) -> tuple[Source, list[Candidate]]:
    """What is studied in a source's place, and the candidates that know enough to range it."""
    source = studied(source) if isinstance(source, Capture) else source
    seen = _drawn(source, 0)
    targets = int(np.isfinite(np.asarray(seen.truth_range_m)).sum())
    require("targets", targets, targets > 0, "a scene in which some pixel sees a surface")
    is_lit = seen.signal is not None and seen.background is not None
    shape = (*seen.shape, seen.acquisition.n_bins)
    return source, [
        each
        for each in ways
        if each.reduction.fits(shape) and (is_lit or not each.is_told_the_light)
    ]


def _middle(capture: Capture) -> Capture:
    """The middle of an image that has too many counts."""
    if capture.cube.size <= MOST_COUNTS:
        return capture
    share = math.sqrt(MOST_COUNTS / capture.cube.size)
    sides = [max(1, int(size * share)) for size in capture.shape]
    rows, cols = (
        slice((size - side) // 2, (size - side) // 2 + side)
        for size, side in zip(capture.shape, sides, strict=True)
    )
    truth_m, signal = capture.truth_range_m, capture.signal
    return replace(
        capture,
        cube=np.ascontiguousarray(capture.cube[rows, cols]),
        truth_range_m=None if truth_m is None else truth_m[rows, cols],
        signal=None if signal is None else signal[rows, cols],
        source=f"{capture.source}; the middle {sides[0]} x {sides[1]} pixels",
    )


def _drawn(source: Source, seed: int) -> Capture:
    return source.capture(seed) if isinstance(source, Simulation) else source


class Piece(NamedTuple):
    """What one process scores at once; `place` is that of its source in a plan."""

    place: int
    source: Source
    candidates: tuple[Candidate, ...]
    seed: int


def scored(piece: Piece) -> list[list[Score]]:
    """Scores of each candidate on one capture: one, or one for each part of a measured one."""
    capture = _drawn(piece.source, piece.seed)
    truth_m = np.asarray(capture.truth_range_m)
    parts = 1 if isinstance(piece.source, Simulation) else TILES
    targets = np.array_split(np.flatnonzero(np.isfinite(truth_m)), parts)
    reduced = {each.reduction: each.reduction.of(capture) for each in piece.candidates}
    scores = []
    for candidate in piece.candidates:
        flux_model_of(reduced[candidate.reduction])
        started = perf_counter()
        range_m = candidate.answer(reduced[candidate.reduction], capture.shape)
        seconds = perf_counter() - started
        bin_m = capture.acquisition.bin_length_m
        scores.append(
            [
                compared(range_m.flat[some], truth_m.flat[some], bin_m, seconds)
                for some in targets
                if some.size
            ]
        )
    return scores


class _Untouched:
    """A capture of which nothing has been found but its light, however it is reduced."""

    def __init__(self, capture: Capture, ways: Sequence[Candidate]) -> None:
        self._capture = replace(capture)
        self._reduced = {
            each.reduction: each.reduction.of(copy.copy(self._capture)) for each in ways
        }
        self._flux = {way: flux_model_of(copy.copy(less)) for way, less in self._reduced.items()}

    def range(self, candidate: Candidate) -> None:
        """Reduce and range it."""
        less = candidate.reduction.of(copy.copy(self._capture))
        candidate.answer(less, self._capture.shape, self._flux[candidate.reduction])

    def light(self, reduction: Reduction) -> None:
        """Find the light of the reduced capture again."""
        flux_model_of(copy.copy(self._reduced[reduction]))


def held_bytes(piece: Piece) -> list[int]:
    """Most bytes that each candidate holds at once; for a process in which nothing else goes on.

    The trace is that of a whole process, and stopping it can crash one in which kernels allocate
    meanwhile (python/cpython#128679).
    """
    untouched = _Untouched(_drawn(piece.source, piece.seed), piece.candidates)
    held = []
    for each in piece.candidates:
        untouched.range(each)  # what is loaded or compiled for it is not its own
        tracemalloc.start()
        untouched.range(each)
        held.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return held


class _Times(NamedTuple):
    """What a candidate takes, round by round."""

    seconds: Floats
    light_s: Floats


def _times(
    untouched: _Untouched, ways: Sequence[Candidate], repeats: int, told: Callable[[int], None]
) -> list[_Times]:
    """Time candidates in turn."""
    lights = dict.fromkeys(each.reduction for each in ways)
    calls: dict[str, Callable[[], object]] = {
        "told": partial(told, len(ways)),  # once a round, within nobody's time
        **{f"light, {reduction}": partial(untouched.light, reduction) for reduction in lights},
        **{f"{i}": partial(untouched.range, each) for i, each in enumerate(ways)},
    }
    seconds = interleaved(calls, repeats)
    return [
        _Times(seconds[f"{i}"], seconds[f"light, {each.reduction}"]) for i, each in enumerate(ways)
    ]


def _point(
    source: Source,
    candidate: Candidate,
    scores: tuple[Score, ...],
    times: _Times,
    peak_bytes: int,
) -> Point:
    if isinstance(source, Simulation):
        name, rows_cols, note = source.name, np.shape(source.scene.range_m), source.note
        sbr, signal = source.flux.sbr, source.flux.signal
    else:
        name, rows_cols, note = source.source, source.shape, "one capture, scored by its parts"
        sbr, signal = None, None
    return Point(
        name,
        sbr,
        signal,
        source.acquisition.n_pulses,
        (rows_cols[0], rows_cols[1], source.acquisition.n_bins),
        candidate,
        scores,
        tuple(times.seconds.tolist()),
        tuple(times.light_s.tolist()),
        peak_bytes,
        note,
    )
