"""Kernels of the tracking differentiators.

`differentiator_step` is one step of the equations in `core.tracking`, as written. The block kernel
runs the same recursion in float32 and in scaled units: with ``K = (m·h)²·l·σ`` and
``S = s/K, X1 = x1/K, X2 = h0·x2/K`` the small scale has ``R = 1``, the large one ``R = n``, and ::

    Y   = X1 + X2 - S
    A   = X2 + copysign(sqrt(R²/4 + 2·R·|Y|) - R/2   if |Y| > R,   else   |Y|,   Y)
    X1' = X1 + X2/m            X2' = X2 - clamp(A, -R, R)/m

so that σ scales the input, ``(m·h)²·l`` is one parameter, and the loop has no division.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.kernels.blocks import LANES, lane_rows
from core.kernels.parallel import COMPILED

# Residuals below this share of the largest count are rounding errors.
ROUNDING_32 = float(16 * np.finfo(np.float32).eps)


class Lanes(NamedTuple):
    """Input and output of the kernel, one number per pixel, each of shape (block, LANES)."""

    sigma: NDArray[np.float64]
    largest: NDArray[np.unsignedinteger]
    position: NDArray[np.float32]
    score: NDArray[np.float32]


class KernelSettings(NamedTuple):
    """Settings of the kernel; 0 in `start_bins` and `n_pulses` means "not used".

    `r_small` is always 1. As a constant it would be clamped with other instructions than `n`, which
    takes 10 % longer.
    """

    k_per_sigma: float
    r_small: float
    n: float
    m: float
    start_bins: int
    n_pulses: int


@njit(**COMPILED)
def differentiator_step(x1, x2, s, r, h, h0):  # type: ignore[no-untyped-def]
    """Return x1 and x2 after one step of a tracking differentiator, the equations as written."""
    d = r * h0
    d0 = h0 * d
    y = x1 - s + h0 * x2
    if abs(y) > d0:
        a0 = math.sqrt(d * d + 8.0 * r * abs(y))
        a = x2 + (a0 - d) / 2.0 * np.sign(y)
    else:
        a = x2 + y / h0
    # With r = 0 the second form is 0/0; the acceleration is 0.
    fh = -r * np.sign(a) if abs(a) > d else (-r * a / d if d > 0.0 else 0.0)
    return x1 + h * x2, x2 + h * fh


@njit(**COMPILED)
def differentiate(s, r, h, m, x1, out):  # type: ignore[no-untyped-def]
    """Run a tracking differentiator over one row."""
    x2 = 0.0
    for k in range(s.size):
        x1, x2 = differentiator_step(x1, x2, s[k], r, h, m * h)
        out[k] = x1


@njit(**COMPILED)
def differentiate_rows(rows, r, h, m, first, out):  # type: ignore[no-untyped-def]
    """Run a tracking differentiator over each row."""
    for i in range(rows.shape[0]):
        differentiate(rows[i], r[i], h, m, first[i], out[i])


# State of the kernel: rows of LANES float32 at constant offsets in one array, so that the compiler
# keeps 16 pixels in a vector and knows that rows do not overlap.
_X1_SMALL, _X2_SMALL, _X1_LARGE, _X2_LARGE = 0 * LANES, 1 * LANES, 2 * LANES, 3 * LANES
_SCALE, _FLOOR, _GAIN, _ARMED = 4 * LANES, 5 * LANES, 6 * LANES, 7 * LANES
_BEST, _AT = 8 * LANES, 9 * LANES
_ROWS = 10

_ALTERNATING = np.float32(1e-20)  # avoids slow subnormal numbers in a filter at rest
_SCALED_MAX = 1e18  # counts in units of K: beyond, squares overflow float32


@njit(**COMPILED, inline="always")
def _follow(x1, x2, s, r, per_m):  # type: ignore[no-untyped-def]
    """Return X1' and X2' of the module's docstring after one step of a scale."""
    quarter, half, two = np.float32(0.25), np.float32(0.5), np.float32(2.0)
    y = x1 + x2 - s
    t = abs(y)
    a = x2 + math.copysign(math.sqrt(quarter * r * r + two * r * t) - half * r if t > r else t, y)
    a = a if a < r else r
    a = a if a > -r else -r
    return x1 + x2 * per_m, x2 - a * per_m


@njit(**COMPILED, inline="always")
def _track_block(b, blocks, lanes, weight, settings, row):  # type: ignore[no-untyped-def]
    """Fill position and score of the pixels of block `b`, by the recursion of the module.

    `row` is scratch memory.
    """
    counts = blocks[b]
    _prepare_rows(counts, lanes.sigma[b], lanes.largest[b], settings, row)
    zero, one = np.float32(0.0), np.float32(1.0)
    r_small, r_large = np.float32(settings.r_small), np.float32(settings.n)
    per_m = np.float32(1.0 / settings.m)
    for k in range(counts.shape[0]):
        if settings.n_pulses > 0:
            for i in range(LANES):
                row[_GAIN + i] = np.float32(settings.n_pulses) / max(row[_ARMED + i], one)
                row[_ARMED + i] -= np.float32(counts[k, i])
        weight_of_bin = weight[k]  # otherwise each lane gathers it, which is slow
        bin_number = np.float32(k)
        offset = _ALTERNATING if k & 1 else -_ALTERNATING
        for i in range(LANES):
            s = row[_SCALE + i] * np.float32(counts[k, i]) + offset
            small, row[_X2_SMALL + i] = _follow(
                row[_X1_SMALL + i], row[_X2_SMALL + i], s, r_small, per_m
            )
            large, row[_X2_LARGE + i] = _follow(
                row[_X1_LARGE + i], row[_X2_LARGE + i], s, r_large, per_m
            )
            row[_X1_SMALL + i], row[_X1_LARGE + i] = small, large
            residual = large - small
            gain = weight_of_bin * row[_GAIN + i]
            enhanced = residual * gain if residual > row[_FLOOR + i] else zero
            best, at = row[_BEST + i], row[_AT + i]
            # Times one, so that all lanes are stored: without AVX-512, storing only those that
            # change takes several times as long.
            row[_AT + i] = r_small * (bin_number if enhanced > best else at)
            row[_BEST + i] = r_small * (enhanced if enhanced > best else best)
    for i in range(LANES):
        found = row[_BEST + i] > zero
        lanes.position[b, i] = row[_AT + i] if found else np.nan
        lanes.score[b, i] = row[_BEST + i] / row[_SCALE + i] if found else zero


@njit(**COMPILED)
def _prepare_rows(counts, sigma, largest, settings, row):  # type: ignore[no-untyped-def]
    """Set scale, floor and initial value of each lane, and everything else to zero."""
    row[:] = 0.0
    for k in range(settings.start_bins):
        for i in range(LANES):
            row[_X1_SMALL + i] += np.float32(counts[k, i])
    for i in range(LANES):
        k_unit = settings.k_per_sigma * sigma[i]
        ranged = 0.0 < largest[i] < _SCALED_MAX * k_unit
        scale = 1.0 / k_unit if ranged else 0.0
        row[_SCALE + i] = scale
        # At least the effect of the alternating offset on a filter at rest.
        floor = max(scale * largest[i] * ROUNDING_32, 1e-18)
        row[_FLOOR + i] = floor if ranged else np.inf
        if settings.start_bins > 0:
            row[_X1_SMALL + i] *= np.float32(scale / settings.start_bins)
        row[_X1_LARGE + i] = row[_X1_SMALL + i]
        row[_GAIN + i] = 1.0
        row[_ARMED + i] = settings.n_pulses


@njit(**COMPILED)
def track_blocks(first, end, blocks, lanes, weight, settings):  # type: ignore[no-untyped-def]
    """Fill `lanes` with the position and score of every pixel, block by block."""
    row = lane_rows(_ROWS)
    for b in range(first, end):
        _track_block(b, blocks, lanes, weight, settings, row)
