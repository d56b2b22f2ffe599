"""Tests of range intervals: against a slow twin, and of their coverage."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats

import core
from core.acquisition import Acquisition, Pulse
from core.capture import Capture
from core.estimators import RangeImage, estimate
from core.inference import TOLERANCE_BINS, flux_model_of
from core.inference.flux import LEVEL_SPAN, LEVELS
from core.inference.intervals import interval_tolerance_bins
from core.studies.methods.calibration import (
    FLUX_REGIMES,
    Regime,
    coverage,
    coverage_table,
    flux_table,
)
from core.studies.methods.calibration import LEVELS as COVERED
from core.tests.twins import log_likelihood
from core.trigger import draw_counts, rate_per_bin

pytestmark = pytest.mark.compiled

SIGNIFICANCE = 1e-4  # by chance, one fixed seed in ten thousand would fall below
N_BINS = 40

PULSES = {
    "gamma": Pulse(1e-9),
    "gaussian": Pulse.gaussian(2e-9),
    "narrow": Pulse.gaussian(0.1e-9),
    "measured": Pulse.measured([0, 1, 4, 6, 3, 0.5], 0.7e-9),
}


def drawn(
    pulse: Pulse, n_pulses: int | None, signal: float = 0.2, background: float = 0.5, seed: int = 0
) -> Capture:
    """Draw pixels with echoes anywhere in the gate, the first two at its ends.

    All photons are those of 300 pulses.
    """
    acquisition, rng = Acquisition(n_bins=N_BINS, n_pulses=n_pulses), np.random.default_rng(seed)
    onset = rng.uniform(0, N_BINS, (12, 12))
    onset[0, :2] = 0.3, N_BINS - 3.2
    rate = rate_per_bin(onset, np.full(onset.shape, signal), background, pulse, acquisition)
    cube = draw_counts(rate if n_pulses else 300 * rate, n_pulses, rng)
    kind = "first" if n_pulses else "all"
    return Capture(cube, acquisition, pulse, acquisition.bin_to_range_m(onset), detection=kind)


def image_at(capture: Capture, bins: np.ndarray) -> RangeImage:
    """Return estimates at given delays."""
    valid = np.isfinite(bins)
    known = np.ones(bins.shape)
    return RangeImage(capture.acquisition.bin_to_range_m(bins), bins, known, known, valid)


def twin(capture: Capture, row: int, col: int, estimate_bin: float, level: float) -> np.ndarray:
    """Compute the interval of one pixel, in bins, from the definition on a fine grid."""
    counts, n_pulses = capture.cube[row, col].astype(float), capture.gated_pulses
    flux = flux_model_of(capture)

    def likelihood(delay: np.ndarray, signal: float, background: float) -> np.ndarray:
        echo = np.full(delay.shape, signal)
        rate = rate_per_bin(delay, echo, background, capture.pulse, capture.acquisition)
        return log_likelihood(counts, rate, n_pulses)

    def log_density(delay: np.ndarray, levels: list[tuple[float, ...]]) -> np.ndarray:
        of_levels = [np.log(w) + likelihood(delay, s, b) for w, s, b in levels]
        return np.logaddexp.reduce(of_levels, axis=0)

    given = list(
        zip(flux.share[1:], flux.signal[1:, row, col], flux.background[1:, row, col], strict=True)
    )
    most_bins = interval_tolerance_bins(capture)
    window = np.clip(estimate_bin + np.array([-1, 1]) * most_bins, 0, N_BINS)
    coarse = np.linspace(*window, 25)
    best = coarse[[log_density(coarse, given).argmax()]]
    fitted = []
    for weight, signal, background in given:
        sd = (LEVEL_SPAN ** (0.5 / (LEVELS - 1)) - 1) * signal

        def loss(x: np.ndarray, start=(signal, background), sd: float = sd) -> float:
            s, b = np.exp(x) * start
            prior = ((s - start[0]) ** 2 + (b - start[1]) ** 2) / (2 * sd**2)
            return float(prior - likelihood(best, s, b)[0])

        found = optimize.minimize(loss, [0.0, 0.0], method="Nelder-Mead", tol=1e-9)
        s, b = np.exp(found.x) * (signal, background)
        penalty = ((s - signal) ** 2 + (b - background) ** 2) / (2 * sd**2)
        fitted.append((weight * math.exp(-penalty), s, b))
    likeliest = max(fitted, key=lambda each: math.log(each[0]) + likelihood(best, *each[1:])[0])
    delay = np.linspace(*window, 20_001)
    log = log_density(delay, fitted) / widening(capture, counts, best[0], *likeliest[1:])
    mass = np.cumsum(np.exp(log - log.max()))
    return np.interp([(1 - level) / 2, (1 + level) / 2], mass / mass[-1], delay)


def widening(
    capture: Capture, counts: np.ndarray, delay: float, signal: float, background: float
) -> float:
    """Variance of a delay if signal and background are unknown, too, over that if they are known.

    From the Fisher information matrix, by differences of the rates.
    """
    at, steps = np.array([delay, signal, background]), np.diag([1e-6, 1e-6, 1e-6])

    def rates(d: float, s: float, b: float) -> np.ndarray:
        return rate_per_bin(d, s, b, capture.pulse, capture.acquisition)

    slopes = np.array([(rates(*(at + h)) - rates(*(at - h))) / 2e-6 for h in steps])
    rate, n_pulses = rates(*at), capture.gated_pulses
    if n_pulses is None:
        matrix = slopes / rate @ slopes.T
    else:
        armed = n_pulses - np.cumsum(counts) + counts
        matrix = slopes * (armed / np.expm1(rate)) @ slopes.T
    prior = 1 / ((LEVEL_SPAN ** (0.5 / (LEVELS - 1)) - 1) * signal) ** 2
    return float(np.linalg.inv(matrix + np.diag([0.0, prior, prior]))[0, 0] * matrix[0, 0])


@pytest.mark.parametrize("pulse", PULSES.values(), ids=PULSES)
@pytest.mark.parametrize("n_pulses", [300, None], ids=["first photons", "photons"])
def test_intervals_are_those_of_the_definition(pulse: Pulse, n_pulses: int | None) -> None:
    capture = drawn(pulse, n_pulses)
    bins = capture.acquisition.range_m_to_bin(capture.truth_range_m) + 0.4
    image = image_at(capture, np.minimum(bins, N_BINS))
    for level in (0.68, 0.95):
        found = core.range_interval(capture, image, level)
        for row, col in ((0, 0), (0, 1), (5, 5)):
            low, high = capture.acquisition.range_m_to_bin([x[row, col] for x in found])
            expected = twin(capture, row, col, image.bin[row, col], level)
            # Nodes are a fiftieth of the interval apart, or more if it is a small part of a bin.
            atol = 0.01 * np.ptp(expected) + 0.005
            np.testing.assert_allclose([low, high], expected, rtol=0, atol=atol)


def test_intervals_are_of_valid_pixels_and_lie_within_the_tolerance() -> None:
    capture = drawn(Pulse(), 300)
    image = estimate(capture, "peak", false_alarm=0.01)
    assert 0 < image.valid.sum() < image.valid.size
    inner, outer = (core.range_interval(capture, image, level) for level in (0.68, 0.95))
    tolerance_m = TOLERANCE_BINS * capture.acquisition.bin_length_m
    begin_m, end_m = capture.acquisition.bin_to_range_m([0, N_BINS])
    some = image.valid
    for values in (*inner, *outer):
        np.testing.assert_array_equal(np.isfinite(values), some)
        assert (np.abs(values - image.range_m)[some] <= tolerance_m * (1 + 1e-9)).all()
        assert ((values[some] >= begin_m) & (values[some] <= end_m)).all()
    assert (outer.low_m < inner.low_m)[some].all() and (inner.high_m < outer.high_m)[some].all()


def test_the_interval_of_a_pixel_is_that_of_the_image() -> None:
    capture = drawn(Pulse(), 300)
    bins = capture.acquisition.range_m_to_bin(capture.truth_range_m)
    bins[:, ::3] = np.nan
    image = image_at(capture, bins)
    inner, outer = (core.range_interval(capture, image, level) for level in (0.68, 0.95))
    for row, col in np.ndindex(capture.shape):
        one, other = core.pixel_range_intervals(capture, image, row, col)
        np.testing.assert_array_equal(one.value, image.range_m[row, col])
        for found, of_image in ((one, inner), (other, outer)):
            expected = of_image.low_m[row, col], of_image.high_m[row, col]
            np.testing.assert_array_equal((found.low, found.high), expected)


def test_a_level_that_is_no_probability_is_refused() -> None:
    capture = drawn(Pulse(), 300)
    image = estimate(capture, "peak")
    empty = replace(image, valid=np.zeros_like(image.valid))
    for level in (0.0, 1.0, math.nan):
        with pytest.raises(ValueError, match=r"level = .* between 0 and 1"):
            core.range_interval(capture, image, level)
        for each in (image, empty):
            with pytest.raises(ValueError, match=r"level = .* between 0 and 1"):
                core.pixel_range_intervals(capture, each, 0, 0, (level,))
    other = replace(capture, cube=capture.cube[:5], truth_range_m=None, flux_prior=None)
    with pytest.raises(ValueError, match="image = "):
        core.range_interval(other, image)


@pytest.mark.parametrize(("row", "col"), [(-1, 0), (0, -1), (10**6, 0), (0, 10**6), (0, 0.5)])
def test_a_pixel_outside_the_image_has_no_interval(row: Any, col: Any) -> None:
    capture = drawn(Pulse(), 300)
    image = estimate(capture, "peak")
    with pytest.raises(ValueError, match=rf"row, col = \({row}, {col}\) .* rows and .* columns"):
        core.pixel_range_intervals(capture, image, row, col)


@pytest.mark.parametrize("n_pulses", [None, 1, 1000])
@pytest.mark.parametrize("n_bins", [1, 2, 9])
@pytest.mark.parametrize("count", [0, 1])
def test_intervals_are_always_defined(count: int, n_bins: int, n_pulses: int | None) -> None:
    cube = np.zeros((1, 2, n_bins), np.uint16)
    cube[..., 0] = count * (n_pulses or 1)
    kind = "all" if n_pulses is None else "first"
    capture = Capture(cube, Acquisition(n_bins=n_bins, n_pulses=n_pulses), detection=kind)
    image = image_at(capture, np.array([[0.0, n_bins]]))
    low_m, high_m = core.range_interval(capture, image)
    assert (low_m < high_m).all()


# -- coverage --------------------------------------------------------------------------------------


def is_covered(hits: float, trials: int, level: float) -> bool:
    """Return whether the truth lies in intervals as often as it should, but for chance."""
    low, high = stats.binom.ppf([SIGNIFICANCE / 2, 1 - SIGNIFICANCE / 2], trials, level)
    return bool(low <= hits <= high)


@pytest.mark.parametrize(
    ("regime", "method"),
    [
        (Regime("first", 1, 0.06), "tracking"),
        (Regime("all", 2, 0.3), "likelihood"),
    ],
    ids=str,
)
def test_intervals_of_right_estimates_cover_the_truth(regime: Regime, method: str) -> None:
    """``make calibration`` covers the other regimes."""
    found = coverage((regime, method, range(1)))
    assert found.right > 500
    for level, share in zip(COVERED, found.shares, strict=True):
        assert is_covered(round(share.value * found.right), found.right, level), share


def test_intervals_in_a_long_gate_cover_the_truth() -> None:
    """There, the distribution of delays is learned from hardly a pixel per bin."""
    acquisition, rng = Acquisition(n_bins=2000, bin_width_s=64e-12), np.random.default_rng(1)
    onset = rng.uniform(200, 1800, (32, 32))
    rate = rate_per_bin(onset, np.full(onset.shape, 0.2), 0.5, Pulse(), acquisition)
    counts = draw_counts(rate, acquisition.n_pulses, rng)
    capture = Capture(counts, acquisition, truth_range_m=acquisition.bin_to_range_m(onset))
    image = estimate(capture, "likelihood")
    tolerance_m = TOLERANCE_BINS * acquisition.bin_length_m
    right = np.abs(image.range_m - capture.truth_range_m) <= tolerance_m
    assert right.mean() > 0.95
    for level, found in zip(COVERED, core.range_intervals(capture, image, COVERED), strict=True):
        holds = (found.low_m <= capture.truth_range_m) & (capture.truth_range_m <= found.high_m)
        assert is_covered(int(holds[right].sum()), int(right.sum()), level), holds[right].mean()


def test_intervals_of_a_pulse_of_many_bins_cover_the_truth() -> None:
    """Errors are those of the pulse, of 4 ns at half its height, and not of bins of 64 ps."""
    acquisition, rng = Acquisition(n_bins=600, bin_width_s=64e-12), np.random.default_rng(3)
    pulse, onset = Pulse.gaussian(1.7e-9), rng.uniform(150, 450, (16, 16))
    rate = rate_per_bin(onset, np.full(onset.shape, 0.1), 0.3, pulse, acquisition)
    counts = draw_counts(rate, acquisition.n_pulses, rng)
    capture = Capture(counts, acquisition, pulse, acquisition.bin_to_range_m(onset))
    image = estimate(capture, "likelihood")
    error_bins = np.abs(image.bin - onset)
    assert interval_tolerance_bins(capture) == 54
    assert (error_bins <= TOLERANCE_BINS).mean() < 0.8
    right = error_bins <= 54
    assert right.mean() > 0.95
    for level, found in zip(COVERED, core.range_intervals(capture, image, COVERED), strict=True):
        holds = (found.low_m <= capture.truth_range_m) & (capture.truth_range_m <= found.high_m)
        assert is_covered(int(holds[right].sum()), int(right.sum()), level), holds[right].mean()


@pytest.mark.parametrize("n_pulses", [400_000, None], ids=["first photons", "photons"])
def test_intervals_of_many_photons_cover_the_truth(n_pulses: int | None) -> None:
    """Sums of pixels have intervals of a hundredth of a bin, with the fluxes of one pixel."""
    hits, trials, acquisition = np.zeros(2, int), 100, Acquisition(n_pulses=n_pulses)
    kind = "all" if n_pulses is None else "first"
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        onset = rng.uniform(20, 90, (1, 1))
        rate = rate_per_bin(onset, np.full((1, 1), 0.1), 0.5, Pulse(), acquisition)
        cube = draw_counts(rate if n_pulses else 400_000 * rate, n_pulses, rng)
        capture = Capture(cube, acquisition, detection=kind)
        image, truth_m = image_at(capture, onset + 0.3), acquisition.bin_to_range_m(onset)[0, 0]
        for i, each in enumerate(core.pixel_range_intervals(capture, image, 0, 0, COVERED)):
            assert each.high - each.low < 0.04 * acquisition.bin_length_m
            hits[i] += each.low <= truth_m <= each.high
    for level, count in zip(COVERED, hits, strict=True):
        assert is_covered(int(count), trials, level), hits


def test_the_study_has_a_row_for_each_regime_and_method(monkeypatch: pytest.MonkeyPatch) -> None:
    regimes = (Regime("first", 1, 3), Regime("all", 1, 3))
    monkeypatch.setattr("core.studies.methods.calibration.REGIMES", regimes)
    monkeypatch.setattr("core.studies.methods.calibration._SIDE", 8)
    found = coverage_table(range(1))
    assert [row[:5] for row in found.rows] == [
        (kind, "1", "3", "0.1041", method)
        for kind in ("first", "all")
        for method in ("likelihood", "tracking")
    ]
    for row in found.rows:
        assert 0 < row[5] <= 64
        assert row[6].low <= row[6].value <= row[7].value <= 1


def test_the_flux_study_has_a_row_for_each_regime_and_bin_width(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    study = "core.studies.methods.calibration"
    monkeypatch.setattr(f"{study}.FLUX_REGIMES", FLUX_REGIMES[11:12])
    monkeypatch.setattr(f"{study}.BIN_WIDTHS_S", (1e-9, 2e-9))
    monkeypatch.setattr(f"{study}._FLUX_SIDE", 6)
    found = flux_table(1)
    regime = ("first", "whole gate", "exponential tail")
    assert [row[:4] for row in found.rows[:2]] == [(*regime, "1"), (*regime, "2")]
    assert [row[4:] for row in found.rows[:2]] == [row[4:] for row in found.rows[2:]]
    for row in found.rows:
        assert all(0 <= each.low <= each.value <= each.high <= 1 for each in row[5:])


def deviations(capture: Capture, image: RangeImage) -> np.ndarray:
    """Distances of the truth from the middle of the 68 % interval, over half its width.

    Of estimates within the tolerance whose echo the gate holds as a whole.
    """
    truth_m, (low_m, high_m) = capture.truth_range_m, core.range_interval(capture, image, 0.68)
    end_m = capture.acquisition.bin_to_range_m(N_BINS - capture.echo_bins)
    tolerance_m = TOLERANCE_BINS * capture.acquisition.bin_length_m
    kept = (np.abs(image.range_m - truth_m) <= tolerance_m) & (truth_m < end_m)
    return np.asarray((2 * truth_m - low_m - high_m) / (high_m - low_m))[kept]


def is_as_wide_as_the_errors(deviation: np.ndarray) -> bool:
    """Return whether deviations have a mean square of 1, but for chance: four deviations of it."""
    return bool(abs((deviation**2).mean() - 1) < 4 * math.sqrt(2 / deviation.size))


@pytest.mark.parametrize("method", ["likelihood", "tracking"])
def test_estimates_of_bright_echoes_lie_in_their_intervals(method: str) -> None:
    """Their errors are those of the photons, and not of the steps in which they are found."""
    capture = drawn(Pulse(1e-9), 1000, signal=3.0, background=1.0)
    image = estimate(capture, method)
    right = np.abs(image.range_m - capture.truth_range_m) < capture.acquisition.bin_length_m
    low_m, high_m = (each[right] for each in core.range_interval(capture, image))
    outside = (image.range_m[right] < low_m) | (image.range_m[right] > high_m)
    truth_m = np.asarray(capture.truth_range_m)[right]
    assert right.sum() > 80
    # It is a third of them where a parabola refines between half bins.
    assert outside.mean() < 0.05
    assert is_covered(((low_m <= truth_m) & (truth_m <= high_m)).sum(), right.sum(), 0.95)
    assert is_as_wide_as_the_errors(deviations(capture, image))


def test_intervals_allow_for_a_wrong_pulse() -> None:
    """Many photons do not make up for a pulse that differs from the echoes."""
    capture = replace(drawn(Pulse.gaussian(2e-9), None, signal=3.0), pulse=Pulse.gaussian(1.2e-9))
    image = estimate(capture, "likelihood")
    low, high = core.range_interval(capture, image)
    covered = (low <= capture.truth_range_m) & (capture.truth_range_m <= high)
    # With the spread of the photons alone, 65 % were covered.
    assert is_covered(covered.sum(), covered.size, 0.95)
    assert is_as_wide_as_the_errors(deviations(capture, image))
