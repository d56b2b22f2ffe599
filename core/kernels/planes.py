"""Kernels that find the plane of each pixel from its neighbours, robust to other surfaces.

A plane is fitted to the window around each pixel. Where that window has several surfaces, another
one that contains the pixel may lie on its surface alone: each pixel takes the plane of the window
that suits it best (shiftable windows; Bobick & Intille 1999, "Large occlusion stereo"), of near
ones rather than of distant ones, since surfaces are curved.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from core.kernels.blocks import LANES, lane_rows
from core.kernels.parallel import COMPILED

SPREADS_BINS = (4.0, 3.0, 2.0, 1.5)
"""Distances from the plane at which the weight of a pixel is a quarter, one per round."""

OWN_SPREAD_BINS = 1.5
"""Distance of a pixel from the plane of a window at which the plane suits it a quarter as well."""

_PER_OWN_SQUARE = np.float32(1 / OWN_SPREAD_BINS**2)

NEAR_PIXELS = 3.0
"""Standard deviation of the Gaussian of the distance to the middle of the window."""

_RIDGE = np.float32(1e-3)  # pulls a slope that no neighbour determines towards 0
_N_SUMS = 9
_WIDE = 2  # times LANES: pixels in a row, and the windows on either side that contain them


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
def fill_window_planes(first_row, end_row, delay, weight, half, windows):  # type: ignore[no-untyped-def]
    """Fit a plane to the window around each pixel.

    Fills `windows` (4, row, col): the weight on the plane, the delay in the pixel, and its change
    from row to row and from col to col.

    Weighted least squares over 2 half + 1 rows and columns. The weights are those given times
    ``1 / (1 + (r / s)²)²`` with the distance r from the plane of the round before, at first a level
    one. `delay` and `weight` are float32 with a margin of `half` pixels, whose weight is 0; `col`
    is a multiple of LANES.
    """
    cols = windows.shape[2]
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
            windows[0, row, first : first + LANES] = sums[:LANES]
            for k in range(3):
                windows[k + 1, row, first : first + LANES] = here[k * LANES : (k + 1) * LANES]


@njit(**COMPILED)
def fill_planes(first_row, end_row, delay, windows, half, plane):  # type: ignore[no-untyped-def]
    """Fill `plane` with the best of the planes of all windows that contain the pixel.

    That is the one with the largest support times ``1 / (1 + (r / s)²)²``, with the distance r of
    the pixel's own delay, times a Gaussian of the distance to the middle of the window.

    Parameters
    ----------
    first_row, end_row : int
    delay : ndarray, shape (half + row + half, half + col + half)
    windows : ndarray, shape (4, half + row + half, half + col + half)
        Support of each window, the share of its weight on the plane, 0 in the margin; delay in its
        middle, and its change from row to row and from col to col.
    half : int
    plane : ndarray, shape (3, row, col)
        Delay in the pixel, and its changes; `col` is a multiple of LANES. All are float32.
    """
    cols, n, reach = plane.shape[2], 2 * half + 1, LANES + 2 * half
    near = np.exp(-0.5 * (np.arange(-half, half + 1) / NEAR_PIXELS) ** 2).astype(np.float32)
    for row in range(first_row, end_row):
        met, best = lane_rows(4 * _WIDE), lane_rows(5)
        for first in range(0, cols, LANES):
            own = delay[row + half, half + first : half + first + LANES]
            best[:] = 0.0
            best[LANES : 2 * LANES] = best[4 * LANES :] = own
            for i in range(n):
                for k in range(4):
                    to = k * _WIDE * LANES
                    met[to : to + reach] = windows[k, row + i, first : first + reach]
                y = np.float32(half - i)
                for j in range(n):
                    _take_better(met[j:], y, np.float32(half - j), near[i] * near[j], best)
            for k in range(3):
                plane[k, row, first : first + LANES] = best[(k + 1) * LANES : (k + 2) * LANES]


@njit(**COMPILED)
def _take_better(windows, y, x, near, best):  # type: ignore[no-untyped-def]
    """Replace the `best` planes of pixels by those of windows that suit them better.

    The pixels lie y rows below and x columns right of the middles of the windows. `windows` has
    rows of `_WIDE` * LANES: support, delay, and changes per row and per column. `best` has rows of
    LANES: how well the plane suits, the plane likewise, and the delay of the pixel.
    """
    for i in range(LANES):
        down, right = windows[2 * _WIDE * LANES + i], windows[3 * _WIDE * LANES + i]
        at = windows[_WIDE * LANES + i] + down * y + right * x
        z = best[4 * LANES + i] - at
        ratio = np.float32(1.0) / (np.float32(1.0) + z * z * _PER_OWN_SQUARE)
        suits = near * windows[i] * ratio * ratio
        is_better = suits > best[i]
        best[i] = suits if is_better else best[i]
        best[LANES + i] = at if is_better else best[LANES + i]
        best[2 * LANES + i] = down if is_better else best[2 * LANES + i]
        best[3 * LANES + i] = right if is_better else best[3 * LANES + i]
