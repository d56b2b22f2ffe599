"""Kernels of messages between neighbouring pixels, along the rows or the columns of an image.

The state of a pixel is the bin of its surface, or "nothing". With probability ρ the second of two
neighbours lies on the plane of the first; otherwise it is independent, with the prior p. The
message of a pixel with weights h(d), which sum to 1, is therefore ::

    m(d') = 1 - ρ + ρ / p(d') Σ_d K(d' - d - g) h(d)

with the slope g of the plane and a narrow kernel K; after "nothing" follows "nothing". Messages are
relative to the prior: a message of 1 leaves a pixel as it is.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.parallel import COMPILED, SUMMING

MOST_TAPS = 33
"""Taps of the kernel K, at most."""

STEEPEST = 24.0
"""Largest slope in bins per pixel; steeper slopes are clipped."""

_MARGIN = int(STEEPEST) + MOST_TAPS  # bins on either side of the gate that a message may read
_TAPS_AT_ONCE = 4


@njit(**SUMMING)
def _weigh(evidence, message, weights):  # type: ignore[no-untyped-def]
    """Fill `weights` (bin,) with a pixel's evidence times the message to it; return the sum."""
    total = np.float32(0.0)
    for d in range(weights.size):
        weights[d] = evidence[d] * message[d]
        total += weights[d]
    return total


@njit(**COMPILED)
def _pass_on(weights, nothing, total, slope, link, taps, sums, message):  # type: ignore[no-untyped-def]
    """Fill `message` (bin,) with ``m(d')``; return the message about nothing.

    `weights` (margin + bin + margin,), 0 in the margins, and `nothing` sum to `total`. `taps` and
    `sums` are scratch memory.
    """
    n_bins, n_taps = message.size, link.kernel.size
    bounded = min(max(slope, -STEEPEST), STEEPEST)
    whole = math.floor(bounded)
    part = np.float32(bounded - whole)
    # A kernel at a fraction of a bin is interpolated.
    taps[0], taps[n_taps] = (1 - part) * link.kernel[0], part * link.kernel[n_taps - 1]
    for j in range(1, n_taps):
        taps[j] = (1 - part) * link.kernel[j] + part * link.kernel[j - 1]
    sums[:] = 0.0
    for j in range(0, taps.size, _TAPS_AT_ONCE):
        first = _MARGIN - whole + n_taps // 2 - j - 3
        met, t0, t1, t2, t3 = weights[first:], taps[j], taps[j + 1], taps[j + 2], taps[j + 3]
        for d in range(n_bins):
            sums[d] += t0 * met[d + 3] + t1 * met[d + 2] + t2 * met[d + 1] + t3 * met[d]
    leak, gain = np.float32(1.0) - link.share, link.share / total
    for d in range(n_bins):
        message[d] = leak + gain * link.per_prior[d] * sums[d]
    return leak + gain * link.per_nothing * nothing


@njit(**SUMMING)
def _multiply(evidence, message, posterior):  # type: ignore[no-untyped-def]
    """Multiply `posterior`, the message from the other side, by evidence and message.

    All of shape (bin,). Returns the sum.
    """
    total = np.float32(0.0)
    for d in range(posterior.size):
        posterior[d] *= evidence[d] * message[d]
        total += posterior[d]
    return total


@njit(**COMPILED)
def fill_posterior(  # type: ignore[no-untyped-def]
    first, end, evidence, nothing, slope, along_rows, link, posterior, posterior_nothing
):
    """Fill the posteriors of the pixels of each row (or column), given the other pixels of it.

    Exact, by messages forward and backward. Of the rows (or columns) from `first` to `end`.

    Parameters
    ----------
    evidence : ndarray, shape (row, col, bin)
        Evidence of each pixel, prior included.
    nothing : ndarray, shape (row, col)
        Evidence of nothing.
    slope : ndarray, shape (row, col)
        Bins per pixel in the direction of the messages.
    along_rows : bool
    link : core.estimators.image_posterior.Link
    posterior : ndarray, shape (row, col, bin)
    posterior_nothing : ndarray, shape (row, col)
        Together 1 in each pixel.
    """
    rows, cols, n_bins = evidence.shape
    length, line_step, step = (cols, cols, 1) if along_rows else (rows, 1, cols)
    seen, found = evidence.reshape(-1, n_bins), posterior.reshape(-1, n_bins)
    dark, found_dark, slopes = nothing.reshape(-1), posterior_nothing.reshape(-1), slope.reshape(-1)
    for line in range(first, end):
        weights = np.zeros(n_bins + 2 * _MARGIN, np.float32)
        inner = weights[_MARGIN : _MARGIN + n_bins]
        message, sums = np.ones(n_bins, np.float32), np.empty(n_bins, np.float32)
        taps = np.zeros(-(-(link.kernel.size + 1) // _TAPS_AT_ONCE) * _TAPS_AT_ONCE, np.float32)
        on_nothing = np.float32(1.0)
        for i in range(length):
            at = line * line_step + i * step
            found[at] = message
            found_dark[at] = on_nothing
            h = dark[at] * on_nothing
            total = _weigh(seen[at], message, inner) + h
            on_nothing = _pass_on(weights, h, total, slopes[at], link, taps, sums, message)
        message[:] = 1.0
        on_nothing = np.float32(1.0)
        for i in range(length - 1, -1, -1):
            at = line * line_step + i * step
            h = dark[at] * on_nothing
            found_dark[at] *= h
            per_total = 1 / (_multiply(seen[at], message, found[at]) + found_dark[at])
            found_dark[at] *= per_total
            here = found[at]
            for d in range(n_bins):
                here[d] *= per_total
            total = _weigh(seen[at], message, inner) + h
            on_nothing = _pass_on(weights, h, total, -slopes[at], link, taps, sums, message)


@njit(**SUMMING)
def fill_lags(first, end, one, other, lags):  # type: ignore[no-untyped-def]
    """Fill ``Σ_d one(d + lag) other(d)`` of each pixel and lag, (pixel, lag); 0 is in the middle.

    `one` and `other` are of shape (pixel, bin).
    """
    n_bins, half = one.shape[1], lags.shape[1] // 2
    padded = np.zeros(n_bins + 2 * half, np.float32)  # sums of equal length are vectorised
    for i in range(first, end):
        padded[half : half + n_bins] = one[i]
        for lag in range(lags.shape[1]):
            shifted, total = padded[lag:], np.float32(0.0)
            for d in range(n_bins):
                total += shifted[d] * other[i, d]
            lags[i, lag] = total


@njit(**COMPILED)
def fill_modes(first, end, posterior, delay, weight):  # type: ignore[no-untyped-def]
    """Fill the likeliest `delay` of each pixel in bins, refined by a parabola, and its `weight`.

    The weight is the probability of a bin or two around it. `posterior` is of shape (pixel, bin),
    `delay` and `weight` (pixel,).
    """
    n_bins = posterior.shape[1]
    for i in range(first, end):
        here = posterior[i]
        # Positive numbers are ordered as their bits, of which the largest is found by vectors.
        bits = here.view(np.int32)
        highest = bits[0]
        for d in range(1, n_bins):
            highest = max(highest, bits[d])
        best = 0
        while bits[best] < highest:
            best += 1
        shift, mass = 0.0, here[best]
        if 0 < best < n_bins - 1:
            mass += here[best - 1] + here[best + 1]
            left, middle, right = (
                math.log(max(here[best - 1], 1e-30)),
                math.log(max(here[best], 1e-30)),
                math.log(max(here[best + 1], 1e-30)),
            )
            curvature = min(left - 2 * middle + right, -1e-9)
            shift = min(max(0.5 * (left - right) / curvature, -0.5), 0.5)
        delay[i] = best + 0.5 + shift
        weight[i] = mass


@njit(**COMPILED)
def fill_window_masses(first, end, posterior, factor, half, begin, window):  # type: ignore[no-untyped-def]
    """Fill `window` with the mass of `half` bins on either side of the beginning of some bins.

    `posterior` (pixel, merged bin) is of `factor` bins each, which share it alike. The bins of a
    pixel are those from `begin` (pixel,), as many as `window` (pixel, n) has columns.
    """
    n_bins = posterior.shape[1] * factor
    for i in range(first, end):
        for n in range(window.shape[1]):
            mass = np.float32(0.0)
            at = begin[i] + n - half
            for d in range(max(at, 0), min(at + 2 * half, n_bins)):
                mass += posterior[i, d // factor] / np.float32(factor)
            window[i, n] = mass
