"""Tests of KDE, Shi, Chi, CFAR and unmixing against their definitions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import signal, stats
from scipy.integrate import quad

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.estimators import ESTIMATORS, chi, kde, shi, unmixing
from core.estimators.cfar import CfarParameters
from core.estimators.chi import ChiParameters
from core.estimators.kde import KdeParameters
from core.estimators.unmixing import Clusters, UnmixingParameters
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions
from core.inference.neighbours import pooled
from core.trigger import rate_per_bin, trigger_probability

ACQUISITION = Acquisition(n_pulses=1000)
CONDITIONS = Conditions(ACQUISITION, Pulse(), 1000, np.array(0.1041), np.array(1.735), 0.06)
RNG = np.random.default_rng(0)
COUNTS = RNG.poisson(9 * np.exp(-np.arange(100) / 50), (6, 100)).astype(float)


def rates(onset_bin: Any, sbr: float, pulse: Pulse = Pulse()) -> np.ndarray:
    """Rates of pixels (row, col, bin) that see echoes at some delays; NaN sees none."""
    onset, flux = np.asarray(onset_bin, float), Flux(sbr=sbr)
    photons = np.where(np.isnan(onset), 0.0, flux.signal)
    return rate_per_bin(np.nan_to_num(onset), photons, flux.background, pulse, ACQUISITION)


def drawn(onset_bin: Any, sbr: float, seed: int, pulse: Pulse = Pulse()) -> np.ndarray:
    """Counts of such pixels."""
    chance = trigger_probability(rates(onset_bin, sbr, pulse))
    none = 1 - chance.sum(axis=-1, keepdims=True)
    rng = np.random.default_rng(seed)
    return rng.multinomial(1000, np.concatenate([chance, none], axis=-1))[..., :-1]


def flux_model_of(shape: tuple[int, int], sbr: float) -> FluxModel:
    """Return the true fluxes."""
    flux = Flux(sbr=sbr)
    photons = np.array([np.zeros(shape), np.full(shape, flux.signal)])
    background = np.full((2, *shape), flux.background)
    return FluxModel(photons, background, np.array([0.5, 0.5]), np.ones(ACQUISITION.n_bins))


def curve(method: str, counts: Any, settings: Any = None) -> np.ndarray:
    estimator = ESTIMATORS[method]
    given = estimator.parameters() if settings is None else settings
    return estimator.curve(np.asarray(counts, float), CONDITIONS, given)


def locate(method: str, counts: Any, sbr: float, settings: Any = None) -> tuple[Any, Any]:
    estimator = ESTIMATORS[method]
    given = estimator.parameters() if settings is None else settings
    capture = Capture(np.asarray(counts, np.uint16), ACQUISITION)
    assert estimator.locate is not None
    return estimator.locate(capture, flux_model_of(capture.shape, sbr), given)


# --- KDE


@pytest.mark.parametrize("bandwidth", [0.1, 0.4, 2.0])
def test_kde_kernel_is_a_gaussian_averaged_over_the_triggers_bin(bandwidth: float) -> None:
    taps = kde.kernel_taps(bandwidth)
    middle = taps.size // 2
    for distance in range(-middle, middle + 1):
        expected, _ = quad(
            lambda t, d=distance: stats.norm.pdf(d - t, scale=bandwidth), -0.5, 0.5, epsabs=1e-12
        )
        assert taps[middle + distance] == pytest.approx(expected, abs=1e-10)
    assert taps.sum() == pytest.approx(1, abs=1e-6)


def test_kde_adds_a_kernel_for_each_trigger_of_the_neighbourhood() -> None:
    cube = RNG.poisson(0.3, (3, 4, 30))
    capture = Capture(cube.astype(np.uint16), Acquisition(n_bins=30))
    edges = np.arange(31)
    expected = np.zeros(30)
    for i in range(3):
        for j in range(3):
            for trigger in np.repeat(np.arange(30), cube[i, j]):
                below = stats.norm.cdf((np.arange(30) + 0.5 - edges[trigger]) / 0.7)
                above = stats.norm.cdf((np.arange(30) + 0.5 - edges[trigger + 1]) / 0.7)
                expected += below - above
    settings = KdeParameters("3x3", 0.7)
    estimator = ESTIMATORS["kde"]
    found = estimator.curve(pooled(capture.cube, 3)[1, 1].astype(float), CONDITIONS, settings)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert [estimator.window_size(KdeParameters(name)) for name in kde.WINDOW_SIZE] == [1, 3, 5]


# --- Shi 2025


def test_prominences_are_those_of_scipy() -> None:
    # Few different values: plateaus, equal peaks, and peaks at the ends.
    rows = RNG.integers(0, 6, (60, 40)).astype(float)
    rows[0], rows[1] = 3.0, np.arange(40)
    found = shi.prominences(rows)
    for row, of in zip(rows, found, strict=True):
        expected = np.zeros(40)
        peaks, _ = signal.find_peaks(row)
        expected[peaks] = signal.peak_prominences(row, peaks)[0]
        np.testing.assert_array_equal(of, expected)


def test_shi_is_its_definition() -> None:
    for counts in COUNTS[:3]:
        wave = np.zeros(100)
        weights = {j: np.sinc(j / 2) * math.cos(math.pi * j / 26) ** 2 for j in range(-12, 13)}
        for k in range(100):
            for j, weight in weights.items():
                wave[k] += weight * counts[min(max(k + j, 0), 99)]
        wave /= sum(weights.values())
        smooth = [sorted(wave[[max(k - 1, 0), k, min(k + 1, 99)]])[1] for k in range(100)]
        expected = np.zeros(100)
        peaks, _ = signal.find_peaks(smooth)
        expected[peaks] = signal.peak_prominences(smooth, peaks)[0]
        np.testing.assert_allclose(curve("shi", counts), expected, atol=1e-9)


# --- Chi 2025


@pytest.mark.parametrize("bandwidth", [0.4, 1.5])
def test_adaptive_density_is_its_definition(bandwidth: float) -> None:
    def kernel(distance: int, width: float) -> float:
        low, high = (distance - 0.5) / width, (distance + 0.5) / width
        return 0.5 * (math.erf(high / math.sqrt(2)) - math.erf(low / math.sqrt(2)))

    for counts in COUNTS[:2, 60:]:
        triggers = np.repeat(np.arange(40), counts.astype(int))
        first = {i: sum(kernel(i - t, bandwidth) for t in triggers) for i in set(triggers)}
        mean = math.exp(sum(math.log(first[t]) for t in triggers) / len(triggers))
        expected = np.zeros(40)
        for t in triggers:
            width = bandwidth * min(max((first[t] / mean) ** -0.5, 0.5), 3.0)
            expected += [kernel(k - t, width) for k in range(40)]
        found = chi.adaptive_density(counts, bandwidth)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-3 * expected.max())


def test_starved_pixels_take_in_more_neighbours() -> None:
    cube = np.zeros((5, 5, 40), np.uint16)
    cube[0, 0, 7] = 2
    cube[2, 2, 30] = 1
    capture = Capture(cube, Acquisition(n_bins=40))
    position, _ = chi.ESTIMATOR.locate(capture, flux_model_of((5, 5), 0.06), ChiParameters())
    assert position[2, 2] == 7  # beyond 3 x 3
    cube = cube.copy()
    cube[2, 2, 20:] = 4
    capture = Capture(cube, Acquisition(n_bins=40))
    position, _ = chi.ESTIMATOR.locate(capture, flux_model_of((5, 5), 0.06), ChiParameters())
    assert position[2, 2] >= 20


def surfaces() -> np.ndarray:
    """A step, and a rectangle with corners, over a gentle slope."""
    depth = np.broadcast_to(20 + 0.2 * np.arange(16.0), (16, 16)).copy()
    depth[:, 10:] += 30
    depth[3:8, 2:7] -= 12
    return depth


def test_repair_keeps_edges_and_corners() -> None:
    depth = surfaces()
    np.testing.assert_array_equal(chi.repaired(depth, np.ones_like(depth)), depth)


def test_repair_replaces_what_stands_alone() -> None:
    truth = surfaces()
    depth = truth.copy()
    for pixel in ((5, 4), (12, 3), (0, 0), (15, 12)):
        depth[pixel] = 90.0
    np.testing.assert_allclose(chi.repaired(depth, np.ones_like(depth)), truth, atol=0.5)


def test_repair_weighs_neighbours_by_their_intensity() -> None:
    depth = np.full((9, 9), 50.0)
    depth[:4] = 20.0
    depth[4, 4] = 80.0  # three neighbours at 20, five at 50
    bright = np.ones((9, 9))
    assert chi.repaired(depth, bright)[4, 4] == 50
    bright[:4] = 9.0
    assert chi.repaired(depth, bright)[4, 4] == 20


def test_repair_leaves_missing_estimates_missing() -> None:
    depth = surfaces()
    depth[4, 4] = np.nan
    np.testing.assert_array_equal(chi.repaired(depth, np.ones_like(depth)), depth)
    nothing = np.full((3, 3), np.nan)
    np.testing.assert_array_equal(chi.repaired(nothing, np.ones((3, 3))), nothing)


# --- CFAR


@pytest.mark.parametrize("settings", [CfarParameters(), CfarParameters(0.5, 0, 2)])
def test_cfar_is_its_definition(settings: CfarParameters) -> None:
    sigma, guard, training = (
        settings.smoothing_bins,
        settings.guard_bins,
        settings.training_bins,
    )
    half = math.ceil(4 * sigma)
    weights = {j: math.exp(-0.5 * (j / sigma) ** 2) for j in range(-half, half + 1)}
    for counts in COUNTS:
        smooth = np.zeros(100)
        for k in range(100):
            for j, weight in weights.items():
                if 0 <= k + j < 100:
                    smooth[k] += weight * counts[k + j] / sum(weights.values())
        expected = np.zeros(100)
        for k in range(100):
            cells = [smooth[i] for i in range(100) if guard < abs(i - k) <= guard + training]
            expected[k] = smooth[k] / (1 + np.mean(cells))
        np.testing.assert_allclose(curve("cfar", counts, settings), expected, rtol=1e-9)


# --- Rapp & Goyal 2017


def test_window_sums_are_the_explicit_sums() -> None:
    for window in (1, 3, 100):
        expected = [COUNTS[:, k : k + window].sum(axis=1) for k in range(100)]
        np.testing.assert_array_equal(unmixing.window_sums(COUNTS, window), np.transpose(expected))
    np.testing.assert_array_equal(unmixing.window_sums(np.ones(2), 5), [2, 1])


def test_a_window_is_two_standard_deviations_of_a_gaussian_echo() -> None:
    assert unmixing.spread_bins(Pulse.gaussian(3e-9), ACQUISITION) == pytest.approx(3, rel=0.01)
    assert unmixing.window_bins(Pulse(), ACQUISITION) == 3
    assert unmixing.window_bins(Pulse(), Acquisition(n_bins=2)) == 2
    assert unmixing.window_bins(Pulse(1e-12), ACQUISITION) == 1


def test_noise_lasts_as_the_map_of_time_says() -> None:
    background, n_pulses = 2.0, 10_000
    rate = np.full(100, background / 100)
    expected = trigger_probability(rate) * n_pulses
    exposure = unmixing.exposures(expected, np.array(background), n_pulses)
    until = np.cumsum(exposure)
    u = -np.expm1(-background * np.arange(1, 101) / 100) / -math.expm1(-background)
    np.testing.assert_allclose(until / until[-1], u, rtol=1e-10)
    # Where pulses are not known noise is uniform in time itself.
    np.testing.assert_array_equal(
        unmixing.exposures(expected, np.array(background), None), np.full(100, background)
    )


def test_scan_is_the_signed_root_of_the_likelihood_ratio() -> None:
    exposure = unmixing.exposures(COUNTS, np.ones(6), 1000)
    windows = unmixing.scan(COUNTS, exposure, 3)
    for pixel in range(2):
        n, whole = COUNTS[pixel].sum(), exposure[pixel].sum()
        for k in range(100):
            c, p = COUNTS[pixel, k : k + 3].sum(), exposure[pixel, k : k + 3].sum() / whole
            best = stats.binom.logpmf(c, n, c / n) - stats.binom.logpmf(c, n, p)
            expected = math.copysign(math.sqrt(2 * max(best, 0.0)), c / n - p)
            assert windows.score[pixel, k] == pytest.approx(expected, abs=1e-5)


def test_the_tail_is_the_binomial_one() -> None:
    least = np.arange(0.0, 11)
    found = unmixing.binomial_from(least, np.full(11, 10.0), np.full(11, 0.3))
    np.testing.assert_allclose(found, stats.binom.sf(least - 1, 10, 0.3), rtol=1e-9)


@pytest.mark.compiled
@pytest.mark.parametrize("sbr", [0.08, 0.03])
@pytest.mark.parametrize("false_acceptance", [0.01, 0.1])
def test_noise_seldom_makes_a_cluster(sbr: float, false_acceptance: float) -> None:
    cube = drawn(np.full((32, 32), np.nan), sbr, seed=3)
    settings = UnmixingParameters(false_acceptance, growth=0, pixels="allow empty pixels")
    position, score = locate("unmixing", cube, sbr, settings)
    alarms = np.count_nonzero(np.isfinite(position))
    assert alarms <= stats.binom.ppf(1 - 1e-4, 1024, false_acceptance)
    assert ((score > 0) == np.isfinite(position)).all()


def test_superpixels_grow_until_there_is_a_cluster() -> None:
    cube = np.ones((9, 9, 100), np.uint16)
    cube[3:6, 3:6, 40:43] += 2  # 9 of a total of 106: alone no cluster, all nine together one
    for growth, found in ((0, 0), (1, 1), (2, 1)):
        settings = UnmixingParameters(growth=growth, pixels="allow empty pixels")
        position, _ = locate("unmixing", cube, 0.06, settings)
        assert np.isfinite(position[4, 4]) == found
        if growth < 2:  # no superpixel reaches the corner
            assert np.isnan(position[0, 0])
    assert abs(position[4, 4] - 40) < 1.5


def clusters_at(delay: np.ndarray, chance: float) -> Clusters:
    ones = np.ones_like(delay)
    return Clusters(delay, ones, chance * ones, ones, ones)


def test_censoring_drops_clusters_far_from_their_neighbours() -> None:
    cautious, published = UnmixingParameters(), UnmixingParameters(censoring="24 neighbours")
    delay = np.full((5, 5), 40.0)
    delay[2, 2] = 60.0
    delay[0, 0] = np.nan
    for settings in (published, cautious):
        dropped = unmixing.censored(clusters_at(delay, 1e-3), 3, settings)
        assert np.argwhere(dropped).tolist() == [[2, 2]]
    clear = clusters_at(delay, 1e-5)
    assert unmixing.censored(clear, 3, published).sum() == 1
    assert not unmixing.censored(clear, 3, cautious).any()
    delay[2, 2] = 45.0  # between one window and two
    assert unmixing.censored(clusters_at(delay, 1e-3), 3, published).sum() == 1
    assert not unmixing.censored(clusters_at(delay, 1e-3), 3, cautious).any()


def test_a_steep_surface_is_censored_by_24_neighbours_only() -> None:
    steep = clusters_at(40 + 4.0 * np.arange(9) * np.ones((9, 1)), 1e-3)
    steep.delay[4, 4] += 4
    for censoring, n_dropped in (("24 neighbours", 1), ("8 neighbours", 0)):
        settings = UnmixingParameters(censoring=censoring)
        assert unmixing.censored(steep, 3, settings)[2:7, 2:7].sum() == n_dropped


def test_pixels_without_a_cluster_take_over_the_range_of_their_neighbours() -> None:
    cube = drawn(np.full((8, 8), 53.6), 0.3, seed=8)
    cube[2, 3] = 0
    cube[5, 5] = 1  # too few photons for a cluster
    alone = {"growth": 0}
    position, score = locate("unmixing", cube, 0.3, UnmixingParameters(**alone))
    assert np.abs(position - 53.6).max() < 2
    assert score[2, 3] == score[5, 5] == 0
    settings = UnmixingParameters(**alone, pixels="allow empty pixels")
    position, _ = locate("unmixing", cube, 0.3, settings)
    assert np.argwhere(np.isnan(position)).tolist() == [[2, 3], [5, 5]]


def test_smoothing_keeps_a_step_but_for_what_the_definition_takes() -> None:
    step = np.zeros((6, 12))
    step[:, 6:] = 20.0
    found = unmixing.smoothed(step, np.full(step.shape, 4.0), 1.0)
    # Either half gives way by β / (w x 6 columns): there the slope of both terms is the same.
    expected = np.where(step > 0, 20 - 1 / 24, 1 / 24)
    np.testing.assert_allclose(found, expected, atol=0.01)
    np.testing.assert_array_equal(unmixing.smoothed(step, np.ones_like(step), 0.0), step)


def energy(z: np.ndarray, y: np.ndarray, w: np.ndarray, beta: float) -> float:
    rows = np.diff(z, axis=0, append=z[-1:])
    cols = np.diff(z, axis=1, append=z[:, -1:])
    return float((w * (z - y) ** 2).sum() / 2 + beta * np.hypot(rows, cols).sum())


def test_nothing_near_a_smoothed_image_is_better() -> None:
    y = surfaces() + RNG.normal(0, 0.5, (16, 16))
    w = RNG.uniform(0, 4, (16, 16))
    w[2:4, 2:4] = 0
    found = unmixing.smoothed(y, w, 1.0)
    least = energy(found, y, w, 1.0)
    assert least < energy(y, y, w, 1.0)
    for size in (0.01, 0.1, 1.0):
        for _ in range(20):
            assert energy(found + RNG.normal(0, size, y.shape), y, w, 1.0) > least


@pytest.mark.compiled
def test_a_surface_is_unmixed_where_single_pixels_are_lost() -> None:
    onset = np.full((16, 16), 53.6)
    cube = drawn(onset, 0.03, seed=6)
    settings = UnmixingParameters(growth=0, pixels="allow empty pixels")
    alone, _ = locate("unmixing", cube, 0.03, settings)
    position, _ = locate("unmixing", cube, 0.03)
    assert (np.abs(alone - onset) <= 3).mean() < 0.4
    assert (np.abs(position - onset) <= 3).mean() > 0.95
