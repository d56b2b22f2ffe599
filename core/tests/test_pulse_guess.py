"""Width of the pulse, estimated from pairs of photons: right within its scatter, or None."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import t as student

from core.acquisition import Acquisition, Flux, Pulse
from core.io.readers import read_capture
from core.io.readers.pulse_guess import guessed_pulse, guessed_sigma_bins, pairs_by_lag
from core.scene import Scene, scenes
from core.simulation import simulate
from core.tests.captures import real_capture_path

pytestmark = pytest.mark.compiled

Cube = np.ndarray
SEEDS = range(6)


def first_photons(sigma_bins: float, sbr: float, seed: int, scene: str = "uniform") -> Cube:
    """First photons of 1000 pulses, 64 x 64 pixels, 100 bins."""
    kind = scenes[scene]()
    pulse = Pulse.gaussian(sigma_bins * 1e-9)
    return simulate(kind, kind.acquisition, Flux(sbr=sbr), pulse, seed).cube


def all_photons(sigma_bins: float, per_pixel: float, seed: int, sbr: float = 1.0) -> Cube:
    """All photons, from surfaces anywhere in 300 of 500 bins, of 100 x 100 pixels."""
    rng = np.random.default_rng(seed)
    signal = per_pixel * sbr / (1 + sbr)
    since_echo = np.arange(501) - rng.uniform(100, 400, (100, 100, 1))
    mean = signal * np.diff(ndtr(since_echo / sigma_bins)) + (per_pixel - signal) / 500
    return rng.poisson(mean).astype(np.uint16)


def require_right(sigma_bins: float, make: Callable[[int], Cube], bias: float) -> None:
    """The mean over seeds is right within its own scatter, at 99.9 %, and a share of `bias`."""
    found = [guessed_sigma_bins(make(seed)) for seed in SEEDS]
    assert None not in found
    guesses = np.array(found, float)
    error = guesses.std(ddof=1) / np.sqrt(len(SEEDS))
    margin = student.ppf(0.9995, len(SEEDS) - 1) * error
    assert abs(guesses.mean() - sigma_bins) < margin + bias * sigma_bins


@pytest.mark.parametrize(
    ("sigma_bins", "sbr", "scene", "bias"),
    [
        *((s, sbr, "uniform", 0.02) for s in (0.5, 1.0, 2.0, 4.0) for sbr in (1.0, 0.3, 0.1, 0.06)),
        # A pulse that fills much of the gate
        (8.0, 1.0, "uniform", 0.05),
        (8.0, 0.3, "uniform", 0.05),
        # Most echoes in a few bins, where the mean histogram is no background
        (1.0, 0.1, "car", 0.05),
        (2.0, 0.1, "car", 0.05),
    ],
)
def test_first_photons_piled_up(sigma_bins: float, sbr: float, scene: str, bias: float) -> None:
    """The steps of the fit are 1 % apart."""
    require_right(sigma_bins, lambda seed: first_photons(sigma_bins, sbr, seed, scene), bias)


@pytest.mark.parametrize(
    ("sigma_bins", "per_pixel", "sbr"),
    [(0.5, 1, 1.0), (2.0, 1, 1.0), (2.0, 2, 1.0), (5.6, 2, 1.0), (5.6, 8, 0.15), (8.0, 5, 0.5)],
)
def test_few_photons_a_pixel(sigma_bins: float, per_pixel: float, sbr: float) -> None:
    require_right(sigma_bins, lambda seed: all_photons(sigma_bins, per_pixel, seed, sbr), bias=0.03)


def test_a_wall_all_at_one_range() -> None:
    wall = Scene(np.full((64, 64), 50.0))
    for sigma_bins in (1.0, 2.0):
        pulse = Pulse.gaussian(sigma_bins * 1e-9)
        cubes = [simulate(wall, Acquisition(), Flux(sbr=0.3), pulse, s).cube for s in SEEDS]
        found = [guessed_sigma_bins(cube) for cube in cubes]
        np.testing.assert_allclose(np.array(found, float), sigma_bins, rtol=0.1)


@pytest.mark.parametrize("sbr", [1.0, 0.1, 0.06, 0.03, 0.01])
def test_nothing_is_estimated_without_an_echo(sbr: float) -> None:
    """Up to ten background photons a pulse, whose first ones decay within ten bins."""
    empty = Scene(np.full((64, 64), np.nan))
    for acquisition in (Acquisition(), Acquisition(300, 0.3e-9, n_pulses=100)):
        for seed in SEEDS:
            cube = simulate(empty, acquisition, Flux(sbr=sbr), seed=seed).cube
            assert guessed_sigma_bins(cube) is None


@pytest.mark.parametrize("mean", [0.0, 0.01, 0.3, 30.0])
def test_nothing_is_estimated_from_background_alone(mean: float) -> None:
    rng = np.random.default_rng(1)
    for n_bins in (16, 17, 100, 700):
        assert guessed_sigma_bins(rng.poisson(mean, (30, 40, n_bins)).astype(np.uint32)) is None
    assert guessed_sigma_bins(rng.poisson(mean, (30, 40, 15)).astype(np.uint32)) is None
    assert guessed_sigma_bins(rng.poisson(mean, (1, 31, 100)).astype(np.uint32)) is None


def test_nothing_is_estimated_from_very_many_bins() -> None:
    assert guessed_sigma_bins(np.zeros((32, 1, 2**16 + 1), np.uint8)) is None


def test_a_pulse_has_two_digits_or_the_width_of_a_bin() -> None:
    assert guessed_pulse(all_photons(2.0, 8, 0), 64e-12) == Pulse.gaussian(130e-12)
    assert guessed_pulse(np.zeros((9, 9, 50), np.uint16), 64e-12) == Pulse.gaussian(64e-12)


def test_pairs_are_those_counted_one_by_one() -> None:
    rows = np.random.default_rng(0).poisson(0.5, (4, 20)).astype(np.uint8)
    # All shifts of each histogram: their mean is level, and all photons weigh the same.
    cube = np.array([np.roll(row, shift) for row in rows for shift in range(20)])[np.newaxis]
    expected = np.zeros(15)
    for row in cube.reshape(-1, 20):
        bins = np.repeat(np.arange(20), row)
        for i, first in enumerate(bins):
            for j, second in enumerate(bins):
                if i != j and 0 <= second - first < 15:
                    expected[second - first] += 1
    pairs = pairs_by_lag(cube, 15)
    assert pairs.shape == (32, 15)
    np.testing.assert_allclose(pairs.sum(axis=0), expected, atol=1e-3)


def test_large_cubes_take_little_memory() -> None:
    """As large as a published capture: 101 million bins."""
    cube = np.zeros((340, 340, 876), np.uint16)
    cube[:, :, 300:310] = 1
    guessed_sigma_bins(cube)  # compiles
    tracemalloc.start()
    try:
        guessed_sigma_bins(cube)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2**25


def test_published_captures() -> None:
    """The face's pulse rises within 50 ps and has a tail of half a nanosecond."""
    for name, sigma_s in {"data_face.mat": 175e-12, "21km_K11_night.mat": 450e-12}.items():
        pulse = read_capture(real_capture_path(name)).pulse
        assert pulse.shape == "gaussian" and pulse.tau_s == pytest.approx(sigma_s, rel=0.05)
