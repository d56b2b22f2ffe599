"""Kernels of the posterior: tables of log likelihoods, and maximum-likelihood mixing shares."""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from core.kernels.blocks import lane_rows
from core.kernels.parallel import COMPILED, PARALLEL, SUMMING

_STEPS = 100  # of expectation and maximisation
_DEPTH_STEPS = 30
_DARK_PIXELS = 0.1  # additional pixels without an echo, so that their share is never 0
_UNIFORM_SHARE = 0.1  # initial share of the surfaces with a delay that is uniform over the gate

_SMOOTHING_BINS = 2.0
_SMOOTHING = np.exp(-0.5 * (np.arange(-8, 9) / _SMOOTHING_BINS) ** 2)  # to four sigmas
_SMOOTHING /= _SMOOTHING.sum()


# All EM steps run in one kernel: between numpy calls other threads would take the GIL.


@njit(**SUMMING)
def learn_shares(likelihood, share):  # type: ignore[no-untyped-def]
    """Estimate the shares of levels by expectation and maximisation (Laird 1978), in place."""
    n_pixels, n_levels = likelihood.shape
    for _ in range(_STEPS):
        found = np.zeros(n_levels)
        found[0] = _DARK_PIXELS
        for pixel in range(n_pixels):
            mixture = 0.0
            for level in range(n_levels):
                mixture += share[level] * likelihood[pixel, level]
            for level in range(n_levels):
                found[level] += share[level] * likelihood[pixel, level] / mixture
        for level in range(n_levels):
            share[level] = found[level] / (n_pixels + _DARK_PIXELS)


@njit(**SUMMING)
def learn_shares_and_depths(density, share, depth):  # type: ignore[no-untyped-def]
    """Estimate the shares of levels and the probabilities of delays likewise, in place.

    Some delays are uniform over the gate, the others distributed smoothly. The share of the uniform
    ones is estimated, too; one additional surface counts as uniform, so that it is never 0.
    """
    n_pixels, n_levels, n_bins = density.shape
    mass, some = np.empty(n_levels), depth.copy()
    uniform = _UNIFORM_SHARE
    for _ in range(_DEPTH_STEPS):
        likely = depth.astype(np.float32)
        found, reweighted = np.zeros(n_levels), np.zeros(n_bins, np.float32)
        found[0] = _DARK_PIXELS
        for pixel in range(n_pixels):
            mass[0] = share[0] * density[pixel, 0, 0]
            for level in range(1, n_levels):
                total_density = np.float32(0.0)
                for k in range(n_bins):
                    total_density += density[pixel, level, k] * likely[k]
                mass[level] = share[level] * total_density
            total = mass.sum()
            for level in range(n_levels):
                found[level] += mass[level] / total
            for level in range(1, n_levels):
                weight = np.float32(share[level] / total)
                for k in range(n_bins):
                    reweighted[k] += weight * density[pixel, level, k]
        for level in range(n_levels):
            share[level] = max(found[level] / (n_pixels + _DARK_PIXELS), 1e-12)  # never 0
        surfaces, anywhere = 0.0, 0.0
        for k in range(n_bins):
            surfaces += depth[k] * reweighted[k]
            anywhere += uniform / n_bins * reweighted[k]
        smooth = smoothed(some * reweighted)
        whole = smooth.sum()
        if whole == 0:  # certainly no pixel has an echo
            break
        uniform = (anywhere + 1) / (surfaces + 1)
        for k in range(n_bins):
            some[k] = smooth[k] / whole
            depth[k] = (1 - uniform) * some[k] + uniform / n_bins


@njit(**COMPILED)
def smoothed(density):  # type: ignore[no-untyped-def]
    """Convolve with the Gaussian `_SMOOTHING`; the density is constant beyond its ends."""
    half, last = _SMOOTHING.size // 2, density.size - 1
    smooth = np.zeros(density.size)
    for k in range(density.size):
        for j in range(_SMOOTHING.size):
            smooth[k] += _SMOOTHING[j] * density[min(max(k + j - half, 0), last)]
    return smooth


@njit(**COMPILED)
def _fill_counts(b, prepared, fired, unfired, unfired_echo):  # type: ignore[no-untyped-def]
    """Fill counts, unfired pulses ``A_k - n_k`` and ``Σ_k (A_k - n_k) p_k(d)`` of a block."""
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
        unfired_echo[d, :] = 0.0
        for tap in range(max(0, -first), min(n_taps, n_bins - first)):
            p = prepared.echo[step, tap]
            for i in range(lanes):
                unfired_echo[d, i] += p * unfired[first + tap, i]


@njit(**COMPILED)
def _fill_level(b, level, prepared, fired, unfired_echo, gain, ratio):  # type: ignore[no-untyped-def]
    """Fill `ratio` (delay, lane) with ``T(d)`` of one level (`core.inference.likelihood`)."""
    n_bins, lanes = fired.shape
    n_steps, n_taps = prepared.echo.shape
    previous_signal, previous_background = 0.0, 0.0
    for i in range(lanes):
        signal = prepared.signal[level, b, i]
        background = prepared.background[level, b, i] / n_bins
        if i > 0 and signal == previous_signal and background == previous_background:
            for step in range(n_steps):  # logarithms are slow, and neighbours often equal
                for tap in range(n_taps):
                    gain[step, tap, i] = gain[step, tap, i - 1]
            continue
        previous_signal, previous_background = signal, background
        bare = -math.expm1(-background)
        for step in range(n_steps):
            for tap in range(n_taps):
                s = signal * prepared.echo[step, tap]
                if prepared.n_pulses > 0:
                    # (1 - exp(-b - s)) / (1 - exp(-b)), without cancellation.
                    odds = 1.0 - math.expm1(-s) * (1.0 - bare) / bare
                    gain[step, tap, i] = math.log(odds)
                else:
                    gain[step, tap, i] = math.log1p(s / background)
    for d in range(n_bins * n_steps):
        step, first = d % n_steps, d // n_steps + prepared.first_tap
        for i in range(lanes):
            ratio[d, i] = -np.float32(prepared.signal[level, b, i]) * unfired_echo[d, i]
        for tap in range(max(0, -first), min(n_taps, n_bins - first)):
            for i in range(lanes):
                ratio[d, i] += gain[step, tap, i] * fired[first + tap, i]


@njit(**COMPILED)
def _flat_likelihood(b, level, prepared, fired, unfired, flat):  # type: ignore[no-untyped-def]
    """Fill `flat` with the log likelihood ratio of the level's background to the first level's.

    `fired` and `unfired` are sums over the bins.
    """
    n_bins, lanes = prepared.counts.shape[1:]
    for i in range(lanes):
        here = prepared.background[level, b, i] / n_bins
        bare = prepared.background[0, b, i] / n_bins
        odds = math.expm1(-here) / math.expm1(-bare) if prepared.n_pulses > 0 else here / bare
        flat[i] = fired[i] * math.log(odds) - unfired[i] * (here - bare)


@njit(**COMPILED)
def _fill_block(b, prepared, log):  # type: ignore[no-untyped-def]
    """Fill log likelihood ratios of each level and delay to no echo, (level, delay, lane)."""
    n_levels, n_delays, lanes = log.shape
    n_bins = prepared.counts.shape[1]
    n_steps, n_taps = prepared.echo.shape
    # Aligned to cache lines: vectors that straddle them cost twice.
    fired = lane_rows(n_bins, lanes).reshape(n_bins, lanes)
    unfired = lane_rows(n_bins, lanes).reshape(n_bins, lanes)
    unfired_echo = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    ratio = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    gain = lane_rows(n_steps * n_taps, lanes).reshape(n_steps, n_taps, lanes)
    all_fired, all_unfired, flat = np.zeros((3, lanes))
    _fill_counts(b, prepared, fired, unfired, unfired_echo)
    for k in range(n_bins):
        for i in range(lanes):
            all_fired[i] += fired[k, i]
            all_unfired[i] += unfired[k, i]
    log[0] = 0.0
    for level in range(1, n_levels):
        _fill_level(b, level, prepared, fired, unfired_echo, gain, ratio)
        _flat_likelihood(b, level, prepared, all_fired, all_unfired, flat)
        for d in range(n_delays):
            for i in range(lanes):
                log[level, d, i] = ratio[d, i] + np.float32(flat[i])


@njit(**PARALLEL)
def fill_blocks(first, prepared, log):  # type: ignore[no-untyped-def]
    """Fill log likelihood ratios of the blocks from `first`, (block, level, delay, lane)."""
    for b in prange(log.shape[0]):
        _fill_block(first + b, prepared, log[b])
