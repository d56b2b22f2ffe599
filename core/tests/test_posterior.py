"""Tests of the posterior against its equations."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import import_module
from itertools import product
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from scipy import ndimage, special, stats

from core.acquisition import Acquisition, Pulse
from core.capture import Capture
from core.inference.flux import flux_model_of, shares_and_depths
from core.inference.flux_model import FluxModel
from core.inference.likelihood import (
    Conditions,
    level_densities,
    level_evidence,
    log_likelihood_ratio,
    prepare,
    rate_and_n_armed,
)
from core.inference.posterior import (
    TOLERANCE_BINS,
    Posterior,
    has_posterior,
    least_loss,
    posterior_of,
    surface_probability,
    tolerance_probability,
)
from core.io.readers.dense import guess_detection
from core.kernels.posterior import learn_shares
from core.tests.twins import log_likelihood
from core.trigger import coates_rate, rate_per_bin, trigger_probability

EPS_32 = float(np.finfo(np.float32).eps)
BIN_S = 1e-9

PULSES = {
    "gamma": Pulse(1e-9),
    "long gamma": Pulse(6e-9),  # longer than the gate
    "gaussian": Pulse.gaussian(1.5e-9),  # begins before its delay
    "measured": Pulse.measured([0, 1, 4, 6, 3, 0.5], 0.7e-9),
    "late": Pulse.measured([0] * 60 + [1], 1e-9),  # comes when the gate has closed
}
any_pulse = pytest.mark.parametrize("pulse", PULSES.values(), ids=PULSES)
pulses_known = pytest.mark.parametrize("n_pulses", [200, None], ids=["first photons", "photons"])


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pad blocks less where kernels are not compiled."""
    if numba.config.DISABLE_JIT:
        monkeypatch.setattr(import_module("core.kernels.blocks"), "LANES", 16)
        monkeypatch.setattr("core.inference.likelihood.LANES", 16)
        monkeypatch.setattr("core.kernels.posterior.LANES", 16)


def capture_of(cube: Any, n_pulses: int | None = 1000, pulse: Pulse = Pulse()) -> Capture:
    cube = np.asarray(cube)
    if cube.dtype.kind != "u":
        cube = cube.astype(np.uint16)
    setting = Acquisition(n_bins=cube.shape[2], n_pulses=n_pulses)
    return Capture(cube, setting, pulse, detection=guess_detection(cube, n_pulses))


# --- The twin: one pixel, one level, one delay at a time, in float64. ---


class Twin(NamedTuple):
    delay: np.ndarray
    """In bins, (delay,)."""
    log_levels: np.ndarray
    """Likelihood of each level over that of no echo, (pixel, level, delay)."""
    log_density: np.ndarray
    """The same, levels and delays weighted by their shares, (pixel, delay)."""
    evidence: np.ndarray
    """Likelihood of each level, all delays alike, over that of no echo, (pixel, level)."""
    rounding: np.ndarray
    """Rounding error of log likelihoods in single precision, (pixel,)."""


def twin(capture: Capture, flux: FluxModel, steps_per_bin: int) -> Twin:
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    tail = 1e-3  # of an echo's photons, on either side, is left out
    first = math.floor(max(capture.pulse.quantile_s(tail) / BIN_S, -n_bins))
    last = math.ceil(min(capture.pulse.quantile_s(1 - tail) / BIN_S, n_bins))
    delay = (np.arange(n_bins * steps_per_bin) + 0.5) / steps_per_bin
    pixels = capture.cube.reshape(-1, n_bins).astype(float)
    of_levels = np.empty((len(pixels), len(flux.share), delay.size))
    rounding = np.zeros(len(pixels))
    for i, counts in enumerate(pixels):
        for level in range(len(flux.share)):
            signal = flux.signal.reshape(len(flux.share), -1)[level, i]
            background = flux.background.reshape(len(flux.share), -1)[:, i] / n_bins
            shape = flux.relative_background
            nothing = log_likelihood(counts, background[0] * shape, n_pulses)
            for j, d in enumerate(delay):
                echo = capture.pulse.bin_probability(d, n_bins, BIN_S)
                since = np.arange(n_bins) - math.floor(d)
                echo[(since < first) | (since > last)] = 0.0
                rate = background[level] * shape + signal * echo
                of_levels[i, level, j] = log_likelihood(counts, rate, n_pulses) - nothing
                # A product and a sum for each tap of the echo, and some roundings besides.
                unfired = 1.0 if n_pulses is None else n_pulses - np.cumsum(counts)
                gained = counts @ np.log(rate / (background[level] * shape))
                terms = gained + signal * (unfired * echo).sum()
                roundings = 2 * (last - first + 1) + 8
                error = roundings * EPS_32 * terms
                if flux.background_shape is not None:
                    error += INTERPOLATED * gained
                rounding[i] = max(rounding[i], error)
        rounding[i] += 4 * EPS_32 * np.abs(of_levels[i]).max()  # level and offset, put together
    with np.errstate(divide="ignore"):
        log_share = np.log(flux.share)[1:, np.newaxis]
    log_depth = np.log([flux.depth[math.floor(d)] for d in delay])
    return Twin(
        delay,
        of_levels,
        np.logaddexp.reduce(of_levels[:, 1:] + log_share, axis=1) + log_depth,
        np.logaddexp.reduce(of_levels, axis=2) - math.log(delay.size),
        rounding,
    )


INTERPOLATED = 1e-4  # relative error of a logarithm between nodes of the background
OF_SUMS = 64 * EPS_32  # sums of up to so many float32, none of them negative


def histograms(n_bins: int, n_pulses: int | None, pulse: Pulse) -> np.ndarray:
    """Histograms with echoes in the gate and at its edges, and degenerate ones."""
    delay = np.array([0.0, 0.3, n_bins / 2, n_bins - 1.6, n_bins - 0.1])
    acquisition = Acquisition(n_bins=n_bins)
    rate = rate_per_bin(delay, np.full(delay.shape, 0.4), 0.8, pulse, acquisition)
    sent = n_pulses or 200
    drawn = np.random.default_rng(3).binomial(sent, trigger_probability(rate))
    drawn = drawn * sent // np.maximum(drawn.sum(axis=1, keepdims=True), sent)
    empty, constant = np.zeros(n_bins), np.full(n_bins, sent // n_bins)
    first, last = sent * np.eye(n_bins)[[0, -1]]
    return np.concatenate([drawn, [empty, constant, first, last]])


def flux_for(n_pixels: int, n_bins: int, n_pulses: int | None) -> FluxModel:
    """Fluxes of three levels, with different backgrounds and depths."""
    photons = 200 if n_pulses is None else 1
    signal = np.repeat([[[0.0]], [[0.08]], [[0.5]]], n_pixels, axis=2)
    rng = np.random.default_rng(4)
    background = rng.uniform(0.3, 1.5, signal.shape)
    depth = rng.uniform(0.5, 1.5, n_bins)
    share = np.array([0.3, 0.5, 0.2])
    return FluxModel(signal * photons, background * photons, share, depth / depth.mean())


def in_rows(flux: FluxModel, rows: int) -> FluxModel:
    shape = (len(flux.share), rows, -1)
    return replace(
        flux, signal=flux.signal.reshape(shape), background=flux.background.reshape(shape)
    )


def assert_equals_twin(
    monkeypatch: pytest.MonkeyPatch, capture: Capture, flux: FluxModel, steps_per_bin: int
) -> None:
    n_bins = capture.acquisition.n_bins
    expected = twin(capture, flux, steps_per_bin)
    shape = capture.shape
    far = expected.rounding[:, np.newaxis]

    prepared = prepare(capture, capture.cube, flux, steps_per_bin)
    evidence, densities = level_evidence(prepared), level_densities(prepared)
    assert evidence.shape == (capture.counts.size, len(flux.share))
    assert (np.abs(evidence - expected.evidence) <= far + OF_SUMS).all()
    assert densities.shape == (*evidence.shape, expected.delay.size)
    largest = expected.log_levels.max(axis=(1, 2), keepdims=True)
    atol = np.expm1(2 * far)[..., np.newaxis] + EPS_32
    assert (np.abs(densities - np.exp(expected.log_levels - largest)) <= atol).all()

    # At the delay found there is no less than elsewhere, and the score is what there is.
    delay, score = (x.ravel() for x in least_loss(capture, flux, steps_per_bin))
    at = np.clip((delay * steps_per_bin).astype(int), 0, expected.delay.size - 1)
    highest = expected.log_density.max(axis=1)
    pixels = np.arange(delay.size)
    assert (expected.log_density[pixels, at] >= highest - 2 * (expected.rounding + OF_SUMS)).all()
    assert (np.abs(score - highest) <= expected.rounding + OF_SUMS).all()
    for i, peak in enumerate(expected.log_density):
        k = int(peak.argmax())
        others = np.delete(peak, k).max(initial=-math.inf)
        if peak[k] - others <= 10 * far[i, 0] + 1e-3:
            continue  # rounding may choose another
        if k in (0, peak.size - 1):
            assert delay[i] == expected.delay[k]
        else:
            left, middle, right = peak[k - 1 : k + 2]
            curvature = left - 2 * middle + right
            vertex = expected.delay[k] + 0.5 * (left - right) / curvature / steps_per_bin
            blur = 4 * (far[i, 0] + OF_SUMS)
            assert delay[i] == pytest.approx(vertex, abs=blur / -curvature / steps_per_bin)

    if steps_per_bin > 1:
        return  # the posterior is made in whole bins
    monkeypatch.setattr("core.inference.posterior.flux_model_of", lambda _: flux)
    found_posterior = posterior_of(capture)
    with np.errstate(divide="ignore"):
        nothing = np.log(flux.share[0])
    log_each = expected.log_density - math.log(expected.delay.size)
    total = np.logaddexp(np.logaddexp.reduce(log_each, axis=1), nothing)
    each = np.exp(log_each - total[:, np.newaxis])
    within = np.abs(expected.delay[:, np.newaxis] - np.arange(n_bins)) < TOLERANCE_BINS
    # Odds are off by a factor, of two likelihoods, at most.
    atol = np.expm1(2 * (far + OF_SUMS)) + 4 * EPS_32
    assert found_posterior.tolerance_probability.shape == (*shape, n_bins)
    assert found_posterior.tolerance_probability.dtype == np.float32
    assert (
        np.abs(found_posterior.tolerance_probability.reshape(-1, n_bins) - each @ within) <= atol
    ).all()
    surface = found_posterior.surface.ravel()
    assert (np.abs(surface - each.sum(axis=1)) <= atol[:, 0]).all()


@pulses_known
@pytest.mark.parametrize(
    ("pulse", "n_bins", "steps_per_bin"),
    [
        *((name, 12, 1) for name in PULSES),
        *(("gaussian", *size) for size in [(12, 4), (1, 2), (2, 1), (5, 2)]),
    ],
)
def test_kernels_are_the_equations(
    monkeypatch: pytest.MonkeyPatch,
    pulse: str,
    n_pulses: int | None,
    n_bins: int,
    steps_per_bin: int,
) -> None:
    cube = histograms(n_bins, n_pulses, PULSES[pulse])[np.newaxis]
    capture = capture_of(cube, n_pulses, PULSES[pulse])
    assert capture.gated_pulses == n_pulses
    flux = flux_for(*cube.shape[1:], n_pulses)
    assert_equals_twin(monkeypatch, capture, flux, steps_per_bin)


@pulses_known
def test_kernels_are_the_equations_over_any_background(
    monkeypatch: pytest.MonkeyPatch, n_pulses: int | None
) -> None:
    n_bins = 12
    cube = histograms(n_bins, n_pulses, Pulse())[np.newaxis]
    shape = 0.5 + np.exp(-np.arange(n_bins) / 2)
    flux = replace(
        flux_for(*cube.shape[1:], n_pulses), background_shape=np.asarray(shape / shape.mean())
    )
    assert_equals_twin(monkeypatch, capture_of(cube, n_pulses), flux, 1)


@pulses_known
def test_each_rule_has_the_least_expected_loss(n_pulses: int | None) -> None:
    n_bins, steps = 20, 2
    cube = histograms(n_bins, n_pulses, Pulse())[np.newaxis]
    capture, flux = capture_of(cube, n_pulses), flux_for(*cube.shape[1:], n_pulses)
    expected = twin(capture, flux, steps)
    found = {
        rule: least_loss(capture, flux, steps, rule)[0].ravel()
        for rule in ("window", "mean", "median")
    }
    error = np.abs(expected.delay[:, np.newaxis] - expected.delay)
    inside = np.where(error < TOLERANCE_BINS, 1.0, np.where(error > TOLERANCE_BINS, 0.0, 0.5))
    for i, log_density in enumerate(expected.log_density):
        share = np.exp(log_density - np.logaddexp.reduce(log_density))
        blur = 4 * np.expm1(2 * expected.rounding[i] + OF_SUMS)
        mass = inside @ share
        at = min(int(found["window"][i] * steps), mass.size - 1)
        assert mass[at] >= (1 - 1e-3) * mass.max() - blur
        assert found["mean"][i] == pytest.approx(share @ expected.delay, abs=n_bins * blur + 1e-6)
        # Within its step, the density is constant.
        edges = np.arange(share.size + 1) / steps
        half = np.interp(found["median"][i], edges, np.append(0.0, share.cumsum()))
        assert half == pytest.approx(0.5, abs=blur + 1e-6)


@pytest.mark.parametrize(
    "share", [[0.0, 0.7, 0.3], [1 - 1e-9, 1e-9, 0.0], [0.2, 0.0, 0.8]], ids=str
)
def test_kernels_are_the_equations_for_any_shares(
    monkeypatch: pytest.MonkeyPatch, share: list[float]
) -> None:
    cube = histograms(12, 200, Pulse())[np.newaxis]
    flux = flux_for(*cube.shape[1:], 200)
    flux = replace(flux, share=np.array(share))
    assert_equals_twin(monkeypatch, capture_of(cube, 200), flux, 1)


def test_pixels_of_all_blocks_are_the_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    one = histograms(12, 200, Pulse())
    cube = np.concatenate([np.roll(one, shift, axis=1) for shift in range(8)]).reshape(8, 9, 12)
    flux = in_rows(flux_for(72, 12, 200), 8)  # more than one block of pixels
    assert_equals_twin(monkeypatch, capture_of(cube, 200), flux, 1)


def assert_probabilities(capture: Capture) -> None:
    """Require finite values within their bounds."""
    found = posterior_of(capture)
    # Sums of float32 shares of a sum.
    assert ((found.tolerance_probability >= 0) & (found.tolerance_probability <= 1 + 1e-6)).all()
    assert ((found.surface >= 0) & (found.surface <= 1)).all()
    assert (found.tolerance_probability <= found.surface[..., np.newaxis] + 1e-6).all()
    n_bins = capture.acquisition.n_bins
    for steps_per_bin in (1, 2):
        delay, score = least_loss(capture, flux_model_of(capture), steps_per_bin)
        assert ((delay >= 0) & (delay <= n_bins)).all()
        assert np.isfinite(score).all()
    for bins in (0.0, n_bins / 3, n_bins, math.nan):
        chance = tolerance_probability(capture, np.full(capture.shape, bins))
        assert ((chance >= 0) & (chance <= 1)).all()


FEW_COUNTS = product((0, 1, 3), (1, 9), (None, 1, 1000))
IN_PLAIN_PYTHON = ((3, 1, None), (1, 9, 1000))


@pytest.mark.parametrize(
    ("count", "n_bins", "n_pulses"),
    [
        pytest.param(*each, marks=() if each in IN_PLAIN_PYTHON else pytest.mark.compiled)
        for each in FEW_COUNTS
    ],
)
def test_fluxes_and_posterior_are_always_defined(
    count: int, n_bins: int, n_pulses: int | None
) -> None:
    cube = np.zeros((2, 3, n_bins))
    cube[..., 0] = count
    for some in (cube, cube[:1, :1]):
        capture = capture_of(some, n_pulses)
        flux = flux_model_of(capture)
        assert (np.isfinite(flux.signal) & (flux.signal >= 0)).all()
        assert (np.isfinite(flux.background) & (flux.background > 0)).all()
        assert (flux.signal[0] == 0).all()
        assert ((flux.share >= 0) & (flux.share[0] <= 1)).all()
        assert flux.share.sum() == pytest.approx(1, rel=1e-12)
        assert flux.depth.shape == (n_bins,)
        assert (flux.depth > 0).all()
        assert flux.depth.mean() == pytest.approx(1, rel=1e-12)
        for typical in (flux.typical_signal, flux.typical_background):
            assert typical.shape == capture.shape
            assert (np.isfinite(typical) & (typical > 0)).all()
        assert_probabilities(capture)


@pytest.mark.compiled
@pytest.mark.uncounted
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize("n_pulses", [None, 1000, 2**32 - 1])
def test_full_counters_give_probabilities(dtype: type, n_pulses: int | None) -> None:
    full = np.iinfo(dtype).max
    cube = np.zeros((1, 4, 12), dtype)
    cube[0, 0] = full
    cube[0, 1, 0] = cube[0, 2, -1] = cube[0, 3, 5] = full
    assert_probabilities(capture_of(cube, n_pulses))
    if n_pulses is not None:
        fired = min(full, n_pulses)  # every pulse, or as many as can be counted
        assert_probabilities(capture_of(np.minimum(cube[:, 1:], dtype(fired)), n_pulses))


# --- The likelihood, by an independent route. ---


@any_pulse
@pulses_known
@pytest.mark.parametrize("rise", [None, 0.8])
def test_log_likelihood_ratio_is_that_of_the_distribution(
    pulse: Pulse, n_pulses: int | None, rise: float | None
) -> None:
    n_bins = 15
    acquisition = Acquisition(n_bins=n_bins, n_pulses=n_pulses)
    counts = histograms(n_bins, n_pulses, pulse).astype(int)
    photons = 200 if n_pulses is None else 1
    signal = np.linspace(0.02, 0.6, len(counts)) * photons
    background = np.linspace(2.0, 0.2, len(counts)) * photons
    shape = None if rise is None else 1 + rise * np.linspace(-1, 1, n_bins)
    conditions = Conditions(
        acquisition, pulse, n_pulses, signal, background, 0.1, background_shape=shape
    )
    found = log_likelihood_ratio(counts.astype(float), conditions)
    for i, histogram in enumerate(counts):

        def log_probability(onset_bin: float, histogram: np.ndarray = histogram, i: int = i) -> Any:
            rate = rate_per_bin(onset_bin, signal[i], background[i], pulse, acquisition)
            if shape is not None:
                rate += background[i] / n_bins * (shape - 1)
            if n_pulses is None:
                return stats.poisson.logpmf(histogram, rate).sum()
            chance = trigger_probability(rate)
            none = [1 - chance.sum()]
            left = [n_pulses - histogram.sum()]
            return stats.multinomial.logpmf(
                np.concatenate([histogram, left]), n_pulses, np.concatenate([chance, none])
            )

        expected = [log_probability(d) - log_probability(math.nan) for d in range(n_bins)]
        # Differences of logarithms in the thousands, and of a probability from 1.
        np.testing.assert_allclose(found[i], expected, rtol=1e-8, atol=1e-8)


def test_rate_and_armed_undo_the_pile_up() -> None:
    counts = np.random.default_rng(0).multinomial(300, np.full(21, 1 / 21), size=(4, 5))[..., :-1]
    counts[0, 0, 8:] = 0
    counts[0, 0, 8] = 300 - counts[0, 0].sum()  # the last pulses armed
    rate, armed = rate_and_n_armed(counts.astype(float), 300)
    expected = coates_rate(counts, 300)
    finite = np.isfinite(expected)
    assert 0.9 < finite.mean() < 1
    np.testing.assert_allclose(rate[finite], expected[finite], rtol=1e-12)
    np.testing.assert_array_equal(armed[0, 0, 9:], 0)
    np.testing.assert_array_equal(rate[0, 0, 9:], 0)
    np.testing.assert_array_equal(armed, 300 - np.cumsum(counts, axis=-1) + counts)


@pytest.mark.parametrize("last", [1, 7, 100])
def test_the_last_pulses_count_half_a_pulse_less(last: int) -> None:
    rate, armed = rate_and_n_armed(np.array([100.0 - last, last, 0.0]), 100)
    assert armed[1] == last
    # ln(A / (A - n)) with n = A - 1/2
    np.testing.assert_allclose(rate[1:], [math.log(2 * last), 0.0], rtol=1e-12)


def test_rates_are_counts_where_pulses_are_unknown() -> None:
    counts = np.arange(12.0).reshape(3, 4)
    rate, armed = rate_and_n_armed(counts, None)
    np.testing.assert_array_equal(rate, counts)
    np.testing.assert_array_equal(armed, np.ones((3, 4)))


def test_fluxes_of_some_pixels() -> None:
    flux = in_rows(flux_for(6, 12, 200), 2)
    some = flux.of_pixels(np.array([[4, 0], [4, 5]]))
    assert some.signal.shape == some.background.shape == (3, 2, 2)
    np.testing.assert_array_equal(some.background[:, 0, 0], flux.background[:, 1, 1])
    np.testing.assert_array_equal(some.background[:, 1], flux.background[:, 1, 1:])
    np.testing.assert_array_equal(some.share, flux.share)
    np.testing.assert_array_equal(some.depth, flux.depth)


# --- Confidence. ---


@pytest.mark.parametrize(
    ("rows", "bins", "expected"),
    [
        ([[0.25, 0.5, 0.0], [1.0, 0.0, 0.5]], [0.5, 0.5], [0.375, 0.5]),
        ([[0.25, 0.5, 0.0], [1.0, 0.0, 0.5]], [1.75, 2.0], [0.125, 0.5]),
        ([[0.5, 0.5, 0.5]] * 2, [math.nan, 1.0], [0.0, 0.5]),  # no estimate
        ([[0.25, 0.5, 0.75]] * 3, [0.0, 2.5, 3.0], [0.25, 0.75, 0.75]),  # edges of the gate
        ([[0.25]] * 3, [0.0, 0.5, 1.0], [0.25, 0.25, 0.25]),
        ([[1 + 2e-7, -1e-9]] * 2, [0.0, 1.0], [1.0, 0.0]),  # sums that round
    ],
)
def test_tolerance_probability_interpolates_the_posterior(
    monkeypatch: pytest.MonkeyPatch, rows: Any, bins: list[float], expected: list[float]
) -> None:
    table = np.asarray(rows, np.float32)[np.newaxis]
    known = Posterior(table, np.ones(table.shape[:2]))
    monkeypatch.setattr("core.inference.posterior.posterior_of", lambda _: known)
    monkeypatch.setattr("core.inference.posterior.has_posterior", lambda _: True)
    found = tolerance_probability(capture_of(np.zeros(table.shape)), np.array([bins]))
    np.testing.assert_array_equal(found, [expected])


@pytest.mark.parametrize("n_bins", [1, 12])
def test_confidences_are_those_of_the_posterior_to_the_last_bit(
    monkeypatch: pytest.MonkeyPatch, n_bins: int
) -> None:
    one = histograms(n_bins, 200, Pulse())
    cube = np.concatenate([np.roll(one, shift, axis=1) for shift in range(8)]).reshape(8, 9, -1)
    flux, capture = in_rows(flux_for(72, n_bins, 200), 8), capture_of(cube, 200)
    bins = np.random.default_rng(5).uniform(0, n_bins, capture.shape)
    monkeypatch.setattr("core.inference.posterior.flux_model_of", lambda _: flux)
    alone = tolerance_probability(capture, bins)
    monkeypatch.setattr("core.kernels.parallel.SERIAL_BELOW", 0)  # on all threads
    np.testing.assert_array_equal(tolerance_probability(capture, bins), alone)
    assert has_posterior(capture)  # from the second call on
    rows = slice(3, 6)  # pixels in other lanes, of another block
    part = flux.of_pixels(np.arange(72).reshape(8, 9)[rows])
    monkeypatch.setattr("core.inference.posterior.flux_model_of", lambda _: part)
    found = tolerance_probability(capture_of(cube[rows], 200), bins[rows])
    np.testing.assert_array_equal(found, alone[rows])


def test_the_probability_of_a_surface_needs_no_table() -> None:
    capture = capture_of(histograms(40, 200, Pulse()).reshape(3, 3, 40), 200)
    alone = surface_probability(capture)
    assert not has_posterior(capture)
    np.testing.assert_array_equal(alone, posterior_of(capture).surface)


def test_without_detections_the_posterior_is_uniform(monkeypatch: pytest.MonkeyPatch) -> None:
    share = np.array([0.6, 0.4])
    level = np.array([0.0, 1e-9]).reshape(2, 1, 1)  # an echo too faint to be missed
    flux = FluxModel(level, np.ones((2, 1, 1)), share, np.ones(40))
    monkeypatch.setattr("core.inference.posterior.flux_model_of", lambda _: flux)
    found = posterior_of(capture_of(np.zeros((1, 1, 40))))
    expected = 0.4 * (np.minimum(np.arange(40) + 3, 40) - np.maximum(np.arange(40) - 3, 0)) / 40
    np.testing.assert_allclose(found.tolerance_probability[0, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(found.surface, 0.4, rtol=1e-5)


# --- Shares, step by step, in float64. ---


def any_densities(n_levels: int, n_bins: int) -> np.ndarray:
    """Shape (pixel, level, bin): each pixel likes one delay, and the first level likes none.

    The kernel takes four pixels at a time: two are left over.
    """
    rng = np.random.default_rng(n_bins)
    near = np.abs(np.arange(n_bins) - rng.uniform(0, n_bins, (26, 1, 1)))
    likely = np.exp(-near / np.linspace(1, 4, n_levels)[:, np.newaxis]) + 1e-3
    likely[:, 0] = rng.uniform(0.01, 1.0, (26, 1))
    return likely.astype(np.float32)


@pytest.mark.parametrize("n_levels", [2, 5])
@pytest.mark.parametrize("n_bins", [1, 7, 40])
def test_shares_and_depths_are_the_equations(n_levels: int, n_bins: int) -> None:
    density, initial = any_densities(n_levels, n_bins), np.full(n_levels, 1 / n_levels)
    ratios, uniform, learned = initial[1:] / initial[1:].sum(), 0.1, np.full(n_bins, 1 / n_bins)
    share, depth = initial, learned
    cell = 1 / (ndimage.gaussian_filter1d(np.eye(17)[8], 1.0) ** 2).sum()
    for _ in range(60):
        joint = density * share[:, np.newaxis] * depth
        joint[:, 0] = density[:, 0] * share[0] / n_bins
        joint /= joint.sum(axis=(1, 2), keepdims=True)
        none = (0.1 + joint[:, 0].sum()) / (len(density) + 0.1)
        none = np.clip(none, 1e-12, 1 - 1e-12)
        share = np.append(none, (1 - none) * ratios)
        echoes = joint[:, 1:].sum(axis=(0, 1))
        anywhere = (echoes * uniform / n_bins / depth).sum()
        some = echoes * (1 - uniform) * learned / depth
        smooth = ndimage.gaussian_filter1d(some, 1.0, mode="nearest")
        pixels = cell * smooth
        # exp(ψ(n)) to 11 %: the error is 1 - exp(γ) / 2 at most, for small n.
        kept = np.maximum(pixels, 0.01)
        learned = np.where(pixels > 0.01, (pixels + 0.5) * np.exp(-1 / kept), 0.0)
        np.testing.assert_allclose(learned, np.exp(special.digamma(kept)), 0.11, 1e-9)
        found_some = learned.sum() > 0
        # Not to 1: what is fitted to chance makes echoes less likely.
        learned /= pixels.sum() if found_some else 1.0
        uniform = (anywhere + 1) / (echoes.sum() + 1) if found_some else 1.0
        depth = (1 - uniform) * learned + uniform / n_bins
    found = shares_and_depths(density, initial)
    np.testing.assert_allclose(found[0], share, rtol=1e-4)
    np.testing.assert_allclose(found[1], depth / depth.mean(), rtol=1e-4)
    assert (initial == 1 / n_levels).all()


def test_no_echo_at_all_leaves_depths_alike() -> None:
    density = any_densities(3, 9)
    density[:, 1:] = 0.0
    share, depth = shares_and_depths(density, np.full(3, 1 / 3))
    np.testing.assert_allclose(share, [1, 5e-13, 5e-13], rtol=1e-4)
    np.testing.assert_array_equal(depth, np.ones(9))


def test_shares_are_the_equations() -> None:
    evidence = np.log(any_densities(5, 40)[:, :, 20])
    share = np.full(5, 0.2)
    for _ in range(100):
        joint = np.exp(evidence) * share
        joint /= joint.sum(axis=1, keepdims=True)
        share = (0.1 * np.eye(5)[0] + joint.sum(axis=0)) / (len(evidence) + 0.1)
    learned = np.full(5, 0.2)
    learn_shares(np.exp(evidence), learned)
    np.testing.assert_allclose(learned, share, rtol=1e-9)
