"""Tests of the image posterior: messages, planes, and what neighbours add to an estimate."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest

from core.acquisition import Pulse
from core.estimators import ESTIMATORS, estimate
from core.estimators.image_model import Prior, image_model_of, merged_bins, merged_flux
from core.estimators.image_posterior import Link, planes
from core.inspection import pixel_report
from core.kernels.messages import fill_posterior
from core.metrics import calibration_error, reliability, restoration_degree
from core.studies.trials import Condition
from core.tests.twins import posterior_of_chain

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
    fill_posterior(surface, dark, slopes, along_rows, of, found, found_dark)
    expected = posterior_of_chain(weights.astype(float), ALIKE, SCALE, slope, nothing)
    both = np.concatenate([found.reshape(4, n_bins), found_dark.reshape(4, 1)], axis=1)
    np.testing.assert_allclose(both, expected, rtol=1e-4, atol=1e-6)


def test_planes_are_fitted_despite_outliers() -> None:
    row, col = np.mgrid[:40, :30]
    delay = 20 + 1.5 * row - 0.25 * col
    rng = np.random.default_rng(0)
    outlier = rng.uniform(size=delay.shape) < 0.3
    seen = np.where(outlier, rng.uniform(0, 100, delay.shape), delay)
    plane = planes(seen, np.where(outlier, 0.3, 1.0))
    right = ~outlier & (np.abs(plane[1] - 1.5) < 0.1) & (np.abs(plane[2] + 0.25) < 0.1)
    assert right.sum() > 0.97 * (~outlier).sum()


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
def test_unrelated_pixels_are_estimated_independently() -> None:
    capture = Condition("uniform", 0.03).capture(900)
    alone = estimate(capture, "likelihood", depths="learned")
    found = estimate(capture, "image_posterior")
    np.testing.assert_array_equal(found.bin, alone.bin)
    np.testing.assert_array_equal(found.confidence, alone.confidence)
    assert "each pixel is estimated by itself" in found.made_by.remark


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
    assert some[is_sky].mean() < 0.08  # next to the car, neighbours favour a surface
    assert some[~is_sky].mean() > 0.85


@pytest.mark.compiled
@pytest.mark.parametrize("sigma_s", [1e-9, 6e-9])  # of the second, bins are merged
def test_a_posterior_is_made_of_the_pixel_and_its_neighbours(sigma_s: float) -> None:
    condition = Condition("piecewise", 0.03)
    capture = replace(condition.capture(900), pulse=Pulse(sigma_s))
    image = estimate(capture, "image_posterior", pixels="allow empty pixels")
    flux = image_model_of(capture)
    assert flux.agreement.alike > 0
    row, col = np.argwhere(image.confidence > 0.9)[0]
    alone, neighbours, posterior = ESTIMATORS["image_posterior"].evidence_at(capture, row, col)
    for each in (alone, neighbours, posterior):
        assert each.shape == (capture.acquisition.n_bins,) and 0 < each.sum() < 1 + 1e-6
    _, factor = merged_bins(capture)
    assert (factor > 1) == (sigma_s > 5e-9)
    product = alone * neighbours / np.repeat(Prior.of(merged_flux(flux, factor)).surface, factor)
    np.testing.assert_allclose(product / product.sum(), posterior / posterior.sum(), 1e-3, 1e-6)
    assert abs(np.argmax(posterior) + 0.5 - image.bin[row, col]) < 3
    report = pixel_report(capture, image, int(row), int(col), "image_posterior")
    np.testing.assert_array_equal(report.evidence.posterior, posterior)
    assert report.candidates[0].bin == image.bin[row, col]
    assert report.candidates[0].probability == image.confidence[row, col]


@pytest.mark.compiled
def test_neighbours_find_what_a_pixel_alone_does_not_show() -> None:
    capture = Condition("piecewise", 0.02).capture(900)
    image = estimate(capture, "image_posterior")
    right = np.abs(image.range_m - capture.truth_range_m) < capture.acquisition.bin_length_m
    found = [
        ESTIMATORS["image_posterior"].evidence_at(capture, row, col)
        for row, col in np.argwhere(right & (image.confidence > 0.9))[:200]
    ]
    agree = [np.abs(each.alone.argmax() - each.posterior.argmax()) <= 1 for each in found]
    assert len(found) == 200 and np.mean(agree) < 0.6
    assert ESTIMATORS["likelihood"].evidence_at(capture, 0, 0) is None
