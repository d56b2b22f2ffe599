"""Tests of the limits against their definitions and against simulated estimates."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from core import limits
from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.inference.limits import (
    approximation_error,
    best_exposure,
    cramer_rao_bins,
    cramer_rao_m,
    limit,
    right_bin_probability,
)
from core.scene import Scene
from core.simulation import simulate
from core.trigger import draw_counts, rate_per_bin

GATE = Acquisition()
PULSES = [
    Pulse(),
    Pulse(0.3e-9),
    Pulse.gaussian(2e-9),
    Pulse.measured([1.0, 4.0, 2.0, 0.5], 0.7e-9),
]


def draw(
    trials: int, onset: float, signal: float, background: float, pulse: Pulse, gate: Acquisition
) -> np.ndarray:
    """Histograms (trial, bin) of one pixel, each the multinomial of Eq. 1."""
    assert gate.n_pulses is not None
    rate = rate_per_bin(np.full(trials, onset), np.full(trials, signal), background, pulse, gate)
    return draw_counts(rate, gate.n_pulses, np.random.default_rng(0))


def exact_score(
    counts: np.ndarray,
    delays: np.ndarray,
    signal: float,
    background: float,
    pulse: Pulse,
    gate: Acquisition,
) -> np.ndarray:
    """``Σ_k [n_k ln((1-e^-(b+s_k))/(1-e^-b)) - (A_k - n_k) s_k]``, shape (trial, delay)."""
    b = background / gate.n_bins
    s = signal * pulse.bin_probability(delays, gate.n_bins, gate.bin_width_s)
    armed = gate.n_pulses - (np.cumsum(counts, axis=1) - counts)
    gain = np.log(np.expm1(-(b + s)) / np.expm1(-b))
    return counts @ gain.T - (armed - counts) @ s.T


def share_right(
    trials: int, signal: float, background: float, gate: Acquisition, onset: float = 53.6
) -> float:
    """Share of simulated pixels that the exact likelihood places within 3 bins."""
    delays = np.arange(-1, gate.n_bins, 0.5)
    counts = draw(trials, onset, signal, background, Pulse(), gate)
    score = exact_score(counts, delays, signal, background, Pulse(), gate)
    return float(np.mean(np.abs(delays[score.argmax(axis=1)] - onset) <= 3))


def assert_share(share: float, trials: int, low: float, high: float) -> None:
    """A share of trials, whose true probability lies between `low` and `high`."""
    least = stats.binom.ppf(1e-4, trials, max(low, 0.0))
    most = stats.binom.ppf(1 - 1e-4, trials, min(high, 1.0))
    assert least <= round(share * trials) <= most


@pytest.mark.parametrize("background", [0.0, 0.4, 6.0])
def test_cramer_rao_is_its_definition(background: float) -> None:
    onset, signal, gate = 20.3, 0.7, Acquisition(n_bins=40, n_pulses=50)
    information, before = 0.0, 0.0
    for k in range(gate.n_bins):
        t, u = max(k - onset, 0.0), max(k + 1 - onset, 0.0)
        share = (1 + t) * math.exp(-t) - (1 + u) * math.exp(-u)
        slope = t * math.exp(-t) - u * math.exp(-u)
        rate = signal * share + background / gate.n_bins
        if rate > 0:
            h = -math.expm1(-rate)
            h_slope = math.exp(-rate) * signal * slope
            information += 50 * math.exp(-before) * h_slope**2 / (h * (1 - h))
        before += rate
    found = float(cramer_rao_bins(onset, signal, background, Pulse(), gate))
    # The difference quotient, over 1e-4 of the pulse, is good to the square of that.
    assert found == pytest.approx(1 / math.sqrt(information), rel=1e-7)
    in_m = float(cramer_rao_m(onset, signal, background, Pulse(), gate))
    assert in_m == pytest.approx(found * gate.bin_length_m, rel=1e-14)


@pytest.mark.parametrize("pulse", [Pulse(2e-9), Pulse.gaussian(2e-9)])
def test_the_likelihood_reaches_cramer_rao_and_no_more(pulse: Pulse) -> None:
    trials, onset, signal, background = 2000, 53.6, 0.5, 0.5
    gate = replace(GATE, n_pulses=30_000)
    bound = float(cramer_rao_bins(onset, signal, background, pulse, gate))
    delays = onset + bound * np.linspace(-6, 6, 61)
    counts = draw(trials, onset, signal, background, pulse, gate)
    score = exact_score(counts, delays, signal, background, pulse, gate)
    at = score.argmax(axis=1)
    assert at.min() > 0
    assert at.max() < delays.size - 1
    left, top, right = (score[np.arange(trials), at + step] for step in (-1, 0, 1))
    best = delays[at] + (delays[1] - delays[0]) * (left - right) / (left - 2 * top + right) / 2
    least, most = stats.chi2.ppf([1e-4, 1 - 1e-4], trials - 1) / (trials - 1)
    # The bound is of many pulses; 30 000 leave 1 %.
    assert least <= np.var(best, ddof=1) / bound**2 <= most * 1.01
    assert abs(np.mean(best) - onset) <= 4 * bound / math.sqrt(trials) + 0.02 * bound


@pytest.mark.parametrize(
    ("sbr", "published"), [(0.10, 1.0), (0.08, 1.0), (0.06, 0.997), (0.05, None), (0.04, 0.947)]
)
def test_right_place_where_it_is_likely(sbr: float, published: float | None) -> None:
    background = 0.1041 / sbr
    share = share_right(2000, 0.1041, background, GATE)
    found = float(right_bin_probability(53.6, 0.1041, background, Pulse(), GATE))
    assert found > 0.9
    error = 0.005
    assert approximation_error(found, 1000) == error
    assert_share(share, 2000, found - error, found + error)
    if published is not None:
        assert_share(share, 2000, published - 0.005, published + 0.005)


@pytest.mark.parametrize(
    ("n_pulses", "sbr", "too_high"),
    [
        (1000, 0.03, 0.015),
        (1000, 0.02, 0.015),
        (300, 0.06, 0.015),
        (100, 1.0, 0.01),
        (100, 0.06, 0.07),
        (30, 0.1, 0.1),
    ],
)
def test_right_place_is_no_worse_than_it_says(n_pulses: int, sbr: float, too_high: float) -> None:
    gate, background = replace(GATE, n_pulses=n_pulses), 0.1041 / sbr
    share = share_right(2000, 0.1041, background, gate)
    found = float(right_bin_probability(53.6, 0.1041, background, Pulse(), gate))
    assert_share(share, 2000, found - too_high, found + 0.005)


def by_chance() -> float:
    """Share of the gate that counts as the right place for the paper's pulse, begun anywhere."""
    share = Pulse().bin_probability(np.arange(5000, 5100) / 100, GATE.n_bins, GATE.bin_width_s)
    spacing = 1 / (2 * np.mean(np.sum(share**2, axis=1)))
    return float(2 * 1.5 * spacing / GATE.n_bins)


@pytest.mark.parametrize("n_pulses", [1, 10, 300])
def test_without_background_one_photon_finds_the_echo(n_pulses: int) -> None:
    gate, signal = replace(GATE, n_pulses=n_pulses), 0.02
    expected = 1 - math.exp(-n_pulses * signal) * (1 - by_chance())
    for background in (0.0, 1e-12):
        found = right_bin_probability(53.6, signal, background, Pulse(), gate)
        # Eight onsets in a bin give Σ p² to a millionth.
        assert float(found) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("background", [0.0, 1e-4, 0.3])
def test_without_signal_the_echo_is_found_by_chance(background: float) -> None:
    found = float(right_bin_probability(53.6, 0.0, background, Pulse(), GATE))
    # What stands for no signal is a thousandth of a photon. With background, early places have more
    # photons to win by: a little less than by chance.
    assert 0.9 * by_chance() <= found <= by_chance() + 0.001


def test_right_place_falls_with_background_and_depth_and_rises_with_pulses() -> None:
    def probability(onset: float, background: float, n_pulses: int) -> float:
        gate = replace(GATE, n_pulses=n_pulses)
        return float(right_bin_probability(onset, 0.1, background, Pulse(), gate))

    backgrounds = [probability(50.0, background, 300) for background in np.geomspace(1e-7, 50, 40)]
    assert all(np.diff(backgrounds) <= 0.005)  # where a photon is all, the ceiling takes over
    assert all(np.diff(backgrounds[10:]) <= 0)
    assert all(np.diff([probability(onset, 3.0, 1000) for onset in range(5, 95)]) < 0)
    assert all(np.diff([probability(50.0, 2.0, n) for n in (1, 3, 10, 30, 100, 300)]) > 0)


@pytest.mark.parametrize("pulse", PULSES)
def test_an_echo_outside_the_gate_has_no_right_place(pulse: Pulse) -> None:
    onset = np.array([-200.0, 300.0])
    for background in (0.0, 1.0, 1e4):
        found = right_bin_probability(onset, 0.1, background, pulse, GATE)
        np.testing.assert_array_equal(found, 0)
    np.testing.assert_array_equal(cramer_rao_bins(onset, 0.1, 1.0, pulse, GATE), np.inf)


def test_no_echo_has_no_limit() -> None:
    onset = np.array([[np.nan, 50.0]])
    for figure in (right_bin_probability, cramer_rao_bins, best_exposure):
        found = figure(onset, 0.1, 1.0, Pulse(), GATE)
        np.testing.assert_array_equal(np.isnan(found), [[True, False]])
        assert np.isnan(figure(np.nan, 0.1, 1.0, Pulse(), GATE))


@pytest.mark.parametrize("one_signal", [True, False])
def test_many_pixels_are_interpolated_to_what_each_has_alone(one_signal: bool) -> None:
    rng = np.random.default_rng(0)
    onset = rng.uniform(2, 96, (20, 10))
    signal = np.full(onset.shape, 0.1) if one_signal else rng.uniform(0.03, 0.2, onset.shape)
    assert onset.size > limits.MOST_PAIRS
    many = right_bin_probability(onset, signal, 2.0, Pulse(), GATE)
    some = (slice(None), slice(0, 3))
    each = right_bin_probability(onset[some], signal[some], 2.0, Pulse(), GATE)
    np.testing.assert_allclose(many[some], each, rtol=0, atol=0.003 if one_signal else 0.01)


def test_limits_of_a_capture() -> None:
    range_m = np.array([[50.0, np.nan], [51.0, 52.0]])
    reflectivity = np.array([[1.0, 1.0], [0.5, 1.0]])
    capture = simulate(Scene(range_m, reflectivity), GATE, Flux(sbr=0.05))
    found = limit(capture)
    onset = GATE.range_m_to_bin(range_m)
    rates = (0.1041 * reflectivity, 0.1041 / 0.05, Pulse(), GATE)
    np.testing.assert_array_equal(found.right_bin_probability, right_bin_probability(onset, *rates))
    np.testing.assert_array_equal(found.cramer_rao_m, cramer_rao_m(onset, *rates))
    assert np.isnan(found.right_bin_probability[0, 1])
    assert np.isnan(found.cramer_rao_m[0, 1])


def test_a_capture_that_does_not_know_its_truth_is_refused() -> None:
    capture = simulate(Scene(np.full((1, 1), 50.0)), GATE, Flux())
    with pytest.raises(ValueError, match=r"signal and background = None .* known truth"):
        limit(Capture(capture.cube, GATE, truth_range_m=capture.truth_range_m))
    unknown = replace(capture, acquisition=replace(GATE, n_pulses=None))
    with pytest.raises(ValueError, match="n_pulses = None is not accepted"):
        limit(unknown)


@pytest.mark.parametrize("figure", [right_bin_probability, cramer_rao_bins, best_exposure])
def test_impossible_rates_are_refused(figure) -> None:  # type: ignore[no-untyped-def]
    for signal in (-0.1, np.inf, np.nan, [0.1, -0.1]):
        with pytest.raises(ValueError, match=r"signal = .*non-negative"):
            figure(50.0, signal, 1.0, Pulse(), GATE)
    for background in (-0.1, np.inf, np.nan):
        with pytest.raises(ValueError, match=r"background = .*non-negative"):
            figure(50.0, 0.1, background, Pulse(), GATE)


@pytest.mark.parametrize("onset", [20.0, 53.6, 85.0])
def test_best_exposure_has_one_background_photon_before_the_echo(onset: float) -> None:
    background = 8.0
    factor = float(best_exposure(onset, 0.01, background, Pulse(), GATE))
    # Steps of 2 %, and an echo that reaches some bins behind its onset.
    assert factor * background * onset / 100 == pytest.approx(1, rel=0.02 + 2.5 / onset)


@pytest.mark.parametrize(
    ("onset", "signal", "background"), [(53.6, 0.3, 5.0), (85.0, 1.0, 20.0), (30.0, 0.3, 10.0)]
)
def test_best_exposure_is_best_for_both_limits(
    onset: float, signal: float, background: float
) -> None:
    gate = replace(GATE, n_pulses=300)

    def at(figure, factor: float) -> float:  # type: ignore[no-untyped-def]
        return float(figure(onset, factor * signal, factor * background, Pulse(), gate))

    best = float(best_exposure(onset, signal, background, Pulse(), gate))
    factors = np.geomspace(0.01, 1, 100)
    least = min(at(cramer_rao_bins, factor) for factor in factors)
    assert at(cramer_rao_bins, best) <= least * (1 + 1e-3)
    likeliest = max(at(right_bin_probability, factor) for factor in factors)
    assert at(right_bin_probability, best) >= likeliest - 0.01
    assert likeliest > at(right_bin_probability, 1.0) + 0.05


def test_faint_fluxes_are_not_attenuated() -> None:
    found = best_exposure([[20.0, 90.0]], [[0.1, 0.5]], 0.4, Pulse(), GATE)
    np.testing.assert_array_equal(found, [[1.0, 1.0]])
