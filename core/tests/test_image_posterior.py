"""Tests of the image posterior: messages, planes, and what neighbours add to an estimate."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
from scipy.stats import binom, norm

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.estimators import ESTIMATORS, estimate
from core.estimators.image_model import (
    SCALES_BINS,
    Pairs,
    Prior,
    image_model_of,
    laplace,
    merged_bins,
    merged_flux,
    tempered,
)
from core.estimators.image_posterior import Link, image_posterior_of, least_probability, planes
from core.inference.flux import detailed_flux_prior_of, flux_model_with
from core.inference.flux_model import FluxModel
from core.inspection import pixel_report
from core.kernels.blocks import LANES
from core.kernels.messages import fill_posterior
from core.kernels.planes import NEAR_PIXELS, OWN_SPREAD_BINS, fill_planes
from core.metrics import calibration_error, reliability, restoration_degree
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.trials import Condition
from core.tests.twins import best_planes, log_likelihood, posterior_of_chain
from core.trigger import rate_per_bin

ALIKE, SCALE = 0.7, 0.4


def link(n_bins: int, nothing: float) -> Link:
    return Link.of(ALIKE, SCALE, Prior(np.full(n_bins, (1 - nothing) / n_bins), nothing))


@pytest.mark.parametrize("slope", [0.0, 0.75, -1.5])
@pytest.mark.parametrize("along_rows", [True, False])
def test_messages_give_the_exact_posterior_of_a_row(slope: float, along_rows: bool) -> None:
    rng, n_bins, nothing = np.random.default_rng(0), 6, 0.2
    weights = rng.exponential(size=(4, n_bins + 1)).astype(np.float32)
    weights[0, 2] = 1e-18  # nearly excluded
    shape = (1, 4) if along_rows else (4, 1)
    surface = weights[:, :n_bins].reshape(*shape, n_bins).copy()
    dark = weights[:, n_bins].reshape(shape).copy()
    found, found_dark = np.empty_like(surface), np.empty_like(dark)
    slopes, of = np.full(shape, slope, np.float32), link(n_bins, nothing)
    fill_posterior(0, 1, surface, dark, slopes, along_rows, of, found, found_dark)
    expected = posterior_of_chain(weights.astype(float), ALIKE, SCALE, slope, nothing)
    both = np.concatenate([found.reshape(4, n_bins), found_dark.reshape(4, 1)], axis=1)
    np.testing.assert_allclose(both, expected, rtol=1e-4, atol=1e-6)


def test_planes_are_fitted_despite_outliers() -> None:
    row, col = np.mgrid[:6, :60]
    delay = 20 + 1.5 * row - 0.25 * col
    rng = np.random.default_rng(0)
    outlier = rng.uniform(size=delay.shape) < 0.3
    seen = np.where(outlier, rng.uniform(0, 100, delay.shape), delay)
    plane = planes(seen, np.where(outlier, 0.3, 1.0))
    close = [
        np.abs(plane[0] - delay) < 0.5,
        np.abs(plane[1] - 1.5) < 0.1,
        np.abs(plane[2] + 0.25) < 0.1,
    ]
    right = ~outlier & np.all(close, axis=0)
    assert right.sum() > 0.97 * (~outlier).sum()


@pytest.mark.compiled
def test_the_plane_of_a_pixel_beside_another_surface_is_that_of_its_own() -> None:
    row, col = np.mgrid[:20, :30]
    is_ground, is_post = row >= 10, (col >= 12) & (col < 16)
    delay = np.where(is_ground, 60.0 - 2.5 * (row - 9), 60.0)  # a wall, before it sloping ground
    delay = np.where(is_post, 30.0 + 0.5 * (col - 12), delay)
    plane = planes(delay, np.ones(delay.shape))
    down = np.where(is_ground & ~is_post, -2.5, 0.0)
    right = np.where(is_post, 0.5, 0.0)
    is_near = np.abs(row - 10) <= 4
    # On a crease, where two planes meet, either is right.
    is_crease = np.abs(row - 9) <= 1
    kept = is_near & (is_post | ~is_crease)
    np.testing.assert_allclose(plane[0][kept], delay[kept], atol=0.5)
    np.testing.assert_allclose(plane[1][kept], down[kept], atol=0.25)
    np.testing.assert_allclose(plane[2][kept], right[kept], atol=0.25)


def test_each_pixel_takes_the_plane_that_suits_it_best() -> None:
    rng, half, (rows, cols) = np.random.default_rng(1), 2, (4, 2 * LANES)
    delay = rng.uniform(20, 40, (rows, cols)).astype(np.float32)
    windows = rng.normal(size=(4, rows, cols)).astype(np.float32)
    windows[0], windows[1] = rng.uniform(size=(rows, cols)), rng.uniform(20, 40, (rows, cols))
    margin, found = ((half, half), (half, half)), np.empty((3, rows, cols), np.float32)
    fill_planes(0, rows, np.pad(delay, margin), np.pad(windows, ((0, 0), *margin)), half, found)
    expected = best_planes(
        delay.astype(float), windows.astype(float), half, OWN_SPREAD_BINS, NEAR_PIXELS
    )
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-4)  # of float32


def degree(condition: Condition, method: str, seed: int = 900) -> float:
    capture = condition.capture(seed)
    return restoration_degree(
        estimate(capture, method).range_m, capture.truth_range_m, capture.acquisition.bin_length_m
    )


@pytest.mark.compiled
def test_neighbours_raise_the_restoration_degree() -> None:
    condition = Condition("piecewise", 0.02)
    assert degree(condition, "likelihood") < 0.35
    assert degree(condition, "image_posterior") > 0.85


@pytest.mark.compiled
def test_a_wall_is_found_that_pairs_of_pixels_do_not_show() -> None:
    for seed in (905, 906):  # of eight captures, the two without agreement of pairs of pixels
        assert degree(Condition("wall", 0.02), "image_posterior", seed) > 0.9


@pytest.mark.parametrize("apart", [0, 2])
def test_pairs_are_as_likely_with_one_surface_as_the_equation_says(apart: int) -> None:
    rng, n_pairs, n_bins = np.random.default_rng(0), 5, 40
    states = rng.exponential(size=(3, n_pairs, n_bins + 1)) ** 4
    states /= states.sum(axis=2, keepdims=True)
    surface, nothing = states[..., :-1], states[..., -1]
    depth = rng.uniform(0.5, 1.5, n_bins)
    prior = Prior(0.8 * depth / depth.sum(), 0.2)
    found = Pairs(surface.astype(np.float32), nothing, prior).ratios(apart)
    other, dark = (np.roll(each[1:], apart, axis=1) for each in (surface, nothing))
    for scale, of_scale in zip(SCALES_BINS, found, strict=True):
        kernel = laplace(scale)
        smooth = np.array([np.convolve(each, kernel, "full") for each in surface[0]])
        smooth = smooth[:, kernel.size // 2 :][:, :n_bins]
        expected = (smooth * other / prior.surface).sum(axis=2) + nothing[0] * dark / 0.2
        np.testing.assert_allclose(of_scale, expected.ravel(), rtol=1e-5)  # of float32


@pytest.mark.parametrize(
    "pairs, bins_likely, clear", [(64, 1, True), (64, 3, False), (16, 1, False)]
)
def test_pixels_are_clear_that_hesitate_among_few_bins(
    pairs: int, bins_likely: int, clear: bool
) -> None:
    surface = np.zeros((3, pairs, 20), np.float32)
    surface[:, ::2, 5 : 5 + bins_likely] = 1 / bins_likely
    surface[:, 1::2] = 1e-20  # sees no surface, and does not count
    prior = Prior(np.full(20, 0.04), 0.2)
    assert Pairs(surface, 1.0 - surface.sum(axis=2), prior).are_clear() == clear


@pytest.mark.compiled
def test_neighbours_are_added_only_where_pixels_are_not_clear() -> None:
    for sbr, clear in ((0.1, True), (0.015, False)):
        capture = Condition("net", sbr).capture(900)
        own = flux_model_with(capture, detailed_flux_prior_of(capture))
        assert np.array_equal(image_model_of(capture).share, own.share) == clear


@pytest.mark.compiled
def test_unrelated_pixels_are_estimated_independently() -> None:
    capture = Condition("uniform", 0.03).capture(900)
    alone = estimate(capture, "likelihood", depths="learned")
    found = estimate(capture, "image_posterior")
    np.testing.assert_array_equal(found.bin, alone.bin)
    np.testing.assert_array_equal(found.confidence, alone.confidence)
    assert "each pixel is estimated by itself" in found.made_by.remark


@pytest.mark.compiled
@pytest.mark.parametrize("surfaces", [0.0, 0.5])
def test_few_empty_pixels_get_a_range_where_neighbours_do_not_agree(surfaces: float) -> None:
    rng, setting, allowed = np.random.default_rng(3), Acquisition(n_bins=100), 0.01
    delay = rng.uniform(10, 85, (48, 48))
    delay[rng.uniform(size=delay.shape) >= surfaces] = np.nan
    scene, flux = Scene(setting.bin_to_range_m(delay)), Flux(signal=0.1, sbr=0.1)
    capture = simulate(scene, setting, flux, seed=4)
    assert image_model_of(capture).agreement.alike == 0
    every, some = (
        estimate(capture, "image_posterior", pixels=pixels, false_surface=allowed)
        for pixels in ("estimate every pixel", "allow empty pixels")
    )
    is_empty = np.isnan(delay)
    n_empty = np.count_nonzero(is_empty)
    most = binom.ppf(norm.cdf(4), n_empty, allowed)
    assert np.count_nonzero(some.valid & is_empty) <= most
    assert every.valid.all()
    np.testing.assert_array_equal(some.bin[some.valid], every.bin[some.valid])
    np.testing.assert_array_equal(some.score, every.score)
    assert np.count_nonzero(some.valid & ~is_empty) >= 0.95 * np.count_nonzero(~is_empty)


@pytest.mark.compiled
def test_merged_bins_keep_the_background_per_bin() -> None:
    capture = Condition("car", 0.06).capture(900)
    flux = image_model_of(capture)
    merged = merged_flux(flux, 30)  # 10 of 100 bins are left over
    np.testing.assert_allclose(merged.background / (3 * 30), flux.background / 100)


@pytest.mark.compiled
def test_confidence_is_the_share_of_right_estimates() -> None:
    capture = Condition("piecewise", 0.03).capture(901)
    image = estimate(capture, "image_posterior")
    bin_m = capture.acquisition.bin_length_m
    right = np.abs(image.range_m - capture.truth_range_m) <= 3 * bin_m
    calibration = reliability(image.confidence.ravel(), right.ravel())
    assert calibration_error(calibration) < 0.03


@pytest.mark.compiled
@pytest.mark.usefixtures("threads")
def test_messages_do_not_depend_on_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("core.kernels.parallel.SERIAL_BELOW", 0)
    found = []
    for n_threads in (1, numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(n_threads)
        found.append(estimate(Condition("car", 0.03).capture(900), "image_posterior"))
    np.testing.assert_array_equal(found[0].bin, found[1].bin)
    np.testing.assert_array_equal(found[0].confidence, found[1].confidence)


@pytest.mark.compiled
def test_the_sky_is_empty_if_empty_pixels_are_allowed() -> None:
    capture = Condition("car", 0.03).capture(902)
    is_sky = np.isnan(np.asarray(capture.truth_range_m))
    every, some = (
        estimate(capture, "image_posterior", pixels=each).valid
        for each in ("estimate every pixel", "allow empty pixels")
    )
    assert every.all()
    assert some[is_sky].mean() < 0.05  # next to the car, neighbours favour a surface
    assert some[~is_sky].mean() > 0.95


def test_few_empty_pixels_get_a_range() -> None:
    rng = np.random.default_rng(0)
    empty, seen = rng.uniform(0, 0.3, 20_000), rng.uniform(0.999, 1.0, 20_000)
    assert least_probability(np.concatenate([empty, seen]), 0.01) == 0.5
    ambiguous = rng.uniform(0.3, 0.9, 2_000)
    surface = np.concatenate([empty, seen, ambiguous])
    for share in (0.005, 0.01, 0.02):
        least, false = least_probability(surface, share), 1 - surface
        assert 0.5 < least < 0.9
        assert false[surface >= least].sum() / false.sum() == pytest.approx(share, rel=0.01)


def test_in_an_image_without_empty_pixels_all_get_a_range() -> None:
    surface = np.random.default_rng(0).uniform(0.9998, 1.0, 4096)
    assert least_probability(surface, 0.01) <= surface.min()
    assert least_probability(surface, 1e-4) <= surface.min()


@pytest.mark.compiled
@pytest.mark.parametrize("sbr", [0.03, 0.06])
def test_the_share_of_false_surfaces_holds_on_sky(sbr: float) -> None:
    scene = scenes["car"]()
    range_m = scene.range_m.copy()
    sky = np.s_[: len(range_m) // 2]
    range_m[sky] = np.nan
    capture = simulate(replace(scene, range_m=range_m), scene.acquisition, Flux(sbr=sbr), seed=900)
    valid = [
        estimate(
            capture, "image_posterior", pixels="allow empty pixels", false_surface=share
        ).valid[sky]
        for share in (0.01, 0.001)
    ]
    assert not (valid[1] & ~valid[0]).any()
    for each, share in zip(valid, (0.01, 0.001), strict=True):
        assert each.mean() <= 2 * share  # not binomial: false surfaces come in patches


@pytest.mark.compiled
def test_a_clear_image_keeps_all_its_ranges() -> None:
    capture = Condition("piecewise", 0.03).capture(900)
    assert estimate(capture, "image_posterior", pixels="allow empty pixels").valid.all()


def test_a_tempered_prior_keeps_the_order_of_delays_and_excludes_none() -> None:
    depth = np.array([0.0, 1e-6, 0.5, 1.5, 8.0])
    found = tempered(depth / depth.mean())
    assert found.mean() == pytest.approx(1.0)
    assert found.min() > 0.1
    assert (np.diff(found) >= 0).all()
    assert found[-1] / found[-2] == pytest.approx((8.0 / 1.5) ** 0.5)
    np.testing.assert_allclose(tempered(np.ones(7)), 1.0)


@pytest.mark.compiled
def test_dark_pixels_follow_their_neighbours() -> None:
    scene = scenes["wall"](32, seed=1)
    dark = np.zeros((32, 32), bool)
    dark[10:20, 12:22] = True
    scene = replace(scene, reflectivity=np.where(dark, 0.02, 1.0))
    capture = simulate(scene, Acquisition(), Flux(0.1041, sbr=0.1), seed=900)
    flux = image_model_of(capture)
    assert image_posterior_of(capture, flux).surface[dark].mean() < 0.5  # taken for empty
    found = estimate(capture, "image_posterior").range_m
    right = np.abs(found - scene.range_m) <= 3 * capture.acquisition.bin_length_m
    assert right.mean() > 0.97


evidence_at = ESTIMATORS["image_posterior"].evidence_at


def alone(capture: Capture, flux: FluxModel, row: int, col: int) -> np.ndarray:
    """Probability of a surface in each bin from the counts of one pixel, with any signal level."""
    acquisition, n_bins = capture.acquisition, capture.acquisition.n_bins
    counts, nothing = capture.cube[row, col].astype(float), Prior.of(flux).nothing
    center = np.arange(n_bins) + 0.5
    echo = rate_per_bin(center, np.ones(n_bins), 0.0, capture.pulse, acquisition)
    dark = flux.relative_background / n_bins
    levels = zip(flux.signal[:, row, col], flux.background[:, row, col], strict=True)
    log = [log_likelihood(counts, s * echo + b * dark, capture.gated_pulses) for s, b in levels]
    likelihood = np.exp(np.array(log) - np.max(log))
    surface = flux.depth / n_bins * (flux.share[1:] @ likelihood[1:])
    return np.asarray(surface / (surface.sum() + nothing * likelihood[0, 0]))


@pytest.mark.compiled
@pytest.mark.parametrize("sigma_s", [1e-9, 6e-9])  # of the second, bins are merged
def test_the_evidence_of_a_pixel_alone_is_its_likelihood(sigma_s: float) -> None:
    capture = replace(Condition("piecewise", 0.03).capture(900), pulse=Pulse(sigma_s))
    merged, factor = merged_bins(capture)
    assert (factor > 1) == (sigma_s > 5e-9)
    flux = merged_flux(image_model_of(capture), factor)
    for row, col in ((3, 5), (40, 22)):
        found = evidence_at(capture, row, col)
        expected = np.repeat(alone(merged, flux, row, col) / factor, factor)
        # Log likelihoods of 1000 pulses are rounded to float32; 0.6 % was the largest error found.
        np.testing.assert_allclose(found.alone, expected, rtol=0.02, atol=1e-6)
        assert found.alone.argmax() == expected.argmax()


@pytest.mark.compiled
@pytest.mark.parametrize("sigma_s", [1e-9, 6e-9])
def test_the_posterior_of_a_pixel_peaks_at_its_estimate(sigma_s: float) -> None:
    capture = replace(Condition("piecewise", 0.03).capture(900), pulse=Pulse(sigma_s))
    image = estimate(capture, "image_posterior", pixels="allow empty pixels")
    _, factor = merged_bins(capture)
    for row, col in np.argwhere(image.confidence > 0.9)[::500].tolist():
        evidence = evidence_at(capture, row, col)
        for each in evidence:
            assert each.shape == (capture.acquisition.n_bins,)
            assert (each >= 0).all() and 0 < each.sum() < 1 + 1e-6  # the rest is no surface
        # The estimate is interpolated between (merged) bins.
        assert abs(evidence.posterior.argmax() + factor / 2 - image.bin[row, col]) <= factor
        report = pixel_report(capture, image, row, col, "image_posterior")
        np.testing.assert_array_equal(report.evidence.posterior, evidence.posterior)
        assert report.candidates[0].bin == image.bin[row, col]
        assert report.candidates[0].probability == image.confidence[row, col]


@pytest.mark.compiled
def test_neighbours_find_what_a_pixel_alone_does_not_show() -> None:
    capture = Condition("piecewise", 0.02).capture(900)
    image = estimate(capture, "image_posterior")
    pixels = np.argwhere(image.confidence > 0.9)
    found = [evidence_at(capture, row, col) for row, col in pixels[:: len(pixels) // 200]]
    agree = [abs(int(each.alone.argmax() - each.neighbours.argmax())) <= 3 for each in found]
    # These pixels alone, estimated by the likelihood, are right in two of five cases; neighbours
    # nearly always are.
    assert 0.2 < np.mean(agree) < 0.6
    followed = [abs(int(each.posterior.argmax() - each.neighbours.argmax())) <= 3 for each in found]
    assert np.mean(followed) > 0.9  # confidence above 0.9 comes from the neighbours
    assert ESTIMATORS["likelihood"].evidence_at(capture, 0, 0) is None


@pytest.mark.compiled
def test_the_evidence_of_bright_pixels_is_finite() -> None:
    """That of no surface underflows in float32, both in the pixel alone and in the posterior."""
    capture = simulate(scenes["piecewise"](32), Acquisition(), Flux(1.0, sbr=1.0), seed=1)
    for row, col in ((0, 0), (16, 9)):
        for each in evidence_at(capture, row, col):
            assert np.isfinite(each).all() and each.sum() == pytest.approx(1.0)
