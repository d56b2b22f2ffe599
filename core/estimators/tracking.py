"""The paper's estimator, the dual-scale tracking differentiator of `core.tracking`.

It finds the bin of the echo. The largest likelihood in the neighbourhood gives the range below a
bin, unless `TrackingParameters.refine` is "none".
"""

from __future__ import annotations

from core.acquisition import Floats
from core.capture import Capture
from core.estimators.base import Estimator
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions
from core.inference.refinement import refined
from core.tracking import TrackingParameters, track, tracking_signals


def _locate(
    capture: Capture, flux: FluxModel, parameters: TrackingParameters
) -> tuple[Floats, Floats]:
    position, score = track(capture.blocks, parameters, capture.gated_pulses)
    return position.reshape(capture.shape).astype(float), score.reshape(capture.shape).astype(float)


def _curve(histogram: Floats, conditions: Conditions, parameters: TrackingParameters) -> Floats:
    return tracking_signals(histogram, parameters, conditions.n_pulses).enhanced


def _refine(
    capture: Capture, flux: FluxModel, delay_bin: Floats, parameters: TrackingParameters
) -> Floats:
    return refined(capture, flux, delay_bin) if parameters.refine == "likelihood" else delay_bin


ESTIMATOR = Estimator(
    "Dual-scale tracking differentiator",
    TrackingParameters,
    _curve,
    _locate,
    first_bin=lambda parameters: parameters.t_n,
    refine=_refine,
)
