"""Tests of delays that are refined below a bin by the likelihood in their neighbourhood."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import get_args

import numpy as np
import pytest
import scipy

from core.acquisition import Acquisition, Pulse
from core.capture import Capture
from core.estimators import estimate
from core.inference import TOLERANCE_BINS, flux_model_of
from core.inference.flux_model import FluxPrior
from core.inference.refinement import (
    FEWEST,
    FINE_STEPS_PER_BIN,
    SHARP_BINS,
    STEPS_PER_BIN,
    refined,
)
from core.kernels.refinement import FITTING_ROUNDS
from core.studies.methods.calibration import Regime
from core.tests.twins import log_likelihood
from core.tracking import PRESETS, tracking_signals
from core.tracking_parameters import Refine
from core.trigger import draw_counts, rate_per_bin

N_BINS, COLS = 40, 10

PULSES = {
    "gamma": Pulse(1e-9),
    "gaussian": Pulse.gaussian(2e-9),  # wider than the tolerance
    "measured": Pulse.measured([0, 1, 4, 6, 3, 0.5], 0.7e-9),
}


def drawn(pulse: Pulse, n_pulses: int | None, rows: int = 3) -> Capture:
    """Draw pixels with echoes anywhere in the gate, brighter in later rows, and backgrounds."""
    acquisition, rng = Acquisition(n_bins=N_BINS, n_pulses=n_pulses), np.random.default_rng(2)
    onset = rng.uniform(0, N_BINS, (rows, COLS))
    signal = np.broadcast_to(np.geomspace(0.2, 2.0, rows)[:, np.newaxis], onset.shape)
    rate = rate_per_bin(onset, signal, 0.0, pulse, acquisition)
    rate += np.linspace(0.2, 1.0, COLS)[:, np.newaxis] / N_BINS
    photons = 1.0 if n_pulses else 300.0
    levels = photons * np.array([0.0, 0.3, 1.5])
    # Given, since plain Python takes seconds to estimate it.
    known = FluxPrior(
        levels, np.array([0.1, 0.5, 0.4]), np.ones(N_BINS), np.asarray(0.6 * photons), 0.8
    )
    return Capture(
        draw_counts(photons * rate, n_pulses, rng),
        acquisition,
        pulse,
        detection="first" if n_pulses else "all",
        flux_prior=known,
    )


def searched(
    capture: Capture,
    row: int,
    col: int,
    delay_bin: float,
    steps: int,
    reach: int,
    signal: float | None = None,
) -> tuple[float, float]:
    """Find one delay and its standard deviation in steps, one likelihood at a time."""
    flux, acquisition = flux_model_of(capture), capture.acquisition
    counts, n_pulses = capture.cube[row, col].astype(float), capture.gated_pulses
    signal = float(flux.typical_signal[row, col]) if signal is None else signal
    background = float(flux.typical_background[row, col])
    within = (np.arange(steps) + 0.5) / steps
    taps, first = capture.pulse.taps(N_BINS, acquisition.bin_width_s, within)
    delays, log = [], []
    for k in range(N_BINS):
        for step in range(steps):
            rate = np.full(N_BINS, background / N_BINS)
            for tap, share in enumerate(taps[step]):
                if 0 <= k + first + tap < N_BINS:
                    rate[k + first + tap] += signal * share
            log.append(log_likelihood(counts, rate, n_pulses))
            delays.append(k + within[step])
    while True:
        distance = np.abs(np.array(delays) - delay_bin)
        near = np.flatnonzero(distance < reach)
        best = int(near[np.take(log, near).argmax()])
        if near[0] < best < near[-1]:
            break
        if delays[best] == delay_bin:
            return delay_bin, math.inf
        delay_bin = delays[best]
    left, middle, right = log[best - 1 : best + 2]
    curvature = min(left - 2 * middle + right, -1e-9)
    found = delays[best] + 0.5 * (left - right) / curvature / steps
    return float(found), 1 / (steps * math.sqrt(-curvature))


def twin(capture: Capture, row: int, col: int, delay_bin: float) -> tuple[float, bool]:
    """Refine one delay as described; also return whether it was sharpened."""
    reach = max(TOLERANCE_BINS, capture.echo_bins)
    found, _ = searched(capture, row, col, delay_bin, STEPS_PER_BIN, reach)
    fine, spread = sharp(capture, row, col, found)
    is_sharp = spread < SHARP_BINS and abs(fine - found) < 0.5
    return (fine if is_sharp else found), is_sharp


def sharp(capture: Capture, row: int, col: int, delay_bin: float) -> tuple[float, float]:
    """Fit signal and delay in turn, if there are enough photons near the delay."""
    background = float(flux_model_of(capture).typical_background[row, col]) / N_BINS
    counts, n_pulses = capture.cube[row, col].astype(float), capture.gated_pulses
    width_s = capture.acquisition.bin_width_s
    fewest = FEWEST * (capture.pulse.sigma_s / width_s / SHARP_BINS) ** 2
    within = (np.arange(FINE_STEPS_PER_BIN) + 0.5) / FINE_STEPS_PER_BIN
    taps, first = capture.pulse.taps(N_BINS, width_s, within)
    spread = math.inf
    for _ in range(FITTING_ROUNDS):
        begin = min(int(delay_bin), N_BINS - 1) + first - 1
        bins = np.arange(max(begin, 0), min(begin + taps.shape[1] + 2, N_BINS))
        armed = (n_pulses or 0) - (np.cumsum(counts) - counts)[bins]
        fired = counts[bins]
        rate = np.log1p(fired / np.maximum(armed - fired, 0.5)) if n_pulses else fired
        is_armed = armed > 0 if n_pulses else np.ones(bins.size, bool)
        signal = max(float((rate - background * is_armed).sum()), 0.0)
        excess = (fired - background * (armed if n_pulses else 1.0)).sum()
        if excess * abs(excess) < fewest * fired.sum():
            return delay_bin, math.inf
        step = round((delay_bin - int(delay_bin)) * FINE_STEPS_PER_BIN - 0.5)
        share = np.zeros(N_BINS + 2 * taps.shape[1])
        at = int(delay_bin) + first + taps.shape[1] + step // FINE_STEPS_PER_BIN
        share[at : at + taps.shape[1]] = taps[step % FINE_STEPS_PER_BIN]
        share = share[taps.shape[1] : -taps.shape[1]]

        def loss(signal: float, share: np.ndarray = share) -> float:
            return -log_likelihood(counts, background + signal * share, n_pulses)

        best = scipy.optimize.minimize_scalar(
            loss, bounds=(signal / 64, 64 * signal), method="bounded", options={"xatol": 1e-9}
        )
        delay_bin, spread = searched(
            capture, row, col, delay_bin, FINE_STEPS_PER_BIN, 1, float(best.x)
        )
    return delay_bin, spread


@pytest.mark.parametrize(
    ("pulse", "n_pulses"), [("gamma", 300), ("gaussian", None), ("measured", 300)]
)
def test_delays_move_to_the_largest_likelihood(pulse: str, n_pulses: int | None) -> None:
    capture = drawn(PULSES[pulse], n_pulses)
    start = np.random.default_rng(5).uniform(0, N_BINS, capture.shape)
    start[0, :3] = 0.0, N_BINS, np.nan
    before = start.copy()
    found = refined(capture, flux_model_of(capture), start)
    np.testing.assert_array_equal(start, before)
    assert math.isnan(found[0, 2])
    sharpened = []
    for row, col in [(0, 0), (0, 1), *((r, c) for r in range(3) for c in range(4, COLS, 2))]:
        expected, is_sharp = twin(capture, row, col, start[row, col])
        assert found[row, col] == pytest.approx(expected, abs=1e-6)
        sharpened.append(is_sharp)
    assert 0 < sum(sharpened) < len(sharpened)  # both kinds are compared
    assert np.nanmin(found) >= 0 and np.nanmax(found) <= N_BINS


REGIMES = [
    *product(["first", "all"], [0.5, 1.0, 2.0, 5.0], [0.3, 3.0]),
    *[("first", sigma_bins, 0.06) for sigma_bins in (0.5, 1.0, 2.0)],
    *[("all", sigma_bins, 0.03) for sigma_bins in (1.0, 5.0)],
]
FAINT = [("first", 5.0, 0.03), ("first", 5.0, 0.06)]
"""Regimes in which the likelihood itself is hardly more precise than the tolerance."""


def rms(error: np.ndarray) -> float:
    return math.sqrt(np.mean(error**2))


@pytest.mark.compiled
@pytest.mark.parametrize("regime", [Regime(*each) for each in REGIMES + FAINT], ids=str)
def test_tracking_is_as_precise_as_the_likelihood(regime: Regime) -> None:
    """Refined delay and likelihood are compared where both are within tolerance.

    The whole bins of tracking are biased by up to half a bin and correlated with the refined delay:
    selecting pixels by them, too, would bias the refined delay.
    """
    is_faint = (regime.detection, regime.sigma_bins, regime.sbr) in FAINT
    captures = [regime.capture(seed) for seed in range(4 if is_faint else 1)]
    error = {
        name: np.concatenate(
            [
                estimate(capture, method, **more).bin.ravel()
                - capture.acquisition.range_m_to_bin(np.ravel(capture.truth_range_m))
                for capture in captures
            ]
        )
        for name, method, more in (
            ("printed", "tracking", {"refine": "none"}),
            ("refined", "tracking", {}),
            ("likelihood", "likelihood", {}),
        )
    }
    is_right = {name: np.abs(each) <= TOLERANCE_BINS for name, each in error.items()}
    both = is_right["refined"] & is_right["likelihood"]
    assert abs(np.mean(error["refined"][both])) <= 0.1
    assert rms(error["refined"][both]) <= 1.02 * rms(error["likelihood"][both])
    right = both & is_right["printed"]
    most = (1.0 if is_faint else 0.9) * rms(error["printed"][right])
    assert rms(error["likelihood"][right]) < most
    assert is_faint or right.sum() > 900


@pytest.mark.compiled
def test_refined_delays_take_all_fractions_of_a_bin() -> None:
    capture = Regime("first", 1.0, 0.3).capture(0)
    whole, refined = (estimate(capture, "tracking", refine=each).bin for each in get_args(Refine))
    assert len(np.unique(np.round((whole - whole[0, 0]) % 1, 6) % 1)) == 1
    tenths = np.bincount((refined[np.isfinite(refined)] % 1 * 10).astype(int), minlength=10)
    assert tenths.min() > 0.5 * tenths.mean()


@pytest.mark.compiled
def test_the_literal_preset_gives_whole_bins_minus_the_lag() -> None:
    capture = drawn(Pulse(), 300, rows=1)
    literal = replace(PRESETS["literal"], t_n=5)
    bins = estimate(capture, "tracking", literal).bin[0]
    position = tracking_signals(capture.cube[0], literal, 300).position_bin
    lag = position - bins
    clipped = (bins == 0) | (bins == N_BINS)
    np.testing.assert_allclose(lag[~clipped], np.median(lag), atol=1e-9)
