"""Kernels of the posterior: tables of log likelihoods, and maximum-likelihood mixing shares."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.blocks import LANES, lane_rows
from core.kernels.elementary import log1p32
from core.kernels.parallel import COMPILED, SUMMING

_STEPS = 100  # of expectation and maximisation
_DARK_PIXELS = 0.1  # additional pixels without an echo, so that their share is never 0
_NEGLIGIBLE = np.float32(1e-30)  # density, of which products are subnormal: those are slow
_UNIFORM_SHARE = 0.1  # initial share of the surfaces with a delay that is uniform over the gate

_SMOOTHING_BINS = 1.0
_SMOOTHING = np.exp(-0.5 * (np.arange(-4, 5) / _SMOOTHING_BINS) ** 2)  # to four sigmas
_SMOOTHING /= _SMOOTHING.sum()
_CELL_BINS = 1 / (_SMOOTHING**2).sum()  # bins that are smoothed into one


# All EM steps run in one kernel: between numpy calls other threads would take the GIL.


@njit(**SUMMING)
def learn_shares(likelihood, share):  # type: ignore[no-untyped-def]
    """Estimate the shares of levels by expectation and maximisation (Laird 1978), in place."""
    n_pixels, n_levels = likelihood.shape
    likely, mixture = likelihood.T.copy(), np.empty(n_pixels)
    for _ in range(_STEPS):
        mixture[:] = 0.0
        for level in range(n_levels):
            part, of_level = share[level], likely[level]
            for pixel in range(n_pixels):
                mixture[pixel] += part * of_level[pixel]
        for pixel in range(n_pixels):
            mixture[pixel] = 1.0 / mixture[pixel]
        for level in range(n_levels):
            found, of_level = 0.0, likely[level]
            for pixel in range(n_pixels):
                found += of_level[pixel] * mixture[pixel]
            dark = _DARK_PIXELS if level == 0 else 0.0
            share[level] = (share[level] * found + dark) / (n_pixels + _DARK_PIXELS)


@njit(**SUMMING, inline="always")
def _add_reweighted(echo, none, dark, likely, reweighted):  # type: ignore[no-untyped-def]
    """Add densities (pixel, bin) of four pixels over their means; return how many have no echo.

    At once, since a sum over bins waits for its last term, and `reweighted` is written once.
    """
    e0, e1, e2, e3 = echo[0], echo[1], echo[2], echo[3]
    m0 = m1 = m2 = m3 = np.float32(0.0)
    for k in range(likely.size):
        m0 += e0[k] * likely[k]
        m1 += e1[k] * likely[k]
        m2 += e2[k] * likely[k]
        m3 += e3[k] * likely[k]
    t0, t1 = dark * none[0] + (1 - dark) * m0, dark * none[1] + (1 - dark) * m1
    t2, t3 = dark * none[2] + (1 - dark) * m2, dark * none[3] + (1 - dark) * m3
    w0, w1 = np.float32((1 - dark) / t0), np.float32((1 - dark) / t1)
    w2, w3 = np.float32((1 - dark) / t2), np.float32((1 - dark) / t3)
    for k in range(likely.size):
        reweighted[k] += w0 * e0[k] + w1 * e1[k] + w2 * e2[k] + w3 * e3[k]
    return dark * (none[0] / t0 + none[1] / t1 + none[2] / t2 + none[3] / t3)


@njit(**SUMMING)
def learn_shares_and_depths(density, n_steps, share, depth):  # type: ignore[no-untyped-def]
    """Estimate the share of no echo and the probabilities of delays likewise, in place.

    The shares of the other levels keep their ratios. Some delays are uniform over the gate, the
    others distributed smoothly. The share of the uniform ones is estimated, too; one additional
    surface counts as uniform, so that it is never 0.

    In each step the probabilities of the smooth delays add up to less than 1, by what `_credit`
    takes: so many more pixels would show an echo only because delays are fitted to them.
    """
    n_pixels, n_levels, n_bins = density.shape
    # Four pixels at a time: those added to the last ones have no echo, and are not counted.
    n_rows = -(-n_pixels // 4) * 4
    none, echo = np.ones(n_rows), np.zeros((n_rows, n_bins), np.float32)
    for pixel in range(n_pixels):
        none[pixel] = density[pixel, 0, 0]
        for level in range(1, n_levels):
            weight = np.float32(share[level] / (1 - share[0]))
            for k in range(n_bins):
                echo[pixel, k] += weight * density[pixel, level, k]
        for k in range(n_bins):
            if echo[pixel, k] < _NEGLIGIBLE:
                echo[pixel, k] = 0.0
    some, uniform, before = depth.copy(), _UNIFORM_SHARE, share[0]
    dark = before
    for _ in range(n_steps):
        likely = depth.astype(np.float32)
        found, reweighted = _DARK_PIXELS - (n_rows - n_pixels), np.zeros(n_bins, np.float32)
        for pixel in range(0, n_rows, 4):
            found += _add_reweighted(
                echo[pixel : pixel + 4], none[pixel:], dark, likely, reweighted
            )
        dark = min(max(found / (n_pixels + _DARK_PIXELS), 1e-12), 1 - 1e-12)  # never 0 or 1
        surfaces, anywhere = 0.0, 0.0
        for k in range(n_bins):
            surfaces += depth[k] * reweighted[k]
            anywhere += uniform / n_bins * reweighted[k]
        smooth = smoothed((1 - uniform) * some * reweighted)
        fitted = smooth.sum()
        for k in range(n_bins):
            smooth[k] *= _credit(smooth[k] * _CELL_BINS)
        whole = smooth.sum()  # 0 if the pixels require no delay but uniform ones
        uniform = (anywhere + 1) / (surfaces + 1) if whole > 0 else 1.0
        for k in range(n_bins):
            some[k] = smooth[k] / fitted if whole > 0 else 0.0
            depth[k] = (1 - uniform) * some[k] + uniform / n_bins
    depth /= depth.sum()
    for level in range(1, n_levels):
        share[level] *= (1 - dark) / (1 - before)
    share[0] = dark


@njit(**COMPILED)
def _credit(pixels):  # type: ignore[no-untyped-def]
    """Return the factor on the share of delays that a number of pixels seem to have.

    ``exp(ψ(n)) / n``, about ``1 - 1 / 2n``: a share is estimated by its expected logarithm under a
    sparse Dirichlet prior, which empties what the pixels do not require (Rousseau & Mengersen
    2011). The largest likelihood would find surfaces in the noise of pixels without an echo.
    """
    if pixels < 0.01:
        return 0.0
    return (1 + 0.5 / pixels) * math.exp(-1 / pixels)


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
def correlate(taps, values, first, sums):  # type: ignore[no-untyped-def]
    """Add ``Σ_j taps[j] values[d + first + j]`` to the sums of each d; (tap or bin, lane) each."""
    n_bins, lanes = values.shape
    begin, end = max(0, -first), n_bins - first - len(taps) + 1
    if lanes == LANES and begin < end:
        end = begin + (end - begin) // 4 * 4
        _correlate_inside(taps.reshape(-1), values.reshape(-1), first, begin, end, sums)
    else:
        end = begin
    for d in range(n_bins):
        if begin <= d < end:
            continue
        for j in range(max(0, -d - first), min(len(taps), n_bins - d - first)):
            for i in range(lanes):
                sums[d, i] += taps[j, i] * values[d + first + j, i]


@njit(**COMPILED)
def _correlate_inside(taps, values, first, begin, end, sums):  # type: ignore[no-untyped-def]
    """As `correlate` from `begin` to `end`, a multiple of four apart, all of whose bins exist.

    Four by four, so that most operands stay in registers. One dimension and constant distances,
    since the compiler vectorises what it knows not to overlap.
    """
    n_taps = taps.size // LANES
    for d in range(begin, end, 4):
        s = sums[d : d + 4].reshape(-1)
        for j in range(0, n_taps - 3, 4):
            t, k = taps[j * LANES : (j + 4) * LANES], d + first + j
            v = values[k * LANES : (k + 7) * LANES]
            for i in range(LANES):
                t0, t1, t2, t3 = t[i], t[LANES + i], t[2 * LANES + i], t[3 * LANES + i]
                v1, v2, v3 = v[LANES + i], v[2 * LANES + i], v[3 * LANES + i]
                v4, v5, v6 = v[4 * LANES + i], v[5 * LANES + i], v[6 * LANES + i]
                s[i] = s[i] + t0 * v[i] + t1 * v1 + t2 * v2 + t3 * v3
                s[LANES + i] = s[LANES + i] + t0 * v1 + t1 * v2 + t2 * v3 + t3 * v4
                s[2 * LANES + i] = s[2 * LANES + i] + t0 * v2 + t1 * v3 + t2 * v4 + t3 * v5
                s[3 * LANES + i] = s[3 * LANES + i] + t0 * v3 + t1 * v4 + t2 * v5 + t3 * v6
        for j in range(n_taps // 4 * 4, n_taps):
            t, k = taps[j * LANES : (j + 1) * LANES], d + first + j
            v = values[k * LANES : (k + 4) * LANES]
            for i in range(LANES):
                s[i] += t[i] * v[i]
                s[LANES + i] += t[i] * v[LANES + i]
                s[2 * LANES + i] += t[i] * v[2 * LANES + i]
                s[3 * LANES + i] += t[i] * v[3 * LANES + i]


@njit(**COMPILED)
def counts_of(b, prepared):  # type: ignore[no-untyped-def]
    """Return the parts of ``T(d)`` of a block that all levels share.

    Counts, shared out among the nodes of the background (node, bin, lane), and their sums (node,
    lane), the armed pulses ``A_k`` at each edge of the bins (edge, lane), and sums of the unfired
    pulses ``A_k - n_k``, weighted with the shape of the background (lane,).
    """
    n_bins, lanes = prepared.counts.shape[1:]
    n_nodes = len(prepared.node)
    # Aligned to cache lines: vectors that straddle them cost twice.
    fired = lane_rows(n_nodes * n_bins, lanes).reshape(n_nodes, n_bins, lanes)
    armed = lane_rows(n_bins + 1, lanes).reshape(n_bins + 1, lanes)
    left = np.full(lanes, float(prepared.n_pulses))
    all_fired, all_unfired = np.zeros((n_nodes, lanes)), np.zeros(lanes)
    armed[0] = prepared.n_pulses
    for k in range(n_bins):
        # Separate loops, since those of several types are not vectorised.
        for node in range(n_nodes):
            weight = prepared.node_weight[node, k]
            for i in range(lanes):
                fired[node, k, i] = weight * prepared.counts[b, k, i]
            for i in range(lanes):
                all_fired[node, i] += weight * prepared.counts[b, k, i]
        for i in range(lanes):
            left[i] -= prepared.counts[b, k, i]
        for i in range(lanes):
            armed[k + 1, i] = left[i]
        for i in range(lanes):
            all_unfired[i] += prepared.background_shape[k] * left[i]
    if prepared.n_pulses == 0:
        armed[:], all_unfired[:] = 1.0, n_bins
    return fired, all_fired, armed, all_unfired


@njit(**COMPILED)
def fill_log_gain(b, level, node, prepared, gain):  # type: ignore[no-untyped-def]
    """Fill `gain` (step, tap, lane) with the logarithm that multiplies a count in ``T(d)``.

    `node` is the background relative to its mean.
    """
    n_bins, lanes = prepared.counts.shape[1:]
    n_steps, n_taps = prepared.echo.shape
    unit, background = np.empty(lanes, np.float32), prepared.background[level, b]
    signal = prepared.signal[level, b]
    # Neighbours are often alike, and exponentials are slow.
    for i in range(lanes):
        if i > 0 and background[i] == background[i - 1]:
            unit[i] = unit[i - 1]
        else:
            rate = node * background[i] / n_bins
            unit[i] = 1.0 / (math.expm1(rate) if prepared.n_pulses > 0 else rate)
    for step in range(n_steps):
        for tap in range(n_taps):
            row, met = gain[step, tap], 0.0
            for i in range(lanes):
                if i == 0 or signal[i] != signal[i - 1]:
                    s = signal[i] * prepared.echo[step, tap]
                    met = -math.expm1(-s) if prepared.n_pulses > 0 else s
                row[i] = met
    for step in range(n_steps):
        for tap in range(n_taps):
            for i in range(lanes):
                # (1 - exp(-b - s)) / (1 - exp(-b)), without cancellation.
                gain[step, tap, i] = log1p32(gain[step, tap, i] * unit[i])


@njit(**COMPILED)
def _fill_gain(b, level, node, prepared, gain):  # type: ignore[no-untyped-def]
    """Fill `gain` (step, tap, lane) with what each count adds to ``T(d)``; see `fill_level`."""
    n_steps, n_taps, lanes = gain.shape
    fill_log_gain(b, level, node, prepared, gain)
    for step in range(n_steps):
        for tap in range(n_taps):
            missed = prepared.echo_tail[step, tap] if prepared.n_pulses > 0 else 0.0
            for i in range(lanes):
                gain[step, tap, i] += np.float32(missed * prepared.signal[level, b, i])


@njit(**COMPILED)
def fill_level(b, level, prepared, fired, armed, ratio):  # type: ignore[no-untyped-def]
    """Fill `ratio` (step, bin, lane) with ``T(d)`` of one level (`core.inference.likelihood`).

    The pulses that are unfired after a bin are those armed when the echo begins, less the counts
    in between. So each count of an echo's bin adds its logarithm and the signal of that bin and of
    later ones, and ``S A`` is subtracted, as if all of the echo met the pulses armed at its
    beginning: one sum over the taps instead of two. Taps outside the gate count for nothing.
    """
    n_nodes, n_bins, lanes = fired.shape
    n_steps, n_taps = prepared.echo.shape
    gain = lane_rows(n_steps * n_taps, lanes).reshape(n_steps, n_taps, lanes)
    signal = prepared.signal[level, b].astype(np.float32)
    for step in range(n_steps):
        tail = prepared.echo_tail[step]
        for d in range(n_bins):
            first = d + prepared.first_tap
            before = tail[0] - tail[min(max(-first, 0), n_taps)]
            behind = tail[min(max(n_bins - first, 0), n_taps)]
            here, row = armed[min(max(first, 0), n_bins)], ratio[step, d]
            for i in range(lanes):
                outside = before * armed[0, i] + behind * armed[n_bins, i]
                row[i] = signal[i] * (outside - tail[0] * here[i])
    for node in range(n_nodes):
        _fill_gain(b, level, prepared.node[node], prepared, gain)
        for step in range(n_steps):
            correlate(gain[step], fired[node], prepared.first_tap, ratio[step])


@njit(**COMPILED)
def fill_flat(b, level, prepared, fired, unfired, flat):  # type: ignore[no-untyped-def]
    """Fill `flat` with the log likelihood ratio of the level's background to the first level's.

    `fired` (node, lane) are sums over the bins, `unfired` (lane,) those weighted with the shape of
    the background.
    """
    n_bins, lanes = prepared.counts.shape[1:]
    here, bare = prepared.background[level, b] / n_bins, prepared.background[0, b] / n_bins
    for i in range(lanes):
        flat[i] = -unfired[i] * (here[i] - bare[i])
    for node in range(len(fired)):
        factor, gained = prepared.node[node], 0.0
        for i in range(lanes):
            if i == 0 or here[i] != here[i - 1] or bare[i] != bare[i - 1]:
                odds = here[i] / bare[i]
                if prepared.n_pulses > 0 and here[i] != bare[i]:
                    odds = math.expm1(-here[i] * factor) / math.expm1(-bare[i] * factor)
                gained = math.log(odds) if here[i] != bare[i] else 0.0
            flat[i] += fired[node, i] * gained


@njit(**COMPILED, inline="always")
def _fill_block(b, prepared, log):  # type: ignore[no-untyped-def]
    """Fill log likelihood ratios of each level and delay to no echo, (level, delay, lane)."""
    n_levels, n_delays, lanes = log.shape
    fired, all_fired, armed, all_unfired = counts_of(b, prepared)
    n_steps = len(prepared.echo)
    ratio, flat = lane_rows(n_delays, lanes).reshape(n_steps, -1, lanes), np.empty(lanes)
    log[0] = 0.0
    for level in range(1, n_levels):
        fill_level(b, level, prepared, fired, armed, ratio)
        fill_flat(b, level, prepared, all_fired, all_unfired, flat)
        for d in range(n_delays):
            for i in range(lanes):
                log[level, d, i] = ratio[d % n_steps, d // n_steps, i] + np.float32(flat[i])


@njit(**COMPILED)
def fill_blocks(first, end, skipped, prepared, log):  # type: ignore[no-untyped-def]
    """Fill log likelihood ratios of blocks after `skipped` ones, (block, level, delay, lane)."""
    for b in range(first, end):
        _fill_block(skipped + b, prepared, log[b])
