"""Range estimation from first-photon (Geiger-mode APD) lidar captures, without a screen."""

from core import limits, metrics
from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture, CaptureError
from core.estimators import ESTIMATORS, Estimator, RangeImage, estimate
from core.export import save_capture, save_image, save_pixel
from core.pipeline import Run, run
from core.readers import read_capture
from core.scene import Scene, scenes
from core.simulate import simulate
from core.tracking import PRESETS, Signals, TrackingParameters, tracking_signals
from core.trigger import (
    coates_rate,
    first_difference,
    no_trigger_probability,
    rate_per_bin,
    trigger_probability,
)
from core.warmup import warm_up

__all__ = [
    "ESTIMATORS",
    "PRESETS",
    "Acquisition",
    "Capture",
    "CaptureError",
    "Estimator",
    "Flux",
    "Pulse",
    "RangeImage",
    "Run",
    "Scene",
    "Signals",
    "TrackingParameters",
    "coates_rate",
    "estimate",
    "first_difference",
    "limits",
    "metrics",
    "no_trigger_probability",
    "rate_per_bin",
    "read_capture",
    "run",
    "save_capture",
    "save_image",
    "save_pixel",
    "scenes",
    "simulate",
    "tracking_signals",
    "trigger_probability",
    "warm_up",
]
