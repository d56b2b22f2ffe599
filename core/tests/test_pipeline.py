"""Tests of the pipeline and of the compilation at start-up."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import core
from core import metrics
from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.estimators import estimate
from core.pipeline import run
from core.scene import Scene
from core.simulation import simulate
from core.tracking import PRESETS

pytestmark = pytest.mark.compiled


def simulated() -> Capture:
    range_m = np.linspace(45, 56, 24).reshape(4, 6)
    range_m[0, 0] = np.nan
    return simulate(Scene(range_m), Acquisition(), Flux(sbr=0.1))


def test_a_run_holds_the_estimate_and_its_figures() -> None:
    capture = simulated()
    done, image = run(capture, "coates"), estimate(capture, "coates")
    assert done.capture is capture
    assert done.estimate_s > 0
    assert run(capture, "coates").flux_time_s < done.flux_time_s  # cached
    np.testing.assert_array_equal(done.image.range_m, image.range_m)
    truth_m = np.asarray(capture.truth_range_m)
    assert done.figures["rmse_m"] == metrics.rmse_m(image.range_m, truth_m)
    assert done.figures["coverage"] == metrics.coverage(image.range_m, truth_m)
    assert done.figures["inlier_rmse_m"] <= done.figures["rmse_m"]


def test_restoration_degrees_use_tolerances_of_1_to_3_bins() -> None:
    capture = simulated()
    answer_m = run(capture, "peak").image.range_m
    off_bins = np.resize([0.0, 0.9, 1.9, 2.9, 3.1, 9.0], answer_m.shape)
    truth_m = answer_m + off_bins * capture.acquisition.bin_length_m
    figures = run(Capture(capture.cube, capture.acquisition, truth_range_m=truth_m), "peak").figures
    shares = [figures[f"rd_{name}"] for name in ("1_bin", "2_bins", "3_bins")]
    assert shares == [2 / 6, 3 / 6, 4 / 6]


def test_a_run_uses_its_settings() -> None:
    capture, settings = simulated(), PRESETS["literal"]
    found = run(capture, "tracking", settings).image.score
    np.testing.assert_array_equal(found, estimate(capture, "tracking", settings).score)


def test_without_truth_there_are_no_figures() -> None:
    capture = simulated()
    assert run(Capture(capture.cube, capture.acquisition), "peak").figures == {}


def test_nothing_is_left_to_compile_or_import_after_warming_up() -> None:
    # In fresh processes, whose kernels no other test has entered: one warms up all, one a method.
    script = """
import core, numba, os, sys
import numpy as np
from numba.core.dispatcher import Dispatcher

modules = [module for name, module in sys.modules.items() if name.startswith("core.")]
kernels = [each for module in modules for each in vars(module).values()
           if isinstance(each, Dispatcher) and each.__module__ == module.__name__]
assert bool(kernels) != bool(numba.config.DISABLE_JIT)
child = os.fork()
only = None if child else "tracking"
core.warm_up(only=only)
warm, imported = [len(each.signatures) for each in kernels], set(sys.modules)
scene = core.scenes["uniform"](8)
capture = core.simulate(scene, scene.acquisition, core.Flux())
for method in [only] if only else core.ESTIMATORS:
    core.run(capture, method)
if only is None:
    flat = core.simulate(core.scenes["wall"](16), scene.acquisition, core.Flux(sbr=1.0))
    core.estimate(flat, "image_posterior", returns=2)
    core.reductions.share_of_pulses(flat, 0.5)
    for each in core.inspection.maps.values():
        each(flat)
    beside = core.Scene(np.full((12, 12), scene.acquisition.bin_to_range_m(30.0)))
    short = core.Pulse(0.4 * scene.acquisition.bin_width_s)
    core.inference.fit_of(core.simulate(beside, scene.acquisition, core.Flux(sbr=2.0), short))
    # Counts beyond uint16.
    bright = core.Capture(np.uint32(2**17) * flat.cube, scene.acquisition, detection="all")
    for method in set(core.ESTIMATORS) - {"oracle"}:
        core.run(bright, method)
    core.reductions.share_of_pulses(bright, 0.5)
for settings in core.PRESETS.values():
    core.tracking_signals(capture.cube, settings)
    image = core.estimate(capture, "tracking", settings)
core.inspection.pixel_report(capture, image, 0, 0)
assert not {name for name in set(sys.modules) - imported if name.startswith("scipy")}
assert [len(each.signatures) for each in kernels] == warm
if child:
    assert os.waitpid(child, 0)[1] == 0
"""
    root = Path(core.__file__).parents[1]
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], cwd=root, check=True)
