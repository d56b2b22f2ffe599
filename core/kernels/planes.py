"""Kernel that fits a plane to the neighbourhood of each pixel, robust to other surfaces."""

from __future__ import annotations

import numpy as np
from numba import njit

from core.kernels.blocks import LANES, lane_rows
from core.kernels.parallel import COMPILED

SPREADS_BINS = (4.0, 3.0, 2.0, 1.5)
"""Distances from the plane at which the weight of a pixel is a quarter, one per round."""

_RIDGE = np.float32(1e-3)  # pulls a slope that no neighbour determines towards 0
_N_SUMS = 9


@njit(**COMPILED)
def _add(delay, weight, y, x, per_square, plane, sums):  # type: ignore[no-untyped-def]
    """Add neighbours (lane,), y rows below and x columns right of the pixels, to the sums.

    `plane` is of shape (3 * LANES,), `sums` of shape (9 * LANES,).
    """
    for i in range(LANES):
        z = delay[i] - (plane[i] + plane[LANES + i] * y + plane[2 * LANES + i] * x)
        ratio = np.float32(1.0) / (np.float32(1.0) + z * z * per_square)
        w = weight[i] * ratio * ratio
        sums[i] += w
        sums[LANES + i] += w * y
        sums[2 * LANES + i] += w * x
        sums[3 * LANES + i] += w * y * y
        sums[4 * LANES + i] += w * x * x
        sums[5 * LANES + i] += w * x * y
        sums[6 * LANES + i] += w * z
        sums[7 * LANES + i] += w * y * z
        sums[8 * LANES + i] += w * x * z


@njit(**COMPILED)
def _solve(sums, plane):  # type: ignore[no-untyped-def]
    """Correct `plane` by the least-squares solution of the `sums`, both as in `_add`."""
    for i in range(LANES):
        s = sums[i] + np.float32(1e-6)
        y, x, z = sums[LANES + i] / s, sums[2 * LANES + i] / s, sums[6 * LANES + i] / s
        yy = sums[3 * LANES + i] - sums[LANES + i] * y + _RIDGE
        xx = sums[4 * LANES + i] - sums[2 * LANES + i] * x + _RIDGE
        xy = sums[5 * LANES + i] - sums[2 * LANES + i] * y
        yz = sums[7 * LANES + i] - sums[LANES + i] * z
        xz = sums[8 * LANES + i] - sums[2 * LANES + i] * z
        determinant = yy * xx - xy * xy
        down, right = (xx * yz - xy * xz) / determinant, (yy * xz - xy * yz) / determinant
        plane[i] += z - down * y - right * x
        plane[LANES + i] += down
        plane[2 * LANES + i] += right


@njit(**COMPILED)
def fill_planes(first_row, end_row, delay, weight, half, plane):  # type: ignore[no-untyped-def]
    """Fill `plane` (3, row, col): delay in the pixel, and its change from row to row, col to col.

    Weighted least squares over 2 half + 1 rows and columns. The weights are those given times
    ``1 / (1 + (r / s)²)²`` with the distance r from the plane of the round before, at first a level
    one. `delay` and `weight` are float32 with a margin of `half` pixels, whose weight is 0; `col`
    is a multiple of LANES.
    """
    cols = plane.shape[2]
    for row in range(first_row, end_row):
        here, sums = lane_rows(3), lane_rows(_N_SUMS)
        for first in range(0, cols, LANES):
            here[:LANES] = delay[row + half, half + first : half + first + LANES]
            here[LANES:] = 0.0
            for spread in SPREADS_BINS:
                per_square = np.float32(1.0 / (spread * spread))
                sums[:] = 0.0
                for i in range(2 * half + 1):
                    for j in range(2 * half + 1):
                        met = slice(first + j, first + j + LANES)
                        y, x = np.float32(i - half), np.float32(j - half)
                        _add(
                            delay[row + i, met], weight[row + i, met], y, x, per_square, here, sums
                        )
                _solve(sums, here)
            for k in range(3):
                plane[k, row, first : first + LANES] = here[k * LANES : (k + 1) * LANES]
