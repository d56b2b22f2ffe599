"""Kernels that fit several echoes to a pixel by maximum likelihood, one after the other.

With background b and echoes of S_j photons per pulse at the delays d_j, bin k receives ::

    μ_k = b β_k + Σ_j S_j p_k(d_j)

photons per pulse. With n_k detections and u_k pulses that have not fired after it, the
log likelihood is ::

    ℓ = Σ_k [ n_k ln(1 - exp(-μ_k)) - u_k μ_k ]

for first photons (Eq. 1), and ``Σ_k [ n_k ln μ_k - μ_k ]`` if all photons are counted. Background,
signals and delays are fitted together (Levenberg 1944, Marquardt 1963, with the curvature in μ).
Only bins with detections enter the first sum, and the second is linear in b and S.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core.kernels.elementary import exp32, log1p32
from core.kernels.parallel import COMPILED

_LEAST = 1e-9  # photons per pulse, or per pixel, of background or signal
_STEPS = 25  # of a fit
_CONVERGED = 1e-3  # gain in log likelihood of the last step
_MOST_DAMPING = 1e6
_HOPE = 1.0  # that a fit gains in addition to twice what the curvature suggests
_LARGEST_MOVE = 1.0  # of a delay in one step, in bins
_PEAKS = 3  # highest peaks of the gain that are tried as delays of one more echo
_ROUNDED_UP = 1.0 + 1e-12  # so that a bound holds in spite of rounding
_SHARES = ((0.5, 0.5, 1.0), (0.3, 0.7, 1.5), (0.7, 0.3, 1.5))
"""Ways to split one echo in two: share of the first, of the second, distance in `apart_bins`."""


class EchoModel(NamedTuple):
    """Quantities that the pixels of a capture share."""

    echo: NDArray[np.float64]
    """Share of the photons of an echo per bin, for delays from 0 to 1 bin, shape (step, tap)."""
    first_tap: int
    """Bins from a delay to the first tap."""
    background: NDArray[np.float64]
    """β, share of the background in each bin, shape (bin,)."""
    is_uniform: bool
    """Whether each bin has the same."""
    is_first: bool
    """Whether pulses fire once."""
    n_pulses: float
    """Pulses of first photons; 1 if all photons are counted."""
    apart_bins: float
    """Smallest distance of two echoes."""


class Pixel(NamedTuple):
    """Counts of one pixel."""

    counts: NDArray[np.float64]
    """n, shape (bin,)."""
    unfired: NDArray[np.float64]
    """u, shape (bin,)."""
    fired: NDArray[np.intp]
    """Bins with detections."""
    n_photons: float
    exposure: float
    """``Σ_k u_k β_k``."""


@njit(**COMPILED)
def _copy(values, n_values, other):  # type: ignore[no-untyped-def]
    """Copy the first values; compiles in a tenth of the time of an assignment of slices."""
    for a in range(n_values):
        other[a] = values[a]


@njit(**COMPILED)
def _largest(values):  # type: ignore[no-untyped-def]
    """Return the index of the largest value."""
    best = 0
    for a in range(values.size):
        best = a if values[a] > values[best] else best
    return best


@njit(**COMPILED)
def _share(model, k, delay):  # type: ignore[no-untyped-def]
    """Return ``p_k(d)``, interpolated between steps of the delay, and its slope per bin."""
    whole = math.floor(delay)
    tap = k - whole - model.first_tap
    if tap < 0 or tap >= model.echo.shape[1]:
        return 0.0, 0.0
    n_steps = model.echo.shape[0] - 1
    at = (delay - whole) * n_steps
    step = min(int(at), n_steps - 1)
    here, rise = model.echo[step, tap], model.echo[step + 1, tap] - model.echo[step, tap]
    return here + (at - step) * rise, n_steps * rise


@njit(**COMPILED)
def _is_met(model, k, delay, n_echoes):  # type: ignore[no-untyped-def]
    """Whether one of the first echoes adds photons to a bin."""
    for j in range(n_echoes):
        if 0 <= k - math.floor(delay[j]) - model.first_tap < model.echo.shape[1]:
            return True
    return False


@njit(**COMPILED)
def _add_bin(n, rate, is_first, change, gradient, curvature):  # type: ignore[no-untyped-def]
    """Return what n detections add to ℓ; add to its gradient and curvature.

    The rate of their bin, at least `_LEAST` of its background, changes by `change` (value,) with
    the values.
    """
    rate = max(rate, _LEAST * change[0])
    if is_first:
        more = math.expm1(rate)
        log = n * (math.log(more) - rate)
        first_order, second_order = n / more, n * (more + 1.0) / (more * more)
    else:
        log = n * math.log(rate)
        first_order, second_order = n / rate, n / (rate * rate)
    for a in range(change.size):
        if change[a] != 0.0:
            gradient[a] += first_order * change[a]
            weight = second_order * change[a]
            for c in range(a + 1):
                curvature[a, c] += weight * change[c]
    return log


@njit(**COMPILED)
def _evaluate(pixel, model, values, n_echoes, gradient, curvature):  # type: ignore[no-untyped-def]
    """Return ℓ; fill its gradient (value,) and the negative curvature (value, value).

    `values` are b, the signals of all echoes, then their delays.
    """
    n_values = 1 + 2 * n_echoes
    log = -values[0] * pixel.exposure
    for a in range(n_values):
        gradient[a] = -pixel.exposure if a == 0 else 0.0
        for c in range(a + 1):
            curvature[a, c] = 0.0
    n_bins, n_taps = pixel.counts.size, model.echo.shape[1]
    for j in range(n_echoes):
        signal, delay = values[1 + j], values[1 + n_echoes + j]
        first = math.floor(delay) + model.first_tap
        for k in range(max(first, 0), min(first + n_taps, n_bins)):
            share, slope = _share(model, k, delay)
            log -= pixel.unfired[k] * signal * share
            gradient[1 + j] -= pixel.unfired[k] * share
            gradient[1 + n_echoes + j] -= pixel.unfired[k] * signal * slope
    change = np.zeros(n_values)
    n_alone = pixel.n_photons  # in bins that no echo meets
    for j in range(n_echoes):
        first = math.floor(values[1 + n_echoes + j]) + model.first_tap
        for k in range(max(first, 0), min(first + n_taps, n_bins)):
            if pixel.counts[k] > 0 and not _is_met(model, k, values[1 + n_echoes :], j):
                n_alone -= pixel.counts[k]
                rate = values[0] * model.background[k]
                change[0] = model.background[k]
                for i in range(n_echoes):
                    share, slope = _share(model, k, values[1 + n_echoes + i])
                    rate += values[1 + i] * share
                    change[1 + i], change[1 + n_echoes + i] = share, values[1 + i] * slope
                log += _add_bin(pixel.counts[k], rate, model.is_first, change, gradient, curvature)
    for a in range(1, n_values):
        change[a] = 0.0
    if model.is_uniform:
        change[0] = model.background[0]
        rate = values[0] * change[0]
        return log + _add_bin(n_alone, rate, model.is_first, change, gradient, curvature)
    for k in pixel.fired:
        if not _is_met(model, k, values[1 + n_echoes :], n_echoes):
            change[0] = model.background[k]
            rate = values[0] * change[0]
            log += _add_bin(pixel.counts[k], rate, model.is_first, change, gradient, curvature)
    return log


@njit(**COMPILED)
def _solve(curvature, gradient, damping, n_values, work, step):  # type: ignore[no-untyped-def]
    """Fill `step` with the solution of ``(H + damping diag H) step = gradient`` (Cholesky)."""
    for a in range(n_values):
        for c in range(a + 1):
            work[a, c] = curvature[a, c]
        work[a, a] += damping * curvature[a, a] + 1e-12
    for a in range(n_values):
        for c in range(a + 1):
            total = work[a, c]
            for i in range(c):
                total -= work[a, i] * work[c, i]
            work[a, c] = math.sqrt(max(total, 1e-12)) if a == c else total / work[c, c]
    for a in range(n_values):
        total = gradient[a]
        for i in range(a):
            total -= work[a, i] * step[i]
        step[a] = total / work[a, a]
    for a in range(n_values - 1, -1, -1):
        total = step[a]
        for i in range(a + 1, n_values):
            total -= work[i, a] * step[i]
        step[a] = total / work[a, a]


@njit(**COMPILED)
def _bound(values, n_echoes, n_bins, apart_bins):  # type: ignore[no-untyped-def]
    """Keep fluxes positive and delays in the gate and `apart_bins` from each other, in place."""
    for a in range(1 + n_echoes):
        values[a] = max(values[a], _LEAST)
    for j in range(n_echoes):
        at = 1 + n_echoes + j
        values[at] = min(max(values[at], 0.0), float(n_bins))
        for other in range(1 + n_echoes, at):
            between = values[at] - values[other]
            if abs(between) < apart_bins:
                half = 0.5 * (apart_bins - abs(between))
                half = half if between >= 0 else -half
                values[at] += half
                values[other] -= half


@njit(**COMPILED)
def _fit(pixel, model, values, n_echoes, needed):  # type: ignore[no-untyped-def]
    """Fit `values`, as for `_evaluate`, in place; return ℓ.

    Stops where the curvature suggests that ℓ will remain well below `needed`.
    """
    n_values, n_bins = 1 + 2 * n_echoes, pixel.counts.size
    gradient, step, trial = np.empty(n_values), np.zeros(n_values), np.empty(n_values)
    _copy(values, n_values, trial)
    curvature, work = np.zeros((n_values, n_values)), np.empty((n_values, n_values))
    trial_gradient, trial_curvature = np.empty(n_values), np.zeros((n_values, n_values))
    log, damping = -np.inf, 1e-2
    for _ in range(_STEPS):
        _bound(trial, n_echoes, n_bins, model.apart_bins)
        found = _evaluate(pixel, model, trial, n_echoes, trial_gradient, trial_curvature)
        if found > log:
            gain, log = found - log, found
            _copy(trial, n_values, values)
            gradient, trial_gradient = trial_gradient, gradient
            curvature, trial_curvature = trial_curvature, curvature
            damping *= 0.1
            if gain < _CONVERGED:
                break
        else:
            damping *= 10.0
            if damping > _MOST_DAMPING:
                break
        _solve(curvature, gradient, damping, n_values, work, step)
        expected = 0.0
        for a in range(n_values):
            expected += 0.5 * step[a] * gradient[a]
            move = step[a]
            if a > n_echoes:
                move = min(max(move, -_LARGEST_MOVE), _LARGEST_MOVE)
            trial[a] = values[a] + move
        if log + 2.0 * expected + _HOPE < needed:
            break
    return log


@njit(**COMPILED)
def _fill_most_gains(pixel, model, values, n_echoes, more, signal, most):  # type: ignore[no-untyped-def]
    """Fill signal and upper bound of the gain of one more echo in the middle of each bin, (bin,).

    The signal is the best linear unbiased estimate for the rates μ of the echoes so far, of which
    `more` (bin,) is set to ``exp(μ) - 1``, or to μ if all photons are counted. Their background is
    not fitted again, which changes the gain in second order.
    """
    n_bins, n_taps = pixel.counts.size, model.echo.shape[1]
    residual, weight = np.empty(n_bins), np.empty(n_bins)
    middle = (model.echo.shape[0] - 1) // 2
    for k in range(n_bins):
        more[k] = values[0] * model.background[k]
    for j in range(n_echoes):
        first = math.floor(values[1 + n_echoes + j]) + model.first_tap
        for k in range(max(first, 0), min(first + n_taps, n_bins)):
            more[k] += values[1 + j] * _share(model, k, values[1 + n_echoes + j])[0]
    for k in range(n_bins):
        if model.is_first:
            more[k] = math.expm1(more[k])
        residual[k] = pixel.counts[k] / more[k] - pixel.unfired[k]
        armed = pixel.unfired[k] + (pixel.counts[k] if model.is_first else 0.0)
        weight[k] = armed / more[k]
    for d in range(n_bins):
        first, score, known = d + model.first_tap, 0.0, 0.0
        for k in range(max(first, 0), min(first + n_taps, n_bins)):
            share = model.echo[middle, k - first]
            score += share * residual[k]
            known += share * share * weight[k]
        there = score > 0.0 and known > 0.0
        signal[d] = score / known if there else 0.0
        most[d] = _ROUNDED_UP * signal[d] * score if there else 0.0


@njit(**COMPILED)
def _gain(pixel, model, d, signal, more):  # type: ignore[no-untyped-def]
    """Return the gain in ℓ of one more echo in the middle of bin d, see `_fill_most_gains`.

    At most what it is to first order in the signal, since ``ln(1 + x) <= x``.
    """
    middle, first, gain = (model.echo.shape[0] - 1) // 2, d + model.first_tap, 0.0
    for k in range(max(first, 0), min(first + model.echo.shape[1], pixel.counts.size)):
        photons = signal * model.echo[middle, k - first]
        gain -= photons * pixel.unfired[k]
        if pixel.counts[k] > 0:
            added = -math.expm1(-photons) if model.is_first else photons
            gain += pixel.counts[k] * math.log1p(added / more[k])
    return gain


@njit(**COMPILED)
def _highest(pixel, model, signal, more, gain, is_exact):  # type: ignore[no-untyped-def]
    """Return the bin of the highest gain; replace bounds that exceed it by gains, in place."""
    d = _largest(gain)
    while not is_exact[d]:
        gain[d], is_exact[d] = _gain(pixel, model, d, signal[d], more), True
        d = _largest(gain)
    return d


@njit(**COMPILED)
def _start(values, n_echoes, signal, delay, start):  # type: ignore[no-untyped-def]
    """Fill `start` with `values` and one more echo, whose photons come from the background."""
    _copy(values, 1 + n_echoes, start)
    _copy(values[1 + n_echoes :], n_echoes, start[2 + n_echoes :])
    start[1 + n_echoes], start[2 + 2 * n_echoes] = signal, delay
    start[0] = max(start[0] - signal, 0.1 * start[0])


@njit(**COMPILED)
def _fill_starts(pixel, model, values, n_echoes, starts):  # type: ignore[no-untyped-def]
    """Fill `starts` (start, value) with fits to begin with of one more echo; return their number.

    One more echo at the highest peaks of the gain, or half of the strongest echo.
    """
    n_bins, half, n_starts = pixel.counts.size, math.ceil(model.apart_bins), 0
    signal, more, gain = np.empty(n_bins), np.empty(n_bins), np.empty(n_bins)
    _fill_most_gains(pixel, model, values, n_echoes, more, signal, gain)
    is_exact = gain <= 0.0
    for _ in range(_PEAKS if n_echoes > 0 else 1):
        d = _highest(pixel, model, signal, more, gain, is_exact)
        if gain[d] <= 0.0:
            break
        _start(values, n_echoes, signal[d], d + 0.5, starts[n_starts])
        for k in range(max(d - half, 0), min(d + half + 1, n_bins)):
            gain[k], is_exact[k] = 0.0, True
        n_starts += 1
    if n_echoes == 0:
        return n_starts
    strongest = _largest(values[1 : 1 + n_echoes])
    middle, whole = values[1 + n_echoes + strongest], values[1 + strongest]
    for first, second, distance in _SHARES:
        start, apart = starts[n_starts], distance * model.apart_bins
        _start(values, n_echoes, second * whole, middle + first * apart, start)
        start[0], start[1 + strongest] = values[0], first * whole
        start[2 + n_echoes + strongest] = middle - second * apart
        n_starts += 1
    return n_starts


@njit(**COMPILED)
def _add_echo(pixel, model, values, n_echoes, needed, best):  # type: ignore[no-untyped-def]
    """Fill `best` with the best fit of one more echo than `values`; return its ℓ."""
    n_values, log = 3 + 2 * n_echoes, -np.inf
    starts = np.empty((_PEAKS + len(_SHARES), n_values))
    for i in range(_fill_starts(pixel, model, values, n_echoes, starts)):
        found = _fit(pixel, model, starts[i], n_echoes + 1, max(needed, log))
        if found > log:
            log = found
            _copy(starts[i], n_values, best)
    return log


@njit(**COMPILED)
def _pixel(counts, model):  # type: ignore[no-untyped-def]
    """Return the `Pixel` of counts (bin,)."""
    n, unfired = np.empty(counts.size), np.ones(counts.size)
    fired, n_fired = np.empty(counts.size, np.intp), 0
    left, exposure, n_photons = model.n_pulses, 0.0, 0.0
    for k in range(n.size):
        n[k] = counts[k]
        n_photons += n[k]
        if model.is_first:
            left -= n[k]
            unfired[k] = left
        exposure += unfired[k] * model.background[k]
        if n[k] > 0:
            fired[n_fired] = k
            n_fired += 1
    return Pixel(n, unfired, fired[:n_fired], n_photons, exposure)


@njit(**COMPILED, inline="always")
def _fit_returns(counts, model, least_gain, most, values, gains):  # type: ignore[no-untyped-def]
    """Fit echoes to one pixel, see `fill_returns`; return their number."""
    pixel = _pixel(counts, model)
    best, flat = np.empty(1 + 2 * most), np.empty(1)
    flat[0] = pixel.n_photons / max(pixel.exposure, _LEAST)
    log = _fit(pixel, model, flat, 0, -np.inf)
    values[0] = flat[0]
    for n_echoes in range(most):
        least = least_gain if n_echoes > 0 else 0.0
        found = _add_echo(pixel, model, values, n_echoes, log + least, best)
        gains[n_echoes] = max(found - log, 0.0)
        if not found - log > least:
            return n_echoes
        log = found
        _copy(best, 3 + 2 * n_echoes, values)
    return most


@njit(**COMPILED)
def fill_returns(first, end, counts, model, least_gain, values, gains, number):  # type: ignore[no-untyped-def]
    """Fit echoes to each pixel, one more as long as it raises ℓ by more than `least_gain`.

    Parameters
    ----------
    counts : ndarray of uint32, shape (pixel, bin)
    model : EchoModel
    least_gain : float
        For the second echo and further ones.
    values : ndarray, shape (pixel, 1 + 2 most)
        Filled with b, the signals of the echoes and their delays in bins.
    gains : ndarray, shape (pixel, most)
        Zeros; filled with the gain of each echo, and of the first one that is not accepted.
    number : ndarray, shape (pixel,)
        Filled with the number of echoes.
    """
    for i in range(first, end):
        number[i] = _fit_returns(counts[i], model, least_gain, gains.shape[1], values[i], gains[i])


@njit(**COMPILED)
def _fill_rate(i, model, background, signal, delay, rate):  # type: ignore[no-untyped-def]
    """Fill the rate (bin,) of a background and of echoes (echo, pixel) of pixel i."""
    n_bins, n_taps = rate.size, model.echo.shape[1]
    for k in range(n_bins):
        rate[k] = background * model.background[k]
    for j in range(len(signal)):
        if signal[j, i] > 0:
            first = math.floor(delay[j, i]) + model.first_tap
            for k in range(max(first, 0), min(first + n_taps, n_bins)):
                rate[k] += signal[j, i] * _share(model, k, delay[j, i])[0]


@njit(**COMPILED)
def _met_bins(i, model, signal, delay):  # type: ignore[no-untyped-def]
    """Return the first of the bins that may not be alike, and their end.

    Those that the echoes (echo, pixel) of pixel i meet, and any in between; all of them over a
    background that varies.
    """
    n_bins, n_taps = model.background.size, model.echo.shape[1]
    first, end = n_bins, 0
    for j in range(len(signal)):
        if signal[j, i] > 0:
            begin = math.floor(delay[j, i]) + model.first_tap
            first, end = min(first, max(begin, 0)), max(end, min(begin + n_taps, n_bins))
    return (first, end) if model.is_uniform else (0, n_bins)


@njit(**COMPILED)
def _fill_more(i, model, background, signal, delay, met, more):  # type: ignore[no-untyped-def]
    """Fill ``exp(rate) - 1`` for first photons, else the rate, of the bins of `_met_bins`.

    Returns that of the other bins. See `_fill_rate`.
    """
    _fill_rate(i, model, background, signal, delay, more)
    alone = background * model.background[0]
    if not model.is_first:
        return alone
    for k in range(met[0], met[1]):
        more[k] = math.expm1(more[k])
    return math.expm1(alone)


@njit(**COMPILED)
def _add_tap(photons, gained, fired, unfired, log):  # type: ignore[no-untyped-def]
    """Add to `log` what the bins (n,) that one tap of an echo meets add to ℓ.

    As if each count there gained the same logarithm.
    """
    for d in range(log.size):
        log[d] += fired[d] * gained - photons * unfired[d]


@njit(**COMPILED)
def _correct_tap(gain, gained, fired, per_more, log):  # type: ignore[no-untyped-def]
    """Replace `gained` by the logarithm that a count gains in each bin (n,)."""
    for d in range(log.size):
        log[d] += fired[d] * (log1p32(gain * per_more[d]) - gained)


@njit(**COMPILED)
def _add_logarithms(one, log):  # type: ignore[no-untyped-def]
    """Replace `log` (n,) by ``ln (exp(log) + exp(one))``."""
    for d in range(log.size):
        high = one[d] if one[d] > log[d] else log[d]
        low = log[d] if one[d] > log[d] else one[d]
        log[d] = high + log1p32(exp32(low - high))


@njit(**COMPILED, inline="always")
def _fill_further(i, counts, model, background, signal, delay, levels, weight, log):  # type: ignore[no-untyped-def]
    """Fill `log` (bin,) of one pixel, see `fill_further`."""
    n_bins, n_taps, middle = counts.size, model.echo.shape[1], (model.echo.shape[0] - 1) // 2
    pixel, before, after = _pixel(counts, model), np.empty(n_bins), np.empty(n_bins)
    fired, unfired = pixel.counts.astype(np.float32), pixel.unfired.astype(np.float32)
    per_more, one = np.empty(n_bins, np.float32), np.empty(n_bins, np.float32)
    exposure = pixel.exposure
    if model.is_first:  # a count adds -μ to its logarithm
        for k in pixel.fired:
            exposure += pixel.counts[k] * model.background[k]
    met = _met_bins(i, model, signal, delay)
    alone_before = _fill_more(i, model, background[i], signal, delay, met, before)
    for level in range(len(levels)):
        s = levels[level, i]
        left = max(background[i] - s, 0.1 * background[i])
        alone = _fill_more(i, model, left, signal, delay, met, after)
        gained = math.log(alone / alone_before)
        base = weight[level] + (background[i] - left) * exposure + pixel.n_photons * gained
        for k in range(met[0], met[1]):
            per_more[k] = 1.0 / after[k]
            if pixel.counts[k] > 0:
                base += pixel.counts[k] * (math.log(after[k] / before[k]) - gained)
        one[:] = base
        for tap in range(n_taps):
            photons = np.float32(s * model.echo[middle, tap])
            gain = np.float32(-math.expm1(-photons) if model.is_first else photons)
            gained, step = log1p32(gain * np.float32(1.0 / alone)), model.first_tap + tap
            begin, end = max(0, step), min(n_bins, n_bins + step)
            if begin < end:
                log_here = one[begin - step : end - step]
                _add_tap(photons, gained, fired[begin:end], unfired[begin:end], log_here)
            begin, end = max(begin, met[0]), min(end, met[1])
            if begin < end:
                log_here = one[begin - step : end - step]
                _correct_tap(gain, gained, fired[begin:end], per_more[begin:end], log_here)
        _add_logarithms(one, log)


@njit(**COMPILED)
def fill_further(first, end, counts, model, background, signal, delay, levels, weight, log):  # type: ignore[no-untyped-def]
    """Fill the log likelihood ratio of one more echo in the middle of each bin to none.

    Its photons are taken from the background; the ratio is the sum over its `levels`.

    Parameters
    ----------
    counts : ndarray of uint32, shape (pixel, bin)
    model : EchoModel
    background : ndarray, shape (pixel,)
        Photons per pulse over the gate, those of one more echo included.
    signal, delay : ndarray, shape (echo, pixel)
        Echoes that are known; a signal of 0 for none.
    levels : ndarray, shape (level, pixel)
        Signals of one more echo.
    weight : ndarray, shape (level,)
        Logarithms of their probabilities.
    log : ndarray of float32, shape (pixel, bin)
    """
    none = np.float32(-1e30)
    for i in range(first, end):
        for k in range(log.shape[1]):
            log[i, k] = none
        _fill_further(i, counts[i], model, background, signal, delay, levels, weight, log[i])


@njit(**COMPILED)
def fill_photons(first, end, counts, model, background, signal, delay, photons, exposure):  # type: ignore[no-untyped-def]
    """Fill expected photons of the background and of each echo, and the exposure to each.

    Parameters
    ----------
    counts, model, background, signal, delay
        As for `fill_further`, without one more echo.
    photons, exposure : ndarray, shape (1 + echo, pixel)
        The ratio of their sums is the next flux of expectation and maximisation.
    """
    for i in range(first, end):
        _fill_photons(i, counts[i], model, background, signal, delay, photons, exposure)


@njit(**COMPILED, inline="always")
def _fill_photons(i, counts, model, background, signal, delay, photons, exposure):  # type: ignore[no-untyped-def]
    """As `fill_photons`, for pixel i."""
    pixel, rate, n_taps = _pixel(counts, model), np.empty(counts.size), model.echo.shape[1]
    _fill_rate(i, model, background[i], signal, delay, rate)
    photons[0, i], exposure[0, i] = 0.0, 0.0
    armed, of_rate, photons_each = model.n_pulses, 0.0, 1.0
    for k in range(counts.size):
        seen = pixel.counts[k]
        exposure[0, i] += (armed if model.is_first else 1.0) * model.background[k]
        if model.is_first:
            armed -= seen
            if rate[k] != of_rate:  # mostly as before
                of_rate = rate[k]
                photons_each = of_rate / -math.expm1(-of_rate)
            seen *= photons_each
        rate[k] = seen / rate[k]  # photons relative to those expected
        photons[0, i] += background[i] * model.background[k] * rate[k]
    for j in range(len(signal)):
        photons[1 + j, i], exposure[1 + j, i] = 0.0, 0.0
        if signal[j, i] > 0:
            first = math.floor(delay[j, i]) + model.first_tap
            for k in range(max(first, 0), min(first + n_taps, counts.size)):
                share = _share(model, k, delay[j, i])[0]
                photons[1 + j, i] += signal[j, i] * share * rate[k]
                before = pixel.unfired[k] + pixel.counts[k] if model.is_first else 1.0
                exposure[1 + j, i] += before * share
