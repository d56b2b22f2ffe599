"""Errors against the truth, and intervals that cover as often as they promise."""

from __future__ import annotations

import math

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
    assert metrics.bias_m(RANGE_M, TRUTH_M) == pytest.approx(-0.2)
    assert metrics.coverage(RANGE_M, TRUTH_M) == 4 / 5


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


def test_a_perfect_answer_has_perfect_figures() -> None:
    assert metrics.rmse_m(TRUTH_M, TRUTH_M) == 0
    assert metrics.bias_m(TRUTH_M, TRUTH_M) == 0
    assert metrics.coverage(TRUTH_M, TRUTH_M) == 1
    assert metrics.restoration_degree(TRUTH_M, TRUTH_M, 0.0) == 1


def test_nothing_to_compare_gives_nan() -> None:
    no_target = np.full((2, 2), np.nan)
    for figure in (metrics.rmse_m, metrics.bias_m, metrics.coverage):
        assert math.isnan(figure(np.ones((2, 2)), no_target))
    assert math.isnan(metrics.restoration_degree(np.ones((2, 2)), no_target, 1.0))


def test_no_answers_restore_nothing() -> None:
    no_answer = np.full((2, 2), np.nan)
    assert math.isnan(metrics.rmse_m(no_answer, np.ones((2, 2))))
    assert math.isnan(metrics.bias_m(no_answer, np.ones((2, 2))))
    assert metrics.coverage(no_answer, np.ones((2, 2))) == 0
    assert metrics.restored(no_answer, np.ones((2, 2)), 1.0) == (0, 4)


def test_images_of_different_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"range_m = 'shape \(2, 2\)' .*\(2, 3\)"):
        metrics.rmse_m(np.ones((2, 2)), TRUTH_M)


@pytest.mark.parametrize("level", [0.5, 0.95, 0.9999])
@pytest.mark.parametrize(("hits", "trials"), [(0, 1), (1, 1), (0, 50), (7, 9), (4000, 4096)])
def test_wilson_is_the_textbook_interval(hits: int, trials: int, level: float) -> None:
    found = metrics.wilson(hits, trials, level)
    expected = stats.binomtest(hits, trials).proportion_ci(level, method="wilson")
    assert found.value == hits / trials
    # A dozen roundings of numbers below 1, and as many in the reference.
    np.testing.assert_allclose([found.low, found.high], expected, rtol=0, atol=1e-14)
    assert 0 <= found.low <= found.value <= found.high <= 1


@pytest.mark.parametrize("share", [0.5, 0.9, 0.98])
def test_wilson_covers_the_truth_as_often_as_it_promises(share: float) -> None:
    trials, repetitions = 4096, 4000
    hits = np.random.default_rng(0).binomial(trials, share, repetitions)
    intervals = {k: metrics.wilson(k, trials) for k in set(hits.tolist())}
    covered = sum(intervals[k].low <= share <= intervals[k].high for k in hits.tolist())
    # Hits are whole numbers: at either end one of them more or less may cover.
    ends = stats.binom.pmf(stats.binom.ppf([0.025, 0.975], trials, share), trials, share).sum()
    least, most = stats.binom.ppf([1e-4, 1 - 1e-4], repetitions, [0.95 - ends, 0.95 + ends])
    assert least <= covered <= most


@pytest.mark.parametrize(
    ("hits", "trials", "level", "name"),
    [(0, 0, 0.95, "trials"), (-1, 5, 0.95, "hits"), (6, 5, 0.95, "hits"), (1, 5, 1.0, "level")],
)
def test_impossible_shares_are_refused(hits: int, trials: int, level: float, name: str) -> None:
    with pytest.raises(ValueError, match=rf"{name} = .* is not accepted"):
        metrics.wilson(hits, trials, level)
