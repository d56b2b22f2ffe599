"""Tests of errors, shares and intervals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from core import metrics

TRUTH_M = np.array([[50.0, 51.0, np.nan], [52.0, 53.0, 54.0]])
RANGE_M = np.array([[50.3, 50.6, 99.0], [52.0, np.nan, 53.0]])  # errors .3, -.4, 0, none, -1


def test_only_target_pixels_count() -> None:
    # Ranges near 50 m round at 7e-15 m.
    np.testing.assert_allclose(
        metrics.errors_m(RANGE_M, TRUTH_M), [0.3, -0.4, 0.0, np.nan, -1.0], rtol=0, atol=2e-14
    )


def test_figures_of_a_small_image() -> None:
    assert metrics.rmse_m(RANGE_M, TRUTH_M) == pytest.approx(math.sqrt((0.09 + 0.16 + 1.0) / 4))
    assert metrics.mae_m(RANGE_M, TRUTH_M) == pytest.approx((0.3 + 0.4 + 1.0) / 4)
    assert metrics.bias_m(RANGE_M, TRUTH_M) == pytest.approx((0.3 - 0.4 - 1.0) / 4)
    assert metrics.median_error_m(RANGE_M, TRUTH_M) == pytest.approx(-0.2)
    assert metrics.coverage(RANGE_M, TRUTH_M) == 4 / 5


@pytest.mark.parametrize(
    ("tolerance_m", "squares"), [(0.1, [0]), (0.3, [0, 0.09]), (0.5, [0, 0.09, 0.16])]
)
def test_inliers_lie_within_the_tolerance(tolerance_m: float, squares: list[float]) -> None:
    found = metrics.inlier_rmse_m(RANGE_M, TRUTH_M, tolerance_m)
    assert found == pytest.approx(math.sqrt(sum(squares) / len(squares)), abs=1e-13)


@pytest.mark.parametrize(("tolerance_m", "hits"), [(0.0, 1), (0.3, 2), (0.4, 3), (0.99, 3), (1, 4)])
def test_restored_pixels_lie_within_the_tolerance(tolerance_m: float, hits: int) -> None:
    assert metrics.restored(RANGE_M, TRUTH_M, tolerance_m) == (hits, 5)
    assert metrics.restoration_degree(RANGE_M, TRUTH_M, tolerance_m) == hits / 5


def test_whole_bins_of_error_meet_a_tolerance_of_whole_bins() -> None:
    bin_m = 299_792_458 / 2 * 1e-9
    truth_m = 1.0 + 1.7 * np.arange(100)
    rounded = np.abs((truth_m + 3 * bin_m) - truth_m) > 3 * bin_m
    assert rounded.any()  # a comparison without grace would fail some
    assert metrics.restoration_degree(truth_m + 3 * bin_m, truth_m, 3 * bin_m) == 1
    assert metrics.restoration_degree(truth_m + 3.001 * bin_m, truth_m, 3 * bin_m) == 0


ERRORS = (
    metrics.rmse_m,
    metrics.mae_m,
    metrics.bias_m,
    metrics.median_error_m,
)


def test_nothing_to_compare_gives_nan() -> None:
    no_target = np.full((2, 2), np.nan)
    for figure in (*ERRORS, metrics.coverage):
        assert math.isnan(figure(np.ones((2, 2)), no_target))
    for within in (metrics.restoration_degree, metrics.inlier_rmse_m):
        assert math.isnan(within(np.ones((2, 2)), no_target, 1.0))


def test_without_estimates_nothing_is_restored() -> None:
    no_answer = np.full((2, 2), np.nan)
    for figure in ERRORS:
        assert math.isnan(figure(no_answer, np.ones((2, 2))))
    assert math.isnan(metrics.inlier_rmse_m(no_answer, np.ones((2, 2)), 1.0))
    assert metrics.coverage(no_answer, np.ones((2, 2))) == 0
    assert metrics.restored(no_answer, np.ones((2, 2)), 1.0) == (0, 4)


@pytest.mark.parametrize("level", [0.5, 0.95, 0.9999])
@pytest.mark.parametrize(("hits", "trials"), [(0, 1), (1, 1), (0, 50), (7, 9), (4000, 4096)])
def test_wilson_is_the_textbook_interval(hits: int, trials: int, level: float) -> None:
    found = metrics.wilson(hits, trials, level)
    expected = stats.binomtest(hits, trials).proportion_ci(level, method="wilson")
    assert found.value == hits / trials
    # A dozen roundings of numbers below 1, and as many in the reference.
    np.testing.assert_allclose([found.low, found.high], expected, rtol=0, atol=1e-14)
    assert 0 <= found.low <= found.value <= found.high <= 1


def test_variance_of_an_estimator_leaves_out_what_has_none() -> None:
    truth_m = np.array([[50.0, 50.0, 50.0, 50.0, np.nan]])
    estimates = [
        [50.0, 51.0, np.nan, np.nan, 1.0],
        [52.0, 51.0, 50.0, np.nan, 9.0],
        [np.nan, 51.0, np.nan, np.nan, 5.0],
    ]
    range_m = np.array(estimates)[:, np.newaxis]
    # Variances 2 and 0; the third pixel has one estimate, the fourth none, the last no target.
    assert metrics.estimator_variance_m2(range_m, truth_m) == pytest.approx(1.0)
    assert math.isnan(metrics.estimator_variance_m2(range_m[:1], truth_m))
    assert math.isnan(metrics.estimator_variance_m2(range_m, np.full((1, 5), np.nan)))


def test_detection_rates_count_estimates_and_targets() -> None:
    truth_m = np.array([[50.0, 51.0, 52.0, 53.0], [np.nan, np.nan, np.nan, 54.0]])
    valid = np.array([[True, True, True, False], [True, False, False, False]])
    found = metrics.precision_recall(valid, truth_m)
    assert found == metrics.DetectionRates(precision=3 / 4, recall=3 / 5, false_alarm_rate=1 / 3)


def test_shares_of_nothing_are_nan() -> None:
    target, none = np.ones((2, 2)), np.full((2, 2), np.nan)
    silent = metrics.precision_recall(np.zeros((2, 2), bool), target)
    assert math.isnan(silent.precision)
    assert silent.recall == 0
    assert math.isnan(silent.false_alarm_rate)
    empty = metrics.precision_recall(np.ones((2, 2), bool), none)
    assert (empty.precision, empty.false_alarm_rate) == (0, 1)
    assert math.isnan(empty.recall)


def test_reliability_compares_like_with_like() -> None:
    confidence = np.array([0.05, 0.95, 0.95, 0.95, 0.95, 1.0])
    right = np.array([False, True, True, True, False, True])
    low, high = metrics.reliability(confidence, right)
    assert (low.count, high.count) == (1, 5)
    assert (low.right.value, high.right.value) == (0, 0.8)
    assert high.confidence == pytest.approx(0.96)
    expected = (1 * 0.05 + 5 * 0.16) / 6
    assert metrics.calibration_error([low, high]) == pytest.approx(expected)


def test_no_estimates_have_no_calibration_error() -> None:
    assert metrics.reliability(np.empty(0), np.empty(0, bool)) == []
    assert math.isnan(metrics.calibration_error([]))


def test_surfaces_are_matched_one_to_one() -> None:
    nan = np.nan
    truth_m = np.array([[10.0, 10.0, 10.0, nan, 10.0], [12.0, 12.0, nan, nan, 10.5]])
    range_m = np.array([[12.1, 11.0, 10.0, 1.0, 10.1], [9.9, nan, 30.0, 2.0, nan]])
    # Both; one return between both; a false return; no target; one return near two surfaces.
    assert metrics.surfaces_found(range_m, truth_m, 1.0) == (2 + 1 + 1 + 0 + 1, 2 + 2 + 2 + 0 + 2)
    error_m = metrics.surface_errors_m(range_m[:, :2], truth_m[:, :2])
    np.testing.assert_allclose(error_m, [-0.1, 1.0, 0.1, -1.0], atol=1e-12)


def test_one_surface_counts_as_before() -> None:
    rng = np.random.default_rng(0)
    truth_m, range_m = rng.uniform(0, 9, (2, 20, 20))
    truth_m[rng.random((20, 20)) < 0.2] = range_m[rng.random((20, 20)) < 0.2] = np.nan
    given = range_m[np.newaxis], truth_m[np.newaxis]
    assert metrics.surfaces_found(*given, 1.0) == metrics.restored(range_m, truth_m, 1.0)
    np.testing.assert_array_equal(
        metrics.surface_errors_m(*given), metrics.errors_m(range_m, truth_m)
    )


REFUSED = [
    (metrics.surfaces_found, (np.ones((1, 2, 2)), TRUTH_M[np.newaxis], 1.0), "range_m = "),
    (metrics.rmse_m, (np.ones((2, 2)), TRUTH_M), r"range_m = 'shape \(2, 2\)' .*\(2, 3\)"),
    (metrics.precision_recall, (np.ones((3, 2), bool), TRUTH_M), r"valid = 'shape .*\(2, 3\)"),
    *(
        (metrics.estimator_variance_m2, (np.ones(shape), TRUTH_M), r"\(repetition, \*\(2, 3\)\)")
        for shape in ((2, 3), (4, 3, 2), (4, 4, 2, 3))
    ),
    *(
        (metrics.rd_variance, (rd,), "rd_per_repetition = .*2 or more")
        for rd in ([], [0.9], 0.9, [[0.9, 0.8]])
    ),
    *(
        (
            figure,
            (np.where(RANGE_M == 52, sign * np.inf, RANGE_M), TRUTH_M),
            "range_m = '1 infinite",
        )
        for figure in (*ERRORS, metrics.coverage)
        for sign in (-1, 1)
    ),
    (metrics.estimator_variance_m2, (np.full((2, 2, 3), np.inf), TRUTH_M), "12 infinite ranges"),
    *(
        (figure, (RANGE_M, TRUTH_M, tolerance_m), f"tolerance_m = {tolerance_m} .*non-negative")
        for figure in (metrics.restoration_degree, metrics.restored, metrics.inlier_rmse_m)
        for tolerance_m in (-1.0, math.nan)
    ),
    (
        metrics.surfaces_found,
        (RANGE_M[np.newaxis], TRUTH_M[np.newaxis], -1.0),
        "tolerance_m = -1.0 .*non-negative",
    ),
    *(
        (
            metrics.reliability,
            (np.array([0.5, bad]), np.ones(2, bool)),
            f"confidence = {bad} .*probabilities, 0 to 1",
        )
        for bad in (math.nan, -0.5, 1.5, math.inf)
    ),
    (metrics.reliability, (np.full(2, 0.5), np.ones(3, bool)), r"right = 'shape \(3,\)' .*\(2,\)"),
    (metrics.wilson, (0, 0), "trials = "),
    (metrics.wilson, (-1, 5), "hits = "),
    (metrics.wilson, (6, 5), "hits = "),
    (metrics.wilson, (1, 5, 1.0), "level = "),
]


@pytest.mark.parametrize(("figure", "arguments", "message"), REFUSED)
def test_wrong_arguments_are_refused(figure: Any, arguments: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        figure(*arguments)
