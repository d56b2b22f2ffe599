"""Calibration of the confidence: is 0.9 right nine times in ten?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.estimators import RangeImage, estimate
from core.inference.posterior import TOLERANCE_BINS
from core.metrics import ReliabilityBin, calibration_error, reliability
from core.studies.outputs import Table, table
from core.studies.paper.printed import TABLE_2
from core.studies.trials import Condition

METHODS = ("likelihood", "tracking", "coates", "peak")
SCENES = ("uniform", "car")


def confidence_and_right(capture: Capture, image: RangeImage) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the confidence of all estimates and whether each is right; wrong without a surface.

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
    tenths: list[ReliabilityBin]
    """Estimates by tenths of confidence, from `core.metrics.reliability`."""

    @property
    def error(self) -> float:
        """Expected calibration error."""
        return calibration_error(self.tenths)


def reports(seeds: Sequence[int]) -> Iterator[Report]:
    """Yield a report per scene, SBR and method, and last of each scene one over all SBRs."""
    for scene in SCENES:
        found: dict[tuple[float, str], tuple[Floats, NDArray[np.bool_]]] = {}
        for sbr in TABLE_2:
            captures = [Condition(scene, sbr).capture(seed) for seed in seeds]
            for method in METHODS:
                pairs = [confidence_and_right(c, estimate(c, method)) for c in captures]
                found[sbr, method] = _joined(pairs)
                yield Report(scene, sbr, method, reliability(*found[sbr, method]))
        for method in METHODS:
            pooled = _joined([found[sbr, method] for sbr in TABLE_2])
            yield Report(scene, None, method, reliability(*pooled))


def _joined(
    pairs: Sequence[tuple[Floats, NDArray[np.bool_]]],
) -> tuple[Floats, NDArray[np.bool_]]:
    confidence, right = (np.concatenate(parts) for parts in zip(*pairs, strict=True))
    return confidence, right


def calibration_table(seeds: Sequence[int]) -> Table:
    """Return calibration error and share of right estimates by confidence of each report."""
    return table(
        "calibration",
        "Calibration of confidence",
        reports(seeds),
        {
            "scene": lambda report: report.scene,
            "SBR": lambda report: "all six" if report.sbr is None else f"{report.sbr:g}",
            "method": lambda report: report.method,
            "calibration error": lambda report: report.error,
            "confidence: share right (estimates)": lambda report: ", ".join(
                f"{t.confidence:.2f}: {t.right.value:.2f} ({t.count})" for t in report.tenths
            ),
        },
    )
