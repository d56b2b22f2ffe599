"""The bin with the most triggers, the baseline of all comparisons."""

from __future__ import annotations

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.estimators.base import Estimator, NoParameters
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions


def _locate(capture: Capture, flux: FluxModel, parameters: NoParameters) -> tuple[Floats, Floats]:
    position = capture.cube.argmax(axis=2)
    height = np.take_along_axis(capture.cube, position[..., np.newaxis], axis=2)[..., 0]
    return position.astype(float), height.astype(float)


def _curve(histogram: Floats, conditions: Conditions, parameters: NoParameters) -> Floats:
    return histogram


ESTIMATOR = Estimator("Peak of the histogram", NoParameters, _curve, _locate)
