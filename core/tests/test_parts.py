"""Tests of the physics of the parts of scenes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

from core.acquisition import Acquisition, Flux, Pulse
from core.effects import LIDAR_RATIO_SR, Backscatter, FaultyPixels, Jitter, Motion, SecondSurface
from core.estimators import estimate
from core.scene import PARTS, Scene, parts_of, scenes, without
from core.simulation import cumulative_trigger_probability, simulate
from core.studies.ablation.plain import plain_triggered
from core.trigger import no_trigger_probability, rate_per_bin, trigger_probability

GATE = Acquisition(n_bins=80, n_pulses=400)
FLUX, PULSE = Flux(0.4, 0.5), Pulse()
ONSET_BIN = np.array([[20.3, 41.7, np.nan]])
SCENE = Scene(GATE.bin_to_range_m(ONSET_BIN))


def edges(scene: Scene, acquisition: Acquisition = GATE, flux: Flux = FLUX) -> np.ndarray:
    return cumulative_trigger_probability(scene, acquisition, flux, PULSE)


def second(onset_bin: Any, share: Any) -> SecondSurface:
    shape = SCENE.range_m.shape
    range_m = GATE.bin_to_range_m(np.broadcast_to(onset_bin, shape).astype(float))
    return SecondSurface(range_m, np.broadcast_to(share, shape).astype(float))


def faulty(dark_count_hz: Any = 0.0, dead: Any = False) -> FaultyPixels:
    shape = SCENE.range_m.shape
    return FaultyPixels(
        np.broadcast_to(dark_count_hz, shape).astype(float), np.broadcast_to(dead, shape)
    )


# -- absence ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", scenes)
def test_absent_parts_leave_the_plain_model_bit_for_bit(name: str) -> None:
    scene = without(scenes[name](), *PARTS)
    assert parts_of(scene) == ()
    given = (scene, scene.acquisition, Flux(), Pulse())
    np.testing.assert_array_equal(cumulative_trigger_probability(*given), plain_triggered(*given))


@pytest.mark.parametrize(
    "nothing",
    [
        {"ambient": np.ones(SCENE.range_m.shape)},
        {"second_surface": second(60.0, 0.0)},
        {"second_surface": second(np.nan, 0.7)},
        {"backscatter": Backscatter(0.0)},
        {"faulty_pixels": faulty()},
        {"motion": Motion(0.0, 1e3)},
        {"jitter": Jitter(0.0)},
    ],
    ids=[
        "even background",
        "no share",
        "no second surface",
        "clear air",
        "good pixels",
        "standing",
        "no jitter",
    ],
)
def test_a_part_that_does_nothing_changes_no_bit(nothing: dict[str, Any]) -> None:
    np.testing.assert_array_equal(edges(replace(SCENE, **nothing)), edges(SCENE))


def test_parts_are_known_by_name() -> None:
    scene = replace(SCENE, motion=Motion(3.0, 1e3), jitter=Jitter(1e-9))
    assert parts_of(SCENE) == ()
    assert parts_of(scene) == ("motion", "jitter")
    assert parts_of(without(scene, "motion")) == ("jitter",)
    assert parts_of(without(scene, "motion", "jitter")) == ()
    assert without(scene) is scene
    assert set(PARTS) == set(vars(Scene(SCENE.range_m))) - {"range_m", "acquisition"}
    with pytest.raises(ValueError, match=r"part = 'rain' .*'motion'"):
        without(scene, "rain")


def test_each_part_is_needed_by_a_built_in_scene() -> None:
    built_in = {part for build in scenes.values() for part in parts_of(build())}
    assert built_in | {"falloff"} == set(PARTS)  # added by a photon budget


# -- what each part does ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", scenes)
def test_probabilities_are_probabilities(name: str) -> None:
    scene = scenes[name]()
    triggered = cumulative_trigger_probability(scene, scene.acquisition, Flux(5.0, 10.0), Pulse())
    assert (triggered[:, 0] == 0).all()
    assert triggered.max() <= 1 + 1e-12  # what is left of 1 is that of no trigger
    assert np.diff(triggered).min() >= -1e-12


def test_each_pixel_has_its_own_background() -> None:
    factors = np.array([[0.0, 0.5, 3.0]])
    found = edges(replace(SCENE, ambient=factors))
    for pixel, factor in enumerate(factors[0]):
        flux = Flux(FLUX.signal, FLUX.signal / (factor * FLUX.background) if factor else math.inf)
        np.testing.assert_allclose(found[pixel], edges(SCENE, flux=flux)[pixel], atol=1e-14)
    assert simulate(replace(SCENE, ambient=factors), GATE, FLUX).background is None


def test_a_pixel_that_sees_two_surfaces_mixes_their_echoes() -> None:
    share, onset_bin = 0.3, 60.2
    found = np.diff(edges(replace(SCENE, second_surface=second(onset_bin, share))))[0]
    near, far = (
        rate_per_bin(at, strength * FLUX.signal, 0.0, PULSE, GATE)
        for at, strength in ((20.3, 1 - share), (onset_bin, share))
    )
    expected = trigger_probability(near + far + FLUX.background / GATE.n_bins)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_a_second_surface_that_returns_everything_is_the_first() -> None:
    whole = replace(SCENE, second_surface=second(ONSET_BIN + 30, 1.0))
    moved = Scene(GATE.bin_to_range_m(ONSET_BIN + 30))
    np.testing.assert_array_equal(edges(whole), edges(moved))


def test_fog_returns_what_the_lidar_equation_says() -> None:
    gate = Acquisition(n_bins=60, gate_delay_s=30e-9)
    fog, signal = Backscatter(0.02, reference_m=40.0), 0.3

    def returned(range_m: float) -> float:
        scale = math.pi * signal * 40.0**2 * 0.02 / LIDAR_RATIO_SR
        return scale * math.exp(-0.04 * range_m) / range_m**2

    def before(time_bin: float) -> float:
        """All that fog from one metre on returns until then: each metre as late as its pulse."""
        last_m = float(gate.bin_to_range_m(time_bin))
        late_s = gate.bin_width_s / gate.bin_length_m

        def arrived(range_m: float) -> float:
            return returned(range_m) * float(PULSE.cdf((last_m - range_m) * late_s))

        return quad(arrived, 1.0, last_m, epsabs=1e-12, limit=200)[0]

    expected = np.array([before(k) for k in range(0, 61, 10)]) - before(0)
    found = fog.photons_before(signal, PULSE, gate)
    # The pulse's tail beyond a thousandth is left out, and the ramp is even within a bin.
    np.testing.assert_allclose(found[::10], expected, rtol=3e-3)
    np.testing.assert_allclose(fog.transmission(np.array([25.0])), math.exp(-1))


def test_fog_dims_what_lies_behind_it() -> None:
    scene = replace(SCENE, backscatter=Backscatter(0.01))
    range_m, ramp = scene.range_m[0, 0], Backscatter(0.01).photons_before(FLUX.signal, PULSE, GATE)
    echo = rate_per_bin(20.3, FLUX.signal * math.exp(-0.02 * range_m), FLUX.background, PULSE, GATE)
    expected = trigger_probability(echo + np.diff(ramp))
    np.testing.assert_allclose(np.diff(edges(scene))[0], expected, rtol=0, atol=1e-14)


def test_hot_pixels_fire_as_often_as_they_say_and_dead_ones_never() -> None:
    hot_hz = 2e7
    scene = replace(SCENE, faulty_pixels=faulty([[0.0, 0.0, hot_hz]], [[True, False, False]]))
    photons = FLUX.background + hot_hz * GATE.n_bins * GATE.bin_width_s
    found = edges(scene)
    assert (found[0] == 0).all()
    np.testing.assert_array_equal(found[1], edges(SCENE)[1])
    np.testing.assert_allclose(1 - found[2, -1], math.exp(-photons), rtol=1e-12)
    counts = simulate(scene, GATE, FLUX, seed=1).counts[0]
    assert counts[0] == 0
    low, high = stats.binom.ppf([5e-5, 1 - 5e-5], GATE.n_pulses, 1 - math.exp(-photons))
    assert low <= counts[2] <= high


@pytest.mark.parametrize(("speed_m_per_s", "n_pulses"), [(-15.0, 400), (40.0, 400), (400.0, 5)])
def test_motion_is_the_mean_over_the_pulses(speed_m_per_s: float, n_pulses: int) -> None:
    gate, rate_hz = replace(GATE, n_pulses=n_pulses), 10e3
    found = np.diff(edges(replace(SCENE, motion=Motion(speed_m_per_s, rate_hz)), gate))[0]
    sent_s = (np.arange(n_pulses) - (n_pulses - 1) / 2) / rate_hz
    onset_bin = 20.3 + sent_s * speed_m_per_s / gate.bin_length_m
    signal = np.full(n_pulses, FLUX.signal)
    each = trigger_probability(rate_per_bin(onset_bin, signal, FLUX.background, PULSE, gate))
    # Groups of pulses a quarter of a bin wide; with as many groups as pulses, exact.
    np.testing.assert_allclose(
        found, each.mean(axis=0), rtol=0, atol=1e-13 if n_pulses == 5 else 2e-4
    )
    # Pulses that stand in order scatter less than those that are drawn, by a few hundredths.
    in_order = (each * (1 - each)).sum(axis=0)
    drawn = n_pulses * found * (1 - found)
    assert (in_order > 0.9 * drawn).all()


def test_jitter_convolves_what_is_recorded() -> None:
    bin_width_s, sigma_bins = GATE.bin_width_s, 1.3
    before, found = edges(SCENE), edges(replace(SCENE, jitter=Jitter(sigma_bins * bin_width_s)))
    # Detections spread evenly over their bin, then by a Gaussian: by quadrature, edge by edge.
    x, weight = np.polynomial.hermite_e.hermegauss(120)
    k = np.arange(GATE.n_bins + 1)
    at = k - sigma_bins * x[:, np.newaxis]
    expected = np.array([weight @ np.interp(at, k, row) / weight.sum() for row in before])
    np.testing.assert_allclose(found, expected - expected[:, :1], rtol=0, atol=2e-4)


def test_jitter_does_not_change_which_photon_is_first() -> None:
    bright = Flux(0.5, 0.1)
    clear, jittered = (
        edges(each, flux=bright)[2, -1] for each in (SCENE, replace(SCENE, jitter=Jitter(1e-9)))
    )
    rate = rate_per_bin(np.nan, 0.0, bright.background, PULSE, GATE)
    assert clear == pytest.approx(1 - no_trigger_probability(rate))
    # As many fire; those lost left the gate by its front: at most rate · σ / √(2π).
    assert clear - rate[0] / math.sqrt(2 * math.pi) < jittered < clear


# -- captures of scenes with parts -----------------------------------------------------------------


def test_true_fluxes_are_known_only_for_one_echo_over_uniform_background() -> None:
    plain = simulate(replace(SCENE, reflectivity=np.array([[1.0, 0.5, 1.0]])), GATE, FLUX)
    assert plain.signal is not None
    assert plain.background == FLUX.background
    foggy = simulate(replace(SCENE, backscatter=Backscatter(0.01)), GATE, FLUX)
    assert foggy.signal is foggy.background is None
    np.testing.assert_array_equal(foggy.truth_range_m, SCENE.range_m)
    with pytest.raises(ValueError, match="oracle"):
        estimate(foggy, "oracle")


def test_a_moving_scene_needs_a_number_of_pulses() -> None:
    moving = replace(SCENE, motion=Motion(1.0, 1e3))
    with pytest.raises(ValueError, match="n_pulses = None"):
        edges(moving, replace(GATE, n_pulses=None))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: second(30.0, 1.5), "share = .*0 to 1"),
        (lambda: second(30.0, np.nan), "share = "),
        (lambda: SecondSurface(np.zeros((2, 2)), np.zeros((2, 3))), "share = 'shape"),
        (lambda: Backscatter(-0.1), "extinction_per_m = -0.1"),
        (lambda: Backscatter(0.1, 0.0), "reference_m = 0.0"),
        (lambda: faulty(-1.0), "dark_count_hz = "),
        (lambda: faulty(np.inf), "dark_count_hz = "),
        (lambda: FaultyPixels(np.zeros((2, 2)), np.zeros((1, 2), bool)), "dead = 'shape"),
        (lambda: Motion(math.nan, 1.0), "speed_m_per_s = nan"),
        (lambda: Motion(1.0, 0.0), "pulse_rate_hz = 0.0"),
        (lambda: Jitter(-1e-9), "sigma_s = -1e-09"),
        (lambda: Jitter(math.inf), "sigma_s = inf"),
        (lambda: Scene(np.zeros((2, 2)), second_surface=second(30.0, 0.5)), "second_surface = "),
        (lambda: Scene(np.zeros((2, 2)), faulty_pixels=faulty()), "faulty_pixels = "),
    ],
)
def test_bad_parts_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


# -- the scenes that need them ---------------------------------------------------------------------


def test_edges_see_two_surfaces_apart_by_area() -> None:
    scene, coarse = scenes["edges"](), scenes["building"]()
    other = scene.second_surface
    assert other is not None
    share = other.effective_share
    assert 0.05 < (share > 0).mean() < 0.5
    assert share.max() <= 0.5
    apart_m = np.abs(other.range_m - scene.range_m)[share > 0]
    assert apart_m.min() >= 2 * scene.acquisition.bin_length_m
    alone = (share == 0) & np.isfinite(scene.range_m) & np.isfinite(coarse.range_m)
    assert np.median(np.abs(scene.range_m - coarse.range_m)[alone]) < 0.1
    assert scene.reflectivity is not None
    np.testing.assert_array_equal(scene.reflectivity == 0, np.isnan(scene.range_m))
