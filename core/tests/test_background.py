"""Tests of the background shape: found where there is one, uniform where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.effects import SecondSurface
from core.estimators import estimate
from core.estimators.base import histogram_numbers
from core.inference.background import SIZE, echo_free, nodes_of, shape_text
from core.inference.fit import fit_of
from core.inference.flux import flux_prior_of
from core.inspection import capture_report, estimate_mean_flux
from core.scene import Scene, net
from core.simulation import simulate
from core.studies.methods import alarms
from core.studies.methods.calibration import FluxRegime, confidence_and_right
from core.studies.methods.fit import NULL_CASES
from core.trigger import draw_counts, rate_per_bin

SIDE = 24  # rows and columns of captures
TIME = np.linspace(0, 1, 100)  # in the gate

SHAPES = {
    "is uniform": np.ones(100),
    "rises by 50 %": 1 + 0.5 * TIME,
    "falls by 20 %": 1 - 0.2 * TIME,
    "decays": 1 + 0.5 * np.exp(-10 * TIME),
    "is largest in the middle": 1 + 0.5 * np.sin(np.pi * TIME),
}

DELAYS = {
    "whole gate": (0.0, 99.0),
    "wall": (50.0, 50.5),
    "car": (48.0, 60.0),
    "nowhere": (np.nan, np.nan),
}


def drawn(shape: np.ndarray, delays: tuple[float, float], n_pulses: int | None = 1000) -> Capture:
    """Capture with echoes of 0.1 photons per pulse over 1.7 of background."""
    rng, acquisition = np.random.default_rng(0), Acquisition(n_pulses=n_pulses)
    onset = (
        rng.uniform(*delays, (SIDE, SIDE))
        if np.isfinite(delays[0])
        else np.full((SIDE, SIDE), np.nan)
    )
    rate = rate_per_bin(onset, np.full(onset.shape, 0.1), 0.0, Pulse(), acquisition)
    rate += 1.7 * shape / shape.sum()
    detection = "all" if n_pulses is None else "first"
    counts = draw_counts(rate if n_pulses else 1000 * rate, n_pulses, rng)
    truth_m = acquisition.bin_to_range_m(onset)
    return Capture(counts, acquisition, Pulse(), truth_m, detection=detection)


@pytest.mark.compiled
@pytest.mark.parametrize(("n_pulses", "photons"), [(1000, 0.5), (1000, 40.0), (None, 3.0)])
def test_bins_without_an_echo_add_up_as_written(n_pulses: int | None, photons: float) -> None:
    rng, n_pixels, n_bins, (first, end) = np.random.default_rng(0), 5, 40, (-3, 6)
    density = rng.uniform(0, 1, (n_pixels, 3, n_bins)).astype(np.float32)
    density[:, 0] = density[:, :1, 0]  # no echo is the same at all delays
    prior, shape = rng.uniform(0, 1, (3, n_bins)), rng.uniform(0.5, 1.5, n_bins)
    background = photons * rng.uniform(0.5, 1.5, (n_pixels, 3))
    counts = rng.integers(0, 9, (n_pixels, n_bins)).astype(np.uint16)
    found = echo_free(density, prior, background, counts, n_pulses, (first, end), shape)
    armed = np.ones((n_pixels, n_bins))
    if n_pulses:
        armed = n_pulses - (np.cumsum(counts, axis=1) - counts)
    joint = prior * density.astype(float)
    expected = np.zeros((3, n_bins))
    for k in range(n_bins):
        delay = np.arange(n_bins)
        is_far = (k - delay < first) | (k - delay >= end)
        alone = joint * np.where(np.arange(3)[:, np.newaxis] == 0, True, is_far)
        share = alone.sum(axis=(1, 2)) / joint.sum(axis=(1, 2))
        mean = (background * alone.sum(axis=2)).sum(axis=1) / alone.sum(axis=(1, 2))
        rate = mean / n_bins * shape[k]
        fires = -np.expm1(-rate) if n_pulses else rate
        of_pixels = counts[:, k], armed[:, k] * fires / shape[k], armed[:, k]
        expected[:, k] = [(share * each).sum() for each in of_pixels]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("shape", "delays", "n_pulses"),
    [
        ("rises by 50 %", "whole gate", 1000),
        ("falls by 20 %", "wall", 1000),
        ("decays", "car", 1000),
        ("decays", "whole gate", None),
        ("is largest in the middle", "nowhere", None),
    ],
)
def test_the_shape_is_found_wherever_the_surfaces_are(
    shape: str, delays: str, n_pulses: int | None
) -> None:
    true = SHAPES[shape] / SHAPES[shape].mean()
    found = flux_prior_of(drawn(true, DELAYS[delays], n_pulses)).background_shape
    assert found is not None
    error = found / true - 1
    # 512 pixels with 4 to 17 photons in each bin, and a dozen parameters.
    assert np.sqrt((error**2).mean()) < 0.025
    assert found.mean() == pytest.approx(1)


@pytest.mark.compiled
def test_a_uniform_background_is_found_uniform_and_changes_no_bit() -> None:
    captures = [case.capture(seed) for case in NULL_CASES for seed in (100, 101)]
    captures += [drawn(np.ones(100), delays, n) for delays in DELAYS.values() for n in (1000, None)]
    found = [flux_prior_of(capture).background_shape for capture in captures]
    others = sum(shape is not None for shape in found)
    assert others <= stats.binom.isf(1e-4, len(captures), SIZE)
    assert nodes_of(np.ones(7)).weight.tolist() == [[1.0] * 7]  # the likelihood of one background


@pytest.mark.compiled
def test_no_warning_remains_where_the_shape_explains_the_background() -> None:
    assert fit_of(drawn(SHAPES["decays"], DELAYS["whole gate"])).remark == ""


@pytest.mark.compiled
def test_the_report_on_the_capture_names_the_shape() -> None:
    falling = drawn(SHAPES["falls by 20 %"], DELAYS["car"])
    found = flux_prior_of(falling).background_shape
    assert shape_text(found).startswith("the background falls by ")
    assert shape_text(found) in capture_report(falling).flux_remark


@pytest.mark.compiled
def test_false_alarms_are_those_asked_for_whatever_the_background(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(alarms, "METHODS", ("coates",))
    (few, many) = found = alarms.alarms(("falls by 50 %", range(1)))
    assert few.holds and many.holds
    assert many.if_uniform > 5 * many.reported
    assert [row[-3] for row in alarms.alarms_table(found).rows] == ["0.01", "0.1"]


@pytest.mark.parametrize("photons", [1, 400])
def test_numbers_of_histograms_are_even(photons: int) -> None:
    rng = np.random.default_rng(0)
    histograms = rng.multinomial(photons, np.full(100, 0.01), size=4000).astype(np.uint16)
    numbers = histogram_numbers(histograms)
    np.testing.assert_array_equal(numbers, histogram_numbers(histograms.copy()))
    shares = np.histogram(numbers, bins=10, range=(0, 1))[0] / len(numbers)
    np.testing.assert_allclose(shares, 0.1, atol=0.02)


def test_nodes_interpolate_the_gain_of_a_count() -> None:
    shape = np.geomspace(0.2, 3, 50)
    node, weight = nodes_of(shape)
    for signal in (1e-3, 0.1, 10.0):
        gain = np.log1p(signal / node) @ weight
        np.testing.assert_allclose(gain, np.log1p(signal / shape), rtol=1e-4)
    assert np.abs(weight).sum(axis=0).max() < 3
    np.testing.assert_allclose(weight.sum(axis=0), 1)


def test_a_capture_without_photons_has_a_uniform_background() -> None:
    for n_bins in (1, 2, 30):
        empty = Capture(np.zeros((3, 4, n_bins), np.uint16), Acquisition(n_bins))
        assert flux_prior_of(empty).background_shape is None


def test_shapes_are_described_by_what_they_do() -> None:
    assert shape_text(None) == "the background is uniform over the gate"
    assert shape_text(SHAPES["rises by 50 %"]) == "the background rises by 50 % over the gate"
    assert shape_text(SHAPES["falls by 20 %"]) == "the background falls by 20 % over the gate"
    middle = SHAPES["is largest in the middle"]
    middle_text = shape_text(middle / middle.mean())
    assert middle_text.startswith("the background varies over the gate, from 0.76 of its mean in")


@pytest.mark.compiled
def test_echoes_longer_than_the_pulse_are_not_taken_for_background() -> None:
    captures, _ = FluxRegime("all", "middle", "twice as long").captures(seed=3)
    assert flux_prior_of(captures[0]).background_shape is None


FAINT = {
    "decays by the middle": np.exp(-3 * TIME),
    "decays soon": np.exp(-np.arange(100) / 30),
    "afterglow": 1 + 4 * np.exp(-np.arange(100) / 3),
}
"""Shapes over which faint echoes seem to lie where the background is largest."""


def faint(shape: np.ndarray, delays: tuple[float, float], signal: float) -> Capture:
    """Capture with echoes over one photon of background per pulse."""
    rng, acquisition = np.random.default_rng(1), Acquisition(n_pulses=1000)
    onset = rng.uniform(*delays, (SIDE, SIDE))
    rate = rate_per_bin(onset, np.full(onset.shape, signal), 0.0, Pulse(), acquisition)
    counts = draw_counts(rate + shape / shape.sum(), 1000, rng)
    return Capture(counts, acquisition, Pulse(), acquisition.bin_to_range_m(onset))


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("shape", "delays", "signal"),
    [
        ("decays by the middle", (15, 85), 0.08),
        ("decays soon", (15, 85), 0.1),
        ("decays soon", (45, 55), 0.05),  # also echoes hide the shape
        ("decays soon", (8, 18), 0.05),  # the shape is large at the echoes, too
        ("afterglow", (15, 85), 0.15),
    ],
)
def test_echoes_are_not_found_where_the_background_is_large(
    shape: str, delays: tuple[float, float], signal: float
) -> None:
    true = FAINT[shape] / FAINT[shape].mean()
    capture = faint(true, delays, signal)
    found = flux_prior_of(capture).background_shape
    assert found is not None
    assert np.sqrt(((found / true - 1) ** 2).mean()) < 0.025
    confidence, is_right = confidence_and_right(capture, estimate(capture, "likelihood"))
    assert is_right.mean() > 0.93
    # Three standard deviations of a share, and the error of one estimate of the fluxes.
    assert confidence.mean() == pytest.approx(is_right.mean(), abs=0.03)
    assert "background" not in fit_of(capture).remark


@pytest.mark.compiled
def test_much_longer_echoes_are_not_taken_for_background() -> None:
    rng, acquisition = np.random.default_rng(1), Acquisition(n_pulses=100)
    onset = rng.uniform(45, 55, (SIDE, SIDE))
    rate = rate_per_bin(onset, np.ones(onset.shape), 0.3, Pulse(6e-9), acquisition)
    capture = Capture(draw_counts(rate, 100, rng), acquisition, Pulse())
    assert flux_prior_of(capture).background_shape is None


def with_two_surfaces(width_s: float, sbr: float, *, is_flat: bool) -> Capture:
    """Capture of a pane that all pixels see before a scene, both as bright."""
    rng, gate = np.random.default_rng(0), Acquisition(n_pulses=1000)
    behind = np.full((32, 32), 60.7) if is_flat else rng.uniform(48, 60, (32, 32))
    pane_m, behind_m = map(gate.bin_to_range_m, (np.full((32, 32), 30.3), behind))
    scene = Scene(pane_m, second_surface=SecondSurface(behind_m, np.full((32, 32), 0.5)))
    return simulate(scene, gate, Flux(0.1, sbr), Pulse(width_s))


@pytest.mark.compiled
@pytest.mark.parametrize(
    "capture",
    [
        simulate(net(32, 15.0), Acquisition(n_pulses=1000), Flux(0.1, 0.3), Pulse(0.5e-9)),
        simulate(net(32), Acquisition(n_pulses=1000), Flux(0.1, 0.3), Pulse(1e-9)),
        with_two_surfaces(3e-9, 0.3, is_flat=True),
        with_two_surfaces(1e-9, 0.3, is_flat=False),
    ],
)
def test_a_surface_that_all_pixels_see_besides_another_is_not_taken_for_background(
    capture: Capture,
) -> None:
    assert flux_prior_of(capture).background_shape is None
    flux = estimate_mean_flux(capture)
    assert flux.signal.low <= 0.1 <= flux.signal.high
    assert flux.background.low <= 0.1 / 0.3 <= flux.background.high
    returns = estimate(capture, "likelihood", returns=2).returns
    assert returns is not None
    has_two = returns.count(capture.shape)[returns.row, returns.col] == 2
    assert has_two.mean() > 0.9
    assert np.quantile(returns.confidence[has_two], 0.1) > 0.9


@pytest.mark.compiled
def test_a_cloud_longer_than_the_pulse_is_background() -> None:
    at = np.arange(100) + 0.5
    shape = 1 + 0.6 * np.exp(-(((at - 40) / 6) ** 2) / 2)
    capture = drawn(shape, (55.0, 85.0))
    found = flux_prior_of(capture).background_shape
    assert found is not None
    assert np.sqrt(((found / shape * shape.mean() - 1) ** 2).mean()) < 0.03
    assert "would look the same" in capture_report(capture).flux_remark
