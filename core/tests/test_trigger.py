"""Tests of trigger probabilities, their differences and Coates' rates."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from core.acquisition import Acquisition, Pulse
from core.trigger import (
    coates_rate,
    draw_counts,
    draw_triggers,
    first_difference,
    no_trigger_probability,
    rate_per_bin,
    trigger_probability,
)

FULL_RANGE = st.sampled_from([0.0, 1e-12, 1e6]) | st.floats(0, 30)


def equation_1(rate: list[float]) -> list[float]:
    """``P_k = exp(-Σ_{i<k} λ_i) · (1 - exp(-λ_k))``, one bin at a time."""
    return [math.exp(-math.fsum(rate[:k])) * -math.expm1(-rate[k]) for k in range(len(rate))]


@given(st.lists(FULL_RANGE, min_size=1, max_size=60))
@example([0.3, 1e6])
def test_trigger_probability_is_equation_1(rate: list[float]) -> None:
    # x·exp(-x) < 0.4, so that a sum of n rates rounds at n · 1.1e-16 or less, seen in exp.
    tolerance = len(rate) * np.finfo(float).eps
    np.testing.assert_allclose(trigger_probability(rate), equation_1(rate), rtol=0, atol=tolerance)


def test_a_certain_photon_hides_what_follows() -> None:
    probability = trigger_probability([0.3, np.inf, 0.5])
    np.testing.assert_allclose(probability, [1 - math.exp(-0.3), math.exp(-0.3), 0], rtol=1e-15)


@pytest.mark.parametrize("n_pulses", [500, 20_000], ids=["one by one", "multinomial"])
def test_draws_follow_equation_1(n_pulses: int) -> None:
    rate = [[0.5, 0.0, 2.0, 0.1], [0.03, 0.02, 0.3, 1.0]]
    counts = draw_counts([rate] * 50, n_pulses, np.random.default_rng(3))
    assert (counts.shape, counts.dtype) == ((50, 2, 4), np.uint16)
    assert not counts[:, 0, 1].any()
    assert len(np.unique(counts[:, 1, 3])) > 10  # pixels are independent
    for found, of in zip(counts.sum(axis=0, dtype=int), rate, strict=True):
        share = np.array(equation_1(of))
        seen = share > 0
        outcomes = np.append(found[seen], 50 * n_pulses - found.sum())
        expected = 50 * n_pulses * np.append(share[seen], math.exp(-sum(of)))
        # By chance, one fixed seed in ten thousand would fall below.
        assert stats.chisquare(outcomes, expected).pvalue > 1e-4


@pytest.mark.parametrize("n_pulses", [500, 20_000], ids=["one by one", "multinomial"])
def test_probabilities_may_be_rounded_beyond_0_and_1(n_pulses: int) -> None:
    below, above = -4 * np.finfo(float).eps, 1 + 4 * np.finfo(float).eps
    counts = draw_triggers(np.array([[0.0, below, 0.0, above, 1.0]]), n_pulses, seed=0)
    np.testing.assert_array_equal(counts, [[0, 0, n_pulses, 0]])


def test_draws_of_all_photons_are_poisson() -> None:
    counts = draw_counts(np.full((100, 100), 3.0), None, np.random.default_rng(0))
    # Mean and variance, each to four standard errors.
    assert counts.mean() == pytest.approx(3.0, abs=4 * math.sqrt(3.0) / 100)
    assert counts.var() == pytest.approx(3.0, abs=4 * math.sqrt(2 * 9.0 + 3.0) / 100)


@pytest.mark.parametrize("low", [-1e-9, -np.inf, np.nan])
def test_impossible_rates_are_refused(low: float) -> None:
    for probability in (trigger_probability, no_trigger_probability):
        with pytest.raises(ValueError, match=rf"rate = {low} .*non-negative"):
            probability([0.1, low])


@given(hnp.arrays(float, (3, 20), elements=st.floats(0, 1)))
def test_first_differences_add_up_to_what_they_came_from(probability: np.ndarray) -> None:
    difference = first_difference(probability)
    assert (difference[:, 0] == 0).all()
    back = probability[:, :1] + np.cumsum(difference, axis=1)
    np.testing.assert_allclose(
        back, probability, rtol=0, atol=20 * np.finfo(float).eps
    )  # 20 sums below 1


def test_rates_add_echo_and_background() -> None:
    acquisition = Acquisition(n_bins=80)
    rate = rate_per_bin([[30.0, np.nan]], [[0.4, 0.4]], 1.6, Pulse(), acquisition)
    assert rate.shape == (1, 2, 80)
    # Behind bin 30 lie 50 time constants of the pulse.
    np.testing.assert_allclose(rate.sum(axis=-1), [[0.4 + 1.6, 1.6]], rtol=1e-12)
    np.testing.assert_allclose(rate[0, 1], 1.6 / 80, rtol=1e-15)


@given(hnp.arrays(float, (3, 20), elements=st.just(0.0) | st.floats(1e-9, 0.25)))
def test_coates_gives_the_rates_back(rate: np.ndarray) -> None:
    n_pulses = 10**15
    counts = np.rint(trigger_probability(rate) * n_pulses).astype(np.int64)
    still_armed = no_trigger_probability(rate).min() * n_pulses
    # Every count is off by rounding to a whole one, and by 2 more where the product rounds.
    tolerance = 3 * rate.shape[1] / still_armed
    np.testing.assert_allclose(coates_rate(counts, n_pulses), rate, rtol=0, atol=tolerance)


def test_coates_counts_only_armed_pulses() -> None:
    expected = [math.log(10 / 8), math.log(8 / 5), 0.0, math.log(5 / 4)]
    np.testing.assert_allclose(coates_rate([2, 3, 0, 1], 10), expected, rtol=1e-15)


def test_coates_rates_without_armed_pulses_are_nan() -> None:
    np.testing.assert_array_equal(coates_rate([0, 5, 0, 0], 5), [0, np.inf, np.nan, np.nan])


def test_coates_accepts_any_counts_dtype_and_leaves_it_alone() -> None:
    counts = np.array([[1, 2], [0, 3]], np.uint8)
    np.testing.assert_array_equal(coates_rate(counts, 300), coates_rate(counts.tolist(), 300))
    np.testing.assert_array_equal(counts, [[1, 2], [0, 3]])


def test_more_detections_than_pulses_are_refused() -> None:
    with pytest.raises(ValueError, match=r"n_pulses = 5 .*at least 6, the detections of a pixel"):
        coates_rate([[1, 1], [3, 3]], 5)


def test_negative_counts_are_refused() -> None:
    with pytest.raises(ValueError, match=r"counts = -1 .*non-negative"):
        coates_rate([-1, 2], 10)
