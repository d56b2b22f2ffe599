"""The bin that triggered most often: what everything else is compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.estimators.base import Estimator
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions


@dataclass(frozen=True)
class PeakParameters:
    """The peak has no settings."""


def _locate(capture: Capture, flux: FluxModel, parameters: PeakParameters) -> tuple[Floats, Floats]:
    position = capture.cube.argmax(axis=2)
    height = np.take_along_axis(capture.cube, position[..., np.newaxis], axis=2)[..., 0]
    return position.astype(float), height.astype(float)


def _curve(histogram: Floats, conditions: Conditions, parameters: PeakParameters) -> Floats:
    return histogram


ESTIMATOR = Estimator("Peak of the histogram", PeakParameters, _curve, _locate)
