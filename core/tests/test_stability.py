"""Sensitivity: trusted ranges of settings, doubtful zones, and regressions at extreme values."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.cli import main
from core.estimators import ESTIMATORS, estimate
from core.inference.limits import cramer_rao_bins
from core.kernels.blocks import to_blocks
from core.parameters import doubts
from core.scene import Scene
from core.simulation import simulate
from core.studies.sensitivity import sweep as sensitivity
from core.tracking import PRESETS, TrackingParameters, track, tracking_signals
from core.trigger import coates_rate

# -- Regressions -----------------------------------------------------------------------------------


@pytest.mark.parametrize("pulse", [Pulse(), Pulse(1e-6), Pulse.gaussian(1e-9)])
@pytest.mark.parametrize("onset", [50.0, 50 + 1e-9, 50.5])
def test_a_vanishing_background_is_like_none(onset: float, pulse: Pulse) -> None:
    none = cramer_rao_bins(onset, 0.5, 0.0, pulse, Acquisition())
    for background in (5e-324, 1e-300, 1e-12):
        faint = cramer_rao_bins(onset, 0.5, background, pulse, Acquisition())
        assert faint == pytest.approx(none, rel=1e-3)


def test_the_density_is_the_slope_of_the_cdf() -> None:
    time_s = np.array([-3.2, 0.3, 1.7, 2.2, 5.5]) * 1e-9
    for pulse in (Pulse(2e-9), Pulse.gaussian(1e-9), Pulse.measured([0, 1, 3, 2], 1e-9)):
        slope = (pulse.cdf(time_s + 1e-14) - pulse.cdf(time_s - 1e-14)) / 2e-14
        np.testing.assert_allclose(pulse.density(time_s), slope, atol=1e5)


def test_coates_keeps_its_precision_where_nearly_every_pulse_fires() -> None:
    rate = coates_rate([10**9 - 5, 1], 10**9)
    assert rate[0] == pytest.approx(np.log(10**9 / 5), rel=1e-15)


@pytest.mark.parametrize("alpha", [5e-324, 1e-310, 100.0, 1e4, 1e6])
@pytest.mark.parametrize("weight", ["cubic", "exponential"])
def test_any_strength_of_the_weight_agrees_in_both_precisions(weight: Any, alpha: float) -> None:
    rows = np.zeros((64, 100), np.uint16)
    rows[np.arange(64), 20 + np.arange(64)] = 300
    rows += np.random.default_rng(2).poisson(3, rows.shape).astype(np.uint16)
    chosen = TrackingParameters(weight=weight, alpha=alpha)
    position, _ = track(to_blocks(rows), chosen)
    np.testing.assert_array_equal(position, tracking_signals(rows, chosen).position_bin)


@pytest.mark.parametrize("alpha", [100.0, 1e6])
def test_an_extreme_exponential_weight_prefers_the_last_bins(alpha: float) -> None:
    rows = np.zeros((1, 100), np.uint16)
    rows[0, 30], rows[0, 92] = 300, 20
    chosen = TrackingParameters(weight="exponential", alpha=alpha)
    assert tracking_signals(rows, chosen).position_bin[0] > 90


@pytest.mark.compiled
def test_many_photons_locate_an_echo_finer_than_the_steps() -> None:
    gate = Acquisition(n_pulses=10**6)
    onset = np.linspace(20, 90, 256).reshape(16, 16)
    capture = simulate(Scene(gate.bin_to_range_m(onset)), gate, Flux(0.1041, 0.06), seed=1)
    error = estimate(capture, "likelihood").bin - onset
    # Estimates in the middle of steps of half a bin have a rms error of 0.14.
    assert np.sqrt(np.mean(error**2)) < 0.06


@pytest.mark.compiled
def test_a_gate_that_closes_before_the_echo_is_ranged() -> None:
    cube = np.ones((3, 3, 1), np.uint16)
    image = estimate(Capture(cube, Acquisition(1, n_pulses=5), Pulse(1e-6)), "unmixing")
    assert ((image.bin[image.valid] >= 0) & (image.bin[image.valid] <= 1)).all()


# -- Doubtful settings -----------------------------------------------------------------------------


@pytest.mark.compiled
def test_measurements_confirm_the_doubtful_zones() -> None:
    rows = list(sensitivity.zone_rows())
    assert {row[-1] for row in rows} == {"yes"}
    assert {row[1] for row in rows} >= {"l", "n", "h", "m", "(m·h)²·l"}


def test_presets_and_defaults_are_not_doubtful() -> None:
    for each in (*PRESETS.values(), *(each.parameters() for each in ESTIMATORS.values())):
        assert doubts(each) == []


def test_zones_lie_within_accepted_values() -> None:
    for _, name, spec, default in sensitivity.numbers():
        for zone in spec.doubtful:
            assert spec.least <= zone.low < zone.high <= spec.most, name
            assert default not in zone


def sweep_of(shares: list[int], values: list[float] | None = None) -> sensitivity.Sweep:
    """Ten thousand pixels with these numbers of correct estimates."""
    right = [np.arange(10_000) < share for share in shares]
    values = values or [float(i) for i in range(len(shares))]
    points = [
        sensitivity.Point(value, each, 1.0, 0.5) for value, each in zip(values, right, strict=True)
    ]
    return sensitivity.Sweep("tracking", "l", 0.1, points)


def test_trusted_ranges_follow_the_losses() -> None:
    sweep = sweep_of([0, 4000, 8500, 9400, 10_000, 9900, 6000, 9900])
    assert sweep.best.value == 4
    assert sweep.ranges("trusted") == "3 to 5, 7"
    assert sweep.ranges("degraded") == "2, 6"
    assert sweep.ranges("failing") == "0 to 1"
    assert sweep.worst.value == 0


@pytest.mark.files
@pytest.mark.usefixtures("blank_figures")
def test_the_command_fails_where_a_zone_is_not_confirmed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    sweep = sweep_of([5000, 10_000], [0.5, 1.0])
    settings = [replace(sweep, parameter=name) for name in ("l", "n", "h", "m", "alpha")]
    scene = [replace(sweep, parameter=name) for name in ("sbr", "n_pulses", "tau_bins")]
    monkeypatch.setattr(sensitivity, "setting_sweeps", lambda progress: settings)
    monkeypatch.setattr(sensitivity, "scene_sweeps", lambda progress: scene)
    rows = [("a", "b", "c", "d", "e", "f", confirmed) for confirmed in ("yes", "NO")]
    monkeypatch.setattr(sensitivity, "zone_rows", lambda: iter(rows))
    assert main(["stability", "--folder", str(tmp_path)]) == 1
    assert "a, b = c" in capsys.readouterr().err
    page = (tmp_path / "index.html").read_text()
    assert all(title in page for title in ("Doubtful settings", "Scenes"))
    rows.pop()
    assert main(["stability", "--folder", str(tmp_path)]) == 0
