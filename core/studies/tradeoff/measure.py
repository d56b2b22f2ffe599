"""Speed against accuracy: the time and memory of each configuration, and its errors.

A `Candidate` is a configuration: a method with its settings, on the whole capture or on a reduced
one. `study` measures candidates on simulations or captures and returns a `Point` for each, from
which `core.studies.tradeoff.pareto` chooses. All candidates see the same captures and are timed in
turn.

Errors are those of the whole image at the capture's own bin width: pixels that a reduction leaves
out take the estimate of their neighbour.
"""

from __future__ import annotations

import copy
import math
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property, partial
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.checks import require
from core.deprecation import renamed
from core.estimators import ESTIMATORS, Estimator, estimate
from core.inference.flux import flux_model_of
from core.inference.flux_model import FluxModel
from core.metrics import Interval
from core.parameters import Number, spec_of
from core.reductions import Reduction
from core.studies.middle import middle
from core.studies.statistics import MIN_REPEATS, median_interval
from core.studies.timing import interleaved, kernel_threads
from core.studies.tradeoff.surrogate import Simulation, surrogate_of
from core.studies.trials import (
    Method,
    Score,
    Summary,
    compare,
    default_methods,
    mapped,
    summary,
)
from core.tracking import TrackingParameters, tracking_signals

Source = Simulation | Capture

TILES = 16
"""Parts of a measured capture, in reading order, which take the place of seeds."""


def _all_signals(
    capture: Capture, flux: FluxModel, parameters: TrackingParameters
) -> tuple[Floats, Floats]:
    signals = tracking_signals(capture.cube, parameters, capture.gated_pulses)
    return signals.position_bin, signals.enhanced.max(axis=2)


KERNELS: Mapping[str, Mapping[str, Estimator]] = {
    "": ESTIMATORS,
    # The equations as written, a few rows of pixels at a time: temporaries stay in the cache.
    "float64, by rows": {"tracking": replace(ESTIMATORS["tracking"], locate=None)},
    "float64, signals kept": {"tracking": replace(ESTIMATORS["tracking"], locate=_all_signals)},
}
"""Other implementations of the same method; the registry's own (``""``) computes tracking in
float32 and keeps no signals."""


@dataclass(frozen=True)
class Candidate:
    """One configuration to range an image.

    Parameters
    ----------
    method : Method
    reduction : Reduction
        Applied to the capture first.
    kernel : str
        A key of `KERNELS`.
    threads : int, optional
        Threads of kernels; numba's setting where None.
    knows_truth : bool
        Whether its gate is cut to the true ranges of the targets.
    returns : int
        Surfaces of a pixel to look for, as for `core.estimate`; more than 1 only by the method's
        own kernel.

    Raises
    ------
    ValueError
        If the method has no such kernel.
    """

    method: Method
    reduction: Reduction = field(default_factory=Reduction)
    kernel: str = ""
    threads: int | None = None
    knows_truth: bool = False
    returns: int = 1

    is_told_the_light = renamed("knows_flux")

    def __post_init__(self) -> None:
        known = [kernel for kernel, of in KERNELS.items() if self.method.estimator in of]
        require("kernel", self.kernel, self.kernel in known, " or ".join(map(repr, known)))

    @property
    def estimator(self) -> Estimator:
        """The estimator with this kernel."""
        return KERNELS[self.kernel][self.method.estimator]

    @property
    def settings(self) -> Any:
        """The method's settings in bins of the reduced capture."""
        return rescaled(self.method.settings, self.reduction)

    @property
    def knows_flux(self) -> bool:
        """Whether it is given the true flux, which no instrument knows, as the oracle is."""
        return self.estimator.knows_flux

    @property
    def is_bound(self) -> bool:
        """Whether it knows what no instrument knows: it is never recommended."""
        return self.knows_flux or self.knows_truth

    def range_m(
        self, reduced: Capture, shape: tuple[int, int], flux: FluxModel | None = None
    ) -> Floats:
        """Return ranges (return, row, col) at full resolution `shape` from the reduced capture.

        A given flux model is not estimated again, except by methods with one of their own, and for
        several returns.
        """
        if self.returns > 1:
            with kernel_threads(self.threads):
                image = estimate(
                    reduced, self.method.estimator, self.settings, returns=self.returns
                )
            found = image.returns
            assert found is not None
            numbers = range(1, self.returns + 1)
            images = (found.image("range_m", number, reduced.shape) for number in numbers)
            return np.stack([self.reduction.spread(each, shape) for each in images])
        estimator = self.estimator
        if flux is not None and estimator.flux_model is flux_model_of:
            estimator = replace(estimator, flux_model=lambda _: flux)
        with kernel_threads(self.threads):
            bins, _ = estimator.delays(reduced, self.settings)
        range_m = self.reduction.spread(reduced.acquisition.bin_to_range_m(bins), shape)
        return range_m[np.newaxis]

    def __str__(self) -> str:
        plural = "" if self.threads == 1 else "s"
        threads = "" if self.threads is None else f"{self.threads} thread{plural}"
        returns = "" if self.returns == 1 else f"{self.returns} returns"
        reduction = "" if self.reduction == Reduction() else str(self.reduction)
        parts = (self.method.name, returns, reduction, self.kernel, threads)
        return ", ".join(filter(None, parts))


_MERGE_POWERS = {"bins": -1, "1/bin": 1}


def rescaled(settings: Any, reduction: Reduction) -> Any:
    """Return a method's settings in bins of the reduced capture.

    The metadata of each field decides (`core.parameters.Number`): lengths in bins are divided by
    the merging factor, what is given per bin is multiplied by it, and a bin of the gate moves with
    its start. A field whose metadata says otherwise keeps its value: at SBR 0.06, a smoothing
    kernel made narrower costs Shi's method a fifth of its correct estimates with 2 bins merged.
    """
    factor, first = reduction.merge, reduction.gate[0] if reduction.gate else 0
    changed = {}
    for each in fields(settings):
        spec, value = spec_of(each), getattr(settings, each.name)
        if not isinstance(spec, Number):
            continue
        power = spec.merge_power
        if power is None:
            power = _MERGE_POWERS.get(spec.unit, 0)
        new = value - first if spec.is_bin_index else value
        new = new * factor**power if power >= 0 else new / factor**-power
        new = min(max(math.ceil(new) if spec.whole else new, spec.least), spec.most)
        if new != value:
            changed[each.name] = new
    return replace(settings, **changed)


@dataclass(frozen=True)
class Point:
    """A candidate measured under one condition.

    Parameters
    ----------
    source : str
        Name of the scene or capture.
    sbr, signal : float or None
        The flux, where it is known.
    n_pulses : int or None
    shape : tuple of int
        Rows, columns and bins of the whole image.
    candidate : Candidate
    scores : tuple of Score
        One per seed, or per part (`TILES`) of a measured capture; the same for all points of a
        condition, so that differences are paired. Where pixels see two surfaces, both are targets.
    seconds : tuple of float
        Times to reduce a capture and range it with known flux model, one per round; rounds are
        shared by all points of a condition.
    flux_s : tuple of float
        Times to estimate the flux model of the reduced capture, needed once per capture.
    peak_bytes : int
        Peak memory beyond the capture itself, on one thread.
    note : str
        A remark on these errors.
    """

    source: str
    sbr: float | None
    signal: float | None
    n_pulses: int | None
    shape: tuple[int, int, int]
    candidate: Candidate
    scores: tuple[Score, ...]
    seconds: tuple[float, ...]
    flux_s: tuple[float, ...]
    peak_bytes: int
    note: str = ""

    light_s, light_ms = renamed("flux_s"), renamed("flux_ms")

    @property
    def condition(self) -> tuple[str, float | None, int | None]:
        """Source, SBR and pulses, which comparable points share."""
        return self.source, self.sbr, self.n_pulses

    @cached_property
    def summary(self) -> Summary:
        """Every figure of its errors."""
        return summary(self.scores)

    def rd(self, tolerance_bins: int = 3) -> Interval:
        """Return the restoration degree within 1, 2 or 3 bins, with a 95 % interval."""
        return self.summary.rd[tolerance_bins - 1]

    @property
    def rmse_m(self) -> Interval:
        """Root mean square error, with a 95 % interval."""
        return self.summary.rmse_m

    @cached_property
    def milliseconds(self) -> Interval:
        """Median of `seconds`, with a 95 % interval."""
        return median_interval(1e3 * np.array(self.seconds))

    @cached_property
    def flux_ms(self) -> Interval:
        """Median of `flux_s`, with a 95 % interval."""
        return median_interval(1e3 * np.array(self.flux_s))

    @property
    def ns_per_pixel_bin(self) -> float:
        """Time per pixel and bin of the whole image."""
        return self.milliseconds.value * 1e6 / math.prod(self.shape)

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings that reproduce it, as JSON."""
        return {
            "source": self.source,
            "sbr": self.sbr,
            "signal": self.signal,
            "n_pulses": self.n_pulses,
            "method": self.candidate.method.estimator,
            "parameters": asdict(self.candidate.settings),
            **asdict(self.candidate.reduction),
            "kernel": self.candidate.kernel,
            "returns": self.candidate.returns,
            "threads": self.candidate.threads,
        }


MERGES = (1, 2, 4)
VARIED = ("tracking", "cfar", "coates", "likelihood")
"""Methods that make up Pareto fronts, of which more variations are measured."""

RETURNING = ("likelihood", "image_posterior")
"""Methods of which two returns of a pixel are measured, by itself and with its neighbours."""


def candidates(methods: Sequence[Method] = (), merges: Sequence[int] = MERGES) -> list[Candidate]:
    """Return methods (by default all registered ones) with each number of bins merged.

    Those of `RETURNING` also with two returns.
    """
    chosen = methods or default_methods(with_motion=True)
    return [
        *(Candidate(method, Reduction(merge=merge)) for method in chosen for merge in merges),
        *(Candidate(method, returns=2) for method in chosen if method.name in RETURNING),
    ]


def variations(window: tuple[int, int] | None = None) -> list[Candidate]:
    """Return the methods `VARIED` with other reductions and kernels.

    Parameters
    ----------
    window : tuple of int, optional
        First bin and end of a gate that holds the targets, where these are known.
    """
    reductions = [Reduction(skip=2), Reduction(skip=4), Reduction(pool=2)]
    reductions += [Reduction(merge=2, pool=2), Reduction(merge=4, pool=2)]
    cut = [Reduction(gate=window), Reduction(gate=window, merge=2)] if window else []
    chosen = [each for each in default_methods() if each.name in VARIED]
    return [
        *(Candidate(method, each) for method in chosen for each in reductions),
        *(Candidate(method, each, knows_truth=True) for method in chosen for each in cut),
        *(
            Candidate(method, kernel=kernel)
            for method in chosen
            for kernel, of in KERNELS.items()
            if kernel and method.estimator in of
        ),
    ]


def study(
    plan: Sequence[tuple[Source, Sequence[Candidate]]],
    *,
    seeds: Sequence[int] = range(8),
    repeats: int = 9,
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Point]:
    """Measure candidates.

    Parameters
    ----------
    plan : sequence
        Sources and the candidates that range them. A `Simulation` is simulated with each seed. A
        `Capture` with a truth is scored by parts (`TILES`); one without is replaced by a simulation
        like it (`surrogate_of`); of a large one the middle is taken (`core.studies.middle`). The
        points' notes say so. Candidates that need an unknown flux, pulses in order, or a larger
        capture, are left out, and those that look for two surfaces where no pixel is known to have
        them: their second returns are all false.
    seeds : sequence of int
        At least 2.
    repeats : int
        Rounds of timing, at least `MIN_REPEATS`.
    processes : int
        Share the scoring. Memory is always measured in another process, so a script that calls
        this needs its ``if __name__ == "__main__"``. Times are taken afterwards, in this process.
    progress : callable
        ``(images ranged, images in all)``, called at the start and whenever images are
        done; an exception that it raises cancels the study.

    Returns
    -------
    list of Point
        In the order of the plan.

    Raises
    ------
    ValueError
        If there is no target, or there are too few seeds or repeats.
    """
    require("seeds", len(seeds), len(seeds) >= 2, "at least 2")
    require("repeats", repeats, repeats >= MIN_REPEATS, f"at least {MIN_REPEATS}")
    known = [applicable(source, configurations) for source, configurations in plan]
    pieces = [
        Piece(place, source, tuple(configurations), seed)
        for place, (source, configurations) in enumerate(known)
        for seed in (seeds if isinstance(source, Simulation) else seeds[:1])
    ]
    timed = sum((repeats + 2) * len(each) for _, each in known)  # warm-up and memory included
    of = sum(len(piece.candidates) for piece in pieces) + timed
    done = 0

    def advance(n: int) -> None:
        nonlocal done
        done += n
        progress(done, of)

    advance(0)
    scores: dict[tuple[int, int], list[list[Score]]] = {}
    for piece, found in mapped(scored, pieces, processes):
        scores[piece.place, piece.seed] = found
        advance(len(piece.candidates))
    peaks: dict[int, list[int]] = {}
    firsts = [piece for piece in pieces if piece.seed == seeds[0]]
    for piece, held in mapped(held_bytes, firsts, 1, in_new_process=True):
        peaks[piece.place] = held
        advance(len(piece.candidates))
    points = []
    for place, (source, configurations) in enumerate(known):
        per_seed = [found for (at, _), found in sorted(scores.items()) if at == place]
        fresh = _FreshCapture(_capture(source, seeds[0]), configurations)
        seconds, flux_s = _times(fresh, configurations, repeats, advance)
        for i, candidate in enumerate(configurations):
            each = tuple(score for found in per_seed for score in found[i])
            times = seconds[i], flux_s[candidate.reduction]
            points.append(_point(source, candidate, each, *times, peaks[place][i]))
    return points


def studied(capture: Capture) -> Source:
    """Return what is studied instead of a capture: itself, its middle, or its surrogate.

    Raises
    ------
    ValueError
        If it has no truth and no pixel is clear enough for a surrogate.
    """
    part = middle(capture)
    return surrogate_of(part, part.source) if part.truth_range_m is None else part


def applicable(
    source: Source, configurations: Sequence[Candidate]
) -> tuple[Source, list[Candidate]]:
    """Return what is studied instead of a source, and the candidates that can range it.

    Raises
    ------
    ValueError
        If there is no target; as `studied`.
    """
    source = studied(source) if isinstance(source, Capture) else source
    capture = _capture(source, 0)
    targets = int(np.isfinite(np.asarray(capture.truth_range_m)).sum())
    require("targets", targets, targets > 0, "a scene in which some pixel sees a surface")
    has_flux = capture.signal is not None and capture.background is not None
    shape = (*capture.shape, capture.acquisition.n_bins)
    most = len(source.scene.surfaces_m) if isinstance(source, Simulation) else 1
    return source, [
        each
        for each in configurations
        if each.reduction.fits(shape)
        and (has_flux or not each.knows_flux)
        and each.returns <= most
        and (capture.groups is not None or not each.estimator.follows_motion)
    ]


def _capture(source: Source, seed: int) -> Capture:
    return source.capture(seed) if isinstance(source, Simulation) else source


class Piece(NamedTuple):
    """Work of one process; `place` is that of its source in a plan."""

    place: int
    source: Source
    candidates: tuple[Candidate, ...]
    seed: int


def scored(piece: Piece) -> list[list[Score]]:
    """Score each candidate on one capture: once, or once per part of a measured one."""
    capture, source = _capture(piece.source, piece.seed), piece.source
    acquisition = capture.acquisition
    if isinstance(source, Simulation):
        truth_m, parts = source.scene.surfaces_m, 1
    else:
        truth_m, parts = np.asarray(capture.truth_range_m)[np.newaxis], TILES
    surfaces_m = truth_m.reshape(len(truth_m), -1)
    targets = np.array_split(np.flatnonzero(np.isfinite(surfaces_m).any(axis=0)), parts)
    reduced = {each.reduction: each.reduction.of(capture) for each in piece.candidates}
    scores = []
    for candidate in piece.candidates:
        flux_model_of(reduced[candidate.reduction])
        started = perf_counter()
        range_m = candidate.range_m(reduced[candidate.reduction], capture.shape)
        seconds = perf_counter() - started
        found_m = range_m.reshape(len(range_m), -1)
        scores.append(
            [
                compare(found_m[:, part], surfaces_m[:, part], acquisition, seconds)
                for part in targets
                if part.size
            ]
        )
    return scores


class _FreshCapture:
    """A capture with known flux models, of which no other result is cached."""

    def __init__(self, capture: Capture, configurations: Sequence[Candidate]) -> None:
        self._capture = replace(capture)
        self.reduced = {
            each.reduction: each.reduction.of(copy.copy(self._capture)) for each in configurations
        }
        self._flux = {key: flux_model_of(copy.copy(each)) for key, each in self.reduced.items()}

    def range(self, candidate: Candidate) -> None:
        """Reduce and range it."""
        reduced = candidate.reduction.of(copy.copy(self._capture))
        candidate.range_m(reduced, self._capture.shape, self._flux[candidate.reduction])

    def estimate_flux(self, reduction: Reduction) -> None:
        """Estimate the flux model of the reduced capture again."""
        flux_model_of(copy.copy(self.reduced[reduction]))


def held_bytes(piece: Piece) -> list[int]:
    """Return the peak memory of each candidate; to be called in a process without other work.

    The trace covers the whole process, and stopping it can crash one in which kernels allocate at
    the same time (python/cpython#128679).
    """
    fresh = _FreshCapture(_capture(piece.source, piece.seed), piece.candidates)
    held = []
    for each in piece.candidates:
        fresh.range(each)  # loads and compiles what it needs
        tracemalloc.start()
        fresh.range(each)
        held.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return held


def _times(
    fresh: _FreshCapture,
    configurations: Sequence[Candidate],
    repeats: int,
    advance: Callable[[int], None],
) -> tuple[list[Floats], dict[Reduction, Floats]]:
    """Return the seconds per round of each candidate, and of estimating the flux."""
    calls: dict[str, Callable[[], object]] = {
        "progress": partial(advance, len(configurations)),  # once a round, not timed with others
        **{
            f"flux, {reduction}": partial(fresh.estimate_flux, reduction)
            for reduction in fresh.reduced
        },
        **{f"{i}": partial(fresh.range, each) for i, each in enumerate(configurations)},
    }
    taken = interleaved(calls, repeats)
    return [taken[f"{i}"] for i in range(len(configurations))], {
        reduction: taken[f"flux, {reduction}"] for reduction in fresh.reduced
    }


def _point(
    source: Source,
    candidate: Candidate,
    scores: tuple[Score, ...],
    seconds: Floats,
    flux_s: Floats,
    peak_bytes: int,
) -> Point:
    sbr = signal = None
    if isinstance(source, Simulation):
        name, rows_cols, note = source.name, np.shape(source.scene.range_m), source.note
        sbr, signal = source.flux.sbr, source.flux.signal
    else:
        name, rows_cols, note = source.source, source.shape, "one capture, scored by its parts"
    return Point(
        name,
        sbr,
        signal,
        source.acquisition.n_pulses,
        (rows_cols[0], rows_cols[1], source.acquisition.n_bins),
        candidate,
        scores,
        tuple(seconds.tolist()),
        tuple(flux_s.tolist()),
        peak_bytes,
        note,
    )
