"""Tests of the goodness of fit: uniform p-values under the model, and power against others."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace

import numba
import numpy as np
import pytest
from scipy import stats

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture, Detection
from core.estimators import estimate
from core.inference.fit import SIGNIFICANCE, fit_in, fit_of, fit_p_values
from core.inference.predictive import predictive_of
from core.studies.methods.fit import CASES, LEAST_RIGHT, NULL_CASES, fit_table, outcome
from core.trigger import draw_counts, rate_per_bin

SIZE = 32  # rows and columns
ACQUISITION = Acquisition(n_pulses=1000)
PULSE = Pulse(1e-9)
RARE = 1e-4  # probability of a false alarm of a test


def ripples(x: Floats) -> Floats:
    """Return a background that no smooth shape describes, at times from 0 to 1."""
    return np.asarray(1 + 0.3 * np.sin(40 * np.pi * x))


def drawn(
    sbr: float = 0.06,
    n_pulses: int = 1000,
    detection: Detection = "first",
    shape: Callable[[Floats], Floats] = np.ones_like,
    pulse: Pulse = PULSE,
    second: float = 0.0,
    seed: int = 0,
) -> Capture:
    """Capture of random depths that is taken for one of `PULSE` over a flat background.

    `shape` is that of the background over the gate, from 0 to 1; another surface returns the share
    `second` of the echo.
    """
    rng, acquisition, signal = np.random.default_rng(seed), ACQUISITION, 0.1041
    onset = rng.uniform(2, 94, (2, SIZE, SIZE))
    one, other = (
        rate_per_bin(each, np.full(each.shape, share * signal), 0.0, pulse, acquisition)
        for each, share in zip(onset, (1 - second, second), strict=True)
    )
    background = shape(np.linspace(0, 1, acquisition.n_bins))
    rate = one + other + signal / sbr * background / background.sum()
    if detection == "all":
        cube = draw_counts(n_pulses * rate, None, rng)
    else:
        cube = draw_counts(rate, n_pulses, rng)
    return Capture(cube, replace(acquisition, n_pulses=n_pulses), PULSE, detection=detection)


@pytest.mark.compiled
@pytest.mark.parametrize("sbr", [0.03, 0.3, 1.0])
@pytest.mark.parametrize(
    ("detection", "n_pulses"), [("first", 1000), ("first", 50), ("all", 1000), ("all", 50)]
)
def test_p_values_are_uniform_where_the_model_holds(
    detection: Detection, n_pulses: int, sbr: float
) -> None:
    capture = drawn(sbr, n_pulses, detection)
    p_values = fit_p_values(capture)
    assert p_values.shape == capture.shape
    assert stats.kstest(p_values.ravel(), "uniform").pvalue > RARE
    few = np.count_nonzero(p_values < SIGNIFICANCE)
    assert few <= stats.binom.isf(RARE, p_values.size, SIGNIFICANCE)
    assert min(check.p_value for check in fit_of(capture)) > RARE


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("case", "failing"),
    [
        ({"shape": ripples}, "background"),
        ({"pulse": Pulse(3e-9), "sbr": 0.3}, "pulse"),
        ({"second": 0.5, "sbr": 0.3}, "pixels"),
    ],
    ids=["ripples", "pulse", "second surface"],
)
def test_the_check_of_what_differs_fails(case: dict[str, object], failing: str) -> None:
    found = fit_of(drawn(**case))  # type: ignore[arg-type]
    assert getattr(found, failing) in found.failed
    assert getattr(found, failing).reason in found.remark
    if failing == "pixels":
        assert found.pixels.effect > 0.1


@pytest.mark.compiled
def test_estimates_carry_the_warning_where_the_model_does_not_hold() -> None:
    rippled = drawn(shape=ripples)
    for capture, warning in ((rippled, fit_of(rippled).remark), (drawn(), "")):
        made_by = estimate(capture, "peak").made_by
        sent = pickle.loads(pickle.dumps(made_by))  # to another process, before it is read here
        assert made_by is not None and made_by.remark == sent.remark == warning


@pytest.mark.compiled
@pytest.mark.parametrize("name", CASES)
def test_confidence_is_right_or_the_capture_carries_the_warning(name: str) -> None:
    found = outcome(name, CASES[name], range(1))
    assert found.holds
    assert not found.fits[0].fits or found.all_right.value >= LEAST_RIGHT
    assert fit_table([found]).rows[0][:4] == (name, CASES[name].scene, "0.06", 1)


@pytest.mark.compiled
def test_warnings_are_rare_where_the_model_holds() -> None:
    fits = [fit_of(case.capture(seed)).fits for case in NULL_CASES for seed in range(2)]
    assert fits.count(False) <= stats.binom.isf(RARE, len(fits), SIGNIFICANCE)


def facing_wall(phase: float, pulse: Pulse, assumed: Pulse, seed: int = 0) -> Capture:
    """Capture whose echoes all have the same delay; the pulse may be taken for another."""
    onset, signal = np.full((SIZE, SIZE), 40 + phase), np.full((SIZE, SIZE), 0.1041)
    rate = rate_per_bin(onset, signal, 0.1041, pulse, ACQUISITION)
    counts = draw_counts(rate, 1000, np.random.default_rng(seed))
    return Capture(counts, ACQUISITION, assumed)


@pytest.mark.compiled
@pytest.mark.parametrize("width_bins", [0.35, 1.0])
def test_warnings_are_rare_where_all_delays_are_at_the_same_phase_of_a_bin(
    width_bins: float,
) -> None:
    pulse = Pulse(width_bins * ACQUISITION.bin_width_s)
    captures = [facing_wall(phase, pulse, pulse, i) for phase in (0.0, 0.5) for i in range(4)]
    fits = [fit_of(capture).fits for capture in captures]
    assert fits.count(False) <= stats.binom.isf(RARE, len(fits), SIGNIFICANCE)


@pytest.mark.compiled
def test_another_pulse_does_not_pass_for_delays_at_few_phases() -> None:
    assumed, longer = (Pulse(each * ACQUISITION.bin_width_s) for each in (0.35, 0.45))
    found = fit_of(facing_wall(0.0, longer, assumed))
    assert found.pulse in found.failed


@pytest.mark.compiled
def test_p_values_depend_on_the_pixel_alone() -> None:
    capture = drawn()
    again = replace(capture, cube=capture.cube.copy())
    np.testing.assert_array_equal(fit_p_values(capture), fit_p_values(again))
    # Of a region, they are those of the image.
    some = np.arange(0, capture.counts.size, 3)
    few = np.count_nonzero(fit_p_values(capture).ravel()[some] < SIGNIFICANCE)
    assert fit_in(capture, some).pixels.effect == max(few / some.size - SIGNIFICANCE, 0.0)


@pytest.mark.parametrize(
    "n_bins", [3, *(pytest.param(each, marks=pytest.mark.compiled) for each in (1, 50))]
)
@pytest.mark.parametrize("detection", ["first", "all"])
def test_any_histogram_has_a_p_value(detection: Detection, n_bins: int) -> None:
    for count in (7,) if numba.config.DISABLE_JIT else (0, 1, 7):
        cube = np.zeros((2, 3, n_bins), np.uint16)
        cube[..., n_bins // 2] = count
        capture = Capture(cube, Acquisition(n_bins, 1e-9, n_pulses=7), detection=detection)
        p_values = fit_p_values(capture)
        assert ((p_values >= 0) & (p_values <= 1)).all()
        assert all(0 <= check.p_value <= 1 and check.effect >= 0 for check in fit_of(capture))
        assert np.isfinite(predictive_of(capture, np.arange(6))).all()


@pytest.mark.compiled
@pytest.mark.parametrize("detection", ["first", "all"])
@pytest.mark.parametrize("n_pixels", [1, SIZE * SIZE])
def test_predicted_counts_hold_where_the_model_does(detection: Detection, n_pixels: int) -> None:
    capture = drawn(0.3, detection=detection)
    pixels = np.arange(n_pixels)
    found = predictive_of(capture, pixels)
    total = capture.cube.reshape(capture.counts.size, -1)[pixels].sum(axis=0)
    np.testing.assert_array_equal(found.counts, total)
    assert (found.low <= found.expected).all() and (found.expected <= found.high).all()
    outside = np.count_nonzero((found.counts < found.low) | (found.counts > found.high))
    assert outside <= stats.binom.isf(RARE, total.size, 0.05)
    assert stats.kstest(found.residual, "norm").pvalue > RARE


@pytest.mark.compiled
def test_residuals_of_predicted_counts_show_a_background_that_is_not_smooth() -> None:
    capture = drawn(shape=ripples)
    residual = predictive_of(capture, np.arange(capture.counts.size)).residual
    wave = ripples((np.arange(residual.size) + 0.5) / residual.size)
    assert np.corrcoef(residual, wave)[0, 1] > 0.7
