"""Estimates compared with the ranges that the instrument itself reported."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from core.capture import Capture
from core.estimators import RangeImage
from core.inspection.echoes import CONFIDENT


class ReportedCheck(NamedTuple):
    """Difference of confident estimates from the reported ranges: estimate minus report."""

    n_pixels: int
    """Pixels with a reported range whose estimate is confident by `CONFIDENT`."""
    median_m: float
    """Median difference; NaN without such pixels."""
    spread_m: float
    """Half the range of the middle 68 % of the differences, likewise."""


def reported_check(capture: Capture, image: RangeImage) -> ReportedCheck | None:
    """Compare estimates with the ranges that the instrument reported; None if it reported none."""
    if capture.reported_range_m is None:
        return None
    difference_m = image.confident(CONFIDENT).range_m - capture.reported_range_m
    known_m = difference_m[np.isfinite(difference_m)]
    if not known_m.size:
        return ReportedCheck(0, np.nan, np.nan)
    low_m, median_m, high_m = np.percentile(known_m, [16, 50, 84]).tolist()
    return ReportedCheck(known_m.size, median_m, (high_m - low_m) / 2)
