"""One path from a capture to an answer and its figures, and a start that compiles it all."""

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
from core.estimators import ESTIMATORS, estimate
from core.pipeline import run
from core.scene import Scene
from core.simulation import simulate
from core.tracking import PRESETS

pytestmark = pytest.mark.compiled


def simulated() -> Capture:
    range_m = np.linspace(45, 56, 24).reshape(4, 6)
    range_m[0, 0] = np.nan
    return simulate(Scene(range_m), Acquisition(), Flux(sbr=0.1))


@pytest.mark.parametrize("method", ESTIMATORS)
def test_a_run_is_the_estimate_and_its_figures(method: str) -> None:
    capture = simulated()
    done = run(capture, method)
    image = estimate(capture, method)
    assert done.capture is capture
    assert done.estimate_s > 0
    assert run(capture, method).flux_time_s < done.flux_time_s  # kept by the capture
    np.testing.assert_array_equal(done.image.range_m, image.range_m)
    truth_m, bin_m = capture.truth_range_m, capture.acquisition.bin_length_m
    assert truth_m is not None
    assert done.figures == {
        "rmse_m": metrics.rmse_m(image.range_m, truth_m),
        "mae_m": metrics.mae_m(image.range_m, truth_m),
        "inlier_rmse_m": metrics.inlier_rmse_m(image.range_m, truth_m, 3 * bin_m),
        "bias_m": metrics.bias_m(image.range_m, truth_m),
        "median_error_m": metrics.median_error_m(image.range_m, truth_m),
        "coverage": metrics.coverage(image.range_m, truth_m),
        "rd_1_bin": metrics.restoration_degree(image.range_m, truth_m, bin_m),
        "rd_2_bins": metrics.restoration_degree(image.range_m, truth_m, 2 * bin_m),
        "rd_3_bins": metrics.restoration_degree(image.range_m, truth_m, 3 * bin_m),
    }


def test_figures_tell_errors_of_some_bins_apart() -> None:
    capture = simulated()
    answer_m = run(capture, "peak").image.range_m
    off_bins = np.resize([0.0, 0.9, 1.9, 2.9, 3.1, 9.0], answer_m.shape)
    truth_m = answer_m + off_bins * capture.acquisition.bin_length_m
    figures = run(Capture(capture.cube, capture.acquisition, truth_range_m=truth_m), "peak").figures
    shares = [figures[f"rd_{name}"] for name in ("1_bin", "2_bins", "3_bins")]
    assert shares == [2 / 6, 3 / 6, 4 / 6]


def test_a_run_uses_its_settings() -> None:
    capture, settings = simulated(), PRESETS["as printed"]
    found = run(capture, "tracking", settings).image.score
    np.testing.assert_array_equal(found, estimate(capture, "tracking", settings).score)


def test_without_truth_there_are_no_figures() -> None:
    capture = simulated()
    assert run(Capture(capture.cube, capture.acquisition), "peak").figures == {}


def test_nothing_is_left_to_compile_after_warming_up() -> None:
    # In a fresh process, whose kernels no other test has entered.
    script = """
import core, numba, sys
from core import tracking, warmup
from numba.core.dispatcher import Dispatcher

tracking.SERIAL_BELOW = warmup.SERIAL_BELOW = 10_000
modules = [module for name, module in sys.modules.items() if name.startswith("core.")]
kernels = [each for module in modules for each in vars(module).values()
           if isinstance(each, Dispatcher) and each.__module__ == module.__name__]
assert bool(kernels) != bool(numba.config.DISABLE_JIT)
core.warm_up()
warm = [len(each.signatures) for each in kernels]
scene = core.scenes["uniform"](8)
capture = core.simulate(scene, scene.acquisition, core.Flux())
for method in core.ESTIMATORS:
    core.run(capture, method)
for settings in core.PRESETS.values():
    core.tracking_signals(capture.cube, settings)
    core.estimate(capture, "tracking", settings)
assert [len(each.signatures) for each in kernels] == warm
"""
    root = Path(core.__file__).parents[1]
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], cwd=root, check=True)
