"""Kernels of the likelihood of surfaces that move while the pulses are sent.

Groups of pulses are added up with displacements that grow with time, so that the echoes of a
surface with one velocity meet in the bins of the middle of the recording. What a displacement moves
out of the gate counts for nothing: of echoes near its ends that is a part of the tail.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.blocks import lane_rows
from core.kernels.confidence import add_level, fill_argmax, fill_highest, log_sum
from core.kernels.elementary import exp32
from core.kernels.parallel import COMPILED
from core.kernels.posterior import correlate, counts_of, fill_flat, fill_log_gain

AT_ONCE = 4
"""Groups added per read and write of the sums, which cost more than the additions."""


@njit(**COMPILED)
def _values_of(b, prepared, counts, n_pulses, margin):  # type: ignore[no-untyped-def]
    """Return counts of each node, and unfired pulses, of a block: (node or 1, group, bin, lane).

    With zeros in `margin` bins before and after the gate, and for groups that complete the last
    `AT_ONCE`. Also returns room for their sums, (node or 1, step, bin, lane).
    """
    n_groups, _, n_bins, lanes = counts.shape
    n_nodes, n_steps = len(prepared.node), len(prepared.echo)
    n_rows, n_filled = n_bins + 2 * margin, -(-n_groups // AT_ONCE) * AT_ONCE
    values = lane_rows((n_nodes + 1) * n_filled * n_rows, lanes)
    values = values.reshape(n_nodes + 1, n_filled, n_rows, lanes)
    values[:] = 0.0
    left = np.empty(lanes)
    for g in range(n_groups):
        left[:] = n_pulses[g]
        for k in range(n_bins):
            for node in range(n_nodes):
                weight = prepared.node_weight[node, k]
                for i in range(lanes):
                    values[node, g, margin + k, i] = weight * counts[g, b, k, i]
            if prepared.n_pulses > 0:
                for i in range(lanes):
                    left[i] -= counts[g, b, k, i]
            values[n_nodes, g, margin + k] = left
    sums = lane_rows((n_nodes + 1) * n_steps * n_bins, lanes)
    return values, sums.reshape(n_nodes + 1, n_steps, n_bins, lanes)


@njit(**COMPILED)
def _taps_of(b, prepared, lanes):  # type: ignore[no-untyped-def]
    """Return what a count of each node, and an unfired pulse, add to ``T(d)``, without "no echo".

    Of shape (level, node or 1, step, tap, lane).
    """
    n_levels, n_nodes = len(prepared.signal) - 1, len(prepared.node)
    n_steps, n_taps = prepared.echo.shape
    taps = lane_rows(n_levels * (n_nodes + 1) * n_steps * n_taps, lanes)
    taps = taps.reshape(n_levels, n_nodes + 1, n_steps, n_taps, lanes)
    for level in range(n_levels):
        for node in range(n_nodes):
            fill_log_gain(b, level + 1, prepared.node[node], prepared, taps[level, node])
        for step in range(n_steps):
            for tap in range(n_taps):
                share = prepared.echo[step, tap]
                for i in range(lanes):
                    taps[level, n_nodes, step, tap, i] = -prepared.signal[level + 1, b, i] * share
    return taps


@njit(**COMPILED)
def _interpolated(moved, phase):  # type: ignore[no-untyped-def]
    """Return the bin and the weight of the value of a displacement in steps, a quarter bin each.

    Cubic interpolation between the four steps around it, of which one has each phase: linear
    interpolation would flatten the maximum of the likelihood, and so favour displacements of whole
    steps, such as none.
    """
    below = math.floor(moved)
    x, at = moved - below, (phase - below + 1) % 4
    if at == 0:
        share = -x * (x - 1.0) * (x - 2.0) / 6.0
    elif at == 1:
        share = (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0
    elif at == 2:
        share = -(x + 1.0) * x * (x - 2.0) / 2.0
    else:
        share = (x + 1.0) * x * (x - 1.0) / 6.0
    return (below - 1 + at) // 4, np.float32(share)


@njit(**COMPILED)
def _add_group(moved, values, sums):  # type: ignore[no-untyped-def]
    """Add the values (bin, lane) of a group, `moved` steps later, to sums (phase, bin, lane)."""
    n_bins, margin = sums.shape[1], (len(values) - sums.shape[1]) // 2
    for phase in range(len(sums)):
        whole, share = _interpolated(moved, phase)
        for k in range(n_bins):
            row, total = values[margin + whole + k], sums[phase, k]
            for i in range(total.size):
                total[i] += share * row[i]


@njit(**COMPILED)
def _add_groups(moved, values, sums):  # type: ignore[no-untyped-def]
    """As `_add_group`, of `AT_ONCE` groups (group, bin, lane), each with its own displacement."""
    n_bins, lanes = sums.shape[1:]
    margin = (values.shape[1] - n_bins) // 2
    for phase in range(len(sums)):
        w0, s0 = _interpolated(moved[0], phase)
        w1, s1 = _interpolated(moved[1], phase)
        w2, s2 = _interpolated(moved[2], phase)
        w3, s3 = _interpolated(moved[3], phase)
        v0 = values[0].reshape(-1)[(margin + w0) * lanes :]
        v1 = values[1].reshape(-1)[(margin + w1) * lanes :]
        v2 = values[2].reshape(-1)[(margin + w2) * lanes :]
        v3 = values[3].reshape(-1)[(margin + w3) * lanes :]
        total = sums[phase].reshape(-1)
        for i in range(total.size):
            total[i] += s0 * v0[i] + s1 * v1[i] + s2 * v2[i] + s3 * v3[i]


@njit(**COMPILED)
def _fill_ratio(first, taps, sums, ratio):  # type: ignore[no-untyped-def]
    """Fill ``T(d)`` (delay, bin, lane) of one level, at equidistant steps of each bin.

    `taps` (node or 1, step, tap, lane) are those of `_taps_of`, and `sums` (node or 1, phase, bin,
    lane) those over the groups that are displaced by whole bins and `phase` steps.
    """
    n_steps, n_tried = sums.shape[1], len(ratio)
    ratio[:] = 0.0
    for delay in range(n_tried):
        step = delay * n_steps // n_tried
        for phase in range(n_steps):
            at = (step + phase) % n_steps
            tap = first + (step + phase) // n_steps
            for n in range(len(sums)):
                correlate(taps[n, at], sums[n, phase], tap, ratio[delay])


@njit(**COMPILED)
def fill_velocity_evidence(  # type: ignore[no-untyped-def]
    first, end, prepared, counts, n_pulses, displaced, margin, n_tried, evidence
):
    """Fill the log likelihood ratio of each velocity to no echo, (velocity, block, lane).

    Averaged over `n_tried` delays per bin in the middle of the recording, and over the levels.
    `counts` is of shape (group, block, bin, lane), `n_pulses` (group,), and `displaced` (velocity,
    group) are the displacements in steps, of which there are four in a bin; those of zeros complete
    the last `AT_ONCE` groups. No displacement, interpolated, exceeds `margin` bins.
    """
    n_velocities, _, lanes = evidence.shape
    n_bins, n_levels = counts.shape[2], len(prepared.signal) - 1
    n_delays = n_tried * n_bins
    for b in range(first, end):
        values, sums = _values_of(b, prepared, counts, n_pulses, margin)
        taps = _taps_of(b, prepared, lanes)
        ratio = lane_rows(n_delays, lanes).reshape(n_tried, n_bins, lanes)
        delays = ratio.reshape(n_delays, lanes)
        flat, total = np.empty((n_levels, lanes)), np.empty(lanes)
        highest, row = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
        _, all_fired, _, all_unfired = counts_of(b, prepared)
        for level in range(n_levels):
            fill_flat(b, level + 1, prepared, all_fired, all_unfired, flat[level])
            flat[level] += prepared.log_share[level + 1]
        for v in range(n_velocities):
            sums[:] = 0.0
            for g in range(0, values.shape[1], AT_ONCE):
                moved = displaced[v, g : g + AT_ONCE]
                for n in range(len(sums)):
                    _add_groups(moved, values[n, g : g + AT_ONCE], sums[n])
            evidence[v, b] = prepared.log_share[0]
            for level in range(n_levels):
                _fill_ratio(prepared.first_tap, taps[level], sums, ratio)
                fill_highest(delays, highest)
                total[:] = 0.0
                for d in range(n_delays):
                    for i in range(lanes):
                        row[i] = exp32(delays[d, i] - highest[i])
                    for i in range(lanes):
                        total[i] += row[i]
                for i in range(lanes):
                    here = flat[level, i] + highest[i] + math.log(total[i] / n_delays)
                    most, least = max(here, evidence[v, b, i]), min(here, evidence[v, b, i])
                    evidence[v, b, i] = most + math.log1p(math.exp(least - most))


@njit(**COMPILED)
def fill_moving_delays(  # type: ignore[no-untyped-def]
    first, end, prepared, counts, n_pulses, displaced, margin, velocity, best, around, surface
):
    """Fill the likeliest delay of each pixel for its velocity, in steps, (block, lane).

    Also the logarithms of the likelihood ratios to no echo before, at and after it, (block, lane,
    3), and the posterior probability of a surface in each bin, (block, lane, bin).

    `velocity` (block, lane) are rows of `displaced` (velocity, group); other arguments are those of
    `fill_velocity_evidence`.
    """
    _, lanes, n_bins = surface.shape
    n_levels, n_steps = len(prepared.signal) - 1, len(prepared.echo)
    n_delays, none = n_steps * n_bins, prepared.log_share[0]
    for b in range(first, end):
        values, sums = _values_of(b, prepared, counts, n_pulses, margin)
        taps = _taps_of(b, prepared, lanes)
        ratio = lane_rows(n_levels * n_delays, lanes).reshape(n_levels, n_steps, n_bins, lanes)
        density = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
        offset, top = np.empty((n_levels, lanes)), np.full(lanes, -np.inf)
        _, all_fired, _, all_unfired = counts_of(b, prepared)
        sums[:], density[:] = 0.0, 0.0
        begin = 0
        for i in range(lanes):
            if i + 1 < lanes and velocity[b, i + 1] == velocity[b, begin]:
                continue
            alike, begin = slice(begin, i + 1), i + 1
            for g in range(len(counts)):
                moved = displaced[velocity[b, i], g]
                for n in range(len(sums)):
                    _add_group(moved, values[n, g, :, alike], sums[n, :, :, alike])
        for level in range(n_levels):
            _fill_ratio(prepared.first_tap, taps[level], sums, ratio[level])
            fill_flat(b, level + 1, prepared, all_fired, all_unfired, offset[level])
            offset[level] += prepared.log_share[level + 1]
            add_level(ratio[level], offset[level], density, top)
        at = np.empty(lanes, np.int32)
        fill_argmax(density, at)
        for i in range(lanes):
            best[b, i] = at[i]
            for j in range(3):
                d = min(max(at[i] + j - 1, 0), n_delays - 1)
                log = ratio[:, d % n_steps, d // n_steps]
                around[b, i, j] = log_sum(1.0, log, offset, i)
            unit = max(top[i], none)  # so that neither overflows
            seen, total = math.exp(top[i] - unit) / n_delays, 0.0
            for d in range(n_delays):
                total += density[d, i]
            every = seen * total + math.exp(none - unit)
            for k in range(n_bins):
                mass = 0.0
                for step in range(n_steps):
                    mass += density[k * n_steps + step, i]
                surface[b, i, k] = seen * mass / every
