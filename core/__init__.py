"""Range estimation from first-photon (Geiger-mode APD) lidar captures, without a screen.

The names exported here are what most scripts need. `PUBLIC_MODULES` export more; any other module
may change without notice.

Examples
--------
Counts of any origin become a capture: unsigned numbers of shape (row, col, bin), and what is known
of the recording. Here they are simulated.

>>> import core
>>> scene = core.scenes["staircase"](16)
>>> counts = core.simulate(scene, core.Acquisition(), core.Flux(signal=0.3, sbr=1.0), seed=1).cube
>>> acquisition = core.Acquisition(n_bins=counts.shape[2], bin_width_s=1e-9, n_pulses=1000)
>>> capture = core.Capture(counts, acquisition, truth_range_m=scene.range_m, source="staircase")

Estimate its ranges, and compare them with the truth.

>>> image = core.estimate(capture, "likelihood", false_alarm=0.01)
>>> image.range_m.shape
(16, 16)
>>> core.metrics.coverage(image.range_m, capture.truth_range_m)
1.0
>>> core.metrics.rmse_m(image.range_m, capture.truth_range_m) < capture.acquisition.bin_length_m
True

Continue with labelled arrays, or save a file for other software.

>>> image.to_xarray().range_m.attrs["units"]
'm'
>>> dict(capture.to_xarray().counts.sizes)
{'row': 16, 'col': 16, 'bin': 100}
>>> core.save_image(capture, image, "ranges.nc")
"""

from core import inspection, metrics, reductions
from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture, CaptureError, StatedFlux
from core.corrections import CORRECTIONS, without_correction
from core.estimators import (
    ESTIMATORS,
    Estimator,
    RangeImage,
    estimate,
    judged_by_image,
    with_returns,
)
from core.inference import (
    RangeInterval,
    Returns,
    limits,
    pixel_range_intervals,
    range_interval,
    range_intervals,
)
from core.io import (
    SceneError,
    open_capture,
    read_capture,
    read_scene,
    read_truth,
    save_capture,
    save_image,
    save_pixel,
)
from core.out_of_core import Window, as_image, estimate_large, read_window, sampled_flux_prior
from core.photon_budget import PhotonBudget
from core.pipeline import Run, run
from core.pulse_groups import USUAL_GROUPS, PulseGroups
from core.report import save_report
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
from core.tuning import Tuning, tuned
from core.version import __version__ as __version__
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
    "core.photon_budget",
    "core.reductions",
    "core.report",
    "core.scripts",
    "core.studies",
    "core.studies.ablation",
    "core.studies.budget",
    "core.studies.lessons",
    "core.studies.paper",
    "core.studies.pulses",
    "core.studies.report",
    "core.studies.sensitivity",
    "core.studies.tradeoff",
    "core.studies.trials",
    "core.tuning",
    "core.typesetting",
)
"""Modules whose ``__all__`` is public, too."""

light_of_whole = sampled_flux_prior  # deprecated name, to be removed after the next release

__all__ = [
    "CORRECTIONS",
    "ESTIMATORS",
    "PARTS",
    "PRESETS",
    "USUAL_GROUPS",
    "Acquisition",
    "Capture",
    "CaptureError",
    "Estimator",
    "Flux",
    "PhotonBudget",
    "Pulse",
    "PulseGroups",
    "RangeImage",
    "RangeInterval",
    "Returns",
    "Run",
    "Scene",
    "SceneError",
    "Signals",
    "StatedFlux",
    "TrackingParameters",
    "Tuning",
    "Window",
    "as_image",
    "coates_rate",
    "estimate",
    "estimate_large",
    "first_difference",
    "first_photons",
    "inspection",
    "judged_by_image",
    "light_of_whole",
    "limits",
    "metrics",
    "no_trigger_probability",
    "open_capture",
    "parts_of",
    "pixel_range_intervals",
    "range_interval",
    "range_intervals",
    "rate_per_bin",
    "read_capture",
    "read_scene",
    "read_truth",
    "read_window",
    "reductions",
    "run",
    "sampled_flux_prior",
    "save_capture",
    "save_image",
    "save_pixel",
    "save_report",
    "scenes",
    "simulate",
    "tracking_signals",
    "trigger_probability",
    "tuned",
    "warm_up",
    "with_returns",
    "without",
    "without_correction",
]
