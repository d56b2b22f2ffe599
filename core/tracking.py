"""The paper's heart: two tracking differentiators, and the echo as their difference.

A tracking differentiator (TD) follows a signal ``s`` as fast as a bound ``r`` on its acceleration
allows (Xie et al., Electronics 2026, 15, 2816, Eqs. 4-5; the control function is Han's ``fhan``)::

    d  = r·h0          d0 = h0·d          y = x1 - s[k] + h0·x2
    a0 = sqrt(d² + 8·r·|y|)
    a  = x2 + (a0 - d)/2 · sign(y)   if |y| > d0,   else   x2 + y/h0
    fh = -r·sign(a)                  if |a| > d,    else   -r·a/d
    x1' = x1 + h·x2                  x2' = x2 + h·fh

The small scale ``r_small = l·σ`` follows the trend, the large one ``r_large = n·r_small`` the jump;
their positive difference is the residual, the residual times a weight is the enhanced signal, and
the largest enhanced signal is the echo (Eqs. 6-15).

`tracking_signals` computes this as written, in float64; its signals hold the ``x1'`` of each step.
`track` computes the position alone, for whole captures, from the same recursion with its units
divided out: with ``K = (m·h)²·l·σ`` and ``S = s/K, X1 = x1/K, X2 = h0·x2/K`` the small scale has
``R = 1``, the large one ``R = n``, and ::

    Y   = X1 + X2 - S
    A   = X2 + copysign(sqrt(R²/4 + 2·R·|Y|) - R/2   if |Y| > R,   else   |Y|,   Y)
    X1' = X1 + X2/m            X2' = X2 - clamp(A, -R, R)/m

so that σ scales the input, ``(m·h)²·l`` is one parameter, and no division is left in the loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats
from core.checks import require
from core.kernels.blocks import LANES, Blocks, lane_rows, lane_spread
from core.kernels.parallel import COMPILED, KERNEL_LOCK, PARALLEL, SERIAL_BELOW
from core.parameters import Choice, Number, Zone, check_fields, parameter

Weight = Literal["cubic", "exponential", "survival", "none"]
Start = Literal["zero", "mean"]
SigmaFrom = Literal["gate", "before T_n"]


# Where settings are in doubt, as ``python -m core stability`` measures it.
CALM_M = 0.8  # chaotic below
LINEAR = 1.0
STEEP_ALPHA = 1.6
FEW_BINS = 4


@dataclass(frozen=True)
class TrackingParameters:
    """Settings of the dual-scale tracking differentiator; the defaults are the recommended preset.

    Each field's meaning, unit and bounds are in its metadata (`core.parameters`).

    Raises
    ------
    ValueError
        If a value lies outside its bounds.
    """

    l: float = parameter(  # noqa: E741 - the paper's letter
        0.004,
        Number(
            "l",
            1e-4,
            1.0,
            log=True,
            least=0.0,
            most=1e6,
            doubtful=(
                Zone(0.0, 7e-4, "So slow a small scale leaves dim pixels without an answer."),
                Zone(0.03, 1e6, "So fast a small scale follows the echo, too: it is lost in it."),
            ),
        ),
        "Speed of the small scale, r_small = l·σ: smaller follows only the slow trend.",
    )
    n: float = parameter(
        1000.0,
        Number(
            "n",
            1.0,
            1e4,
            log=True,
            least=0.0,
            most=1e9,
            doubtful=(
                Zone(0.0, 70.0, "The scales are too much alike; at n = 1 nothing is left of them."),
            ),
        ),
        "Large scale over small scale, r_large = n·r_small: larger follows the echo's jump faster.",
    )
    h: float = parameter(
        1.0,
        Number(
            "h",
            0.25,
            4.0,
            log=True,
            least=0.0,
            most=1e6,
            open_below=True,
            unit="bins",
            doubtful=(
                Zone(0.0, 0.42, "As too small an l: dim pixels are left without an answer."),
                Zone(2.6, 1e6, "As too large an l: the small scale follows the echo, too."),
            ),
        ),
        "Step of the integration. Only (m·h)²·l counts: h and l are one knob.",
    )
    m: float = parameter(
        1.4,
        Number(
            "m",
            0.4,
            5.0,
            least=1e-3,
            most=1e6,
            doubtful=(
                Zone(1e-3, 0.5, "It never comes to rest: at ½ and below it cycles for ever."),
                Zone(
                    0.5,
                    CALM_M,
                    "Chaotic: rounding decides, and float32 finds other echoes.",
                ),
                Zone(
                    CALM_M,
                    1.0,
                    "It smooths nothing: at 1 a pure delay, below it overshoots.",
                ),
            ),
        ),
        "Smoothing, h0 = m·h: delays by 2m - 1 bins.",
    )
    alpha: float = parameter(
        0.15,
        Number("α", 0.1, 30.0, log=True, least=0.0, most=1e6),
        "Strength of the weight. With the cubic weight, as printed, it scales every bin alike and "
        "cannot move a range; with the exponential weight it can.",
    )
    t_n: int = parameter(
        20,
        Number("T_n", 0, 99, whole=True, least=0, most=2**31 - 1, unit="bins"),
        "First bin in which the residual may peak, about two bins behind the echo's onset: what "
        "comes before is taken for noise.",
    )
    weight: Weight = parameter(
        "exponential",
        Choice("Weight", ("none", "survival", "cubic", "exponential")),
        "What the residual is multiplied by: nothing, 1 / share of pulses still armed (undoes the "
        "decay by pile-up), α·(k/N)³ as printed, or exp(α·(k/N)³).",
    )
    start: Start = parameter(
        "mean",
        Choice("Start", ("mean", "zero")),
        "First value of both scales: the mean of the first five bins, or zero, whose start-up jump "
        "T_n must hide.",
    )
    sigma_from: SigmaFrom = parameter(
        "gate",
        Choice("σ from", ("gate", "before T_n")),
        "Bins whose standard deviation is σ: the whole gate (Eq. 6) or those before T_n "
        "(Algorithm 1). The paper prints both.",
    )

    def __post_init__(self) -> None:
        check_fields(self)

    def joint_doubts(self) -> list[str]:
        """Why answers are in doubt with settings that are sound one by one."""
        linear = (self.m * self.h) ** 2 * self.l
        found = []
        if linear >= LINEAR:
            found.append(
                f"(m·h)²·l = {linear:.2g}: from about {LINEAR:g} on both scales turn linear and "
                "move alike, which leaves little residual or none."
            )
        if self.weight == "exponential" and self.alpha >= STEEP_ALPHA:
            found.append(
                f"An exponential weight of α = {self.alpha:g}, {STEEP_ALPHA:g} or more, favours "
                "the end of the gate over any echo before it."
            )
        if self.start == "zero" and self.weight != "cubic":
            found.append(
                "From zero both scales must first jump up to the background; only the cubic weight "
                "hides that jump."
            )
        if self.sigma_from == "before T_n" and self.t_n < FEW_BINS:
            found.append(
                f"σ of the {self.t_n} bins before T_n, fewer than {FEW_BINS}, is chance; of one "
                "bin or none it is 0, and nothing is answered."
            )
        return found


PRESETS: dict[str, TrackingParameters] = {
    "recommended": TrackingParameters(),
    "as printed": TrackingParameters(
        l=0.001, n=1000.0, h=1.0, m=1.5, alpha=1.0, t_n=20, weight="cubic", start="zero"
    ),
}


class Signals(NamedTuple):
    """Every stage of the estimator, each of the histogram's shape (..., bin), in counts."""

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


# A residual below this share of the largest count is rounding: both scales moved alike.
ROUNDING_32 = float(16 * np.finfo(np.float32).eps)

START_BINS = 5


def tracking_signals(
    histogram: ArrayLike, parameters: TrackingParameters, n_pulses: int | None = None
) -> Signals:
    """Every stage of the estimator, as written in the paper and in float64.

    Parameters
    ----------
    histogram : array_like, shape (..., bin)
        Counts, or expected counts.
    parameters : TrackingParameters
    n_pulses : int, optional
        Pulses sent; needed by the weight "survival" only.

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
        _differentiate_rows(rows, r, float(parameters.h), float(parameters.m), first, scale)
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
    """Position of the echo in every pixel, without the signals that lead there.

    Parameters
    ----------
    blocks : Blocks
        Counts, as `to_blocks` lays them out.
    parameters : TrackingParameters
    n_pulses : int, optional
        Pulses sent; needed by the weight "survival" only.

    Returns
    -------
    position_bin : ndarray, shape (pixel,)
        As `Signals.position_bin`; NaN where there is none.
    score : ndarray, shape (pixel,)
        The enhanced signal there, in counts; 0 where there is none.
    """
    n_blocks, n_bins, _ = blocks.counts.shape
    weight = common_weight(n_bins, parameters)
    top = weight.max() or 1.0
    settings = _Settings(
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
    lanes = _Lanes(sigma, blocks.largest, position, score)
    given = blocks.counts, lanes, (weight / top).astype(np.float32), settings
    if blocks.counts.size > SERIAL_BELOW:
        with KERNEL_LOCK:
            _track_parallel(*given)
    else:
        _track_serial(*given)
    pixels = slice(blocks.n_pixels)
    return position.ravel()[pixels], score.ravel()[pixels] * top


class _Lanes(NamedTuple):
    """One number a pixel, each of shape (block, LANES): what goes in, and what comes out."""

    sigma: NDArray[np.float64]
    largest: NDArray[np.unsignedinteger]
    position: NDArray[np.float32]
    score: NDArray[np.float32]


class _Settings(NamedTuple):
    """What the kernel needs to know; 0 in `start_bins` and `n_pulses` means "not used".

    `r_small` is always 1. Were it written in the kernel, clamping to it would take other
    instructions than to `n`, and a tenth of the time more.
    """

    k_per_sigma: float
    r_small: float
    n: float
    m: float
    start_bins: int
    n_pulses: int


def _sigma_bins(parameters: TrackingParameters, n_bins: int) -> int:
    return n_bins if parameters.sigma_from == "gate" else min(parameters.t_n, n_bins)


def _pulses_for_survival(parameters: TrackingParameters, n_pulses: int | None) -> int | None:
    if parameters.weight != "survival":
        return None
    if n_pulses is None:
        raise ValueError(
            "weight = 'survival' needs the number of pulses, which is not known here, or smaller "
            "than a pixel's detections: give n_pulses, or choose another weight."
        )
    return n_pulses


def common_weight(n_bins: int, parameters: TrackingParameters) -> Floats:
    """The part of the weight that is the same for every pixel (Eq. 13), shape (bin,)."""
    bins = np.arange(n_bins)
    rise = (bins / n_bins) ** 3
    if parameters.weight == "cubic":
        # A strength that has lost its digits would give its shape to the weight: it is none.
        weight = (parameters.alpha if parameters.alpha >= np.finfo(float).tiny else 0.0) * rise
    elif parameters.weight == "exponential":
        # Where it spans more than float32 does, the last bins win, as they should, and the others
        # are still something; times a count it is finite.
        power = parameters.alpha * rise
        weight = np.exp(np.maximum(power, power[-1] - 60.0) - max(power[-1] - 600.0, 0.0))
    else:
        weight = np.ones(n_bins)
    return np.where(bins >= parameters.t_n, weight, 0.0)


@njit(**COMPILED)
def differentiator_step(x1, x2, s, r, h, h0):  # type: ignore[no-untyped-def]
    """One step of a tracking differentiator, the equations as written: x1 and x2 after it."""
    d = r * h0
    d0 = h0 * d
    y = x1 - s + h0 * x2
    if abs(y) > d0:
        a0 = math.sqrt(d * d + 8.0 * r * abs(y))
        a = x2 + (a0 - d) / 2.0 * np.sign(y)
    else:
        a = x2 + y / h0
    # With r = 0 the second form is 0/0: nothing may accelerate.
    fh = -r * np.sign(a) if abs(a) > d else (-r * a / d if d > 0.0 else 0.0)
    return x1 + h * x2, x2 + h * fh


@njit(**COMPILED)
def differentiate(s, r, h, m, x1, out):  # type: ignore[no-untyped-def]
    """One tracking differentiator over one row."""
    x2 = 0.0
    for k in range(s.size):
        x1, x2 = differentiator_step(x1, x2, s[k], r, h, m * h)
        out[k] = x1


@njit(**COMPILED)
def _differentiate_rows(rows, r, h, m, first, out):  # type: ignore[no-untyped-def]
    for i in range(rows.shape[0]):
        differentiate(rows[i], r[i], h, m, first[i], out[i])


# The kernel's registers: one row of LANES float32 each, at a constant place in one array, which is
# what lets the compiler keep 16 pixels in a vector and see that no two rows overlap.
_X1_SMALL, _X2_SMALL, _X1_LARGE, _X2_LARGE = 0 * LANES, 1 * LANES, 2 * LANES, 3 * LANES
_SCALE, _FLOOR, _GAIN, _ARMED = 4 * LANES, 5 * LANES, 6 * LANES, 7 * LANES
_BEST, _AT = 8 * LANES, 9 * LANES
_ROWS = 10

_ALTERNATING = np.float32(1e-20)  # keeps a filter at rest out of the slow subnormal numbers
_SCALED_MAX = 1e18  # a count beyond this many K: squares still fit a float32, echoes no longer show


@njit(**COMPILED, inline="always")
def _follow(x1, x2, s, r, per_m):  # type: ignore[no-untyped-def]
    """One step of a scale in its own units: X1' and X2' of the module's docstring."""
    quarter, half, two = np.float32(0.25), np.float32(0.5), np.float32(2.0)
    y = x1 + x2 - s
    t = abs(y)
    a = x2 + math.copysign(math.sqrt(quarter * r * r + two * r * t) - half * r if t > r else t, y)
    a = a if a < r else r
    a = a if a > -r else -r
    return x1 + x2 * per_m, x2 - a * per_m


@njit(**COMPILED)
def _track_block(b, blocks, lanes, weight, settings, row):  # type: ignore[no-untyped-def]
    """Position and score of the pixels of block `b`; `row` is scratch.

    See the module's docstring for the recursion.
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
        weight_of_bin = weight[k]  # each lane would gather it, at many times the cost
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
            best = row[_BEST + i]
            row[_AT + i] = bin_number if enhanced > best else row[_AT + i]
            row[_BEST + i] = enhanced if enhanced > best else best
    for i in range(LANES):
        found = row[_BEST + i] > zero
        lanes.position[b, i] = row[_AT + i] if found else np.nan
        lanes.score[b, i] = row[_BEST + i] / row[_SCALE + i] if found else zero


@njit(**COMPILED)
def _prepare_rows(counts, sigma, largest, settings, row):  # type: ignore[no-untyped-def]
    """Scale, floor and start value of each lane; everything else zero."""
    row[:] = 0.0
    for k in range(settings.start_bins):
        for i in range(LANES):
            row[_X1_SMALL + i] += np.float32(counts[k, i])
    for i in range(LANES):
        k_unit = settings.k_per_sigma * sigma[i]
        ranged = 0.0 < largest[i] < _SCALED_MAX * k_unit
        scale = 1.0 / k_unit if ranged else 0.0
        row[_SCALE + i] = scale
        # Never below what the alternating offset does to a filter at rest.
        floor = max(scale * largest[i] * ROUNDING_32, 1e-18)
        row[_FLOOR + i] = floor if ranged else np.inf
        if settings.start_bins > 0:
            row[_X1_SMALL + i] *= np.float32(scale / settings.start_bins)
        row[_X1_LARGE + i] = row[_X1_SMALL + i]
        row[_GAIN + i] = 1.0
        row[_ARMED + i] = settings.n_pulses


@njit(**COMPILED)
def _track_serial(blocks, lanes, weight, settings):  # type: ignore[no-untyped-def]
    row = lane_rows(_ROWS)
    for b in range(blocks.shape[0]):
        _track_block(b, blocks, lanes, weight, settings, row)


@njit(**PARALLEL)
def _track_parallel(blocks, lanes, weight, settings):  # type: ignore[no-untyped-def]
    for b in prange(blocks.shape[0]):
        _track_block(b, blocks, lanes, weight, settings, lane_rows(_ROWS))
