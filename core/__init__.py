"""Range estimation from first-photon (Geiger-mode APD) lidar captures, without a screen.

The names exported here are what most scripts need. `PUBLIC_MODULES` export more; any other module
may change without notice.
"""

from core import inspection, metrics, reductions
from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture, CaptureError
from core.corrections import CORRECTIONS, without_correction
from core.estimators import ESTIMATORS, Estimator, RangeImage, estimate
from core.inference import limits
from core.io import (
    SceneError,
    open_capture,
    read_capture,
    read_scene,
    save_capture,
    save_image,
    save_pixel,
)
from core.out_of_core import Window, as_image, estimate_large, read_window, sampled_flux_prior
from core.pipeline import Run, run
from core.scene import PARTS, Scene, parts_of, scenes, without
from core.simulation import first_photons, simulate
from core.tracking import PRESETS, Signals, TrackingParameters, tracking_signals
from core.trigger import (
    coates_rate,
    first_difference,
    no_trigger_probability,
    rate_per_bin,
    trigger_probability,
)
from core.warmup import warm_up

PUBLIC_MODULES = (
    "core.checks",
    "core.corrections",
    "core.cost",
    "core.estimators",
    "core.geometry",
    "core.inference",
    "core.inspection",
    "core.io",
    "core.metrics",
    "core.out_of_core",
    "core.parameters",
    "core.reductions",
    "core.studies",
    "core.studies.ablation",
    "core.studies.paper",
    "core.studies.sensitivity",
    "core.studies.tradeoff",
    "core.studies.trials",
)
"""Modules whose ``__all__`` is public, too."""

light_of_whole = sampled_flux_prior  # deprecated name, to be removed after the next release

__version__ = "0.1.0"

__all__ = [
    "CORRECTIONS",
    "ESTIMATORS",
    "PARTS",
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
    "SceneError",
    "Signals",
    "TrackingParameters",
    "Window",
    "as_image",
    "coates_rate",
    "estimate",
    "estimate_large",
    "first_difference",
    "first_photons",
    "inspection",
    "light_of_whole",
    "limits",
    "metrics",
    "no_trigger_probability",
    "open_capture",
    "parts_of",
    "rate_per_bin",
    "read_capture",
    "read_scene",
    "read_window",
    "reductions",
    "run",
    "sampled_flux_prior",
    "save_capture",
    "save_image",
    "save_pixel",
    "scenes",
    "simulate",
    "tracking_signals",
    "trigger_probability",
    "warm_up",
    "without",
    "without_correction",
]
