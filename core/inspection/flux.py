"""Signal and background of a pixel, with intervals.

The likelihood of a histogram (`core.inference.likelihood`) is averaged over all delays of the gate
with a uniform prior, which leaves a likelihood of signal and background alone. The largest peak is
not assumed to be the echo.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.inspection.profile import Box, FluxEstimate, spans, zoomed

METHOD = (
    "95 % profile likelihood intervals of the first-photon likelihood, averaged over all delays"
)

_COARSE, _FINE = (9, 17), (13, 25)
_RIGHT = math.pi / 2
_LEAST_BACKGROUND = 1e-200  # photons; without any, the log likelihood of a count is infinite
_NEGLIGIBLE = 25.0
_AT_ONCE = 2**21  # likelihoods of fluxes and delays: 16 MiB
_STEPS, _STEPS_CLOSE = 2, 16  # delays per bin; likewise if few bins remain
_FEW_BINS, _MANY_BINS = 8, 8  # that remain; width of an echo for which one delay per bin is enough


def estimate_flux(
    histograms: Floats,
    acquisition: Acquisition,
    pulse: Pulse,
    n_pulses: int | None,
    left_out: NDArray[np.bool_] | None = None,
) -> FluxEstimate:
    """Estimate signal, background and their ratio, with 95 % intervals.

    Parameters
    ----------
    histograms : ndarray, shape (bin,) or (pixel, bin)
        Counts of one pixel, or of several with the same fluxes and different delays.
    acquisition : Acquisition
    pulse : Pulse
    n_pulses : int or None
        Pulses sent, for first photons. If None, counts are Poisson, and fluxes are in photons
        instead of photons per pulse.
    left_out : ndarray of bool, shape (bin,), optional
        Bins whose counts are not used, and in which no echo is looked for: those of other surfaces.
        The background is still that over the whole gate.

    Returns
    -------
    FluxEstimate
    """
    counts = np.atleast_2d(np.asarray(histograms, float))
    used = np.full(counts.shape[1], True) if left_out is None else ~left_out
    box = _whole_range(counts * used, n_pulses)
    pixels = [_Pixel(each, acquisition, pulse, n_pulses, used) for each in counts]

    def together(root: Floats, angle: Floats) -> Floats:
        signal, background = _flux_at(root, angle)
        return np.asarray(sum(pixel(signal, background) for pixel in pixels))

    box = zoomed(box, together, _COARSE)
    # With approximate fluxes, most delays can be excluded.
    excluded = [pixel.exclude_delays() for pixel in pixels]
    if any(excluded):
        box = zoomed(box, together, _COARSE)
    likelihood = together(*box.grid(_FINE))

    def flux_at(root: Floats, angle: Floats) -> tuple[Floats, Floats]:
        signal, background = _flux_at(root, angle)
        if box.high[0] == box.most[0]:  # if every pulse fires, the flux has no upper bound
            signal[-1, angle > 0] = background[-1, angle < _RIGHT] = np.inf
        return signal, background

    return spans(box, likelihood, flux_at)


def _whole_range(counts: Floats, n_pulses: int | None) -> Box:
    """Bounds of ``√(S + B)`` and of ``asin √(S / (S + B))`` for pixels (pixel, bin).

    The standard deviation of these is nearly constant, so that the likelihood has a round peak.
    """
    n_pixels, n_bins = counts.shape
    detected = float(counts.sum())
    if n_pulses is None:
        one = 1 / n_pixels
        total, sd, most = detected * one, math.sqrt(detected) * one, 2 * detected + 100
    else:
        sent = n_pulses * n_pixels
        left, one = max(sent - detected, 0.5), 1 / sent
        total, sd = math.log(sent / left), math.sqrt(1 / left - one)
        most = n_bins * math.log(1000.0 * sent)  # all pulses fire with certainty
    low, high = max(total - 4 * sd - one, 0.0), min(total + 4 * sd + 4 * one, most)
    return Box(
        low=(math.sqrt(low), 0.0),
        high=(math.sqrt(high), _RIGHT),
        least=(0.0, 0.0),
        most=(math.sqrt(most), _RIGHT),
    )


def _flux_at(root: Floats, angle: Floats) -> tuple[Floats, Floats]:
    """Signal and background at these coordinates, each of shape (root, angle)."""
    total = root[:, np.newaxis] ** 2
    return total * np.sin(angle) ** 2, total * np.where(angle < _RIGHT, np.cos(angle) ** 2, 0.0)


class _Pixel:
    """Likelihood of signal and background of a pixel, averaged over delays."""

    def __init__(
        self,
        counts: Floats,
        acquisition: Acquisition,
        pulse: Pulse,
        n_pulses: int | None,
        used: NDArray[np.bool_],
    ) -> None:
        self._counts, self._n_pulses = counts * used, n_pulses
        self._acquisition, self._pulse = acquisition, pulse
        # Given the pulses armed in a bin, its counts are independent of those before.
        self._unfired = used * (1.0 if n_pulses is None else n_pulses - np.cumsum(counts))
        self._bins = np.flatnonzero(used)
        wide = pulse.span_s[1] - pulse.span_s[0] > _MANY_BINS * acquisition.bin_width_s
        self._take_steps(1 if wide else _STEPS)

    def _take_steps(self, per_bin: int) -> None:
        """Set the number of delays in each of the remaining bins."""
        n_bins = self._counts.size
        delay = (np.arange(per_bin) + 0.5) / per_bin
        self._echo, first = self._pulse.taps(n_bins, self._acquisition.bin_width_s, delay)
        n_taps = self._echo.shape[1]
        # Bins that an echo at each bin covers, shape (tap, bin), with zeros beyond the gate.
        before, behind = max(-first, 0), max(first + n_taps - 1, 0)
        at = before + first + self._bins
        met_counts, met_unfired = (
            sliding_window_view(np.pad(each, (before, behind)), n_taps)[at].T
            for each in (self._counts, self._unfired)
        )
        unfired_echo = self._echo @ met_unfired
        # Adjacent bins without counts and with as many unfired pulses are equally likely.
        is_counted, differs = np.asarray(met_counts.any(axis=0)), np.full(at.size, True)
        differs[1:] = (np.diff(unfired_echo, axis=1) != 0).any(axis=0)
        differs[1:] |= is_counted[1:] | is_counted[:-1]
        self._group, some = np.cumsum(differs) - 1, np.flatnonzero(differs)
        self._size = np.diff(some, append=self._bins.size).astype(float)
        self._met_counts, self._unfired_echo = met_counts[:, some], unfired_echo[:, some]
        self._best = np.full(some.size, -np.inf)

    def __call__(self, signal: Floats, background: Floats) -> Floats:
        """Log likelihood, of the shape of both arguments."""
        s, b = signal.ravel(), np.maximum(background.ravel(), _LEAST_BACKGROUND) / self._counts.size
        top, mean = np.empty((2, s.size))
        self._best[:] = -np.inf
        at_once = max(1, _AT_ONCE // self._unfired_echo.size)
        for first in range(0, s.size, at_once):
            some = slice(first, first + at_once)
            ratio = self._ratio(s[some, np.newaxis, np.newaxis], b[some, np.newaxis, np.newaxis])
            np.maximum(self._best, ratio.max(axis=(0, 1)), out=self._best)
            top[some] = ratio.max(axis=(1, 2))
            ratio -= top[some, np.newaxis, np.newaxis]
            total = np.exp(ratio, out=ratio).sum(axis=1) @ self._size
            mean[some] = total / (self._counts.size * len(self._echo))
        return np.asarray((self._flat(b) + top + np.log(mean)).reshape(signal.shape))

    def _flat(self, b: Floats) -> Floats:
        """Log likelihood of ``b`` background photons per bin without an echo."""
        fires = b if self._n_pulses is None else -np.expm1(-b)
        return np.asarray(self._counts.sum() * np.log(fires) - self._unfired.sum() * b)

    def _ratio(self, signal: Floats, b: Floats) -> Floats:
        """Log likelihood ratio of an echo at each delay, shape (flux, step, bin)."""
        s = signal * self._echo
        if self._n_pulses is None:
            gain = np.log1p(s / b)
        else:
            gain = np.log1p(np.expm1(-s) * np.exp(-b) / np.expm1(-b))
        return np.asarray(gain @ self._met_counts - signal * self._unfired_echo)

    def exclude_delays(self) -> bool:
        """Exclude delays that are unlikely for all fluxes of the last call, and refine the rest.

        Return whether any were excluded.
        """
        likely = (self._best >= self._best.max() - _NEGLIGIBLE)[self._group]
        self._bins = self._bins[likely]
        steps = _STEPS_CLOSE if self._bins.size <= _FEW_BINS else len(self._echo)
        self._take_steps(steps)
        return not bool(likely.all())
