"""Kernels that move delays to the nearby maximum of the likelihood.

A window holds the bins that echoes near a delay can fill. Its delays ``d`` are steps of a fraction
of a bin, so that ``T(d)`` of `core.inference.likelihood` is a correlation with a finely sampled
echo: bin p of a window of P bins takes the sample ``d + (P - 1 - p) steps``.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.parallel import COMPILED

FITTING_ROUNDS = 2  # of the fit of a signal and its delay
_NEWTON_STEPS = 6


@njit(**COMPILED)
def _fill_gain(signal, background, is_first, echo, gain):  # type: ignore[no-untyped-def]
    """Fill `gain` with the logarithm that each count adds to ``T(d)``, for samples of an echo."""
    unit = math.expm1(background) if is_first else background
    for i in range(echo.size):
        s = signal * echo[i]
        gain[i] = math.log1p((-math.expm1(-s) if is_first else s) / unit) if s > 0.0 else 0.0


@njit(**COMPILED)
def _fill_window(counts, n_pulses, first, fired, unfired):  # type: ignore[no-untyped-def]
    """Fill counts and unfired pulses of the bins from `first`; 0 outside the gate."""
    before = 0
    for k in range(min(max(first, 0), counts.size) if n_pulses > 0 else 0):
        before += counts[k]
    armed = float(n_pulses - before)
    for p in range(fired.size):
        k = first + p
        is_inside = 0 <= k < counts.size
        fired[p] = counts[k] if is_inside else 0.0
        armed -= fired[p]
        unfired[p] = (armed if n_pulses > 0 else 1.0) if is_inside else 0.0


@njit(**COMPILED)
def _fill_score(signal, echo, gain, steps, fired, unfired, score):  # type: ignore[no-untyped-def]
    """Fill `score` with ``T(d)`` of the delays of a window."""
    score[:] = 0.0
    for p in range(fired.size):
        first = (fired.size - 1 - p) * steps
        count, expected = fired[p], signal * unfired[p]
        # Slices: the compiler vectorises only indices that it knows to be non-negative.
        gained, missed = gain[first : first + score.size], echo[first : first + score.size]
        for d in range(score.size):
            score[d] += count * gained[d] - expected * missed[d]


@njit(**COMPILED)
def _excess_in(background, is_first, fired, unfired):  # type: ignore[no-untyped-def]
    """Counts of a window beyond its background."""
    counts = 0.0
    for p in range(fired.size):
        armed = unfired[p] + (fired[p] if is_first else 0.0)
        counts += fired[p] - background * armed
    return counts


@njit(**COMPILED)
def _signal_in(background, is_first, fired, unfired):  # type: ignore[no-untyped-def]
    """Signal of a window beyond its background, 0 or more.

    Corrected for pile-up (Coates 1968); of the pulses that were armed, half a one is left at least.
    """
    signal = 0.0
    for p in range(fired.size):
        armed = unfired[p] + (fired[p] if is_first else 0.0)
        signal += math.log1p(fired[p] / max(unfired[p], 0.5)) if is_first else fired[p]
        signal -= background if armed > 0.0 else 0.0
    return max(signal, 0.0)


@njit(**COMPILED)
def _fitted_signal(signal, background, is_first, sample, fired, unfired):  # type: ignore[no-untyped-def]
    """Likeliest signal by Newton's method from a first one, for an echo with samples of each bin.

    `sample` (bin,) is in reverse order, as `echo` in `_fill_score`.
    """
    for _ in range(_NEWTON_STEPS):
        slope, curvature = 0.0, -1e-30
        for p in range(fired.size):
            share = sample[fired.size - 1 - p]
            rate = background + signal * share
            odds = math.expm1(rate) if is_first else rate
            grown = odds + 1.0 if is_first else 1.0
            slope += share * (fired[p] / odds - unfired[p])
            curvature -= share * share * fired[p] * grown / (odds * odds)
        signal = min(max(signal - slope / curvature, 0.25 * signal), 4.0 * signal)
    return signal


@njit(**COMPILED)
def _highest(score, begin, end):  # type: ignore[no-untyped-def]
    """Maximum of `score` from `begin` to `end` by a parabola, and its curvature; 0 at the ends."""
    best = begin + score[begin:end].argmax()
    if not begin < best < end - 1:
        return float(best), 0.0
    left, middle, right = score[best - 1], score[best], score[best + 1]
    curvature = min(left - 2.0 * middle + right, -1e-9)
    return best + min(max(0.5 * (left - right) / curvature, -0.5), 0.5), curvature


@njit(**COMPILED)
def refine_delays(  # type: ignore[no-untyped-def]
    first_block,
    end_block,
    blocks,
    n_pulses,
    signal,
    background,
    echo,
    steps,
    first_tap,
    reach,
    fewest,
    delay,
    curvature,
):
    """Move each delay (block, lane) to the maximum of ``T(d)`` less than `reach` bins from it.

    A maximum at the end of that window is on the slope of one outside: the window moves there, as
    long as ``T(d)`` increases.

    `blocks` holds counts (block, bin, lane); `signal` and `background`, per bin, have the shape
    (block, lane); `n_pulses` is 0 if unknown; `echo` has `steps` samples a bin, see the module,
    and begins `first_tap` bins from a delay. NaN remains. `curvature` (block, lane) is set to that
    of ``T(d)`` per step squared, 0 at an end of the gate.

    Where the signal is NaN, it is fitted together with the delay, if the counts beyond background
    exceed their noise as much as `fewest` counts without background do; otherwise the delay
    remains.
    """
    for b in range(first_block, end_block):
        _refine_block(
            blocks[b],
            n_pulses,
            signal[b],
            background[b],
            echo,
            steps,
            first_tap,
            reach,
            fewest,
            delay[b],
            curvature[b],
        )


@njit(**COMPILED, inline="always")
def _refine_block(  # type: ignore[no-untyped-def]
    counts, n_pulses, signal, background, echo, steps, first_tap, reach, fewest, delay, curvature
):
    """Move delays as `refine_delays` those of a block; (bin, lane) or (lane,) each."""
    n_bins, lanes = counts.shape
    n_delays = (2 * reach + 1) * steps
    gain, score = np.empty(echo.size), np.empty(n_delays)
    fired, unfired = np.empty((2, (echo.size - n_delays) // steps + 1))
    last_signal, last_background = math.nan, math.nan
    for i in range(lanes):
        if math.isnan(delay[i]):
            continue
        is_own, here = math.isnan(signal[i]), signal[i]
        rounds = FITTING_ROUNDS if is_own else 1
        while rounds > 0:
            rounds -= 1
            highest, is_highest = -math.inf, False
            while not is_highest:
                first = min(int(delay[i]), n_bins - 1) - reach
                _fill_window(counts[:, i], n_pulses, first + first_tap, fired, unfired)
                at = (delay[i] - first) * steps - 0.5
                if is_own:
                    more = _excess_in(background[i], n_pulses > 0, fired, unfired)
                    if more * abs(more) < fewest * fired.sum():
                        rounds = 0
                        break
                    here = _signal_in(background[i], n_pulses > 0, fired, unfired)
                    sample = echo[min(max(round(at), 0), n_delays - 1) :: steps][: fired.size]
                    here = _fitted_signal(here, background[i], n_pulses > 0, sample, fired, unfired)
                if here != last_signal or background[i] != last_background:
                    last_signal, last_background = here, background[i]
                    _fill_gain(last_signal, last_background, n_pulses > 0, echo, gain)
                _fill_score(last_signal, echo, gain, steps, fired, unfired, score)
                begin = max(math.floor(at - reach * steps) + 1, -first * steps)
                end = min(math.ceil(at + reach * steps), (n_bins - first) * steps)
                found, curvature[i] = _highest(score, begin, end)
                is_higher = score[int(found)] > highest  # which NaN is not
                is_highest = begin < found < end - 1 or not is_higher
                highest = score[int(found)]
                delay[i] = first + (found + 0.5) / steps
