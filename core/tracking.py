"""Echo detection with two tracking differentiators, the paper's method.

A tracking differentiator (TD) follows a signal ``s`` as fast as a bound ``r`` on its acceleration
allows (Xie et al., Electronics 2026, 15, 2816, Eqs. 4-5; the control function is Han's ``fhan``)::

    d  = r·h0          d0 = h0·d          y = x1 - s[k] + h0·x2
    a0 = sqrt(d² + 8·r·|y|)
    a  = x2 + (a0 - d)/2 · sign(y)   if |y| > d0,   else   x2 + y/h0
    fh = -r·sign(a)                  if |a| > d,    else   -r·a/d
    x1' = x1 + h·x2                  x2' = x2 + h·fh

The small scale ``r_small = l·σ`` follows the trend, the large one ``r_large = n·r_small`` the jump.
Their positive difference is the residual; the residual times a weight is the enhanced signal, whose
maximum is the position of the echo (Eqs. 6-15).

`tracking_signals` computes these equations as written, in float64, with ``x1'`` of each step as the
signals. `track` computes only the position, for whole captures, in float32 and in scaled units
(`core.kernels.tracking`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats
from core.checks import require
from core.kernels.blocks import LANES, Blocks, lane_spread
from core.kernels.parallel import on_threads
from core.kernels.tracking import (
    ROUNDING_32,
    KernelSettings,
    Lanes,
    differentiate_rows,
    track_blocks,
)
from core.tracking_parameters import (
    CALM_M,
    FEW_BINS,
    PRESETS,
    SLOW_L,
    STEEP_ALPHA,
    SigmaFrom,
    Start,
    TrackingParameters,
    Weight,
)

__all__ = [
    "CALM_M",
    "FEW_BINS",
    "PRESETS",
    "SLOW_L",
    "START_BINS",
    "STEEP_ALPHA",
    "SigmaFrom",
    "Signals",
    "Start",
    "TrackingParameters",
    "Weight",
    "common_weight",
    "track",
    "tracking_signals",
]

START_BINS = 5


class Signals(NamedTuple):
    """Signals of all stages of the estimator, each of shape (..., bin), in counts."""

    raw: Floats
    small: Floats
    large: Floats
    residual: Floats
    weight: Floats
    enhanced: Floats
    sigma: Floats
    """Standard deviation of the histogram, shape (...)."""
    position_bin: Floats
    """Bin of the largest enhanced signal, shape (...); NaN where there is none."""


def tracking_signals(
    histogram: ArrayLike, parameters: TrackingParameters, n_pulses: int | None = None
) -> Signals:
    """Compute all stages of the estimator as written in the paper, in float64.

    Parameters
    ----------
    histogram : array_like, shape (..., bin)
        Counts, or expected counts.
    parameters : TrackingParameters
    n_pulses : int, optional
        Pulses sent; required by the weight "survival".

    Returns
    -------
    Signals

    Raises
    ------
    ValueError
        If the histogram has no bins, or the weight "survival" lacks `n_pulses`.
    """
    raw = np.asarray(histogram, float)
    require("histogram", f"shape {raw.shape}", raw.ndim > 0 and raw.shape[-1] > 0, "(..., bin)")
    rows = raw.reshape(-1, raw.shape[-1])
    small, large = np.empty_like(rows), np.empty_like(rows)
    sigma_bins = _sigma_bins(parameters, rows.shape[1])
    sigma = rows[:, :sigma_bins].std(axis=1) if sigma_bins else np.zeros(len(rows))
    r_small = float(parameters.l) * sigma
    mean = rows[:, :START_BINS].mean(axis=1)
    first = mean if parameters.start == "mean" else np.zeros_like(mean)
    for scale, r in ((small, r_small), (large, float(parameters.n) * r_small)):
        differentiate_rows(rows, r, float(parameters.h), float(parameters.m), first, scale)
    residual = np.maximum(large - small, 0.0)
    residual[~(residual > ROUNDING_32 * rows.max(axis=1, keepdims=True))] = 0.0
    weight = np.broadcast_to(common_weight(rows.shape[1], parameters), rows.shape)
    pulses = _pulses_for_survival(parameters, n_pulses)
    if pulses is not None:
        armed = pulses - (np.cumsum(rows, axis=1) - rows)
        weight = weight * pulses / np.maximum(armed, 1.0)
    enhanced = residual * weight
    found = enhanced.max(axis=1) > 0
    position = np.where(found, np.argmax(enhanced, axis=1), np.nan)
    shape = raw.shape
    return Signals(
        raw,
        small.reshape(shape),
        large.reshape(shape),
        residual.reshape(shape),
        weight.reshape(shape),
        enhanced.reshape(shape),
        sigma.reshape(shape[:-1]),
        position.reshape(shape[:-1]),
    )


def track(
    blocks: Blocks, parameters: TrackingParameters, n_pulses: int | None = None
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute only the position of the echo, for every pixel of a capture.

    Parameters
    ----------
    blocks : Blocks
        Counts, from `core.kernels.blocks.to_blocks`.
    parameters : TrackingParameters
    n_pulses : int, optional
        Pulses sent; required by the weight "survival".

    Returns
    -------
    position_bin : ndarray, shape (pixel,)
        `Signals.position_bin`; NaN where there is none.
    score : ndarray, shape (pixel,)
        Enhanced signal at the position, in counts; 0 where there is none.

    Raises
    ------
    ValueError
        If the weight "survival" lacks `n_pulses`.
    """
    n_blocks, n_bins, _ = blocks.counts.shape
    weight = common_weight(n_bins, parameters)
    top = weight.max() or 1.0
    settings = KernelSettings(
        k_per_sigma=float((parameters.m * parameters.h) ** 2 * parameters.l),
        r_small=1.0,
        n=float(parameters.n),
        m=float(parameters.m),
        start_bins=min(START_BINS, n_bins) if parameters.start == "mean" else 0,
        n_pulses=_pulses_for_survival(parameters, n_pulses) or 0,
    )
    sigma_bins = _sigma_bins(parameters, n_bins)
    sigma = blocks.sigma if sigma_bins == n_bins else lane_spread(blocks.counts, sigma_bins)[1]
    position = np.empty((n_blocks, LANES), np.float32)
    score = np.empty_like(position)
    lanes = Lanes(sigma, blocks.largest, position, score)
    given = blocks.counts, lanes, (weight / top).astype(np.float32), settings
    on_threads(track_blocks, n_blocks, blocks.counts.size, *given)
    pixels = slice(blocks.n_pixels)
    return position.ravel()[pixels], score.ravel()[pixels] * top


def _sigma_bins(parameters: TrackingParameters, n_bins: int) -> int:
    return n_bins if parameters.sigma_from == "gate" else min(parameters.t_n, n_bins)


def _pulses_for_survival(parameters: TrackingParameters, n_pulses: int | None) -> int | None:
    if parameters.weight != "survival":
        return None
    if n_pulses is None:
        raise ValueError(
            "weight = 'survival' needs the number of pulses, which is unknown or smaller than a "
            "pixel's detections: give n_pulses, or choose another weight."
        )
    return n_pulses


def common_weight(n_bins: int, parameters: TrackingParameters) -> Floats:
    """Compute the part of the weight that all pixels share (Eq. 13), shape (bin,)."""
    bins = np.arange(n_bins)
    rise = (bins / n_bins) ** 3
    if parameters.weight == "cubic":
        # A subnormal strength would distort the weight; treat it as 0.
        weight = (parameters.alpha if parameters.alpha >= np.finfo(float).tiny else 0.0) * rise
    elif parameters.weight == "exponential":
        # Clipped to the range of float32: the last bins keep the largest weight, the others stay
        # positive, and products with counts stay finite.
        power = parameters.alpha * rise
        weight = np.exp(np.maximum(power, power[-1] - 60.0) - max(power[-1] - 600.0, 0.0))
    else:
        weight = np.ones(n_bins)
    return np.where(bins >= parameters.t_n, weight, 0.0)
