"""Adaptive kernel density and gradient repair, after Chi et al. 2025.

Only the abstract was available. It names an adaptive-bandwidth kernel density estimate of the
triggers of a neighbourhood, and a correction of the range image by its gradient. Everything else is
a reconstruction.

**Density.** The triggers of 3 x 3 pixels are pooled, or of 5 x 5 if those are fewer than the bins
of the gate. With ``f_i`` their density at bandwidth ``h0`` (`core.estimators.kde`) and ``g`` the
geometric mean of f over the triggers, the bandwidth of each trigger is (Abramson 1982)::

    h_i = h0 (f_i / g)^(-1/2)      but within [h0 / 2, 3 h0]
    F_k = Σ_i n_i [ Φ((k - i + 1/2) / h_i) - Φ((k - i - 1/2) / h_i) ]

so that peaks stay sharp and sparse parts are smoothed. The estimate z is the arg max.

**Repair.** ``|∇z|`` is made of the larger of the two differences along rows and along columns. A
pixel is replaced if ``|∇z| > median + 3 MAD`` over the image and more than two thirds of its up to
8 neighbours lie more than 3 bins away. Its new value is the median of their estimates, weighted
with their densities. A pixel on an edge or in a corner of a surface has enough neighbours on that
surface to be kept. Everything together takes 35 ns per pixel and bin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.estimators.base import Estimator
from core.estimators.filters import correlate
from core.estimators.kde import bandwidth_spec, kernel_taps
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions
from core.inference.neighbours import neighbours, patches, pooled_in, weighted_median
from core.inference.posterior import TOLERANCE_BINS
from core.kernels.parallel import COMPILED
from core.parameters import Settings, parameter

NARROWEST, WIDEST = 0.5, 3.0
"""Bounds of a trigger's bandwidth, relative to that of the first density."""

NUMBERS_AT_ONCE = 2**20  # counts processed together
_LEVELS = 64  # bandwidths in the table of kernels, with interpolation between


@dataclass(frozen=True)
class ChiParameters(Settings):
    """Settings of the adaptive density."""

    bandwidth_bins: float = parameter(
        0.4,
        bandwidth_spec("h₀", 2.4),
        "Bandwidth of the first density; that of each trigger is half to three times as large.",
    )


def adaptive_density(counts: Floats, bandwidth_bins: float) -> Floats:
    """``F_k`` of the module's docstring, in triggers per bin.

    Parameters
    ----------
    counts : ndarray, shape (..., bin)
    bandwidth_bins : float

    Returns
    -------
    ndarray, shape (..., bin)
    """
    first = correlate(counts, kernel_taps(bandwidth_bins))
    rows, first_rows = (
        np.ascontiguousarray(each).reshape(-1, counts.shape[-1]) for each in (counts, first)
    )
    density = np.zeros(rows.shape)
    _fill_density(rows, first_rows, *_kernels(bandwidth_bins), density)
    return density.reshape(counts.shape)


def _kernels(bandwidth_bins: float) -> tuple[Floats, NDArray[np.int64]]:
    """Kernels of `_LEVELS` bandwidths in geometric steps, and their half-widths in bins."""
    widths = bandwidth_bins * np.geomspace(NARROWEST, WIDEST, _LEVELS)
    taps = [kernel_taps(width) for width in widths]
    kernels = np.zeros((_LEVELS, taps[-1].size))
    for level, kernel in enumerate(taps):
        begin = (kernels.shape[1] - kernel.size) // 2
        kernels[level, begin : begin + kernel.size] = kernel
    return kernels, np.array([kernel.size // 2 for kernel in taps])


@njit(**COMPILED)
def _fill_density(counts, first, kernels, halves, density):  # type: ignore[no-untyped-def]
    """Add the triggers of each bin to `density` with the kernel of their bandwidth."""
    n_bins = counts.shape[1]
    last, middle = kernels.shape[0] - 1, kernels.shape[1] // 2
    per_log = last / math.log(WIDEST / NARROWEST)
    logs = np.empty(n_bins)
    for r in range(counts.shape[0]):
        total, mean = 0.0, 0.0
        for i in range(n_bins):
            if counts[r, i] > 0.0:
                logs[i] = math.log(first[r, i])
                total += counts[r, i]
                mean += counts[r, i] * logs[i]
        for i in range(n_bins):
            if counts[r, i] > 0.0:
                widened = 0.5 * (mean / total - logs[i])  # ln(h_i / h0)
                at = min(max((widened - math.log(NARROWEST)) * per_log, 0.0), last)
                level = min(int(at), last - 1)
                upper = counts[r, i] * (at - level)
                lower = counts[r, i] - upper
                half = halves[level + 1]
                for k in range(max(0, i - half), min(n_bins, i + half + 1)):
                    tap = middle + k - i
                    density[r, k] += lower * kernels[level, tap] + upper * kernels[level + 1, tap]


def repaired(position: Floats, intensity: Floats) -> Floats:
    """Replace estimates that disagree with their neighbours; see the module's docstring.

    Parameters
    ----------
    position : ndarray, shape (row, col)
        In bins; NaN stays NaN.
    intensity : ndarray, shape (row, col)
        Weight of each pixel in the medians of its neighbours, positive.

    Returns
    -------
    ndarray, shape (row, col)
    """
    around = neighbours(position, 1, np.nan)
    away = np.nan_to_num(np.abs(around - position))  # 0 where either has none
    # Of the 8 neighbours, 1 and 6 are above and below, 3 and 4 to the left and right.
    steep = np.hypot(np.maximum(away[1], away[6]), np.maximum(away[3], away[4]))
    gradient = steep[np.isfinite(position)]
    if gradient.size == 0:
        return position
    median = np.median(gradient)
    limit = median + 3 * np.median(np.abs(gradient - median))
    known = np.isfinite(around)
    alone = (away > TOLERANCE_BINS).sum(axis=0) > 2 / 3 * known.sum(axis=0)
    wrong = alone & (steep > limit)
    weight = np.where(known, neighbours(intensity, 1, 0.0), 0.0)
    better = position.copy()
    better[wrong] = weighted_median(around[:, wrong], weight[:, wrong])
    return better


def _locate(capture: Capture, flux: FluxModel, parameters: ChiParameters) -> tuple[Floats, Floats]:
    """Return repaired positions and the density at the unrepaired ones."""
    position, height = np.empty((2, *capture.shape))
    for here in patches(capture.cube.shape, NUMBERS_AT_ONCE):
        counts = pooled_in(capture.cube, here, 3)
        starved = counts.sum(axis=2) < capture.acquisition.n_bins
        if starved.any():
            counts[starved] = pooled_in(capture.cube, here, 5)[starved]
        density = adaptive_density(counts.astype(float), parameters.bandwidth_bins)
        height[here] = density.max(axis=2)
        position[here] = np.where(height[here] > 0, density.argmax(axis=2), np.nan)
    return repaired(position, height), height


def _curve(histogram: Floats, conditions: Conditions, parameters: ChiParameters) -> Floats:
    """``F_k`` of the module's docstring."""
    return adaptive_density(histogram, parameters.bandwidth_bins)


ESTIMATOR = Estimator(
    "Adaptive kernel density, gradient repair (Chi 2025)",
    ChiParameters,
    _curve,
    _locate,
    window_size=lambda _: 3,
    reconstructed="the abstract of Chi et al. (2025)",
    whole_image=True,
)
