"""Monte Carlo trials: every method on the same simulated captures, resumable, on all cores."""

from __future__ import annotations

import json
import math
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, astuple, dataclass, replace
from functools import cache
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numba
import numpy as np

import core
from core import metrics
from core.acquisition import Acquisition, Floats, Flux
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.inference.flux import flux_model_of
from core.metrics import Interval
from core.scene import scenes
from core.simulation import simulate
from core.studies.statistics import mean_interval

__all__ = [
    "Condition",
    "Method",
    "Results",
    "Score",
    "as_they_come",
    "default_methods",
    "trials",
]

TOLERANCES_BINS = (1, 2, 3)


@dataclass(frozen=True)
class Condition:
    """A built-in scene and its flux; for scenes with random depths the seed draws these, too."""

    scene: str
    sbr: float
    signal: float = 0.1041
    depths_bin: tuple[float, float] = (20.0, 94.0)
    """Bins between which the depths of the scene ``uniform`` lie; no other scene uses them."""
    n_pulses: int = 1000

    def capture(self, seed: int) -> Capture:
        """Simulate one capture."""
        drawn: dict[str, Any] = {"seed": seed} if self.scene in ("uniform", "wall") else {}
        if self.scene == "uniform":
            drawn["first_bin"], drawn["last_bin"] = self.depths_bin
        scene = scenes[self.scene](**drawn)
        acquisition = replace(scene.acquisition, n_pulses=self.n_pulses)
        return simulate(scene, acquisition, Flux(self.signal, self.sbr), seed=seed)


@dataclass(frozen=True)
class Method:
    """An estimator with settings, under a name of its own."""

    name: str
    estimator: str
    settings: Any


def default_methods(with_motion: bool = False) -> list[Method]:
    """Return every registered estimator with its default settings.

    Those that follow motion only if asked for: most captures keep no pulses in order.
    """
    return [
        Method(name, name, each.parameters())
        for name, each in ESTIMATORS.items()
        if with_motion or not each.follows_motion
    ]


as_they_come = default_methods  # deprecated name, to be removed after the next release


@dataclass(frozen=True)
class Score:
    """One method on one capture: counts and sums, which add up over captures."""

    restored: tuple[int, ...]
    """Target pixels within each of `TOLERANCES_BINS`."""
    targets: int
    answered: int
    """Target pixels with an estimate."""
    absolute_m: float
    """Sum of absolute errors over them; the following are sums, too."""
    signed_m: float
    square_m2: float
    inlier_square_m2: float
    """Over errors within 3 bins."""
    seconds: float
    gate_m: float
    """Length of the gate, the largest possible error."""


def score(capture: Capture, method: Method) -> Score:
    """Range a capture by one method and compare with its truth."""
    flux_model_of(capture)  # estimated once per capture, whatever the method
    started = perf_counter()
    bins, _ = ESTIMATORS[method.estimator].delays(capture, method.settings)
    seconds = perf_counter() - started
    acquisition, truth_m = capture.acquisition, np.asarray(capture.truth_range_m)
    ranges_m = acquisition.bin_to_range_m(bins)[np.newaxis], truth_m[np.newaxis]
    return compare(*ranges_m, acquisition, seconds)


def compare(range_m: Floats, truth_m: Floats, acquisition: Acquisition, seconds: float) -> Score:
    """Score estimates (return, ...) against the truth (surface, ...).

    Where a pixel has several of either, targets are surfaces, as `metrics.surfaces_found` counts
    them, and errors those of the nearest return.
    """
    bin_m = acquisition.bin_length_m
    within = [metrics.surfaces_found(range_m, truth_m, t * bin_m) for t in TOLERANCES_BINS]
    error = metrics.surface_errors_m(range_m, truth_m)
    error = error[np.isfinite(error)]
    inlier = error[np.abs(error) <= TOLERANCES_BINS[-1] * bin_m + 5e-7]
    return Score(
        tuple(hits for hits, _ in within),
        within[0][1],
        error.size,
        float(np.abs(error).sum()),
        float(error.sum()),
        float((error**2).sum()),
        float((inlier**2).sum()),
        seconds,
        acquisition.gate_length_m,
    )


@dataclass(frozen=True)
class Summary:
    """One method under one condition, over all captures; intervals cover 95 %."""

    rd: tuple[Interval, ...]
    """Restoration degree within each of `TOLERANCES_BINS`, with Wilson intervals."""
    rmse_m: Interval
    """With Student's interval of the logarithm of the mean square over captures, which is never
    below 0, cut to the length of the gate."""
    mae_m: float
    bias_m: float
    inlier_rmse_m: float
    answered: float
    """Share of target pixels with an estimate."""
    rd_variance: float
    """Variance of the restoration degree within 3 bins over captures, probably the paper's Var."""
    milliseconds: float
    """Median over captures, on this machine."""


def summary(scores: Sequence[Score]) -> Summary:
    """Add up scores over at least two captures."""
    targets, answered = (sum(getattr(s, name) for s in scores) for name in ("targets", "answered"))
    hits = np.array([s.restored for s in scores])

    def mean(name: str, of: int) -> float:
        return sum(getattr(s, name) for s in scores) / of if of else math.nan

    squares = [s.square_m2 / s.answered if s.answered else np.nan for s in scores]
    mean_square = mean_interval(np.array(squares))
    rmse_m = math.sqrt(mean_square.value)
    most_m = max(s.gate_m for s in scores)
    ratio = math.exp((mean_square.high / mean_square.value - 1) / 2) if rmse_m else 1.0
    return Summary(
        rd=tuple(metrics.wilson(int(h), targets) for h in hits.sum(axis=0)),
        rmse_m=Interval(rmse_m, rmse_m / ratio, min(rmse_m * ratio, max(rmse_m, most_m))),
        mae_m=mean("absolute_m", answered),
        bias_m=mean("signed_m", answered),
        inlier_rmse_m=math.sqrt(mean("inlier_square_m2", int(hits[:, -1].sum()))),
        answered=answered / targets,
        rd_variance=metrics.rd_variance(hits[:, -1] / [s.targets for s in scores]),
        milliseconds=1e3 * float(np.median([s.seconds for s in scores])),
    )


Results = dict[tuple[Condition, str], list[Score]]
"""Scores in the order of the seeds, by condition and name of the method."""

_SEEDS_PER_PIECE = 5  # large enough to be worth a process, small enough to lose


def trials(
    plan: Mapping[Condition, Sequence[Method]],
    seeds: Sequence[int],
    *,
    store: Path | None = None,
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Results:
    """Score every method of a plan on one capture per seed.

    Parameters
    ----------
    plan : mapping
        The methods to run under each condition.
    seeds : sequence of int
        The same for every condition and method, so that differences are paired.
    store : path, optional
        A file to which each finished piece of work is appended and from which finished pieces are
        read: an interrupted run continues where it stopped.
    processes : int
        Does not affect the numbers.
    progress : callable
        ``(pieces done, pieces in all)``, called after each piece.

    Returns
    -------
    dict
    """
    pieces = [
        (condition, tuple(methods), tuple(seeds[first : first + _SEEDS_PER_PIECE]))
        for condition, methods in plan.items()
        for first in range(0, len(seeds), _SEEDS_PER_PIECE)
    ]
    known = dict(_read(store)) if store else {}
    if store and store.exists() and not store.read_bytes().endswith(b"\n"):
        with store.open("a", encoding="utf-8") as file:
            file.write("\n")  # ends a line that an interruption cut short
    done = {piece: known[_key(piece)] for piece in pieces if _key(piece) in known}
    progress(len(done), len(pieces))
    missing = [piece for piece in pieces if piece not in done]
    for piece, scores in mapped(_score_piece, missing, processes):
        done[piece] = scores
        if store:
            with store.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"piece": _key(piece), "scores": scores}) + "\n")
        progress(len(done), len(pieces))
    results: Results = {}
    for piece in pieces:
        condition, methods, _ = piece
        for per_seed in done[piece]:
            for method, (restored, *rest) in zip(methods, per_seed, strict=True):
                so_far = results.setdefault((condition, method.name), [])
                so_far.append(Score(tuple(restored), *rest))
    return results


_Piece = tuple[Condition, tuple[Method, ...], tuple[int, ...]]
_Scores = list[list[Any]]
Piece = TypeVar("Piece")
Found = TypeVar("Found")


def mapped(
    work: Callable[[Piece], Found],
    pieces: Sequence[Piece],
    processes: int,
    in_new_process: bool = False,
) -> Iterator[tuple[Piece, Found]]:
    """Yield pieces and their results as they finish; `work` is a module-level function.

    With one process the work is done in this one, unless `in_new_process`.
    """
    if processes == 1 and not in_new_process:
        yield from ((piece, work(piece)) for piece in pieces)
        return
    with process_pool(processes) as pool:
        futures = {pool.submit(work, piece): piece for piece in pieces}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def process_pool(processes: int) -> ProcessPoolExecutor:
    """Return a pool of new processes, each of which runs kernels on one thread."""
    # A forked process would inherit the state of kernel threads without the threads.
    return ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=numba.set_num_threads,
        initargs=(1,),
    )


def _score_piece(piece: _Piece) -> _Scores:
    condition, methods, seeds = piece
    scores = []
    for seed in seeds:
        capture = condition.capture(seed)
        scores.append([list(astuple(score(capture, method))) for method in methods])
    return scores


def _key(piece: _Piece) -> str:
    """Return a digest of everything that the numbers of a piece depend on."""
    condition, methods, seeds = piece
    parts = [asdict(condition), [[m.estimator, asdict(m.settings)] for m in methods], seeds]
    return sha256((json.dumps(parts, sort_keys=True) + code_digest()).encode()).hexdigest()


@cache
def code_digest() -> str:
    """Return a digest of the code, so that results of another version are not reused."""
    root = Path(core.__file__).parent
    sources = sorted(p for p in root.rglob("*.py") if "tests" not in p.parts)
    return sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


def _read(store: Path) -> Iterator[tuple[str, _Scores]]:
    """Yield the pieces of a store; a line that an interruption cut short is left out."""
    if not store.exists():
        return
    for line in store.read_text(encoding="utf-8").splitlines():
        try:
            stored = json.loads(line)
        except json.JSONDecodeError:
            continue
        yield stored["piece"], stored["scores"]
