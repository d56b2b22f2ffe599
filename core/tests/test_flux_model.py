"""Tests of the fluxes that are estimated from whole images, and of calibrated confidence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.estimators import estimate
from core.inference.flux import LEVEL_SPAN, LEVELS, flux_model_of, total_rates
from core.inference.flux_model import FluxModel
from core.inference.posterior import (
    TOLERANCE_BINS,
    least_loss,
    posterior_of,
    tolerance_probability,
)
from core.inspection import estimate_mean_flux
from core.metrics import restoration_degree
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.trials import Condition
from core.trigger import draw_counts, rate_per_bin, trigger_probability

SIZE = 32  # rows and columns where fluxes are estimated
N_BINS = 30  # in the gate where fluxes are estimated
FOUR_SIGMA = float(stats.norm.sf(4))


@pytest.fixture(autouse=True)
def _whole_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimate fluxes from all pixels, so that only the counts are random."""
    for sample in ("SAMPLE", "DEPTH_SAMPLE"):
        monkeypatch.setattr(f"core.inference.flux.{sample}", 64**2)


SIGNAL, BACKGROUND, N_PULSES = 0.3, 0.6, 1000


def drawn(
    signal: Any,
    background: Any = BACKGROUND,
    n_pulses: int = N_PULSES,
    *,
    onset_bin: Any = None,
    known: bool = True,
    seed: int = 0,
) -> Capture:
    """Echoes of a signal over a background, each for all or per pixel.

    Delays are drawn from the front of the gate, so that it holds whole echoes, unless given.
    """
    shape = (SIZE, SIZE)
    rng = np.random.default_rng(seed)
    anywhere = rng.uniform(0, N_BINS - 8, shape)
    onset_bin = anywhere if onset_bin is None else np.broadcast_to(onset_bin, shape)
    acquisition = Acquisition(n_bins=N_BINS, n_pulses=n_pulses if known else None)
    signal = np.broadcast_to(signal, shape)
    rate = rate_per_bin(onset_bin, signal, 0.0, Pulse(), acquisition)
    rate += np.broadcast_to(background, shape)[..., np.newaxis] / N_BINS
    if known:
        return Capture(draw_counts(rate, n_pulses, rng), acquisition)
    return Capture(draw_counts(n_pulses * rate, None, rng), acquisition)


def chance_variance(total: float, n_pulses: int = N_PULSES) -> float:
    """Variance of ``ln(M / (M - n))``, n of M pulses having fired at a rate `total`."""
    return math.expm1(total) / n_pulses


def columns(left: float, right: float) -> np.ndarray:
    """Two values, one in every other column."""
    return np.where(np.arange(SIZE) % 2 == 0, left, right)


HALF_A_STEP = LEVEL_SPAN ** (0.5 / (LEVELS - 1))
"""A signal is found as the level next to it, or spread over the two."""


@pytest.mark.parametrize("known", [True, False], ids=["first photons", "photons"])
@pytest.mark.parametrize("signal", [0.1, 0.3])
def test_signal_and_background_are_found(signal: float, known: bool) -> None:
    flux = flux_model_of(drawn(signal, known=known))
    photons = 1 if known else N_PULSES
    found = float(flux.typical_signal.mean()) / photons
    assert signal / HALF_A_STEP < found < signal * HALF_A_STEP
    # Only the one additional pixel has no echo.
    assert flux.share[0] < 2 / SIZE**2
    total = float(flux.typical_background.mean()) / photons + (1 - flux.share[0]) * found
    expected = signal + BACKGROUND
    variance = chance_variance(expected) if known else expected / N_PULSES
    assert total == pytest.approx(expected, abs=4 * math.sqrt(variance) / SIZE)


@pytest.mark.parametrize("known", [True, False], ids=["first photons", "photons"])
def test_half_of_the_pixels_with_an_echo_are_found(known: bool) -> None:
    capture = drawn(columns(SIGNAL, 0.0), known=known)
    flux = flux_model_of(capture)
    # 300 detections in some bins leave no doubt; one pixel without an echo is added.
    assert flux.share[0] == pytest.approx(0.5, abs=2 / SIZE**2)
    found = flux.typical_signal.mean() / (1 if known else N_PULSES)
    assert SIGNAL / HALF_A_STEP < found < SIGNAL * HALF_A_STEP
    # But at the end of the gate, where an echo is hardly seen.
    sure = np.abs(posterior_of(capture).surface - columns(1, 0)) < 0.01
    assert sure.mean() > 0.95


def test_an_echo_free_image_has_no_signal() -> None:
    capture = drawn(0.0)
    flux = flux_model_of(capture)
    assert flux.share[0] > 0.99
    assert len(flux.share) == 2  # one that the sample may have missed, and no more
    assert (posterior_of(capture).surface < 0.5).all()


@pytest.mark.parametrize(("scene", "seed"), [("wall", 0), ("car", 3)])
def test_a_signal_too_faint_for_single_pixels_is_found(scene: str, seed: int) -> None:
    capture = Condition(scene, 0.02).capture(seed)
    flux, signal = flux_model_of(capture), Condition(scene, 0.02).signal
    assert flux.share[0] == pytest.approx(np.isnan(capture.truth_range_m).mean(), abs=0.1)
    assert signal / HALF_A_STEP < flux.typical_signal.mean() < signal * HALF_A_STEP
    tolerance_m = TOLERANCE_BINS * capture.acquisition.bin_length_m
    right, best = (
        restoration_degree(estimate(capture, method).range_m, capture.truth_range_m, tolerance_m)
        for method in ("likelihood", "oracle")
    )
    # Four standard deviations of the difference of two independent shares, at most.
    n_targets = np.isfinite(capture.truth_range_m).sum()
    assert right > best - 4 * math.sqrt(2 * 0.25 / n_targets)


def test_two_reflectivities_are_found() -> None:
    flux = flux_model_of(drawn(columns(0.08, 0.4)))
    between = math.sqrt(0.08 * 0.4)
    level = flux.signal[:, 0, 0]
    dark, bright = level[1:] < between, level[1:] > between
    share = flux.share[1:]
    # 80 detections and 400, known to 1 in 5: none is taken for the other.
    assert share[dark].sum() == pytest.approx(0.5, abs=2 / SIZE**2)
    assert share[bright].sum() == pytest.approx(0.5, abs=2 / SIZE**2)
    for some, signal in ((dark, 0.08), (bright, 0.4)):
        found = share[some] @ level[1:][some] / share[some].sum()
        assert signal / HALF_A_STEP < found < signal * HALF_A_STEP


def test_background_is_one_where_chance_alone_makes_it_scatter() -> None:
    flux = flux_model_of(drawn(SIGNAL))
    # A variance of n numbers scatters by sqrt(2 / n) of itself: more than that is not kept.
    excess = 4 * math.sqrt(2) / SIZE
    scatter = math.sqrt(chance_variance(SIGNAL + BACKGROUND) * (1 + excess))
    assert flux.typical_background.std() <= excess * scatter


def test_background_is_one_where_signal_alone_differs() -> None:
    flux = flux_model_of(drawn(columns(SIGNAL, 0.0)))
    # Totals differ by the signal, and backgrounds by no more than what levels miss of it.
    assert flux.background[0].std() < 0.5 * SIGNAL / 2


def test_background_that_differs_is_not_drawn_to_its_mean() -> None:
    background = np.linspace(0.3, 1.2, SIZE)
    flux = flux_model_of(drawn(0.1, background))
    error = flux.typical_background - background
    # As good as each pixel's own total, or better: errors are what chance makes.
    chance = np.mean([chance_variance(0.1 + b) for b in background])
    assert (error - error.mean()).var() <= chance * (1 + 4 * math.sqrt(2) / SIZE)
    assert np.polyfit(background, flux.typical_background.mean(axis=0), 1)[0] > 0.9


@pytest.mark.parametrize("background", [0.01, 0.1])
def test_pixels_without_an_echo_beside_bright_ones_have_no_faint_one(background: float) -> None:
    """A small background of all pixels, as the difference of large numbers, would be too small."""
    acquisition, rng = Acquisition(), np.random.default_rng(7)
    onset_bin = np.kron(rng.uniform(10, 85, (8, 8)), np.ones((6, 6)))
    is_sky = np.arange(48) < 16
    signal = np.where(is_sky[:, np.newaxis], 0.0, 0.3) * np.ones(48)
    rate = rate_per_bin(onset_bin, signal, background, Pulse(), acquisition)
    capture = Capture(draw_counts(rate, acquisition.n_pulses, rng), acquisition)
    # Chance makes a faint echo of the noise in a few of them.
    assert flux_model_of(capture).share[0] == pytest.approx(1 / 3, abs=0.03)
    assert estimate(capture, "likelihood").confidence[is_sky].mean() < 0.03


@pytest.mark.parametrize("background", [1.0, 4.0, 8.0])
@pytest.mark.parametrize("known", [True, False], ids=["first photons", "photons"])
def test_signals_in_proportion_to_backgrounds_are_found(background: float, known: bool) -> None:
    """As where a surface reflects pulse and sunlight alike; in strong sun all pulses fire."""
    reflectivity = columns(0.15, 1.0)
    signal = 0.06 * background * reflectivity
    flux = flux_model_of(drawn(signal, background * reflectivity, known=known))
    photons = 1 if known else N_PULSES
    found = flux.typical_signal.mean(axis=0) / photons
    assert found == pytest.approx(signal, rel=HALF_A_STEP - 1)
    # On average over the pixels of a reflectivity; a few hundredths of an echo are beyond its taps.
    total = flux.typical_background.mean(axis=0) / photons + found
    expected = background * reflectivity + signal
    assert total.reshape(-1, 2).mean(axis=0) == pytest.approx(expected[:2], rel=0.03)


def test_signals_that_do_not_depend_on_backgrounds_are_found_alike() -> None:
    flux = flux_model_of(drawn(0.2, np.linspace(0.5, 3.0, SIZE)))
    assert np.ptp(flux.typical_signal) == 0
    assert 0.2 / HALF_A_STEP < flux.typical_signal.mean() < 0.2 * HALF_A_STEP


def test_strong_sun_on_uneven_surfaces_costs_no_right_estimates() -> None:
    """Ranges are restored as if all fluxes were known."""
    scene = scenes["uniform"](size=48)
    reflectivity = np.random.default_rng(1).choice([0.15, 1.0], scene.range_m.shape)
    acquisition = scene.acquisition
    onset_bin = acquisition.range_m_to_bin(scene.range_m)
    for signal, background in ((0.4, 6.0), (0.4, 10.0)):
        rate = rate_per_bin(onset_bin, signal * reflectivity, 0.0, Pulse(), acquisition)
        rate += background * reflectivity[..., np.newaxis] / acquisition.n_bins
        counts = draw_counts(rate, acquisition.n_pulses, np.random.default_rng(2))
        capture = Capture(counts, acquisition, truth_range_m=scene.range_m)
        known = FluxModel(
            np.stack([np.zeros_like(reflectivity), signal * reflectivity]),
            np.stack([background * reflectivity] * 2),
            np.array([0.0, 1.0]),
            np.ones(acquisition.n_bins),
        )
        tolerance_m = TOLERANCE_BINS * acquisition.bin_length_m
        best = acquisition.bin_to_range_m(least_loss(capture, known, 4, "window")[0])
        right, possible = (
            restoration_degree(range_m, scene.range_m, tolerance_m)
            for range_m in (estimate(capture, "likelihood").range_m, best)
        )
        # Of 2304 pixels with the same counts, few differ.
        assert right > possible - 0.02


def test_totals_are_of_the_background_and_scatter_by_chance() -> None:
    n_pulses, background, n_pixels = 30, 0.9, 40_000
    fired = np.random.default_rng(0).binomial(n_pulses, -math.expm1(-background), (200, 200))
    cube = fired[..., np.newaxis].astype(np.uint16)
    total = total_rates(Capture(cube, Acquisition(n_bins=1, n_pulses=n_pulses)))
    variance = chance_variance(background, n_pulses)
    # To the first order in 1 / pulses; the next is a quarter of it, so few are the pulses.
    assert total.mean() == pytest.approx(
        background, abs=0.25 * variance / 2 + 4 * math.sqrt(variance / n_pixels)
    )
    assert total.var() == pytest.approx(variance, rel=0.25)


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("signal", "background", "n_pulses"),
    [(0.6, 0.3, 20), (0.3, 0.7, 20), (0.3, 1.0, 20), (0.6, 0.3, 10)],
)
def test_few_pulses_are_not_taken_for_a_strong_background(
    signal: float, background: float, n_pulses: int
) -> None:
    """Most bins are then empty, also in pixels of which nearly all pulses fired."""
    acquisition = Acquisition(n_bins=200, n_pulses=n_pulses)
    scene = scenes["uniform"](size=SIZE)
    capture = simulate(scene, acquisition, Flux(signal, signal / background), seed=1)
    flux = estimate_mean_flux(capture)
    variance = chance_variance(signal + background, n_pulses) / capture.counts.size
    assert flux.signal.value == pytest.approx(signal, abs=4 * math.sqrt(variance))
    assert flux.background.value == pytest.approx(background, abs=4 * math.sqrt(variance))
    image = estimate(capture, "likelihood")
    right = np.abs(image.range_m - scene.range_m) < 3 * acquisition.bin_length_m
    assert image.confidence.mean() == pytest.approx(right.mean(), abs=0.03)
    assert "unreliable" not in image.made_by.remark


@pytest.mark.parametrize(("n_pulses", "bias"), [(200, 0.02), (1000, 0.005)])
def test_the_background_that_spends_all_pulses_is_that_of_the_median_bin(
    n_pulses: int, bias: float
) -> None:
    """The median of a few counts is a sixth of a count below their mean."""
    acquisition, rng = Acquisition(n_bins=150, n_pulses=n_pulses), np.random.default_rng(0)
    counts = draw_counts(np.full((40, 50, 150), 8 / 150), n_pulses, rng)
    assert total_rates(Capture(counts, acquisition)).mean() == pytest.approx(8, rel=bias)


@pytest.mark.parametrize("exposure", [3, 4, 6])
def test_a_background_that_fires_every_pulse_is_found(exposure: float) -> None:
    capture = Condition("uniform", 0.04, 0.1041 * exposure).capture(0)
    background = flux_model_of(capture).typical_background
    # Its first fifth is free of echoes and shows the background to 0.1 %; missed ones add to it.
    assert background == pytest.approx(capture.background, rel=0.004)
    right = [estimated_right(capture, method) for method in ("likelihood", "oracle")]
    # Pixels that only one of them ranges are the chance of the difference.
    chance = math.sqrt(np.count_nonzero(right[0] != right[1])) / right[0].size
    assert right[0].mean() >= right[1].mean() - 0.01 - 4 * chance


def estimated_right(capture: Capture, method: str) -> np.ndarray:
    """Whether each estimate is within three bins of the truth."""
    error_m = np.abs(estimate(capture, method).range_m - capture.truth_range_m)
    return np.asarray(error_m <= 3 * capture.acquisition.bin_length_m)


def test_depths_that_are_alike_are_found_alike() -> None:
    depth = flux_model_of(drawn(SIGNAL)).depth
    # Echoes begin in bins 0 to 21; a pixel or more in each, over five bins of smoothing.
    excess = 4 / math.sqrt(5 * SIZE**2 / (N_BINS - 8))
    expected = N_BINS / (N_BINS - 8)
    assert (np.abs(depth[3:18] / expected - 1) < 0.15 + excess).all()
    assert depth[-4:].mean() < 0.5


def test_depths_that_occur_are_learned() -> None:
    flux = flux_model_of(drawn(0.1, onset_bin=10.0))
    assert flux.depth[6:15].sum() > 0.7 * N_BINS
    # But none is ruled out: one of the echoes may begin anywhere.
    assert flux.depth.min() >= 1 / (SIZE**2 + 1)


@pytest.mark.parametrize("empty_column", [0, 3])
def test_the_sample_has_no_regular_step(empty_column: int) -> None:
    size = 2 * SIZE  # more pixels than are looked at
    acquisition = Acquisition(n_bins=N_BINS, n_pulses=50_000)
    onset_bin = np.full((size, size), 12.0)
    onset_bin[:, empty_column::4] = np.nan
    rate = rate_per_bin(onset_bin, np.full((size, size), 0.5), 1.5, Pulse(), acquisition)
    counts = np.rint(trigger_probability(rate) * 50_000).astype(np.uint16)
    flux = flux_model_of(Capture(counts, acquisition))
    drawn_by_chance = math.sqrt(0.25 * 0.75 / 1024)
    assert flux.share[0] == pytest.approx(0.25, abs=4 * drawn_by_chance)
    # The strongest level is what the middle four fifths of an echo hold, or more.
    found = flux.typical_signal.mean()
    assert 0.8 * 0.5 / HALF_A_STEP < found <= 0.5


def test_typical_fluxes_are_means() -> None:
    share = np.array([0.5, 0.1, 0.4])
    signal = np.array([0.0, 1.0, 2.0]).reshape(3, 1, 1)
    flux = FluxModel(signal, np.array([3.0, 2.0, 1.0]).reshape(3, 1, 1), share, np.ones(9))
    # Of the pixels that see an echo; of all.
    np.testing.assert_allclose(flux.typical_signal, [[(0.1 * 1 + 0.4 * 2) / 0.5]], rtol=1e-12)
    np.testing.assert_allclose(flux.typical_background, [[1.5 + 0.2 + 0.4]], rtol=1e-12)
    dark = FluxModel(signal, signal, np.array([1.0, 0.0, 0.0]), np.ones(9))
    np.testing.assert_allclose(dark.typical_signal, [[1.5]], rtol=1e-12)


# --- Calibration. ---


@pytest.fixture(scope="module")
def uniform_captures() -> list[tuple[Capture, np.ndarray]]:
    """Captures with uniform depths at two signal-to-background ratios, and their delays."""
    captures = []
    for seed, sbr in enumerate((0.03, 0.06)):
        acquisition = Acquisition()
        rng = np.random.default_rng(seed)
        onset_bin = rng.uniform(0, acquisition.n_bins, (64, 64))
        scene = Scene(acquisition.bin_to_range_m(onset_bin))
        captures.append((simulate(scene, acquisition, Flux(sbr=sbr), seed=seed), onset_bin))
    return captures


def assert_calibrated(estimates: list[tuple[Capture, np.ndarray, np.ndarray]]) -> None:
    """Require confidences (capture, delay, true delay) to be calibrated."""
    chance = np.concatenate(
        [tolerance_probability(capture, bins).ravel() for capture, bins, _ in estimates]
    )
    error = np.concatenate([np.abs(bins - truth).ravel() for _, bins, truth in estimates])
    right = error <= TOLERANCE_BINS
    # The posterior has a resolution of a bin.
    doubtful = np.abs(error - TOLERANCE_BINS) < 0.5
    variance = (chance * (1 - chance)).sum() + 0.25 * np.count_nonzero(doubtful)
    assert abs(chance.sum() - np.count_nonzero(right)) <= 4 * math.sqrt(variance)
    tenth = np.minimum((chance * 10).astype(int), 9)
    for i in range(10):
        some = (tenth == i) & ~doubtful
        expected = chance[some].mean() if some.any() else 0.0
        low, high = stats.binom.ppf([FOUR_SIGMA, 1 - FOUR_SIGMA], np.count_nonzero(some), expected)
        assert low <= np.count_nonzero(right[some]) <= high or not some.any()


@pytest.mark.parametrize("method", ["likelihood", "tracking"])
def test_confidence_is_the_share_of_right_estimates(
    uniform_captures: list[tuple[Capture, np.ndarray]], method: str
) -> None:
    estimates = []
    for capture, truth in uniform_captures:
        image = estimate(capture, method)
        assert image.valid.all()
        np.testing.assert_array_equal(image.confidence, tolerance_probability(capture, image.bin))
        estimates.append((capture, image.bin, truth))
    assert_calibrated(estimates)


@pytest.mark.parametrize("bins", [50.0, 10.5, 1.0, 96.0])
def test_confidence_of_a_fixed_delay_is_calibrated(
    uniform_captures: list[tuple[Capture, np.ndarray]], bins: float
) -> None:
    assert_calibrated(
        [(each, np.full(each.shape, bins), truth) for each, truth in uniform_captures]
    )


def test_probability_of_a_surface_is_calibrated() -> None:
    capture = drawn(columns(0.06, 0.0), seed=1)
    surface = posterior_of(capture).surface
    assert surface[:, ::2].mean() > 0.8
    assert surface[:, 1::2].mean() < 0.2
    n, expected = surface.size, float(surface.mean())
    low, high = stats.binom.ppf([FOUR_SIGMA, 1 - FOUR_SIGMA], n, expected)
    assert low <= n / 2 <= high
