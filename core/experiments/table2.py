"""The paper's Table 2: the car at 50 m under six SBRs, one set of parameters for all of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from core import metrics
from core.acquisition import Flux
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.metrics import Interval
from core.scene import Scene, scenes
from core.simulate import simulate
from core.tracking import TrackingParameters

PRINTED = {  # SBR: (RD, RMSE in metres), as printed
    0.08: (0.9989, 0.1607),
    0.07: (0.9957, 0.2585),
    0.06: (0.9786, 0.8122),
    0.05: (0.9282, 1.1173),
    0.04: (0.8124, 1.4779),
    0.03: (0.5916, 2.0705),
}

TOLERANCE_BINS = 3  # not printed; the one with which the paper's tables come out


@dataclass(frozen=True)
class Row:
    """One SBR: restoration degree and RMSE, ours with 95 % intervals, and the paper's."""

    sbr: float
    rd: Interval
    rmse_m: Interval
    answered: float
    printed_rd: float
    printed_rmse_m: float

    @property
    def as_good(self) -> bool:
        """Whether both figures are at least as good as the printed ones."""
        return self.rd.value >= self.printed_rd and self.rmse_m.value <= self.printed_rmse_m


def table2(settings: TrackingParameters, seeds: Sequence[int]) -> Iterator[Row]:
    """Compute the table, one row at a time.

    Parameters
    ----------
    settings : TrackingParameters
        The same for every row.
    seeds : sequence of int
        One simulated capture each, at least 2.
    """
    for sbr in PRINTED:
        yield row(sbr, captures(scenes["car"](), sbr, seeds), settings)


def captures(scene: Scene, sbr: float, seeds: Sequence[int]) -> Iterator[Capture]:
    """One simulated capture of a scene for each seed."""
    return (simulate(scene, scene.acquisition, Flux(sbr=sbr), seed=seed) for seed in seeds)


def row(sbr: float, of_captures: Iterable[Capture], settings: TrackingParameters) -> Row:
    """One row of the table, from captures of the car at that SBR."""
    rd, rmse_m, answered = accuracy(of_captures, settings)
    return Row(sbr, rd, rmse_m, answered, *PRINTED[sbr])


def accuracy(
    of_captures: Iterable[Capture], settings: TrackingParameters
) -> tuple[Interval, Interval, float]:
    """Restoration degree, RMSE in metres, and share answered, over captures with truth."""
    hits = targets = answers = 0
    mean_squares = []
    for capture in of_captures:
        truth_m = np.asarray(capture.truth_range_m)
        range_m = ESTIMATORS["tracking"](capture, settings).range_m
        tolerance_m = TOLERANCE_BINS * capture.acquisition.bin_length_m
        good, of = metrics.restored(range_m, truth_m, tolerance_m)
        hits, targets = hits + good, targets + of
        answers += round(metrics.coverage(range_m, truth_m) * of)
        mean_squares.append(metrics.rmse_m(range_m, truth_m) ** 2)
    return metrics.wilson(hits, targets), _root_of_mean(mean_squares), answers / targets


def _root_of_mean(squares: Sequence[float]) -> Interval:
    """Root of a mean over seeds, with Student's 95 % interval of that mean."""
    mean = float(np.mean(squares))
    count = len(squares)
    half = float(stdtrit(count - 1, 0.975) * np.std(squares, ddof=1) / math.sqrt(count))
    return Interval(math.sqrt(mean), math.sqrt(max(mean - half, 0.0)), math.sqrt(mean + half))


def as_markdown(rows: Sequence[Row]) -> str:
    """The table as a person reads it."""
    lines = [
        "| SBR | RD within 3 bins [95 %] | paper | RMSE m [95 %] | paper | answered | as good |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row.sbr:.2f} | {row.rd.value:.4f} [{row.rd.low:.4f}, {row.rd.high:.4f}] "
            f"| {row.printed_rd:.4f} "
            f"| {row.rmse_m.value:.3f} [{row.rmse_m.low:.3f}, {row.rmse_m.high:.3f}] "
            f"| {row.printed_rmse_m:.4f} | {row.answered:.4f} | {'yes' if row.as_good else 'no'} |"
        )
    return "\n".join(lines)
