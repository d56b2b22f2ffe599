"""The pulse, estimated from pairs of photons: right within its scatter, or None."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import gammainc, ndtr
from scipy.stats import binom
from scipy.stats import t as student

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.estimators import estimate
from core.io.readers.pulse_guess import (
    PulseGuess,
    guessed_pulse,
    pulse_guess,
)
from core.scene import Scene, scenes
from core.simulation import simulate
from core.tests.refusing import with_peak

pytestmark = pytest.mark.compiled

Cube = NDArray[Any]
SEEDS = range(6)
RIGHT = 1.3
"""Largest factor between the width of a right guess and the truth."""


def first_photons(sigma_bins: float, sbr: float, seed: int, scene: str = "uniform") -> Cube:
    """First photons of 1000 pulses, 64 x 64 pixels, 100 bins."""
    kind = scenes[scene]()
    pulse = Pulse.gaussian(sigma_bins * 1e-9)
    return simulate(kind, kind.acquisition, Flux(sbr=sbr), pulse, seed).cube


def all_photons(sigma_bins: float, per_pixel: float, seed: int, sbr: float = 1.0) -> Cube:
    """All photons, from surfaces anywhere in 300 of 500 bins, of 100 x 100 pixels."""
    rng = np.random.default_rng(seed)
    n_pixels, n_bins = 10_000, 500
    signal = per_pixel * sbr / (1 + sbr)
    depths = rng.uniform(100, 400, n_pixels)
    pixel = np.repeat(np.arange(n_pixels), rng.poisson(signal, n_pixels))
    echoes = (depths[pixel] + sigma_bins * rng.standard_normal(pixel.size)).astype(int)
    noise = rng.integers(0, n_pixels * n_bins, rng.poisson((per_pixel - signal) * n_pixels))
    photons = np.concatenate([pixel * n_bins + echoes, noise])
    counts = np.bincount(photons, minlength=n_pixels * n_bins)
    return counts.astype(np.uint16).reshape(100, 100, n_bins)


def width_of(cube: Cube) -> float | None:
    guess = pulse_guess(cube)
    return None if guess is None else guess.sigma_bins


def require_right(sigma_bins: float, make: Callable[[int], Cube], bias: float) -> None:
    """The mean over seeds is right within its own scatter, at 99.9 %, and a share of `bias`."""
    found = [width_of(make(seed)) for seed in SEEDS]
    assert None not in found
    guesses = np.array(found, float)
    error = guesses.std(ddof=1) / np.sqrt(len(SEEDS))
    margin = student.ppf(0.9995, len(SEEDS) - 1) * error
    assert abs(guesses.mean() - sigma_bins) < margin + bias * sigma_bins


@pytest.mark.parametrize(
    ("sigma_bins", "sbr", "scene", "bias"),
    [
        *((sigma, sbr, "uniform", 0.02) for sigma in (0.5, 4.0) for sbr in (1.0, 0.06)),
        # A pulse that fills much of the gate
        (8.0, 0.3, "uniform", 0.05),
        # Most echoes in a few bins, where the mean histogram is no background
        (2.0, 0.1, "car", 0.05),
    ],
)
def test_first_photons_piled_up(sigma_bins: float, sbr: float, scene: str, bias: float) -> None:
    """Candidates are 2 % apart."""
    require_right(sigma_bins, lambda seed: first_photons(sigma_bins, sbr, seed, scene), bias)


@pytest.mark.parametrize(
    ("sigma_bins", "per_pixel", "sbr"),
    [(0.5, 1, 1.0), (5.6, 2, 1.0), (5.6, 8, 0.15)],
)
def test_few_photons_a_pixel(sigma_bins: float, per_pixel: float, sbr: float) -> None:
    require_right(sigma_bins, lambda seed: all_photons(sigma_bins, per_pixel, seed, sbr), bias=0.03)


DEPTHS: dict[str, Callable[[float, int, np.random.Generator], Cube]] = {
    # At the same place in the bin for all pixels, which a narrow pulse must not be confused by
    "flat": lambda sigma, n, rng: np.full((40, 40), n / 2 + rng.random()),
    "ramp": lambda sigma, n, rng: n / 2 + np.add.outer(np.zeros(40), np.linspace(0, 4 * sigma, 40)),
    "spread": lambda sigma, n, rng: rng.uniform(n / 4, 3 * n / 4, (40, 40)),
    "no echo": lambda sigma, n, rng: np.full((40, 40), np.inf),
}


def cumulative(shape: str, since_echo: Cube, sigma: float) -> Cube:
    """Return the share of an echo that has arrived, for a standard deviation."""
    if shape == "gaussian":
        return np.asarray(ndtr(since_echo / sigma))
    return np.asarray(gammainc(2, np.maximum(since_echo, 0) * np.sqrt(2) / sigma))


def random_guess(scene: str, seed: int, shape: str = "gaussian") -> tuple[float, PulseGuess | None]:
    """Draw a width, 1 to 1000 photons a pixel, an SBR of 0.02 to 100 and counts; return a guess."""
    rng = np.random.default_rng(seed)
    sigma, per_pixel, sbr = np.exp(rng.uniform(*np.log([(0.3, 1, 0.02), (30, 1000, 100)])))
    n_bins = 256 if sigma < 8 else 1024
    since_echo = np.arange(n_bins + 1) - DEPTHS[scene](sigma, n_bins, rng)[..., np.newaxis]
    echo = per_pixel * sbr / (1 + sbr) * cumulative(shape, since_echo, sigma)
    before = echo + per_pixel / (1 + sbr) * np.linspace(0, 1, n_bins + 1)
    if seed % 2:
        return sigma, pulse_guess(rng.poisson(np.diff(before)).astype(np.uint16))
    shares = np.diff(-np.expm1(-before / 1000), append=1.0)  # first photons of 1000 pulses
    shares[..., 0] = 1 - shares[..., 1:].sum(axis=-1)
    return sigma, pulse_guess(rng.multinomial(1000, shares)[..., :-1].astype(np.uint16))


@pytest.mark.parametrize(
    ("scene", "first", "shape"),
    [
        ("flat", 0, "gaussian"),
        ("ramp", 16, "gaussian"),
        ("spread", 32, "gaussian"),
        ("spread", 48, "gamma"),
    ],
)
def test_a_guess_is_right_or_undetermined(scene: str, first: int, shape: str) -> None:
    """Three standard errors from 32 groups are exceeded as often as Student's t."""
    guesses = [random_guess(scene, seed, shape) for seed in range(first, first + 8)]
    found = [(sigma, guess) for sigma, guess in guesses if guess]
    made = [(sigma, guess) for sigma, guess in found if guess.is_determined]
    assert len(made) >= 4
    wrong = [
        (sigma, guess)
        for sigma, guess in made
        if (guess.shape != shape and not (guess.shape == "gaussian" and guess.may_have_tail))
        or abs(np.log(guess.sigma_bins / sigma)) > np.log(RIGHT)
    ]
    wrong += [
        (sigma, guess)
        for sigma, guess in found
        if not guess.is_determined
        and not guess.low_bins < sigma * guess.tau_bins / guess.sigma_bins < guess.high_bins
    ]
    assert len(wrong) <= binom.ppf(0.99, len(found), 2 * student.sf(3, 31)), wrong


def test_no_guess_is_made_without_an_echo() -> None:
    assert [random_guess("no echo", seed)[1] for seed in range(8)] == [None] * 8


def test_most_true_widths_lie_in_the_interval() -> None:
    guesses = [pulse_guess(first_photons(2.0, 0.1, seed)) for seed in range(10)]
    assert None not in guesses
    inside = [guess.low_bins < 2.0 < guess.high_bins for guess in guesses if guess]
    assert sum(inside) >= binom.ppf(0.001, len(inside), 1 - 2 * student.sf(3, 31))


def test_spread_depths_are_not_taken_for_the_pulse() -> None:
    """Two photons of 102 come from depths that are spread over 60 bins of 1024."""
    rng = np.random.default_rng(1)
    delay = 100 + 30 * np.sin(np.add.outer(np.arange(72) / 23, np.arange(88) / 30))
    since_echo = np.arange(1025) - delay[..., np.newaxis]
    cube = rng.poisson(2 * np.diff(ndtr(since_echo / 2)) + 100 / 1024).astype(np.uint16)
    acquisition = Acquisition(n_bins=1024, gate_delay_s=0.0, n_pulses=None)
    shares = []
    for pulse in (Pulse.gaussian(2e-9), guessed_pulse(cube, 1e-9)[0]):
        capture = Capture(cube[::2], acquisition, pulse, detection="all")
        error_bins = acquisition.range_m_to_bin(estimate(capture, "likelihood").range_m)
        shares.append(np.mean(np.abs(error_bins - delay[::2]) <= 3))
    assert shares[0] > 0.15
    assert shares[1] == pytest.approx(shares[0], abs=0.02)


def test_brighter_pixels_that_decay_faster_are_no_echo() -> None:
    rng = np.random.default_rng(0)
    rate = 2 * np.exp(0.5 * rng.standard_normal((64, 64, 1)))
    before = -np.expm1(-rate * np.linspace(0, 1, 257))
    for n_pulses in (300, 3000):
        cube = rng.multinomial(n_pulses, np.diff(before, append=1.0))[..., :-1]
        assert pulse_guess(cube.astype(np.uint16)) is None


@pytest.mark.parametrize(("scene", "sbr"), [("uniform", 0.3), ("uniform", 0.1), ("car", 0.3)])
def test_a_pulse_with_a_tail(scene: str, sbr: float) -> None:
    kind = scenes[scene]()
    for tau_s in (1e-9, 2e-9):
        cube = simulate(kind, kind.acquisition, Flux(sbr=sbr), Pulse(tau_s), seed=1).cube
        pulse = guessed_pulse(cube, 1e-9)[0]
        assert pulse.shape == "gamma" and pulse.tau_s == pytest.approx(tau_s, rel=0.1)


def test_a_wall_all_at_one_range() -> None:
    wall = Scene(np.full((64, 64), 50.0))
    for sigma_bins in (1.0, 2.0):
        pulse = Pulse.gaussian(sigma_bins * 1e-9)
        cubes = [simulate(wall, Acquisition(), Flux(sbr=0.3), pulse, s).cube for s in range(2)]
        found = [width_of(cube) for cube in cubes]
        np.testing.assert_allclose(np.array(found, float), sigma_bins, rtol=0.1)


def bright(shape: str, signal: float, background: float, seed: int) -> Cube:
    """First photons of 1000 pulses of sigma 2 bins, from a slope: 32 x 32 pixels, 128 bins."""
    depths = np.linspace(40, 80, 32) + np.zeros((32, 1))
    since_echo = np.arange(129) - depths[..., np.newaxis]
    before = signal * cumulative(shape, since_echo, 2.0) + background * np.linspace(0, 1, 129)
    shares = np.diff(-np.expm1(-before), append=1.0)
    counts = np.random.default_rng(seed).multinomial(1000, shares)[..., :-1]
    return np.asarray(counts.astype(np.uint16))


@pytest.mark.parametrize("shape", ["gaussian", "gamma"])
def test_a_bright_pulse_is_not_shortened_by_pile_up(shape: str) -> None:
    """Its first photons alone come from the leading edge, and fewer follow than lead."""
    for signal, background in ((3.0, 0.3), (1.0, 2.0)):
        guesses = [pulse_guess(bright(shape, signal, background, s), 1000) for s in range(4)]
        found = [guess for guess in guesses if guess and guess.shape == shape]
        assert len(found) == len(guesses) and all(guess.is_determined for guess in found)
        tau = 2.0 / (np.sqrt(2) if shape == "gamma" else 1.0)
        inside = [guess.low_bins < tau < guess.high_bins for guess in found]
        assert sum(inside) >= binom.ppf(0.001, len(inside), 1 - 2 * student.sf(3, 31))


def test_nothing_is_estimated_where_no_pulse_is_left() -> None:
    assert pulse_guess(bright("gaussian", 1.0, 7.0, 0), 1000) is None


@pytest.mark.parametrize("sbr", [1.0, 0.06, 0.01])
def test_nothing_is_estimated_without_an_echo(sbr: float) -> None:
    """Up to ten background photons a pulse, whose first ones decay within ten bins."""
    empty = Scene(np.full((64, 64), np.nan))
    for acquisition in (Acquisition(), Acquisition(300, 0.3e-9, n_pulses=100)):
        for seed in range(2):
            cube = simulate(empty, acquisition, Flux(sbr=sbr), seed=seed).cube
            assert pulse_guess(cube) is None


@pytest.mark.parametrize("mean", [0.0, 0.01, 0.3, 30.0])
def test_nothing_is_estimated_from_background_alone(mean: float) -> None:
    rng = np.random.default_rng(1)
    for n_bins in (16, 17, 100, 700):
        assert pulse_guess(rng.poisson(mean, (30, 40, n_bins)).astype(np.uint32)) is None
    assert pulse_guess(rng.poisson(mean, (30, 40, 15)).astype(np.uint32)) is None
    assert pulse_guess(rng.poisson(mean, (1, 31, 100)).astype(np.uint32)) is None


def test_nothing_is_estimated_from_very_many_bins() -> None:
    assert pulse_guess(np.zeros((32, 1, 2**16 + 1), np.uint8)) is None


def test_a_pulse_has_two_digits_or_the_width_of_a_bin() -> None:
    assert guessed_pulse(all_photons(2.0, 8, 0), 64e-12)[0] == Pulse.gaussian(130e-12)
    assert guessed_pulse(np.zeros((9, 9, 50), np.uint16), 64e-12)[0] == Pulse.gaussian(64e-12)


def test_large_cubes_take_little_memory() -> None:
    """As large as a published capture: 101 million bins."""
    cube = np.zeros((340, 340, 876), np.uint16)
    cube[:, :, 300:310] = 1
    pulse_guess(cube)  # compiles
    assert with_peak(lambda: pulse_guess(cube))[1] < 2**25
