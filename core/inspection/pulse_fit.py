"""Fit of a pulse to the echoes: stretched in time, and with an exponential tail.

The pulse of a file is often a guess, and photons of an echo outside its pulse would count as
background. Detectors lengthen a pulse by their jitter and by carriers that diffuse into the
junction, which arrive with an exponential delay (Hernandez et al. 2017, "A computational model of a
single-photon avalanche diode sensor for transient imaging").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import LONGEST_S, SHORTEST_PULSE_S, Floats, Pulse

LogLikelihood = Callable[[Pulse, float], float]
"""Function from a pulse and a coordinate of the background to a log likelihood."""

_LEAST_GAIN = 4.0  # in log likelihood, for which the given pulse is replaced
_LEAST_TAIL_GAIN = 10.0  # for a tail: the grid of delays explains a few
_TRIED = 0.35  # logarithm of a stretch
_STRETCH = (-1.6, 1.6)
_SHARE, _TAIL = (0.02, 0.9), (-1.0, 2.0)  # share of the tail; logarithm of its length in pulses
_TAILS = ((0.05, 1.2), (0.2, 0.0), (0.2, 1.2), (0.5, 0.0), (0.5, 1.2))
_SHARPER = -0.5  # stretch of a pulse whose tail explains a part of its width
_MOST_TRIALS, _MOST_CLOSER = 90, 5
_CLOSE, _CLOSE_LIKELIHOOD, _CLOSE_BACKGROUND = 0.2, 0.2, 0.05
_TAIL_LENGTHS = 5.0  # after which a tail ends


class PulseFit(NamedTuple):
    """Most likely pulse, and the coordinate of the background with it."""

    log_likelihood: float
    background: float
    pulse: Pulse


def changed(
    pulse: Pulse, stretch: float, share: float, tail_pulses: float, resolution_s: float
) -> Pulse:
    """Return a pulse stretched in time, a share of whose photons is delayed exponentially.

    Parameters
    ----------
    pulse : Pulse
    stretch : float
        Factor of all its times.
    share : float
        Share of the photons in the tail; 0 keeps the shape.
    tail_pulses : float
        Mean delay in the tail, in widths of the stretched pulse (its middle 80 %).
    resolution_s : float
        Spacing of the samples of a pulse with a tail, whose time zero is the first of them.
    """
    core = replace(pulse, tau_s=min(max(pulse.tau_s * stretch, SHORTEST_PULSE_S), LONGEST_S))
    if share == 0:
        return core
    tail_s = tail_pulses * (core.span_s[1] - core.span_s[0])
    begin_s, end_s = core.quantile_s(1e-3), core.quantile_s(1 - 1e-3) + _TAIL_LENGTHS * tail_s
    steps = np.arange(math.ceil((end_s - begin_s) / resolution_s) + 1)
    prompt = np.diff(core.cdf(begin_s + steps * resolution_s))
    delay = np.exp(-steps[:-1] * resolution_s / tail_s)
    late = np.convolve(prompt, delay / delay.sum())[: prompt.size]
    return Pulse.measured(np.maximum((1 - share) * prompt + share * late, 0.0), resolution_s)


def fit_pulse(
    log_likelihood: LogLikelihood, pulse: Pulse, coordinates: Floats, resolution_s: float
) -> PulseFit:
    """Fit stretch, tail and background; keep the given pulse unless another is clearly likelier.

    Parameters
    ----------
    log_likelihood : callable
    pulse : Pulse
        The given pulse, from which the search starts.
    coordinates : ndarray, shape (n,)
        Ascending coordinates of backgrounds between which the background lies; about a standard
        deviation of the logarithm apart.
    resolution_s : float
        Spacing of the samples of a pulse with a tail.
    """

    def of(stretch: float, share: float = 0.0, tail: float = 0.0) -> Pulse:
        return changed(pulse, math.exp(stretch), share, math.exp(tail), resolution_s)

    given = _fit_background(log_likelihood, pulse, coordinates)
    least, background = given.log_likelihood + _LEAST_GAIN, given.background

    def tried(at: tuple[float, ...]) -> _Tried:
        return _Tried(log_likelihood(of(*at[1:]), at[0]), at)

    narrow, wide = (tried((background, stretch)) for stretch in (-_TRIED, _TRIED))
    tailed = [tried((background, 0.0, *tail)) for tail in _TAILS]
    # The parabola through the likelihoods of three stretches has its maximum at their best or gains
    # this much.
    slope = (wide.log_likelihood - narrow.log_likelihood) / 2
    bend = 2 * given.log_likelihood - wide.log_likelihood - narrow.log_likelihood
    gain = slope**2 / (2 * bend) if bend > abs(slope) else abs(slope)
    if given.log_likelihood + gain < least and max(tailed).log_likelihood < least:
        return given

    def fitted(start: _Tried, steps: Sequence[float]) -> _Tried:
        within = ((coordinates[0], coordinates[-1]), _STRETCH, _SHARE, _TAIL)
        return _likeliest(tried, start, steps, within[: len(steps)])

    stretched = fitted(
        max(_Tried(given.log_likelihood, (background, 0.0)), narrow, wide), (0.2, 0.25)
    )
    background, stretch = stretched.at
    for sharper in (0.0, _SHARPER):
        x = max(stretch + sharper, _STRETCH[0])
        tailed += [tried((background, x, *tail)) for tail in _TAILS]
    with_tail = fitted(max(tailed), (-0.3, -0.2, 0.15, 0.4))
    best = given
    for found, gain in ((stretched, _LEAST_GAIN), (with_tail, _LEAST_TAIL_GAIN)):
        if found.log_likelihood > best.log_likelihood + gain:
            best = PulseFit(found.log_likelihood, found.at[0], of(*found.at[1:]))
    return best


class _Tried(NamedTuple):
    log_likelihood: float
    at: tuple[float, ...]
    """Coordinate of the background, logarithm of the stretch, share and logarithm of the tail."""


def _fit_background(log_likelihood: LogLikelihood, pulse: Pulse, coordinates: Floats) -> PulseFit:
    """Maximise over the background between two of the values next to the best of them."""
    found = [log_likelihood(pulse, each) for each in coordinates]
    best = int(np.argmax(found))
    around = coordinates[[max(best - 1, 0), min(best + 1, len(found) - 1)]]
    closer = scipy.optimize.minimize_scalar(
        lambda each: -log_likelihood(pulse, each),
        bounds=around,
        method="bounded",
        options={"xatol": _CLOSE_BACKGROUND, "maxiter": _MOST_CLOSER},
    )
    at_best = PulseFit(found[best], float(coordinates[best]), pulse)
    return max(at_best, PulseFit(-closer.fun, float(closer.x), pulse), key=lambda fit: fit[0])


def _likeliest(
    tried: Callable[[tuple[float, ...]], _Tried],
    start: _Tried,
    steps: Sequence[float],
    within: Sequence[tuple[float, float]],
) -> _Tried:
    """Maximise a likelihood from a simplex at a start (Nelder & Mead 1965)."""
    low, high = np.transpose(within)
    simplex = start.at + np.vstack([np.zeros(len(steps)), np.diag(steps)])
    found = scipy.optimize.minimize(
        lambda at: -tried(tuple(at)).log_likelihood,
        start.at,
        method="Nelder-Mead",
        bounds=within,
        options={
            "xatol": _CLOSE,
            "fatol": _CLOSE_LIKELIHOOD,
            "maxfev": _MOST_TRIALS,
            "initial_simplex": np.clip(simplex, low, high),
        },
    )
    return _Tried(-float(found.fun), tuple(found.x.tolist()))
