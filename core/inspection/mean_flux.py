"""How much signal and background the pixels of a capture see on average, and how well it is known.

Pixels differ: some see no echo, others a brighter one. Of a sample of them a share is taken to see
an echo, whose signal is gamma distributed; neither the share nor the shape of that distribution is
known. What each pixel tells of its own signal, all its delays being alike, adds up to a likelihood
of the mean signal and the mean background alone, the share and the shape being those that make each
most likely: profile likelihood intervals, as of a single pixel (`core.inspection.flux`).

At a given mean a gamma distribution's most likely one has the mean of what is seen, whatever the
pixels' true distribution: where signals are clear it need not be one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.faults import standing_out
from core.inference.flux import detailed_flux_prior_of, level_likelihoods, total_rates
from core.inspection.flux import estimate_flux
from core.inspection.profile import LEVEL, Box, FluxEstimate, spans, zoomed
from core.metrics import Interval
from core.reductions import share_of_pulses

METHOD = (
    "95 % profile likelihood intervals; signals of the pixels that see an echo are taken for "
    "gamma distributed"
)

_SAMPLE = 512  # pixels
_FEW = 24  # pixels, of which the scatter of the signals is not told
_DARK = 30  # photons in all, that tell next to nothing
_BRIGHT = 400  # photons of the brightest echo: more tell nothing more of the mean
_COARSE, _FINE = (5, 9), (7, 15)


@cached_per_capture
def estimate_mean_flux(capture: Capture) -> FluxEstimate:
    """Mean signal and background of all pixels, and their ratio, with 95 % intervals.

    In photons per pulse where the pulses are known, else in photons. Pixels without an echo count,
    as ones of no signal; hot and dead ones do not. Fewer than 24 pixels are taken to see the same
    light.
    """
    capture = _ordinary(capture)
    n_pixels, acquisition, pulse = capture.shape[1], capture.acquisition, capture.pulse
    if n_pixels < _FEW:
        found = estimate_flux(
            capture.cube[0].astype(float), acquisition, pulse, capture.gated_pulses
        )
        return found.of(capture)
    if 2 * capture.echo_bins >= acquisition.n_bins or capture.counts.sum() < _DARK:
        return _untold(capture).of(capture)
    some, share = _dimmer(capture)
    surface = _Mixture(some)
    box = zoomed(surface.box, surface, _COARSE)
    # What of an echo lies behind the bins that are looked at is not the background's.
    echo, _ = pulse.taps(acquisition.n_bins, acquisition.bin_width_s)
    missed = max(1 - float(echo.sum()), 0.0)

    def flux_at(log_background: Floats, root_signal: Floats) -> tuple[Floats, Floats]:
        background, signal = np.meshgrid(np.exp(log_background), root_signal**2, indexing="ij")
        background = np.maximum(background - missed * signal, 0.0)
        if box.low[0] == box.least[0]:
            background[0] = 0.0
        if box.high[0] == box.most[0]:
            background[-1] = np.inf
        return signal, background

    found = spans(box, surface(*box.grid(_FINE)), flux_at).of(some)
    return found if acquisition.n_pulses else found.scaled(1 / share)


def _ordinary(capture: Capture) -> Capture:
    """The pixels that are neither hot nor dead, in one row; all of them where none is ordinary."""
    faulty = standing_out(capture)
    kept = np.ones(capture.shape, bool) if faulty is None else ~(faulty.hot | faulty.dead)
    if not kept.any():
        kept[:] = True
    cube = capture.cube[kept][np.newaxis]
    return replace(capture, cube=cube, truth_range_m=None, signal=None, flux_prior=None)


def _untold(capture: Capture) -> FluxEstimate:
    """Of a gate that an echo fills, or of next to no photons: all may be signal, or background.

    The total's interval is the exact one of a binomial share (Clopper & Pearson 1934) of all pulses
    together or, of photons, of a Poisson mean (Garwood 1936).
    """
    n_pixels, n_pulses, seen = capture.counts.size, capture.gated_pulses, int(capture.counts.sum())
    tail = 0.5 - LEVEL / 2
    if n_pulses is None:
        total = seen / n_pixels
        high = float(scipy.special.gammaincinv(seen + 1, 1 - tail)) / n_pixels
    else:
        unfired = n_pulses * n_pixels - seen
        total = math.log(n_pulses * n_pixels / max(unfired, 0.5))
        least = float(scipy.special.betaincinv(unfired, seen + 1, tail)) if unfired else 0.0
        high = -math.log(least) if least > 0 else math.inf
    sbr = Interval(0.0 if seen else math.nan, 0.0, math.inf)
    return FluxEstimate(Interval(0.0, 0.0, high), Interval(total, 0.0, high), sbr)


def _dimmer(capture: Capture) -> tuple[Capture, float]:
    """The capture with a share of its pulses, where echoes are brighter than a mean requires."""
    strongest = float(detailed_flux_prior_of(capture).levels[-1])
    share = _BRIGHT / max(strongest * (capture.gated_pulses or 1), _BRIGHT)
    return (share_of_pulses(capture, share), share) if share < 1 else (capture, 1.0)


class _Mixture:
    """The likelihood of mean background and mean signal, from the pixels of a sample."""

    def __init__(self, capture: Capture) -> None:
        known = detailed_flux_prior_of(capture)
        total, n_pulses = total_rates(capture), capture.gated_pulses or 1
        self._capture, self._known, acquisition = capture, known, capture.acquisition
        self._pixels = np.random.default_rng(0).permutation(total.size)[:_SAMPLE]
        top = 2 * float(known.levels[-1])
        count = int(np.clip(math.ceil(2 * math.sqrt(top * n_pulses)), 12, 40))
        self._levels = np.linspace(0.0, math.sqrt(top), count + 1) ** 2
        signal = max(float(known.share @ known.levels), top / 1e3)
        background = max(float(total.mean()) - signal, 0.5 / n_pulses)
        chance = math.sqrt(float(total.mean()) / n_pulses / self._pixels.size)
        half = min(4 * chance / background, 1.0)
        self.box = Box(
            low=(math.log(background) - half, 0.6 * math.sqrt(signal)),
            high=(math.log(background) + half, 1.3 * math.sqrt(signal)),
            least=(math.log(1e-4 / n_pulses / self._pixels.size), 0.0),  # beyond: none, or any
            most=(math.log(1000 * (background + top + acquisition.n_bins)), math.sqrt(top)),
        )
        self._know(self.box.low[0], self.box.high[0])

    def _know(self, low: float, high: float) -> None:
        """Find what the pixels tell of each level at some backgrounds, given as logarithms."""
        self._nodes = np.linspace(low, high, _NODES)
        self._logs = np.stack([self._log_likelihoods(math.exp(each)) for each in self._nodes])

    def _log_likelihoods(self, background: float) -> Floats:
        """Of each level, shape (pixel, level)."""
        flux_prior = self._known._replace(
            levels=self._levels,
            share=np.full(self._levels.size, 1 / self._levels.size),
            background=np.asarray(background),
        )
        return level_likelihoods(self._capture, self._pixels, flux_prior, _STEPS)

    def __call__(self, log_background: Floats, root_signal: Floats) -> Floats:
        """Log likelihood, shape (background, signal)."""
        if log_background[0] < self._nodes[0] or log_background[-1] > self._nodes[-1]:
            self._know(log_background[0], log_background[-1])
        return np.stack([self._of_signals(each, root_signal**2) for each in log_background])

    def _of_signals(self, log_background: float, signal: Floats) -> Floats:
        log = np.tensordot(_lagrange(self._nodes, log_background), self._logs, axes=1)
        top = log.max(axis=1, keepdims=True)
        # A few pixels at a time: for larger products threads are started, that wait for each other.
        parts = np.array_split(np.exp(log - top), math.ceil(len(log) / _PIXELS_AT_ONCE))

        def fit(share: Floats, shape: Floats) -> Floats:
            weights = _gamma_weights(self._levels, signal, share, shape)
            tried = np.swapaxes(weights.reshape(signal.size, -1, self._levels.size), 1, 2)
            found = sum(np.log(np.maximum(part @ tried, 1e-300)).sum(axis=1) for part in parts)
            return np.asarray(found).reshape(weights.shape[:-1])

        least_share = np.clip(signal / self._levels[-1], _LEAST_SHARE, 1.0)
        return np.asarray(_largest(fit, least_share) + top.sum())


_NODES = 4
_PIXELS_AT_ONCE = 128
_LEAST_SHARE = 1e-6  # of pixels that see an echo
_STEPS = 2  # delays in a bin
_SHAPES = (0.3, 3000.0)  # of gamma distributions, from most pixels faint to all alike
_TRIED, _ZOOMS = 5, 7


def _lagrange(nodes: Floats, x: float) -> Floats:
    """Weights of the values at the nodes in the polynomial through them, at `x`."""
    apart = nodes[:, np.newaxis] - nodes
    np.fill_diagonal(apart, 1.0)
    off = np.tile(x - nodes, (nodes.size, 1))
    np.fill_diagonal(off, 1.0)
    return np.asarray((off / apart).prod(axis=1))


def _largest(fit: Callable[[Floats, Floats], Floats], least_share: Floats) -> Floats:
    """Largest of a function of share and shape, shape (signal,), for each on its own.

    The function takes shares (signal, share, 1) and shapes (signal, 1, shape).
    """
    every, steps = np.arange(least_share.size), np.linspace(0.0, 1.0, _TRIED)
    lowest = np.stack([np.sqrt(least_share), np.full(every.size, math.log(_SHAPES[0]))])
    highest = np.stack([np.ones(every.size), np.full(every.size, math.log(_SHAPES[1]))])
    low, high, best = lowest, highest, np.full(every.size, -np.inf)
    for _ in range(_ZOOMS):
        root, log = low[..., np.newaxis] + (high - low)[..., np.newaxis] * steps
        found = fit((root**2)[:, :, np.newaxis], np.exp(log)[:, np.newaxis, :])
        flat = found.reshape(every.size, -1)
        at, best = flat.argmax(axis=1), np.maximum(best, flat.max(axis=1))
        centre = np.stack([root[every, at // _TRIED], log[every, at % _TRIED]])
        quarter = (high - low) / 4
        low, high = np.maximum(centre - quarter, lowest), np.minimum(centre + quarter, highest)
    return best


def _gamma_weights(levels: Floats, mean: Floats, share: Floats, shape: Floats) -> Floats:
    """Share of the pixels at each level, (signal, share, shape, level), of a given mean each.

    A share of gamma distributed signals, split between the two levels around each so that the mean
    stays, and the rest at none.
    """
    bright = mean[:, np.newaxis, np.newaxis] / share  # mean of those that see an echo
    x = levels * (shape / np.maximum(bright, 1e-12 * levels[-1]))[..., np.newaxis]
    k = np.broadcast_to(shape[..., np.newaxis], x.shape)
    below = scipy.special.gammainc(k, x)  # share of the signals below each level
    at_level = np.exp(scipy.special.xlogy(k, x) - x - scipy.special.gammaln(k + 1))
    moment = (below - at_level) * bright[..., np.newaxis]
    mass = np.diff(below)
    upper = (np.diff(moment) - mass * levels[:-1]) / np.diff(levels)
    weights = np.zeros_like(x)
    weights[..., 1:] += upper
    weights[..., :-1] += mass - upper
    weights[..., -1] += 1 - below[..., -1]
    weights *= share[..., np.newaxis]
    weights[..., 0] += 1 - share
    return np.asarray(np.maximum(weights, 0.0))
