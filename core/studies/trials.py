"""Many simulated captures, every method on each of them: paired seeds, resumable, on all cores."""

from __future__ import annotations

import json
import math
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, astuple, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from time import perf_counter
from typing import Any, TypeVar

import numba
import numpy as np
from scipy.special import stdtrit

import core
from core import metrics
from core.acquisition import Floats, Flux
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.inference.flux import flux_model_of
from core.metrics import Interval
from core.scene import scenes
from core.simulation import simulate

__all__ = ["Condition", "Method", "Results", "Score", "as_they_come", "trials"]

TOLERANCES_BINS = (1, 2, 3)


@dataclass(frozen=True)
class Condition:
    """A built-in scene under some light; the seed draws the depths, too, where they are random."""

    scene: str
    sbr: float
    signal: float = 0.1041

    def capture(self, seed: int) -> Capture:
        """One simulated capture."""
        scene = scenes[self.scene](**({"seed": seed} if self.scene == "uniform" else {}))
        return simulate(scene, scene.acquisition, Flux(self.signal, self.sbr), seed=seed)


@dataclass(frozen=True)
class Method:
    """An estimator with its settings, under a name of its own."""

    name: str
    estimator: str
    settings: Any


def as_they_come() -> list[Method]:
    """Every registered estimator with its defaults."""
    return [Method(name, name, each.parameters()) for name, each in ESTIMATORS.items()]


@dataclass(frozen=True)
class Score:
    """One method on one capture: counts and sums, which add up over captures."""

    restored: tuple[int, ...]
    """Target pixels within each of `TOLERANCES_BINS`."""
    targets: int
    answered: int
    absolute_m: float
    """Sum over the answered targets, of errors' magnitudes; the following likewise."""
    signed_m: float
    square_m2: float
    inlier_square_m2: float
    """Of errors within 3 bins."""
    seconds: float


def score(capture: Capture, method: Method) -> Score:
    """Range a capture by one method and compare with its truth."""
    flux_model_of(capture)  # once for each capture, whatever the method
    started = perf_counter()
    bins, _ = ESTIMATORS[method.estimator].delays(capture, method.settings)
    seconds = perf_counter() - started
    acquisition, truth_m = capture.acquisition, np.asarray(capture.truth_range_m)
    return compared(acquisition.bin_to_range_m(bins), truth_m, acquisition.bin_length_m, seconds)


def compared(range_m: Floats, truth_m: Floats, bin_m: float, seconds: float) -> Score:
    """An answer beside the truth, both of one shape, and what it took."""
    within = [metrics.restored(range_m, truth_m, t * bin_m) for t in TOLERANCES_BINS]
    error = metrics.errors_m(range_m, truth_m)
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
    )


@dataclass(frozen=True)
class Summary:
    """One method under one condition, over all captures; intervals cover 95 %."""

    rd: tuple[Interval, ...]
    """Restoration degree within each of `TOLERANCES_BINS`, with Wilson intervals."""
    rmse_m: Interval
    """With Student's interval of the mean square over captures."""
    mae_m: float
    bias_m: float
    inlier_rmse_m: float
    answered: float
    rd_variance: float
    """Of the restoration degree within 3 bins over captures: the paper's Var, most plausibly."""
    milliseconds: float
    """Median over captures, of this run on this machine."""


def summary(scores: Sequence[Score]) -> Summary:
    """Add up scores over captures, at least two of them."""
    targets, answered = (sum(getattr(s, name) for s in scores) for name in ("targets", "answered"))
    hits = np.array([s.restored for s in scores])

    def mean(name: str, of: int) -> float:
        return sum(getattr(s, name) for s in scores) / of if of else math.nan

    return Summary(
        rd=tuple(metrics.wilson(int(h), targets) for h in hits.sum(axis=0)),
        rmse_m=_root_of_mean([s.square_m2 / s.answered if s.answered else np.nan for s in scores]),
        mae_m=mean("absolute_m", answered),
        bias_m=mean("signed_m", answered),
        inlier_rmse_m=math.sqrt(mean("inlier_square_m2", int(hits[:, -1].sum()))),
        answered=answered / targets,
        rd_variance=metrics.rd_variance(hits[:, -1] / [s.targets for s in scores]),
        milliseconds=1e3 * float(np.median([s.seconds for s in scores])),
    )


def _root_of_mean(squares: Sequence[float]) -> Interval:
    """Root of a mean over captures, with Student's 95 % interval of that mean."""
    mean, count = float(np.mean(squares)), len(squares)
    half = float(stdtrit(count - 1, 0.975) * np.std(squares, ddof=1) / math.sqrt(count))
    return Interval(math.sqrt(mean), math.sqrt(max(mean - half, 0.0)), math.sqrt(mean + half))


Results = dict[tuple[Condition, str], list[Score]]
"""Scores in the order of the seeds, by condition and method's name."""

_SEEDS_AT_ONCE = 5  # a piece of work: large enough to start, small enough to lose


def trials(
    plan: Mapping[Condition, Sequence[Method]],
    seeds: Sequence[int],
    *,
    store: Path | None = None,
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Results:
    """Score every method of a plan on one capture for each seed.

    Parameters
    ----------
    plan : mapping
        The methods to run under each condition.
    seeds : sequence of int
        The same seeds under every condition and for every method: differences are paired.
    store : path, optional
        A file to which every finished piece is added at once, and from which pieces that are there
        already are taken: a run that was interrupted goes on where it stopped.
    processes : int
        Processes that share the work; the numbers do not depend on it.
    progress : callable
        ``(pieces done, pieces in all)``, called after each piece.

    Returns
    -------
    dict
    """
    pieces = [
        (condition, tuple(methods), tuple(seeds[first : first + _SEEDS_AT_ONCE]))
        for condition, methods in plan.items()
        for first in range(0, len(seeds), _SEEDS_AT_ONCE)
    ]
    known = dict(_read(store)) if store else {}
    if store and store.exists() and not store.read_bytes().endswith(b"\n"):
        with store.open("a", encoding="utf-8") as file:
            file.write("\n")  # behind a line that an interruption cut short
    done = {piece: known[_key(piece)] for piece in pieces if _key(piece) in known}
    progress(len(done), len(pieces))
    missing = [piece for piece in pieces if piece not in done]
    for piece, scores in computed(_work, missing, processes):
        done[piece] = scores
        if store:
            with store.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"piece": _key(piece), "scores": scores}) + "\n")
        progress(len(done), len(pieces))
    results: Results = {}
    for piece in pieces:
        condition, methods, _ = piece
        for per_seed in done[piece]:
            for method, values in zip(methods, per_seed, strict=True):
                restored, *rest = values
                found = Score(tuple(restored), *rest)
                results.setdefault((condition, method.name), []).append(found)
    return results


_Piece = tuple[Condition, tuple[Method, ...], tuple[int, ...]]
_Scores = list[list[Any]]
Piece = TypeVar("Piece")
Found = TypeVar("Found")


def computed(
    work: Callable[[Piece], Found], pieces: Sequence[Piece], processes: int
) -> Iterator[tuple[Piece, Found]]:
    """Do pieces of work, each as soon as a process is free; `work` is a module's own function."""
    if processes == 1:
        return ((piece, work(piece)) for piece in pieces)
    return apart(work, pieces, processes)


def apart(
    work: Callable[[Piece], Found], pieces: Sequence[Piece], processes: int = 1
) -> Iterator[tuple[Piece, Found]]:
    """The same in processes of their own in any case, of one thread each."""
    # Forked processes would inherit the state of kernels' threads without the threads.
    pool = ProcessPoolExecutor(
        processes,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=numba.set_num_threads,
        initargs=(1,),
    )
    with pool:
        futures = {pool.submit(work, piece): piece for piece in pieces}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _work(piece: _Piece) -> _Scores:
    condition, methods, seeds = piece
    scores = []
    for seed in seeds:
        capture = condition.capture(seed)
        scores.append([list(astuple(score(capture, method))) for method in methods])
    return scores


def _key(piece: _Piece) -> str:
    """What a piece is, told by everything that its numbers depend on."""
    condition, methods, seeds = piece
    told = [asdict(condition), [[m.estimator, asdict(m.settings)] for m in methods], seeds]
    return sha256((json.dumps(told, sort_keys=True) + _code()).encode()).hexdigest()


@cache
def _code() -> str:
    """A digest of the code: what another version computed is not taken for this one's."""
    root = Path(core.__file__).parent
    sources = sorted(p for p in root.rglob("*.py") if "tests" not in p.parts)
    return sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


def _read(store: Path) -> Iterator[tuple[str, _Scores]]:
    """Pieces in a store; a line that an interruption cut short is left out."""
    if not store.exists():
        return
    for line in store.read_text(encoding="utf-8").splitlines():
        try:
            stored = json.loads(line)
        except json.JSONDecodeError:
            continue
        yield stored["piece"], stored["scores"]
