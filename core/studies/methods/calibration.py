"""Is a confidence of 0.9 right nine times in ten? For every method, on two scenes, at six SBRs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.estimators import ESTIMATORS, RangeImage
from core.inference.posterior import TOLERANCE_BINS
from core.metrics import Told, calibration_error, reliability
from core.studies.outputs import Table
from core.studies.paper.printed import TABLE_2
from core.studies.trials import Condition

METHODS = ("likelihood", "tracking", "coates", "peak")


def told_and_right(capture: Capture, image: RangeImage) -> tuple[Floats, NDArray[np.bool_]]:
    """Confidence of all answers, and whether each is right; where there is no surface it is wrong.

    Raises
    ------
    ValueError
        If the capture has no truth.
    """
    if capture.truth_range_m is None:
        raise ValueError("truth_range_m = None is not accepted: calibration needs a truth.")
    truth_bin = capture.acquisition.range_m_to_bin(capture.truth_range_m)
    error = np.abs(np.nan_to_num(image.bin - truth_bin, nan=np.inf))
    return image.confidence[image.valid], (error <= TOLERANCE_BINS)[image.valid]


@dataclass(frozen=True)
class Report:
    """One method on one scene at one SBR, or at all of them (``sbr`` is None)."""

    scene: str
    sbr: float | None
    method: str
    told: list[Told]

    @property
    def error(self) -> float:
        """Expected calibration error."""
        return calibration_error(self.told)


def reports(seeds: Sequence[int]) -> Iterator[Report]:
    """Compute the report, one method, scene and SBR at a time, and all SBRs together last."""
    for scene in ("uniform", "car"):
        pooled: dict[str, list[tuple[Floats, NDArray[np.bool_]]]] = {m: [] for m in METHODS}
        for sbr in TABLE_2:
            here: dict[str, list[tuple[Floats, NDArray[np.bool_]]]] = {m: [] for m in METHODS}
            for seed in seeds:
                capture = Condition(scene, sbr).capture(seed)
                for method in METHODS:
                    estimator = ESTIMATORS[method]
                    image = estimator(capture, estimator.parameters())
                    here[method].append(told_and_right(capture, image))
            for method in METHODS:
                yield Report(scene, sbr, method, _pooled(here[method]))
                pooled[method] += here[method]
        for method in METHODS:
            yield Report(scene, None, method, _pooled(pooled[method]))


def _pooled(pairs: Sequence[tuple[Floats, NDArray[np.bool_]]]) -> list[Told]:
    confidence, right = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    return reliability(confidence, right)


def table(reports: Iterable[Report]) -> Table:
    """Return a row for each report: its calibration error, and the share right by confidence."""
    rows = []
    for report in reports:
        bins = (f"{t.confidence:.2f}: {t.right.value:.2f} ({t.count})" for t in report.told)
        sbr = "all six" if report.sbr is None else f"{report.sbr:g}"
        rows.append((report.scene, sbr, report.method, report.error, ", ".join(bins)))
    return Table(
        "calibration",
        "Calibration of confidence",
        ("scene", "SBR", "method", "calibration error", "confidence: share right (estimates)"),
        tuple(rows),
    )
