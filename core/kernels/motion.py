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
from core.kernels.confidence import add_level, fill_highest
from core.kernels.elementary import exp32
from core.kernels.parallel import COMPILED
from core.kernels.posterior import correlate, counts_of, fill_flat, fill_log_gain


@njit(**COMPILED)
def _groups_of(b, prepared, counts, n_pulses):  # type: ignore[no-untyped-def]
    """Return counts (group, node, bin, lane) and unfired pulses (group, bin, lane) of a block.

    And room for their sums: (node, step, bin, lane) and (step, bin, lane).
    """
    n_groups, _, n_bins, lanes = counts.shape
    n_nodes, n_steps = len(prepared.node), len(prepared.echo)
    fired = lane_rows(n_groups * n_nodes * n_bins, lanes)
    fired = fired.reshape(n_groups, n_nodes, n_bins, lanes)
    unfired = lane_rows(n_groups * n_bins, lanes).reshape(n_groups, n_bins, lanes)
    left = np.empty(lanes)
    for g in range(n_groups):
        left[:] = n_pulses[g]
        for k in range(n_bins):
            for node in range(n_nodes):
                weight = prepared.node_weight[node, k]
                for i in range(lanes):
                    fired[g, node, k, i] = weight * counts[g, b, k, i]
            if prepared.n_pulses > 0:
                for i in range(lanes):
                    left[i] -= counts[g, b, k, i]
                unfired[g, k] = left
            else:
                unfired[g, k] = n_pulses[g]
    met_fired = lane_rows(n_nodes * n_steps * n_bins, lanes)
    met_unfired = lane_rows(n_steps * n_bins, lanes)
    return (
        fired,
        unfired,
        met_fired.reshape(n_nodes, n_steps, n_bins, lanes),
        met_unfired.reshape(n_steps, n_bins, lanes),
    )


@njit(**COMPILED)
def _taps_of(b, prepared, lanes):  # type: ignore[no-untyped-def]
    """Return what a count and an unfired pulse add to ``T(d)``, without "no echo".

    Of shapes (level, node, step, tap, lane) and (level, step, tap, lane).
    """
    n_levels, n_nodes = len(prepared.signal) - 1, len(prepared.node)
    n_steps, n_taps = prepared.echo.shape
    gain = lane_rows(n_levels * n_nodes * n_steps * n_taps, lanes)
    gain = gain.reshape(n_levels, n_nodes, n_steps, n_taps, lanes)
    loss = lane_rows(n_levels * n_steps * n_taps, lanes)
    loss = loss.reshape(n_levels, n_steps, n_taps, lanes)
    for level in range(n_levels):
        for node in range(n_nodes):
            fill_log_gain(b, level + 1, prepared.node[node], prepared, gain[level, node])
        for step in range(n_steps):
            for tap in range(n_taps):
                share = prepared.echo[step, tap]
                for i in range(lanes):
                    loss[level, step, tap, i] = -prepared.signal[level + 1, b, i] * share
    return gain, loss


@njit(**COMPILED)
def _add_displaced(moved, values, sums):  # type: ignore[no-untyped-def]
    """Add the values (bin, lane) of a group, `moved` steps later, to sums (phase, bin, lane).

    Between whole steps, by cubic interpolation of the likelihood: linear interpolation flattens its
    maximum, and so favours displacements of whole steps, such as none.
    """
    n_steps, n_bins, lanes = sums.shape
    below = math.floor(moved)
    x = moved - below
    shares = (
        -x * (x - 1.0) * (x - 2.0) / 6.0,
        (x + 1.0) * (x - 1.0) * (x - 2.0) / 2.0,
        -(x + 1.0) * x * (x - 2.0) / 2.0,
        (x + 1.0) * x * (x - 1.0) / 6.0,
    )
    for i_step in range(4):
        step, share = below - 1 + i_step, np.float32(shares[i_step])
        if share == 0.0:
            continue
        whole, phase = step // n_steps, step % n_steps
        for k in range(max(0, -whole), min(n_bins, n_bins - whole)):
            row, total = values[k + whole], sums[phase, k]
            for i in range(lanes):
                total[i] += share * row[i]


@njit(**COMPILED)
def _fill_ratio(first, gain, loss, fired, unfired, ratio):  # type: ignore[no-untyped-def]
    """Fill ``T(d)`` (delay, bin, lane) of one level, at equidistant steps of each bin.

    `fired` (node, phase, bin, lane) and `unfired` (phase, bin, lane) are the sums over the groups
    that are displaced by whole bins and `phase` steps.
    """
    n_steps, n_tried = len(unfired), len(ratio)
    ratio[:] = 0.0
    for delay in range(n_tried):
        step = delay * n_steps // n_tried
        for phase in range(n_steps):
            at = (step + phase) % n_steps
            tap = first + (step + phase) // n_steps
            for node in range(len(fired)):
                correlate(gain[node, at], fired[node, phase], tap, ratio[delay])
            correlate(loss[at], unfired[phase], tap, ratio[delay])


@njit(**COMPILED)
def fill_velocity_evidence(  # type: ignore[no-untyped-def]
    first, end, prepared, counts, n_pulses, displaced, n_tried, evidence
):
    """Fill the log likelihood ratio of each velocity to no echo, (velocity, block, lane).

    Averaged over `n_tried` delays per bin in the middle of the recording, and over the levels.
    `counts` is of shape (group, block, bin, lane), `n_pulses` (group,), and `displaced` (velocity,
    group) are the displacements in steps.
    """
    n_velocities, _, lanes = evidence.shape
    n_groups, n_bins, n_nodes = len(counts), counts.shape[2], len(prepared.node)
    n_levels, n_delays = len(prepared.signal) - 1, n_tried * n_bins
    for b in range(first, end):
        fired, unfired, met, left = _groups_of(b, prepared, counts, n_pulses)
        gain, loss = _taps_of(b, prepared, lanes)
        ratio = lane_rows(n_delays, lanes).reshape(n_tried, n_bins, lanes)
        delays = ratio.reshape(n_delays, lanes)
        flat, total = np.empty((n_levels, lanes)), np.empty(lanes)
        highest, row = np.empty(lanes, np.float32), np.empty(lanes, np.float32)
        _, all_fired, _, all_unfired = counts_of(b, prepared)
        for level in range(n_levels):
            fill_flat(b, level + 1, prepared, all_fired, all_unfired, flat[level])
            flat[level] += prepared.log_share[level + 1]
        for v in range(n_velocities):
            met[:], left[:] = 0.0, 0.0
            for g in range(n_groups):
                for node in range(n_nodes):
                    _add_displaced(displaced[v, g], fired[g, node], met[node])
                _add_displaced(displaced[v, g], unfired[g], left)
            evidence[v, b] = prepared.log_share[0]
            for level in range(n_levels):
                _fill_ratio(prepared.first_tap, gain[level], loss[level], met, left, ratio)
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
    first, end, prepared, counts, n_pulses, displaced, velocity, best, around, surface
):
    """Fill the likeliest delay of each pixel for its velocity, in steps, (block, lane).

    Also the logarithms of the likelihood ratios to no echo before, at and after it, (block, lane,
    3), and the posterior probability of a surface in each bin, (block, lane, bin).

    `velocity` (block, lane) are rows of `displaced` (velocity, group); other arguments are those of
    `fill_velocity_evidence`.
    """
    _, lanes, n_bins = surface.shape
    n_groups, n_nodes = len(counts), len(prepared.node)
    n_levels, n_steps = len(prepared.signal) - 1, len(prepared.echo)
    n_delays, none = n_steps * n_bins, prepared.log_share[0]
    for b in range(first, end):
        fired, unfired, met, left = _groups_of(b, prepared, counts, n_pulses)
        gain, loss = _taps_of(b, prepared, lanes)
        ratio = lane_rows(n_levels * n_delays, lanes).reshape(n_levels, n_steps, n_bins, lanes)
        density = lane_rows(n_delays, lanes).reshape(n_delays, lanes)
        offset, top = np.empty((n_levels, lanes)), np.full(lanes, -np.inf)
        _, all_fired, _, all_unfired = counts_of(b, prepared)
        met[:], left[:], density[:] = 0.0, 0.0, 0.0
        for g in range(n_groups):
            for i in range(lanes):
                moved, one = displaced[velocity[b, i], g], slice(i, i + 1)
                for node in range(n_nodes):
                    _add_displaced(moved, fired[g, node, :, one], met[node, :, :, one])
                _add_displaced(moved, unfired[g, :, one], left[:, :, one])
        for level in range(n_levels):
            _fill_ratio(prepared.first_tap, gain[level], loss[level], met, left, ratio[level])
            fill_flat(b, level + 1, prepared, all_fired, all_unfired, offset[level])
            offset[level] += prepared.log_share[level + 1]
            add_level(ratio[level], offset[level], density, top)
        for i in range(lanes):
            at = density[:, i].argmax()
            best[b, i] = at
            for j in range(3):
                d = min(max(at + j - 1, 0), n_delays - 1)
                log = ratio[:, d % n_steps, d // n_steps, i] + offset[:, i]
                most = log.max()
                around[b, i, j] = most + math.log(np.exp(log - most).sum())
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
