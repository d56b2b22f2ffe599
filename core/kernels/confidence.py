"""Kernels that average likelihoods over delays or signal levels.

The likelihood of a block of pixels stays in the cache. Signal levels are added one by one, in units
of the largest term so far (Milakov & Gimelshein 2018).

Kernels of an image process the blocks from `first` to `end`, see
`core.kernels.parallel.on_threads`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.blocks import PIXELS_AT_ONCE, lane_rows
from core.kernels.elementary import exp32
from core.kernels.parallel import COMPILED
from core.kernels.posterior import counts_of, fill_flat, fill_level

_FEW_WINDOWS = 2  # of a pixel; more are computed for all delays of all pixels at once


@njit(**COMPILED)
def fill_highest(ratio, highest):  # type: ignore[no-untyped-def]
    """Fill `highest` (lane,) with the maximum over the rows of `ratio` (row, lane).

    Two rows at a time, by way of a second one: without AVX-512, storing where a number is larger
    takes several times as long as storing everywhere.
    """
    last, higher = len(ratio) - 1, np.empty_like(highest)
    for i in range(highest.size):
        highest[i] = ratio[last, i]
    for d in range(0, last, 2):
        for i in range(highest.size):
            here, most = ratio[d, i], highest[i]
            higher[i] = here if here > most else most
        for i in range(highest.size):
            here, most = ratio[d + 1, i], higher[i]
            highest[i] = here if here > most else most


@njit(**COMPILED)
def fill_evidence(first, end, prepared, depth, evidence):  # type: ignore[no-untyped-def]
    """Fill the log likelihood ratio of each level to no echo, (block, lane, level).

    `depth` is the prior of the delay relative to uniform, (step, bin).
    """
    for b in range(first, end):
        _fill_evidence(b, prepared, depth, evidence[b])


@njit(**COMPILED, inline="always")
def _fill_evidence(b, prepared, depth, evidence):  # type: ignore[no-untyped-def]
    """Fill `fill_evidence` of a block, (lane, level)."""
    n_steps, n_bins = depth.shape
    lanes, n_levels = evidence.shape
    fired, all_fired, armed, all_unfired = counts_of(b, prepared)
    ratio = lane_rows(depth.size, lanes).reshape(n_steps, n_bins, lanes)
    (highest, row), offset = np.empty((2, lanes), np.float32), np.empty(lanes)
    evidence[:, 0] = 0.0
    for level in range(1, n_levels):
        fill_level(b, level, prepared, fired, armed, ratio)
        fill_flat(b, level, prepared, all_fired, all_unfired, offset)
        fill_highest(ratio.reshape(-1, lanes), highest)
        total = np.zeros(lanes)
        for step in range(n_steps):
            for k in range(n_bins):
                for i in range(lanes):
                    row[i] = depth[step, k] * exp32(ratio[step, k, i] - highest[i])
                for i in range(lanes):
                    total[i] += row[i]
        for i in range(lanes):
            mean = total[i] / depth.size
            evidence[i, level] = offset[i] + highest[i] + math.log(mean)


@njit(**COMPILED)
def fill_densities(first, end, prepared, density):  # type: ignore[no-untyped-def]
    """Fill the likelihood of each level and delay relative to the pixel's largest.

    `density` is of shape (block, lane, level, delay).
    """
    for b in range(first, end):
        _fill_densities(b, prepared, density[b])


@njit(**COMPILED, inline="always")
def _fill_densities(b, prepared, density):  # type: ignore[no-untyped-def]
    """Fill `fill_densities` of a block, (lane, level, delay)."""
    lanes, n_levels, n_delays = density.shape
    n_steps = len(prepared.echo)
    fired, all_fired, armed, all_unfired = counts_of(b, prepared)
    ratio = lane_rows(n_delays, lanes).reshape(n_steps, -1, lanes)
    highest, offset, top = np.empty(lanes, np.float32), np.empty(lanes), np.zeros(lanes)
    for level in range(1, n_levels):
        fill_level(b, level, prepared, fired, armed, ratio)
        fill_flat(b, level, prepared, all_fired, all_unfired, offset)
        fill_highest(ratio.reshape(-1, lanes), highest)
        for i in range(lanes):
            top[i] = max(top[i], highest[i] + offset[i])
        # A few pixels at a time: their rows are far apart, and the cache holds few such lines.
        for first in range(0, lanes, PIXELS_AT_ONCE):
            for d in range(n_delays):
                for i in range(first, min(first + PIXELS_AT_ONCE, lanes)):
                    log = ratio[d % n_steps, d // n_steps, i] + offset[i]
                    density[i, level, d] = log
    for i in range(lanes):
        density[i, 0] = math.exp(-top[i])
        for level in range(1, n_levels):
            row, most = density[i, level], np.float32(top[i])
            for d in range(n_delays):
                row[d] = exp32(row[d] - most)


@njit(**COMPILED)
def add_level(ratio, offset, density, top):  # type: ignore[no-untyped-def]
    """Add ``exp(ratio + offset)`` (step, bin, lane) to `density`, in units of ``exp(top)``.

    `density` is of shape (delay, lane), `offset` and `top` of shape (lane,); `top` becomes that of
    all terms so far.
    """
    n_delays, lanes = density.shape
    highest, kept, unit = np.empty((3, lanes), np.float32)
    fill_highest(ratio.reshape(-1, lanes), highest)
    for i in range(lanes):
        previous = top[i]
        top[i] = max(previous, highest[i] + offset[i])
        kept[i], unit[i] = math.exp(previous - top[i]), top[i] - offset[i]
    for d in range(n_delays):
        row, summed = ratio[d % len(ratio), d // len(ratio)], density[d]
        for i in range(lanes):
            summed[i] = kept[i] * summed[i] + exp32(row[i] - unit[i])


@njit(**COMPILED)
def _fill_density(b, prepared, ratio, offset, density, top):  # type: ignore[no-untyped-def]
    """Fill `density` (delay, lane) with the likelihood ratio of each delay to no echo.

    In units of ``exp(top)``, averaged over the levels and multiplied by the prior of the delay. The
    logarithm of the contribution of a level is left in `ratio` (level, step, bin, lane) and
    `offset` (level, lane), or that of the last level if there is room for one.
    """
    n_delays, lanes = density.shape
    fired, all_fired, armed, all_unfired = counts_of(b, prepared)
    density[:], top[:] = 0.0, -np.inf
    for level in range(1, len(prepared.signal)):
        at = (level - 1) % len(ratio)
        fill_level(b, level, prepared, fired, armed, ratio[at])
        fill_flat(b, level, prepared, all_fired, all_unfired, offset[at])
        for i in range(lanes):
            offset[at, i] += prepared.log_share[level]
        add_level(ratio[at], offset[at], density, top)
    for d in range(n_delays):
        for i in range(lanes):
            density[d, i] *= prepared.depth[d]


@njit(**COMPILED)
def fill_peaks(first, end, prepared, best, around):  # type: ignore[no-untyped-def]
    """Fill the likeliest delay of each pixel, (block, lane).

    And the logarithms of the densities before, at and after it, (block, lane, 3): densities next to
    a strong echo underflow to 0.
    """
    for b in range(first, end):
        _fill_peaks(b, prepared, best[b], around[b])


@njit(**COMPILED, inline="always")
def _fill_peaks(b, prepared, best, around):  # type: ignore[no-untyped-def]
    """Fill `fill_peaks` of a block, (lane,) and (lane, 3)."""
    lanes = best.size
    n_steps, n_delays, n_levels = len(prepared.echo), prepared.depth.size, len(prepared.signal) - 1
    ratio = lane_rows(n_levels * n_delays, lanes).reshape(n_levels, n_steps, -1, lanes)
    density = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    top, offset = np.empty(lanes), np.empty((n_levels, lanes))
    _fill_density(b, prepared, ratio, offset, density, top)
    at = np.empty(lanes, np.int32)
    fill_argmax(density, at)
    for i in range(lanes):
        best[i] = at[i]
        for j in range(3):
            d = min(max(at[i] + j - 1, 0), n_delays - 1)
            log = ratio[:, d % n_steps, d // n_steps]
            around[i, j] = log_sum(prepared.depth[d], log, offset, i)


@njit(**COMPILED)
def fill_argmax(density, at):  # type: ignore[no-untyped-def]
    """Fill `at` (lane,) with the first row of the maximum of `density` (row, lane)."""
    highest = np.full(at.size, -1.0, np.float32)
    at[:] = 0
    for d in range(len(density)):
        for i in range(at.size):
            here, most, before = density[d, i], highest[i], at[i]
            at[i] = d if here > most else before
            highest[i] = here if here > most else most


@njit(**COMPILED)
def log_sum(factor, log, offset, i):  # type: ignore[no-untyped-def]
    """Return ``ln (factor Σ_level exp(log + offset))`` of a lane, from (level, lane) each."""
    most, total = -np.inf, 0.0
    for level in range(len(log)):
        most = max(most, log[level, i] + offset[level, i])
    for level in range(len(log)):
        total += math.exp(log[level, i] + offset[level, i] - most)
    return most + math.log(factor * total)


@njit(**COMPILED)
def _fill_windows(half, density, window):  # type: ignore[no-untyped-def]
    """Fill `window` with sums of `half` numbers on either side of the beginning of each delay."""
    n_delays, lanes = density.shape
    window[:] = 0.0
    for d in range(n_delays):
        for near in range(max(d - half, 0), min(d + half, n_delays)):
            for i in range(lanes):
                window[d, i] += density[near, i]


@njit(**COMPILED)
def _sum_near(half, density, d, i):  # type: ignore[no-untyped-def]
    """Return one number of `_fill_windows`."""
    total = np.float32(0.0)
    for near in range(max(d - half, 0), min(d + half, len(density))):
        total += density[near, i]
    return total


@njit(**COMPILED)
def fill_masses(first, end, prepared, half, begin, mass, surface):  # type: ignore[no-untyped-def]
    """Fill the posterior mass of windows of delays, and of all delays, of each pixel.

    `mass` (block, lane, window) is that of the `half` delays on either side of the beginning of the
    delays from ``begin[block, lane]``, and `surface` (block, lane) that of a surface anywhere.
    """
    for b in range(first, end):
        _fill_masses(b, prepared, half, begin[b], mass[b], surface[b])


@njit(**COMPILED, inline="always")
def _fill_masses(b, prepared, half, begin, mass, surface):  # type: ignore[no-untyped-def]
    """Fill `fill_masses` of a block, (lane, window) and (lane,)."""
    n_delays, (lanes, n_windows) = prepared.depth.size, mass.shape
    none = prepared.log_share[0]
    density = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    ratio = lane_rows(n_delays, lanes).reshape(1, 1, n_delays, lanes)
    top, total, offset = np.empty(lanes), np.zeros(lanes), np.empty((1, lanes))
    _fill_density(b, prepared, ratio, offset, density, top)
    window = ratio[0, 0]  # whose numbers are no longer needed
    if n_windows > _FEW_WINDOWS:
        _fill_windows(half, density, window)
    for d in range(n_delays):
        for i in range(lanes):
            total[i] += density[d, i]
    for i in range(lanes):
        # Relative to the larger of the two, so that neither overflows.
        unit = max(top[i], none)
        seen = math.exp(top[i] - unit) * total[i] / n_delays
        surface[i] = seen / (seen + math.exp(none - unit))
        share = np.float32(surface[i] / total[i])
        for j in range(n_windows):
            d = begin[i] + j
            if n_windows <= _FEW_WINDOWS:
                window[d, i] = _sum_near(half, density, d, i)
            mass[i, j] = share * window[d, i]


@njit(**COMPILED)
def fill_states(first, end, prepared, none, least, surface, nothing):  # type: ignore[no-untyped-def]
    """Fill the probability of a surface at each delay, and of nothing, of pixels by themselves.

    `none` is the prior of nothing, and no probability of a delay is below `least`. `surface` is of
    shape (block, lane, delay) and `nothing` (block, lane).
    """
    for b in range(first, end):
        _fill_states(b, prepared, none, least, surface[b], nothing[b])


@njit(**COMPILED, inline="always")
def _fill_states(b, prepared, none, least, surface, nothing):  # type: ignore[no-untyped-def]
    """Fill `fill_states` of a block, (lane, delay) and (lane,)."""
    lanes, n_delays = surface.shape
    n_steps, n_bins = len(prepared.echo), prepared.counts.shape[1]
    density = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
    ratio = lane_rows(n_delays, lanes).reshape(1, n_steps, n_bins, lanes)
    top, total = np.empty(lanes), np.zeros(lanes)
    _fill_density(b, prepared, ratio, np.empty((1, lanes)), density, top)
    for d in range(n_delays):
        for i in range(lanes):
            total[i] += density[d, i]
    for i in range(lanes):
        unit = max(top[i], 0.0)  # so that neither overflows
        seen, unseen = math.exp(top[i] - unit) / n_delays, none * math.exp(-unit)
        every = seen * total[i] + unseen
        nothing[i] = unseen / every
        share = np.float32(seen / every)
        for d in range(n_delays):
            surface[i, d] = max(share * density[d, i], least)
