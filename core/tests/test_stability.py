"""What must hold at the extremes: a short grid; ``python -m core stability`` has the full one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from core.acquisition import Acquisition, Flux, Pulse
from core.blocks import to_blocks
from core.capture import Capture
from core.estimators import estimate
from core.experiments.extremes import SHORT, SUBNORMAL
from core.experiments.laws import LAWS, Law, verdict
from core.limits import cramer_rao_bins
from core.scene import Scene
from core.simulate import simulate
from core.tracking import TrackingParameters, track, tracking_signals
from core.trigger import coates_rate

# Of these the kernels are few or none; the others range whole images.
PLAIN = (
    "probability",
    "sum",
    "logarithm",
    "Coates",
    "likelihood",
    "limits",
    "background",
    "refusal",
)
# A process of its own without compiled kernels takes longer than all others together, and is left
# to the command, as is what measures times.
TESTED = [law for law in LAWS.values() if not law.is_timed and law.name != "compiled"]


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, id=law.name, marks=() if law.name in PLAIN else pytest.mark.compiled)
        for law in TESTED
    ],
)
def test_laws_hold_at_the_extremes(law: Law) -> None:
    found = verdict(law, SHORT)
    assert found.cases > 1
    assert found.holds, f"{law.sentence} {found.worst} {law.unit}: {found.where}"


@pytest.mark.parametrize("values", [[0.0, 2.0], [float("nan"), 0.0], [0.0, float("nan")]])
def test_a_law_that_is_broken_once_does_not_hold(values: list[float]) -> None:
    law = Law("any", "Any.", 1.0, "units", lambda grid: ((v, f"at {v}") for v in values))
    found = verdict(law, SHORT)
    assert not found.holds
    assert found.where in ("at 2.0", "at nan")


# --- What the laws found; each was wrong once. ---


@pytest.mark.parametrize("pulse", [Pulse(), Pulse(1e-6), Pulse.gaussian(1e-9)])
@pytest.mark.parametrize("onset", [50.0, 50 + 1e-9, 50.5])
def test_next_to_no_background_is_as_good_as_none(onset: float, pulse: Pulse) -> None:
    gate = Acquisition()
    none = cramer_rao_bins(onset, 0.5, 0.0, pulse, gate)
    for background in (SUBNORMAL, 1e-300, 1e-12):
        faint = cramer_rao_bins(onset, 0.5, background, pulse, gate)
        assert faint == pytest.approx(none, rel=1e-3)


def test_the_density_is_the_slope_of_the_cdf() -> None:
    time_s = np.array([-3.2, 0.3, 1.7, 2.2, 5.5]) * 1e-9
    for pulse in (Pulse(2e-9), Pulse.gaussian(1e-9), Pulse.measured([0, 1, 3, 2], 1e-9)):
        slope = (pulse.cdf(time_s + 1e-14) - pulse.cdf(time_s - 1e-14)) / 2e-14
        np.testing.assert_allclose(pulse.density(time_s), slope, atol=1e5)


def test_coates_keeps_its_digits_where_nearly_every_pulse_fires() -> None:
    rate = coates_rate([10**9 - 5, 1], 10**9)
    assert rate[0] == pytest.approx(np.log(10**9 / 5), rel=1e-15)


@pytest.mark.parametrize("alpha", [5e-324, 1e-310, 100.0, 300.0, 1e4, 1e6])
@pytest.mark.parametrize("weight", ["cubic", "exponential"])
def test_any_strength_of_the_weight_is_the_same_in_both_precisions(
    weight: Any, alpha: float
) -> None:
    rows = np.zeros((64, 100), np.uint16)
    rows[np.arange(64), 20 + np.arange(64)] = 300
    rows += np.random.default_rng(2).poisson(3, rows.shape).astype(np.uint16)
    chosen = TrackingParameters(weight=weight, alpha=alpha)
    position, _ = track(to_blocks(rows), chosen)
    np.testing.assert_array_equal(position, tracking_signals(rows, chosen).position_bin)


def test_an_exponential_weight_beyond_measure_lets_the_last_bins_win() -> None:
    rows = np.zeros((1, 100), np.uint16)
    rows[0, 30], rows[0, 92] = 300, 20
    for alpha in (100.0, 700.0, 1e6):
        chosen = TrackingParameters(weight="exponential", alpha=alpha)
        assert tracking_signals(rows, chosen).position_bin[0] > 90


@pytest.mark.compiled
def test_many_photons_place_an_echo_finer_than_the_steps() -> None:
    gate = Acquisition(n_pulses=10**6)
    onset = np.linspace(20, 90, 256).reshape(16, 16)
    capture = simulate(Scene(gate.bin_to_range_m(onset)), gate, Flux(0.1041, 0.06), seed=1)
    error = estimate(capture, "likelihood").bin - onset
    # Answers at the middle of steps of half a bin, which they were once, have a rms of 0.14.
    assert np.sqrt(np.mean(error**2)) < 0.06


@pytest.mark.compiled
def test_a_gate_that_closes_before_the_echo_begins_is_ranged() -> None:
    cube = np.ones((3, 3, 1), np.uint16)
    capture = Capture(cube, Acquisition(1, n_pulses=5), Pulse(1e-6))
    image = estimate(capture, "unmixing")
    assert ((image.bin[image.valid] >= 0) & (image.bin[image.valid] <= 1)).all()
