"""Calibration of the confidence from the pixel alone and from the image posterior."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from core.estimators import JUDGES, Judge, RangeImage, estimate, judged_by_image
from core.metrics import Interval, calibration_error, reliability, wilson
from core.studies.methods.calibration import Pair, confidence_and_right
from core.studies.outputs import Table, table
from core.studies.trials import Condition, mapped

SURE = 0.9
"""Confidence from which the app shows an estimate by default."""

FORMATS = {"error": ".4f", "sure": ".3f"}

Row = tuple[Condition, str]

METHODS = ("tracking", "coates", "unmixing")

CONDITIONS = tuple(
    Condition(scene, sbr)
    for scene in ("piecewise", "staircase", "car", "building", "uniform")
    for sbr in (0.06, 0.04, 0.03, 0.02)
)


class Shares(NamedTuple):
    """What a confidence says of the estimates of a method."""

    right: Interval
    """Share of right estimates."""
    error: float
    """Expected calibration error."""
    sure: float
    """Share of the estimates of at least the confidence `SURE`."""
    sure_right: Interval
    """Share of those that are right."""

    @classmethod
    def of(cls, pairs: Sequence[Pair]) -> Shares:
        """Return the shares of the estimates of several captures."""
        confidence, right = map(np.concatenate, zip(*pairs, strict=True))
        sure = right[confidence >= SURE]
        unknown = Interval(math.nan, math.nan, math.nan)
        return cls(
            wilson(int(right.sum()), right.size),
            calibration_error(reliability(confidence, right)),
            sure.size / right.size,
            wilson(int(sure.sum()), sure.size) if sure.size else unknown,
        )


def judge(piece: tuple[Condition, int]) -> dict[tuple[str, Judge], Pair]:
    """Return confidence and correctness of the estimates of a capture by method and judge."""
    condition, seed = piece
    capture, found = condition.capture(seed), dict[tuple[str, Judge], Pair]()
    for method in METHODS:
        alone = estimate(capture, method)
        images: dict[Judge, RangeImage] = {"pixel": alone, "image": judged_by_image(capture, alone)}
        found |= {(method, by): confidence_and_right(capture, each) for by, each in images.items()}
    return found


def judged_table(
    seeds: Sequence[int], processes: int = 1, conditions: Sequence[Condition] = CONDITIONS
) -> Table:
    """Return what each judge says of the estimates under each condition."""
    pairs: dict[tuple[Condition, str, Judge], list[Pair]] = defaultdict(list)
    pieces = list(product(conditions, seeds))
    for (condition, _), of_capture in mapped(judge, pieces, processes):
        for (method, by), pair in of_capture.items():
            pairs[condition, method, by].append(pair)
    found = {row: Shares.of(each) for row, each in pairs.items()}

    def column(name: str, by: Judge) -> Callable[[Row], object]:
        return lambda row: getattr(found[*row, by], name)

    columns: dict[str, Callable[[Row], object]] = {
        "scene": lambda row: row[0].scene,
        "SBR": lambda row: row[0].sbr,
        "method": lambda row: row[1],
        "right": column("right", "pixel"),
    }
    for by in JUDGES:
        columns |= {
            f"{by}: error": column("error", by),
            f"{by}: sure": column("sure", by),
            f"{by}: sure and right": column("sure_right", by),
        }
    return table(
        "judged",
        "Confidence by the pixel alone and by the image",
        product(conditions, METHODS),
        columns,
        f"{len(seeds)} captures a row. Right: share of the estimates within 3 bins. Pixel: the "
        "confidence from the counts of the pixel alone; image: by the posterior of the image "
        "(`core.judged_by_image`). Error: expected calibration error. Sure: share of the estimates "
        f"with a confidence of at least {SURE}, and the share of these that are right.",
        {f"{by}: {name}": form for by in JUDGES for name, form in FORMATS.items()},
    )
