"""Mean signal and background of the pixels of a capture, with intervals.

Pixels differ: some have no echo, others a stronger one. In a sample of pixels, an unknown share has
an echo, with a gamma distributed signal of unknown shape. The likelihoods of the pixels, averaged
over uniform delays, give a likelihood of mean signal and mean background, maximised over share and
shape, and profile likelihood intervals as for a single pixel (`core.inspection.flux`).

The maximum-likelihood gamma distribution has the mean of the observed signals, whatever their
true distribution, so that the model need not be exact where signals are clear.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.faults import outlier_pixels
from core.inference.flux import detailed_flux_prior_of, level_likelihoods, total_rates
from core.inspection.flux import estimate_flux
from core.inspection.profile import LEVEL, Box, FluxEstimate, spans, zoomed
from core.metrics import Interval
from core.reductions import share_of_pulses

METHOD = (
    "95 % profile likelihood intervals; signals of pixels with an echo are modelled as gamma "
    "distributed"
)

_SAMPLE = 512  # pixels
_FEW = 24  # pixels, too few to estimate the scatter of the signals
_DARK = 30  # photons in all, too few to separate signal and background
_BRIGHT = 400  # photons of the brightest echo, enough for the mean
_COARSE, _FINE = (5, 9), (7, 15)


@cached_per_capture
def estimate_mean_flux(capture: Capture) -> FluxEstimate:
    """Estimate mean signal and background of all pixels, and their ratio, with 95 % intervals.

    In photons per pulse if the number of pulses is known, otherwise in photons. Pixels without an
    echo count as having no signal; hot and dead ones are left out. Fewer than 24 pixels are assumed
    to have the same fluxes.
    """
    capture = _ordinary(capture)
    n_pixels, acquisition, pulse = capture.shape[1], capture.acquisition, capture.pulse
    if n_pixels < _FEW:
        found = estimate_flux(
            capture.cube[0].astype(float), acquisition, pulse, capture.gated_pulses
        )
        return found.of(capture)
    if 2 * capture.echo_bins >= acquisition.n_bins or capture.counts.sum() < _DARK:
        return _unresolved(capture).of(capture)
    some, share = _dimmer(capture)
    surface = _Mixture(some)
    box = zoomed(surface.box, surface, _COARSE)
    # The tail of an echo beyond its taps is not background.
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
    """Return the pixels that are neither hot nor dead, in one row; all if there are none."""
    faulty = outlier_pixels(capture)
    kept = np.ones(capture.shape, bool) if faulty is None else ~(faulty.hot | faulty.dead)
    if not kept.any():
        kept[:] = True
    return selected_pixels(capture, kept)


def selected_pixels(capture: Capture, mask: NDArray[np.bool_]) -> Capture:
    """Return the pixels of a mask (row, col) in one row, without truth and flux prior."""
    cube = capture.cube[mask][np.newaxis]
    return replace(capture, cube=cube, truth_range_m=None, signal=None, flux_prior=None)


def _unresolved(capture: Capture) -> FluxEstimate:
    """Estimate fluxes that cannot be separated: all photons may be signal, or background.

    The interval of the total is the exact one of a binomial share of all pulses (Clopper & Pearson
    1934) or of a Poisson mean (Garwood 1936).
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
    """Reduce the pulses of a capture whose echoes are brighter than the mean requires."""
    strongest = float(detailed_flux_prior_of(capture).levels[-1])
    share = _BRIGHT / max(strongest * (capture.gated_pulses or 1), _BRIGHT)
    return (share_of_pulses(capture, share), share) if share < 1 else (capture, 1.0)


class _Mixture:
    """Likelihood of mean background and mean signal, from a sample of the pixels."""

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
            least=(math.log(1e-4 / n_pulses / self._pixels.size), 0.0),  # beyond: no bound
            most=(math.log(1000 * (background + top + acquisition.n_bins)), math.sqrt(top)),
        )
        self._tabulate(self.box.low[0], self.box.high[0])

    def _tabulate(self, low: float, high: float) -> None:
        """Tabulate log likelihoods of the levels between two backgrounds (as logarithms)."""
        self._nodes = np.linspace(low, high, _NODES)
        self._logs = np.stack([self._log_likelihoods(math.exp(each)) for each in self._nodes])

    def _log_likelihoods(self, background: float) -> Floats:
        """Log likelihood of each level, shape (pixel, level)."""
        flux_prior = self._known._replace(
            levels=self._levels,
            share=np.full(self._levels.size, 1 / self._levels.size),
            background=np.asarray(background),
        )
        return level_likelihoods(self._capture, self._pixels, flux_prior, _STEPS)

    def __call__(self, log_background: Floats, root_signal: Floats) -> Floats:
        """Log likelihood, shape (background, signal)."""
        if log_background[0] < self._nodes[0] or log_background[-1] > self._nodes[-1]:
            self._tabulate(log_background[0], log_background[-1])
        return np.stack([self._of_signals(each, root_signal**2) for each in log_background])

    def _of_signals(self, log_background: float, signal: Floats) -> Floats:
        log = np.tensordot(_lagrange(self._nodes, log_background), self._logs, axes=1)
        top = log.max(axis=1, keepdims=True)
        # A few pixels at a time: larger products start threads, which take longer.
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
_LEAST_SHARE = 1e-6  # of pixels with an echo
_STEPS = 2  # delays per bin
_SHAPES = (0.3, 3000.0)  # of gamma distributions, from mostly faint pixels to equal ones
_TRIED, _ZOOMS = 5, 7


def _lagrange(nodes: Floats, x: float) -> Floats:
    """Weights of the nodes in the interpolating polynomial at `x`."""
    apart = nodes[:, np.newaxis] - nodes
    np.fill_diagonal(apart, 1.0)
    off = np.tile(x - nodes, (nodes.size, 1))
    np.fill_diagonal(off, 1.0)
    return np.asarray((off / apart).prod(axis=1))


def _largest(fit: Callable[[Floats, Floats], Floats], least_share: Floats) -> Floats:
    """Maximise a function over share and shape for each signal, shape (signal,).

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
    """Share of the pixels at each level, (signal, share, shape, level), with given means.

    A share of gamma distributed signals, each split between its two adjacent levels so that the
    mean is preserved; the rest has no signal.
    """
    bright = mean[:, np.newaxis, np.newaxis] / share  # mean of pixels with an echo
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
