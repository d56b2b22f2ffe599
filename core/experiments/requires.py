"""What a scene or a capture requires of its model: which parts and corrections are needed.

A part of a scene (`core.scene.PARTS`), and a correction that an estimator makes, is needed where
the pulses tell a model that has it from one that has not (`core.resolution`) in more than a few
pixels, or where the answers move by more than `MARGIN_RD` or `MARGIN_BINS`. Where they do neither,
the whole of both intervals lying within these margins (Schuirmann's test of equivalence, 1987), it
is not needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from core import metrics, resolution
from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.experiments.timing import interleaved, median_interval
from core.metrics import Interval
from core.posterior import TOLERANCE_BINS, light_of
from core.resolution import Difference
from core.scene import PARTS, Scene, parts_of, without
from core.simulate import pulses_sent, simulate, triggered_by_each_edge

Verdict = Literal["needed", "not needed", "cannot tell"]

MARGIN_RD = 0.005
"""A change of the restoration degree within 3 bins that nobody misses: one pixel in 200."""

MARGIN_BINS = 1 / math.sqrt(12)
"""Of the RMSE, in bins: the error that whole bins make by themselves."""

UNKNOWN = Interval(math.nan, math.nan, math.nan)


@dataclass(frozen=True)
class Requirement:
    """One part of a scene, or one correction of an estimator, and whether it is needed."""

    part: str
    """A key of `core.scene.PARTS` or of `CORRECTIONS`."""
    total_variation: float
    """How far it moves the trigger probabilities: total variation, mean over pixels; NaN where the
    data do not say."""
    worst: float
    """The same in the pixel where it is largest."""
    resolvable: float
    """Total variation from which the pulses tell a difference of this shape: median over pixels."""
    told_share: float
    """Share of the pixels in which they do."""
    rd_change: Interval
    """With less without, paired; of the restoration degree within 3 bins; 95 %."""
    rmse_change_m: Interval
    """Likewise, in metres."""
    time_ratio: Interval
    """With over without: of simulating for a part, of ranging for a correction."""
    verdict: Verdict
    why: str
    """One sentence."""


CORRECTIONS = {
    "pile_up": "pile-up",
    "pulse_shape": "pulse shape",
    "signal_levels": "levels of signal",
}
"""What an estimator may take into account, in words; each is judged whatever the scene."""
