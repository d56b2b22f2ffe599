"""Tests of overlaps, their thresholds, and the closed form of pile-up."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.optimize import brentq

from core.inference.resolution import ERROR, HIDDEN, RESOLVED, Difference, difference, pile_up
from core.trigger import trigger_probability

FLAT = np.full(20, 0.01)
TILTED = FLAT * np.linspace(0.7, 1.3, 20)


def pulses_for(evidence: float) -> int:
    """Pulses with which `TILTED` against `FLAT` has this evidence."""
    return round(evidence / float(difference(FLAT, TILTED, 1).evidence))


def test_the_best_test_errs_as_often_as_the_threshold_says() -> None:
    n_pulses, draws = pulses_for(RESOLVED), 40_000
    assert n_pulses > 500
    rng = np.random.default_rng(0)
    outcomes = [np.append(model, 1 - model.sum()) for model in (FLAT, TILTED)]
    ratio = np.log(outcomes[1] / outcomes[0])
    wrong = [
        (rng.multinomial(n_pulses, outcomes[0], draws) @ ratio > 0).mean(),
        (rng.multinomial(n_pulses, outcomes[1], draws) @ ratio < 0).mean(),
    ]
    # Four standard deviations of a share, and what is left of the logarithm's skewness.
    assert wrong == pytest.approx([ERROR, ERROR], abs=4 * math.sqrt(0.05 * 0.95 / draws) + 0.004)


def test_hidden_is_where_nothing_is_likelier_by_so_much() -> None:
    # Of two outcomes the total variation of many pulses is a sum over binomials.
    one, n_pulses = 0.3, 4000
    other = brentq(lambda p: float(difference([one], [p], n_pulses).evidence) - HIDDEN, 0.3, 0.4)
    k = np.arange(n_pulses + 1)
    masses = [stats.binom.pmf(k, n_pulses, p) for p in (one, other)]
    assert np.abs(masses[0] - masses[1]).sum() / 2 == pytest.approx(ERROR, rel=0.02)


@pytest.mark.parametrize("n_pulses", [1, 30, 1000])
@pytest.mark.parametrize("other", [0.31, 0.35, 0.6])
def test_the_total_variation_of_all_pulses_lies_within_le_cams_bounds(
    n_pulses: int, other: float
) -> None:
    k = np.arange(n_pulses + 1)
    masses = [stats.binom.pmf(k, n_pulses, p) for p in (0.3, other)]
    variation = np.abs(masses[0] - masses[1]).sum() / 2
    overlap = math.exp(-float(difference([0.3], [other], n_pulses).evidence))
    assert 1 - overlap <= variation + 1e-12
    assert variation <= math.sqrt(1 - overlap**2) + 1e-12


def test_evidence_adds_up_and_nothing_differs_from_itself() -> None:
    few, many = (difference(FLAT, TILTED, n) for n in (10, 70))
    assert many.evidence == pytest.approx(7 * few.evidence)
    assert many.total_variation == few.total_variation
    assert few.total_variation == pytest.approx(np.abs(FLAT - TILTED).sum() / 2)
    same = difference(FLAT, FLAT, 10**9)
    assert same.total_variation == same.evidence == 0
    assert same.is_hidden
    assert not same.is_resolved.any()
    assert np.isnan(same.resolvable)


def test_disjoint_models_are_resolved_by_one_pulse() -> None:
    sure = difference([1.0, 0.0], [0.0, 1.0], 1)
    assert sure.total_variation == 1
    assert sure.is_resolved.all()
    assert sure.resolvable == 0


def test_the_least_resolvable_difference_does_not_depend_on_its_size() -> None:
    n_pulses = 200
    at = float(difference(FLAT, TILTED, n_pulses).resolvable)
    small = difference(FLAT, FLAT + (TILTED - FLAT) / 3, n_pulses)
    assert small.resolvable == pytest.approx(at, rel=0.02)  # of this shape, whatever its size


def test_counts_of_photons_are_the_limit_of_many_faint_pulses() -> None:
    photons, pulses = difference(100 * FLAT, 100 * TILTED, None), 10**7
    faint = difference(100 * FLAT / pulses, 100 * TILTED / pulses, pulses)
    assert faint.evidence == pytest.approx(photons.evidence, rel=1e-5)
    assert photons.total_variation == pytest.approx(
        np.abs(TILTED - FLAT).sum() / 2 / max(FLAT.sum(), TILTED.sum())
    )


@given(
    st.lists(st.floats(0.0, 0.5), min_size=2, max_size=30),
    st.integers(1, 5000),
)
def test_pile_up_of_any_flux_is_at_most_that_of_fine_bins(rate: list[float], n_pulses: int) -> None:
    rates = np.array(rate)
    fires = trigger_probability(rates)
    fired, photons = fires.sum(), rates.sum()
    spread = rates * (fired / photons) if photons > 0 else rates
    binned, fine = difference(fires, spread, n_pulses), pile_up(fired, n_pulses)
    assert binned.total_variation <= fine.total_variation + 1e-9
    assert binned.evidence <= fine.evidence + 1e-9 * n_pulses


@pytest.mark.parametrize("photons", [1e-4, 0.0099, 0.0101, 0.3, 2.0, 12.0])
def test_pile_up_is_that_of_fine_bins(photons: float) -> None:
    rates = np.full(20_000, photons / 20_000)
    fires = trigger_probability(rates)
    expected = difference(fires, np.full(rates.size, fires.sum() / rates.size), 1000)
    found = pile_up(-math.expm1(-photons), 1000)
    assert found.total_variation == pytest.approx(expected.total_variation, rel=6e-3)
    assert found.evidence == pytest.approx(expected.evidence, rel=6e-3)


def test_pile_up_of_nothing_and_of_everything_is_finite() -> None:
    found = pile_up([0.0, 1.0], 1000)
    assert found.evidence[0] == 0
    assert np.isfinite(found.evidence).all()
    assert found.total_variation[1] > 0.8


def test_a_few_pixels_do_not_make_an_image() -> None:
    evidence = np.zeros(1000)
    evidence[:10] = 100.0
    assert Difference(evidence, evidence).is_hidden
    evidence[10] = 2 * HIDDEN
    assert not Difference(evidence, evidence).is_hidden
