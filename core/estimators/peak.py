"""The bin that triggered most often: what everything else is compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.estimators.base import Estimator


@dataclass(frozen=True)
class PeakParameters:
    """The peak has no settings."""


def _locate(capture: Capture, parameters: PeakParameters) -> tuple[Floats, Floats]:
    position = capture.cube.argmax(axis=2)
    height = np.take_along_axis(capture.cube, position[..., np.newaxis], axis=2)[..., 0]
    score = height.astype(float)
    return np.where(score > 0, position, np.nan), score


def _curve(histogram: Floats, parameters: PeakParameters, n_pulses: int | None) -> Floats:
    return np.asarray(histogram, float)


ESTIMATOR = Estimator("Peak of the histogram", PeakParameters, _locate, _curve, lambda _: 0)
