"""Tests that simulated captures follow Eq. 1 and depend on the seed only."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from core import trigger
from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.scene import Scene
from core.simulation import add_echo, cumulative_trigger_probability, first_photons, simulate
from core.trigger import no_trigger_probability, rate_per_bin, trigger_probability

DRAWS = 2_000_000  # of a large sample
# By chance, one fixed seed in ten thousand would fall below.
SIGNIFICANCE = 1e-4

ACQUISITION = Acquisition(n_bins=60, n_pulses=500)
ONSET_BIN = 22.3
PIXELS = DRAWS // 500

each_draw = pytest.mark.parametrize(
    "one_by_one_up_to", [8192, 0], ids=["one by one", "multinomial"]
)


def wall(n_pixels: int, onset_bin: float = ONSET_BIN) -> Scene:
    """One row of pixels that all see the same range; NaN for the open sky."""
    return Scene(np.full((1, n_pixels), ACQUISITION.bin_to_range_m(onset_bin)))


def outcomes(capture: Capture) -> np.ndarray:
    """Return the triggers of each bin over all pixels and, last, pulses without a trigger."""
    bins = capture.cube.sum(axis=(0, 1), dtype=np.int64)
    n_pulses = capture.acquisition.n_pulses or 0
    return np.append(bins, capture.cube[..., 0].size * n_pulses - bins.sum())


def expected_share(flux: Flux, pulse: Pulse, onset_bin: float = ONSET_BIN) -> np.ndarray:
    rate = rate_per_bin(onset_bin, flux.signal, flux.background, pulse, ACQUISITION)
    return np.append(trigger_probability(rate), no_trigger_probability(rate))


@pytest.mark.compiled
@each_draw
@pytest.mark.parametrize(
    ("flux", "pulse"),
    [
        (Flux(0.1041, 0.06), Pulse()),
        (Flux(1.5, 0.5), Pulse.gaussian(2e-9)),
        (Flux(0.05, 4.0), Pulse.measured([1, 2, 5, 2], 1e-9)),
    ],
    ids=["paper", "strong", "faint"],
)
def test_histograms_follow_equation_1(
    monkeypatch: pytest.MonkeyPatch, flux: Flux, pulse: Pulse, one_by_one_up_to: int
) -> None:
    monkeypatch.setattr(trigger, "PULSES_DRAWN_ONE_BY_ONE", one_by_one_up_to)
    found = outcomes(simulate(wall(PIXELS), ACQUISITION, flux, pulse, seed=1))
    expected = expected_share(flux, pulse) * found.sum()
    assert expected.min() > 5  # where chi-square holds
    assert stats.chisquare(found, expected).pvalue > SIGNIFICANCE


@pytest.mark.parametrize("n_pulses", [8192, 8193])
def test_many_pulses_are_all_accounted_for(n_pulses: int) -> None:
    certain = Acquisition(n_bins=3, gate_delay_s=0.0, n_pulses=n_pulses)
    cube = simulate(wall(1, np.nan), certain, Flux(1.0, 1 / 90)).cube
    # Thirty photons a bin: one pulse in 1e13 has none in the first.
    np.testing.assert_array_equal(cube, [[[n_pulses, 0, 0]]])


@pytest.mark.parametrize(
    ("n_pulses", "dtype"), [(1, np.uint16), (2**16 - 1, np.uint16), (2**16, np.uint32)]
)
def test_counts_fit_their_type(n_pulses: int, dtype: type) -> None:
    certain = Acquisition(n_bins=1, n_pulses=n_pulses)
    cube = simulate(wall(1, np.nan), certain, Flux(1.0, 1 / 50)).cube
    assert cube.dtype == dtype
    assert cube.item() == n_pulses


@pytest.mark.compiled
def test_cube_depends_on_the_seed_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, acquisition = wall(97), Acquisition(n_bins=60, n_pulses=100)
    first = simulate(scene, acquisition, Flux(), seed=7).cube  # on one thread
    monkeypatch.setattr("core.kernels.parallel.SERIAL_BELOW", 0)
    np.testing.assert_array_equal(simulate(scene, acquisition, Flux(), seed=7).cube, first)
    assert (simulate(scene, acquisition, Flux(), seed=8).cube != first).any(axis=2).all()


@pytest.mark.compiled
def test_pixels_are_independent_of_their_neighbours_and_of_the_next_seed() -> None:
    few = Acquisition(n_bins=10, n_pulses=20)
    scene = Scene(np.full((40, 50), np.nan))
    one, next_seed = (simulate(scene, few, Flux(1.0, 1.0), seed=seed).counts for seed in (4, 5))
    pairs = [
        (one[:, :-1], one[:, 1:]),
        (one[:-1], one[1:]),
        (one, next_seed),
        (one[:, 1:], next_seed[:, :-1]),
    ]
    for left, right in pairs:
        # Standard deviation of the correlation of n independent pairs: 1 / sqrt(n).
        assert abs(np.corrcoef(left.ravel(), right.ravel())[0, 1]) < 4 / np.sqrt(left.size)


def splitmix64(state: np.ndarray) -> np.ndarray:
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def twin_cube(triggered: np.ndarray, n_pulses: int, seed: int) -> np.ndarray:
    """One uniform number a pulse, looked up in the distribution of its first photon's bin."""
    pixel = np.arange(len(triggered), dtype=np.uint64)[:, np.newaxis]
    with np.errstate(over="ignore"):  # uint64 wraps round
        key = splitmix64(splitmix64(np.array([[seed]], np.uint64) + np.uint64(1)) + pixel)
        step = np.arange(n_pulses, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        uniform = (splitmix64(key + step) >> np.uint64(11)).astype(float) * 2.0**-53
    n_bins = triggered.shape[1] - 1
    cube = np.zeros((len(triggered), n_bins), np.int64)
    for row, u, counts in zip(triggered, uniform, cube, strict=True):
        bins = np.searchsorted(row[1:], u, side="right")
        counts[:] = np.bincount(bins, minlength=n_bins + 1)[:n_bins]
    return cube


@pytest.mark.parametrize("seed", [0, 1, 2**63 - 1])
@pytest.mark.parametrize(
    ("n_bins", "n_pulses", "flux"),
    [
        (1, 63, Flux(0.5, 1.0)),
        (2, 64, Flux(0.5, 1.0)),
        (100, 65, Flux(0.1, 0.03)),
        (100, 300, Flux(0.0, 1.0)),  # no photon at all
        (100, 130, Flux(90.0, np.inf)),  # every pulse triggers in the echo's first bins
        (700, 200, Flux(0.3, 0.1)),  # several bins to a cell of the guide
    ],
)
def test_draws_equal_a_plain_twin_bit_for_bit(
    n_bins: int, n_pulses: int, flux: Flux, seed: int
) -> None:
    acquisition = Acquisition(n_bins=n_bins, n_pulses=n_pulses)
    onset_bin = np.array([np.nan, -1.5, 0.0, n_bins / 2, n_bins - 0.5])
    scene = Scene(acquisition.bin_to_range_m(onset_bin[np.newaxis]))
    capture = simulate(scene, acquisition, flux, seed=seed)
    triggered = cumulative_trigger_probability(scene, acquisition, flux, Pulse())
    np.testing.assert_array_equal(capture.cube[0], twin_cube(triggered, n_pulses, seed))


@pytest.mark.parametrize(
    "pulse",
    [Pulse(), Pulse.gaussian(2e-9), Pulse.measured([1, 2, 5, 2], 1.3e-9)],
    ids=["gamma", "gaussian", "measured"],
)
def test_an_echo_is_added_as_its_pulse_arrives(pulse: Pulse) -> None:
    onset_bin = np.array([-3.4, -1.0, 0.0, 17.3, 59.9, 75.0, np.nan, np.inf])
    signal = np.linspace(0.5, 3.0, onset_bin.size)
    before = np.full((onset_bin.size, ACQUISITION.n_bins + 1), 0.25)
    add_echo(onset_bin, signal, pulse, ACQUISITION.bin_width_s, before)
    arrived = pulse.cumulative(onset_bin, ACQUISITION.n_bins, ACQUISITION.bin_width_s)
    expected = 0.25 + signal[:, np.newaxis] * (arrived - arrived[:, :1])
    # Some ten roundings on either side, of which the last are of numbers up to 3.25.
    np.testing.assert_allclose(before, expected, rtol=0, atol=20 * np.finfo(float).eps)


@pytest.mark.parametrize("tau_bins", [1e-3, 1.0, 1e3, 1e6, 1e9])
def test_photons_that_have_arrived_stay(tau_bins: float) -> None:
    before = np.zeros((1, ACQUISITION.n_bins + 1))
    pulse = Pulse(tau_bins * ACQUISITION.bin_width_s)
    add_echo(np.array([0.3]), np.array([1.0]), pulse, ACQUISITION.bin_width_s, before)
    assert (np.diff(before) >= 0).all()


def test_distribution_of_the_first_photon_is_equation_1_summed() -> None:
    onset_bin, signal = np.array([ONSET_BIN, np.nan, -2.5]), np.array([2.0, 0.0, 2.0])
    scene = Scene(ACQUISITION.bin_to_range_m(onset_bin[np.newaxis]))
    triggered = cumulative_trigger_probability(scene, ACQUISITION, Flux(2.0, 2 / 3), Pulse())
    rate = rate_per_bin(onset_bin, signal, 3.0, Pulse(), ACQUISITION)
    expected = np.cumsum(trigger_probability(rate), axis=1)
    assert (triggered[:, 0] == 0).all()
    # Sixty sums of numbers below 1.
    np.testing.assert_allclose(triggered[:, 1:], expected, rtol=0, atol=60 * np.finfo(float).eps)


def test_the_truth_travels_with_the_capture() -> None:
    range_m = np.array([[50.0, np.nan, 45.0]])
    scene = Scene(range_m, reflectivity=np.array([[0.5, 1.0, 2.0]]))
    acquisition, pulse = Acquisition(n_pulses=10), Pulse(2e-9)
    capture = simulate(scene, acquisition, Flux(0.2, 0.1), pulse, seed=9)
    assert capture.acquisition is acquisition
    assert capture.pulse is pulse
    assert capture.background == Flux(0.2, 0.1).background
    assert "seed 9" in capture.source
    np.testing.assert_array_equal(capture.signal, [[0.1, 0.0, 0.4]])
    range_m[:] = 0.0  # the capture keeps its own
    np.testing.assert_array_equal(capture.truth_range_m, [[50.0, np.nan, 45.0]])


@pytest.mark.compiled
def test_a_surface_that_reflects_nothing_is_no_target() -> None:
    sky = simulate(wall(30, np.nan), ACQUISITION, Flux()).cube
    black = simulate(
        Scene(wall(30).range_m, reflectivity=np.zeros((1, 30))), ACQUISITION, Flux()
    ).cube
    np.testing.assert_array_equal(black, sky)


@pytest.mark.compiled
def test_a_stronger_background_keeps_the_random_numbers() -> None:
    weak, strong = (simulate(wall(30), ACQUISITION, Flux(sbr=sbr)).cube for sbr in (0.08, 0.07))
    # With the same dice every pulse triggers as early as before, or earlier.
    earlier = np.cumsum(strong, axis=2, dtype=int) - np.cumsum(weak, axis=2, dtype=int)
    assert (earlier >= 0).all()


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_impossible_seeds_are_refused(seed: int) -> None:
    with pytest.raises(ValueError, match=rf"seed = {seed} .*from 0 to 2\*\*63 - 1"):
        simulate(wall(1), ACQUISITION, Flux(), seed=seed)


def test_an_unknown_number_of_pulses_is_refused() -> None:
    with pytest.raises(ValueError, match=r"n_pulses = None .*give the number of pulses"):
        simulate(wall(1), Acquisition(n_pulses=None), Flux())


# -- first photons of what recorded all ------------------------------------------------------------


def all_photons(n_pulses: int, pixels: int) -> Capture:
    """Poisson counts of a pulse's photons over all pulses, each pixel alike."""
    acquisition = Acquisition(n_bins=30, n_pulses=None)
    rate = rate_per_bin(np.full(pixels, 12.3), np.full(pixels, 0.5), 2.0, Pulse(), acquisition)
    counts = np.random.default_rng(0).poisson(rate * n_pulses).astype(np.uint16)
    return Capture(counts[np.newaxis], acquisition, detection="all")


@pytest.mark.compiled
def test_first_photons_have_the_distribution_of_simulated_ones() -> None:
    n_pulses, pixels = 200, DRAWS // 100
    counts = first_photons(all_photons(n_pulses, pixels), n_pulses, seed=1).cube[0].astype(float)
    acquisition = Acquisition(n_bins=30)
    rate = rate_per_bin(np.array([12.3]), np.array([0.5]), 2.0, Pulse(), acquisition)[0]
    p = trigger_probability(rate)
    spread = np.sqrt(n_pulses * p * (1 - p) / pixels)
    most = stats.norm.isf(1e-6 / p.size)  # of so many bins, one in a million times
    assert np.all(np.abs(counts.mean(axis=0) - n_pulses * p) < most * spread)
    # Not the mean alone: multinomial counts scatter less in sum than each for itself.
    fired = p.sum()
    variance = counts.sum(axis=1).var()
    expected = n_pulses * fired * (1 - fired)
    assert abs(variance / expected - 1) < most * np.sqrt(2 / pixels)


def test_first_photons_are_some_of_all() -> None:
    photons = all_photons(50, 100)
    first = first_photons(photons, 50)
    assert np.all(first.cube <= photons.cube)
    assert first.counts.max() <= first.gated_pulses == 50
    np.testing.assert_array_equal(first.cube, first_photons(photons, 50).cube)
    assert not np.array_equal(first.cube, first_photons(photons, 50, seed=1).cube)
    assert "first photons of 50 pulses" in first.source
    assert first.signal is None
    with_fluxes = replace(
        photons,
        acquisition=replace(photons.acquisition, n_pulses=500),
        signal=np.full(photons.shape, 0.1),
        background=0.2,
    )
    first = first_photons(with_fluxes, 50)  # as many photons on a tenth of the pulses
    np.testing.assert_allclose(first.signal, 1.0)
    assert first.background == pytest.approx(2.0)
    many = first_photons(photons, 10**9)
    np.testing.assert_array_equal(many.cube, photons.cube)  # none shares a pulse


def test_first_photons_are_not_reduced_again() -> None:
    photons = all_photons(50, 4)
    with pytest.raises(ValueError, match=r"detection = 'first' .*all photons"):
        first_photons(first_photons(photons, 50), 50)
    with pytest.raises(ValueError, match="n_pulses = 0"):
        first_photons(photons, 0)
    with pytest.raises(ValueError, match="seed = -1"):
        first_photons(photons, 50, seed=-1)


@pytest.mark.parametrize("name", ["scene", "acquisition", "flux", "pulse"])
def test_arguments_of_another_type_are_refused_by_name(name: str) -> None:
    given: dict[str, Any] = {
        "scene": Scene(np.full((2, 3), 50.0)),
        "acquisition": Acquisition(),
        "flux": Flux(),
        "pulse": Pulse(),
    }
    for wrong in (None, 1e-9):
        with pytest.raises(ValueError, match=rf"{name} = {wrong} .* a core\.{name.title()}"):
            simulate(**{**given, name: wrong})
