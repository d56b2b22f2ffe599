"""Kernels of the posterior: tables of log likelihoods, and maximum likelihood mixing shares."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from core.kernels.blocks import lane_rows
from core.kernels.parallel import COMPILED, PARALLEL, SUMMING

_STEPS = 100  # of expectation and maximisation
_DEPTH_STEPS = 30
_ALIKE = 0.1  # share of the surfaces of which nothing is learned


_SMOOTHING_BINS = 2.0
_SMOOTHING = np.exp(-0.5 * (np.arange(-8, 9) / _SMOOTHING_BINS) ** 2)  # to four sigmas
_SMOOTHING /= _SMOOTHING.sum()


# All EM steps run in one kernel: between numpy calls other threads would take the interpreter lock.


@njit(**SUMMING)
def learn_shares(likelihood, share):  # type: ignore[no-untyped-def]
    """Expectation and maximisation (Laird 1978) of the shares of levels, in place."""
    n_pixels, n_levels = likelihood.shape
    for _ in range(_STEPS):
        found = np.zeros(n_levels)
        found[0] = 1.0
        for pixel in range(n_pixels):
            mixture = 0.0
            for level in range(n_levels):
                mixture += share[level] * likelihood[pixel, level]
            for level in range(n_levels):
                found[level] += share[level] * likelihood[pixel, level] / mixture
        for level in range(n_levels):
            share[level] = found[level] / (n_pixels + 1)


@njit(**SUMMING)
def learn_shares_and_depths(density, share, depth):  # type: ignore[no-untyped-def]
    """The same of the shares of levels and of the delays' probabilities, in place."""
    n_pixels, n_levels, n_bins = density.shape
    mass = np.empty(n_levels)
    for _ in range(_DEPTH_STEPS):
        likely = depth.astype(np.float32)
        found, reweighted = np.zeros(n_levels), np.zeros(n_bins, np.float32)
        found[0] = 1.0
        for pixel in range(n_pixels):
            mass[0] = share[0] * density[pixel, 0, 0]
            for level in range(1, n_levels):
                near = np.float32(0.0)
                for k in range(n_bins):
                    near += density[pixel, level, k] * likely[k]
                mass[level] = share[level] * near
            total = mass.sum()
            for level in range(n_levels):
                found[level] += mass[level] / total
            for level in range(1, n_levels):
                weight = np.float32(share[level] / total)
                for k in range(n_bins):
                    reweighted[k] += weight * density[pixel, level, k]
        for level in range(n_levels):
            share[level] = max(found[level] / (n_pixels + 1), 1e-12)  # never quite impossible
        smooth = smoothed(depth * reweighted)
        whole = smooth.sum()
        if whole == 0:  # all pixels are beyond doubt without an echo
            break
        for k in range(n_bins):
            depth[k] = (1 - _ALIKE) * smooth[k] / whole + _ALIKE / n_bins


@njit(**COMPILED)
def smoothed(density):  # type: ignore[no-untyped-def]
    """Convolved with a Gaussian of `_SMOOTHING`; beyond its ends a density stays as it is."""
    reach, last = _SMOOTHING.size // 2, density.size - 1
    smooth = np.zeros(density.size)
    for k in range(density.size):
        for j in range(_SMOOTHING.size):
            smooth[k] += _SMOOTHING[j] * density[min(max(k + j - reach, 0), last)]
    return smooth


@njit(**COMPILED)
def _fill_reach(b, prepared, fired, unfired, reach):  # type: ignore[no-untyped-def]
    """Counts and unfired pulses of a block as float32, and Σ_k (A_k - n_k) p_k(d) of each delay."""
    n_bins, lanes = fired.shape
    n_steps, n_taps = prepared.echo.shape
    armed = np.full(lanes, float(prepared.n_pulses))
    for k in range(n_bins):
        for i in range(lanes):
            count = prepared.counts[b, k, i]
            armed[i] -= count
            fired[k, i] = count
            unfired[k, i] = armed[i] if prepared.n_pulses > 0 else 1.0
    for d in range(n_bins * n_steps):
        step, first = d % n_steps, d // n_steps + prepared.first_tap
        reach[d, :] = 0.0
        for tap in range(max(0, -first), min(n_taps, n_bins - first)):
            p = prepared.echo[step, tap]
            for i in range(lanes):
                reach[d, i] += p * unfired[first + tap, i]


@njit(**COMPILED)
def _fill_level(b, level, prepared, fired, reach, gain, ratio):  # type: ignore[no-untyped-def]
    """T(d) of one level into `ratio`, (delay, lane)."""
    n_bins, lanes = fired.shape
    n_steps, n_taps = prepared.echo.shape
    previous_signal, previous_background = 0.0, 0.0
    for i in range(lanes):
        signal = prepared.signal[level, b, i]
        background = prepared.background[level, b, i] / n_bins
        if i > 0 and signal == previous_signal and background == previous_background:
            for step in range(n_steps):  # logarithms are what costs, and neighbours are alike
                for tap in range(n_taps):
                    gain[step, tap, i] = gain[step, tap, i - 1]
            continue
        previous_signal, previous_background = signal, background
        bare = -math.expm1(-background)
        for step in range(n_steps):
            for tap in range(n_taps):
                s = signal * prepared.echo[step, tap]
                if prepared.n_pulses > 0:
                    # 1 - exp(-b - s) is what no echo gives, and what it leaves times 1 - exp(-s).
                    odds = 1.0 - math.expm1(-s) * (1.0 - bare) / bare
                    gain[step, tap, i] = math.log(odds)
                else:
                    gain[step, tap, i] = math.log1p(s / background)
    for d in range(n_bins * n_steps):
        step, first = d % n_steps, d // n_steps + prepared.first_tap
        for i in range(lanes):
            ratio[d, i] = -np.float32(prepared.signal[level, b, i]) * reach[d, i]
        for tap in range(max(0, -first), min(n_taps, n_bins - first)):
            for i in range(lanes):
                ratio[d, i] += gain[step, tap, i] * fired[first + tap, i]


@njit(**COMPILED)
def _flat_likelihood(b, level, prepared, fired, unfired, flat):  # type: ignore[no-untyped-def]
    """Log likelihood of the level's background alone, over that of the first level's.

    `fired` and `unfired` are summed over the bins here.
    """
    n_bins, lanes = prepared.counts.shape[1:]
    for i in range(lanes):
        here = prepared.background[level, b, i] / n_bins
        bare = prepared.background[0, b, i] / n_bins
        odds = math.expm1(-here) / math.expm1(-bare) if prepared.n_pulses > 0 else here / bare
        flat[i] = fired[i] * math.log(odds) - unfired[i] * (here - bare)


@njit(**COMPILED)
def _fill_block(b, prepared, log):  # type: ignore[no-untyped-def]
    """Log likelihood of each level and delay over that of no echo; (level, delay, lane)."""
    n_levels, n_delays, lanes = log.shape
    n_bins = prepared.counts.shape[1]
    n_steps, n_taps = prepared.echo.shape
    # On cache lines' boundaries: vectors that straddle them cost twice.
    fired = lane_rows(n_bins, lanes).reshape(n_bins, lanes)
    unfired = lane_rows(n_bins, lanes).reshape(n_bins, lanes)
    reach = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    ratio = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    gain = lane_rows(n_steps * n_taps, lanes).reshape(n_steps, n_taps, lanes)
    all_fired, all_unfired, flat = np.zeros((3, lanes))
    _fill_reach(b, prepared, fired, unfired, reach)
    for k in range(n_bins):
        for i in range(lanes):
            all_fired[i] += fired[k, i]
            all_unfired[i] += unfired[k, i]
    log[0] = 0.0
    for level in range(1, n_levels):
        _fill_level(b, level, prepared, fired, reach, gain, ratio)
        _flat_likelihood(b, level, prepared, all_fired, all_unfired, flat)
        for d in range(n_delays):
            for i in range(lanes):
                log[level, d, i] = ratio[d, i] + np.float32(flat[i])


@njit(**PARALLEL)
def fill_blocks(first, prepared, log):  # type: ignore[no-untyped-def]
    """Log likelihood tables of some blocks from `first` on; (block, level, delay, lane)."""
    for b in prange(log.shape[0]):
        _fill_block(first + b, prepared, log[b])
