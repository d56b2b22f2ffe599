"""Kernel that draws delay, signal and background of pixels from their posterior.

Each step chooses among equidistant values around the current one, which has a random place among
them, with their posterior densities as weights. This leaves the posterior unchanged for any
distance between the values (Neal 2003), which shrinks from round to round.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.parallel import COMPILED
from core.kernels.streams import pixel_key, uniform_at

_VALUES = 8
_SHRINKING = 3.0
_STEEP = 10.0  # rise of the log density towards an end, beyond which its maximum may lie
_MOST_ROUNDS = 20
_WIDTHS = (3.0, 2.0, 0.6)
"""Width of the values in the first round: bins, and logarithms of signal and background."""
_LOG_SIGNAL_SIGMA = 0.3
_LOG_BACKGROUND_SIGMA = 0.2

UNIFORMS = 2 * len(_WIDTHS) * _MOST_ROUNDS
"""Random numbers that a pixel takes at most."""


@njit(**COMPILED)
def _log_density(at, start, is_first, fired, unfired, sums, echo, first_tap, shape, node):  # type: ignore[no-untyped-def]
    """Logarithm of the posterior density at a delay, a log signal and a log background.

    ``T(d)`` of `core.inference.likelihood`, the log likelihood of the background alone, and normal
    densities of the logarithms around their values in `start`. `sums` are those of `fired`, for
    each node of the background, and of `unfired`, weighted with the `shape` of the background
    (`core.inference.background`). `echo` holds its shares in bins for delays at equal fractions of
    a bin, (step, tap).
    """
    delay, signal, background = at[0], math.exp(at[1]), math.exp(at[2])
    unit = math.expm1(background) if is_first else background
    total = -0.5 * ((at[2] - start[2]) / _LOG_BACKGROUND_SIGMA) ** 2
    for j in range(node.size):
        here = background * node[j]
        total += sums[0][j] * math.log(-math.expm1(-here) if is_first else here)
    total -= sums[1] * background
    if math.isnan(delay):
        return total
    if not 0.0 <= delay < fired.size:
        return -math.inf
    total -= 0.5 * ((at[1] - start[1]) / _LOG_SIGNAL_SIGMA) ** 2
    step = (delay - int(delay)) * (len(echo) - 1)
    below = min(int(step), len(echo) - 2)
    first = int(delay) + first_tap
    for tap in range(max(0, -first), min(echo.shape[1], fired.size - first)):
        share = echo[below, tap] + (step - below) * (echo[below + 1, tap] - echo[below, tap])
        s, k = signal * share, first + tap
        total -= s * unfired[k]
        if fired[k] > 0.0:
            if node.size > 1:
                here = background * shape[k]
                unit = math.expm1(here) if is_first else here
            total += fired[k] * math.log1p((-math.expm1(-s) if is_first else s) / unit)
    return total


@njit(**COMPILED)
def _chosen(log_weight, uniform):  # type: ignore[no-untyped-def]
    """Index drawn with weights that are given as logarithms."""
    weight = np.exp(log_weight - log_weight.max())
    left = uniform * weight.sum()
    for i in range(weight.size):
        left -= weight[i]
        if left < 0.0:
            return i
    return log_weight.argmax()


@njit(**COMPILED)
def redraw(  # type: ignore[no-untyped-def]
    first, end, counts, n_pulses, echo, first_tap, background, pixels, state
):
    """Replace the states (pixel, 3) by other draws: delay, log signal, and log background per bin.

    A delay of NaN, no echo, remains. `counts` is (pixel, bin), `pixels` the numbers of their random
    streams, and `n_pulses` 0 if unknown. `background` holds the shape (bin,) and its nodes.
    """
    shape, node, node_weight = background
    for pixel in range(first, end):
        key, draw, scale = pixel_key(np.uint64(0), pixels[pixel]), 0, 1.0
        fired = counts[pixel].astype(np.float64)
        unfired = n_pulses - np.cumsum(fired) if n_pulses > 0 else np.ones(fired.size)
        sums = (node_weight * fired).sum(axis=1), (shape * unfired).sum()
        at, start, log_weight = state[pixel], state[pixel].copy(), np.empty(_VALUES)
        least_scale = 1.0 / math.sqrt(1.0 + fired.sum())  # the posterior is hardly narrower
        for _ in range(_MOST_ROUNDS):
            is_inside = True
            for part in range(2 if math.isnan(at[0]) else 0, len(_WIDTHS)):
                step = scale * _WIDTHS[part] / _VALUES
                lowest = at[part] - step * int(uniform_at(key, draw) * _VALUES)
                for i in range(_VALUES):
                    at[part] = lowest + i * step
                    log_weight[i] = _log_density(
                        at,
                        start,
                        n_pulses > 0,
                        fired,
                        unfired,
                        sums,
                        echo,
                        first_tap,
                        shape,
                        node,
                    )
                chosen = _chosen(log_weight, uniform_at(key, draw + 1))
                at[part] = lowest + chosen * step
                if chosen == 0 or chosen == _VALUES - 1:
                    is_inside &= log_weight[chosen] - log_weight.min() < _STEEP
                draw += 2
            if scale < least_scale:
                break
            if is_inside:
                scale /= _SHRINKING


@njit(**COMPILED)
def fill_delay_logs(  # type: ignore[no-untyped-def]
    first, end, counts, n_pulses, echo, first_tap, background, state, delay, log
):
    """Fill the logarithms of the posterior densities of other delays of pixels, (pixel, delay).

    Given signal and background of `state`; all but `delay` (pixel, delay) as for `redraw`.
    """
    shape, node, node_weight = background
    for pixel in range(first, end):
        fired = counts[pixel].astype(np.float64)
        unfired = n_pulses - np.cumsum(fired) if n_pulses > 0 else np.ones(fired.size)
        sums = (node_weight * fired).sum(axis=1), (shape * unfired).sum()
        at, start = state[pixel].copy(), state[pixel]
        for i in range(delay.shape[1]):
            at[0] = delay[pixel, i]
            log[pixel, i] = _log_density(
                at, start, n_pulses > 0, fired, unfired, sums, echo, first_tap, shape, node
            )
