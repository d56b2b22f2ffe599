"""Accuracy with fewer pulses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy  # loads a submodule when it is first used

from core import metrics
from core.acquisition import Floats
from core.capture import Capture
from core.checks import require
from core.estimators import RangeImage, estimate, settings_of
from core.inference.posterior import TOLERANCE_BINS
from core.inspection.echoes import CONFIDENT
from core.metrics import Interval
from core.reductions import share_of_pulses


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of estimates with a share of the pulses of a capture."""

    share: float
    n_pulses: int | None
    """None if unknown."""
    against: Literal["truth", "all pulses"]
    """Reference: the truth or, if it is unknown, the estimates with all pulses whose confidence is
    at least `CONFIDENT`, which may be wrong."""
    within: Interval | None
    """Share of the pixels with a reference within 3 bins of it, with Wilson's 95 % interval; None
    without any."""
    rmse_m: Interval | None
    """Root mean square difference from the reference over estimated pixels, with Student's 95 %
    interval from the scatter of its squares; None without estimates."""
    confidence: float
    """Mean over all pixels, with 0 for pixels without an estimate."""


def accuracy_over_pulses(
    capture: Capture, shares: Sequence[float], method: str = "tracking", settings: Any = None
) -> Iterator[Accuracy]:
    """Estimate a capture with shares of its pulses, and yield the accuracy of each.

    Computation is lazy. Fewer pulses are a subset of more (`core.reductions.share_of_pulses`).

    Parameters
    ----------
    capture : Capture
    shares : sequence of float
        Shares of the pulses, each above 0 and at most 1.
    method, settings
        As for `core.estimate`.

    Yields
    ------
    Accuracy

    Raises
    ------
    ValueError
        If a share is out of its range, or the method or its settings are unknown.
    """
    for share in shares:
        require("share", share, 0 < share <= 1, "above 0 and at most 1")
    settings = settings_of(method, settings)
    return _steps(capture, shares, method, settings)


def _steps(
    capture: Capture, shares: Sequence[float], method: str, settings: Any
) -> Iterator[Accuracy]:
    truth_m, against = capture.truth_range_m, "truth"
    if truth_m is None:
        image = estimate(capture, method, settings).confident(CONFIDENT)
        truth_m, against = image.range_m, "all pulses"
    for share in shares:
        some = share_of_pulses(capture, share)
        yield _accuracy(some, estimate(some, method, settings), truth_m, share, against)


def _accuracy(
    some: Capture, image: RangeImage, truth_m: Floats, share: float, against: Any
) -> Accuracy:
    tolerance_m = TOLERANCE_BINS * some.acquisition.bin_length_m
    hits, targets = metrics.restored(image.range_m, truth_m, tolerance_m)
    error_m = metrics.errors_m(image.range_m, truth_m)
    return Accuracy(
        share,
        some.acquisition.n_pulses,
        against,
        metrics.wilson(hits, targets) if targets else None,
        _root_mean_square(error_m[np.isfinite(error_m)], some.acquisition.gate_length_m),
        float(image.confidence.mean()),
    )


def _root_mean_square(error_m: Floats, gate_m: float) -> Interval | None:
    """Return the root mean square with Student's interval, from 0 to the length of the gate."""
    if not error_m.size:
        return None
    squares, half = error_m**2, math.inf  # one error shows no scatter
    mean = float(np.mean(squares))
    if squares.size > 1:
        quantile = float(scipy.special.stdtrit(squares.size - 1, 0.975))
        half = quantile * float(np.std(squares, ddof=1)) / math.sqrt(squares.size)
    low, high = max(mean - half, 0.0), min(mean + half, max(mean, gate_m**2))
    return Interval(*map(math.sqrt, (mean, low, high)))
