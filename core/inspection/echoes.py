"""Where the echoes of a capture lie, and the background in the bins that hold none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.faults import ordinary_pixels
from core.inference.flux import flux_prior_of
from core.inference.posterior import TOLERANCE_BINS, posterior_of
from core.inspection.maps import likeliest
from core.inspection.profile import LEVEL, FluxEstimate, difference_of, ratio_of
from core.metrics import Interval

CONFIDENT = 0.9
"""Confidence from which an estimate is taken for a surface, where there is no truth."""

FEWEST = 10
"""Confident estimates from which the delays of echoes are known."""

_FOUND = 0.5  # least share of the echoes that must be found to know where there are none
_FREE = 0.1  # least share of the gate without echoes
_BEFORE, _BEHIND = 1, 4  # lengths of an echo that may be longer than its pulse
_FEWEST_ARMED = 10  # pulses, for a rate
_WINDOWS = 10  # of the gate, of which the darkest bounds the background


class Echoes(NamedTuple):
    """Delays of confident estimates of the likelihood, in bins."""

    first: float
    last: float
    n_found: int


@cached_per_capture
def echoes_of(capture: Capture) -> Echoes | None:
    """Find the first and last delay; None if there are too few confident estimates.

    Leaves out as many estimates as are expected to be wrong, half of them at each end.
    """
    delay, probability = likeliest(capture)
    sure = probability >= CONFIDENT
    count = int(np.count_nonzero(sure))
    if count < FEWEST:
        return None
    found = np.sort(delay[sure])
    wrong = math.ceil(float((1 - probability[sure]).sum()) / 2)
    return Echoes(float(found[wrong]), float(found[-1 - wrong]), count)


@cached_per_capture
def echo_free_flux(capture: Capture) -> FluxEstimate | None:
    """Estimate mean fluxes with the background of the bins before and after all echoes.

    All photons above that background are signal. This does not depend on the shape of the pulse:
    margins allow for echoes that begin one length of the pulse early, or have a tail of four.

    Returns
    -------
    FluxEstimate or None
        Fluxes of the mean pixel without hot and dead pixels, and their 95 % intervals. None unless
        half of the echoes are found, a tenth of the gate is free of them, and pulses are left after
        it.
    """
    window, n_bins = _window(capture), capture.acquisition.n_bins
    if window is None:
        return None
    parts = _photons_between(capture, [0, *window, n_bins])
    if parts is None:
        return None
    free = 1 - float(_background_shares(capture, window)[0])
    return _flux_of(capture, parts[1], parts[0] + parts[2], free, LEVEL)


@cached_per_capture
def darkest_flux(capture: Capture) -> FluxEstimate | None:
    """Estimate mean fluxes as `echo_free_flux` does, with the background of the darkest window.

    The gate is divided into ten windows. Echoes only add photons, whatever their shape and number:
    with the background shape of the capture, the darkest window is an upper bound of it. The
    intervals hold for all ten windows together.

    Returns
    -------
    FluxEstimate or None
        None if the gate has fewer than ten bins, or pulses are not left after it.
    """
    n_bins = capture.acquisition.n_bins
    ends = np.linspace(0, n_bins, _WINDOWS + 1).astype(int)
    parts = _photons_between(capture, ends.tolist()) if n_bins >= _WINDOWS else None
    if parts is None:
        return None
    level, shares = 1 - (1 - LEVEL) / _WINDOWS, _background_shares(capture, ends)
    highest = [part.interval(level).high / share for part, share in zip(parts, shares, strict=True)]
    darkest = int(np.argmin(highest))
    rest = sum(parts[:darkest] + parts[darkest + 1 :], _Photons(0.0, 0.0, 0.0))
    return _flux_of(capture, rest, parts[darkest], float(shares[darkest]), level)


def _flux_of(
    capture: Capture, echoing: _Photons, rest: _Photons, free: float, level: float
) -> FluxEstimate:
    """Mean fluxes, from the photons of all pixels in bins with echoes and in a share without."""
    found, background = echoing.interval(level), rest.interval(level)
    signal = difference_of(found, background.scaled((1 - free) / free))
    ratio = ratio_of(found, background)
    sbr = Interval(*(max(free * each - (1 - free), 0.0) for each in astuple(ratio)))
    fluxes = FluxEstimate(signal, background.scaled(1 / free), sbr)
    return fluxes.scaled(1 / np.count_nonzero(ordinary_pixels(capture))).of(capture)


def total_flux(capture: Capture) -> Interval | None:
    """Estimate signal and background together, likewise.

    None if a mean pixel has too few pulses left. Pixels without any raise the total too little, but
    by less than is known of them.
    """
    parts = _photons_between(capture, [0, capture.acquisition.n_bins], np.mean)
    if parts is None:
        return None
    pulses = 1 if capture.gated_pulses else capture.acquisition.n_pulses or 1
    n_pixels = np.count_nonzero(ordinary_pixels(capture))
    return parts[0].interval(LEVEL).scaled(1 / (pulses * n_pixels))


def _window(capture: Capture) -> tuple[int, int] | None:
    """First bin and end of the window outside which there are no echoes, if that is known."""
    echoes, n_bins = echoes_of(capture), capture.acquisition.n_bins
    if echoes is None or echoes.n_found < _FOUND * posterior_of(capture).surface.sum():
        return None
    echo, tap = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s, 0.5)
    first = math.floor(echoes.first) + min(tap, 0) - TOLERANCE_BINS - _BEFORE * echo.size
    end = math.ceil(echoes.last) + max(tap, 0) + TOLERANCE_BINS + _BEHIND * echo.size
    first, end = max(first, 0), min(end, n_bins)
    return (first, end) if end - first <= (1 - _FREE) * n_bins else None


def _background_shares(capture: Capture, ends: ArrayLike) -> Floats:
    """Share of the background between successive bins."""
    upto = np.pad(np.cumsum(flux_prior_of(capture).relative_background), (1, 0))
    return np.asarray(np.diff(upto[np.asarray(ends)]) / capture.acquisition.n_bins)


class _Photons(NamedTuple):
    """Sum of weighted counts."""

    total: float
    variance: float
    largest: float
    """Largest weight of a count."""

    def __add__(self, other: _Photons) -> _Photons:  # type: ignore[override]
        total, variance = self.total + other.total, self.variance + other.variance
        return _Photons(total, variance, max(self.largest, other.largest))

    def interval(self, level: float) -> Interval:
        """Gamma interval of Fay & Feuer (1997); for equal weights that of Garwood (1936)."""
        total, tail = max(self.total, 0.0), 0.5 - level / 2
        more, wider = total + self.largest, self.variance + self.largest**2
        low, high = (
            float(scipy.special.gammaincinv(mean**2 / variance, share)) * variance / mean
            if mean > 0
            else 0.0
            for mean, variance, share in ((total, self.variance, tail), (more, wider, 1 - tail))
        )
        return Interval(total, low, high)


def _photons_between(
    capture: Capture, ends: Sequence[int], of_pixels: Callable[..., np.number] = np.min
) -> list[_Photons] | None:
    """Photons of the ordinary pixels between successive bins; None if too few pulses are left.

    `of_pixels` says in which: `numpy.min` in any pixel, `numpy.mean` in the mean one.
    """
    kept, n_pulses = capture.cube[ordinary_pixels(capture)], capture.gated_pulses
    counts = np.stack(
        [kept[:, first:end].sum(axis=1, dtype=np.int64) for first, end in pairwise(ends)]
    )
    if n_pulses is None:
        return [_Photons(float(each.sum()), float(each.sum()), 1.0) for each in counts]
    left = n_pulses - np.cumsum(counts, axis=0)
    if of_pixels(left, axis=1).min() < _FEWEST_ARMED:
        return None
    return list(map(_fired, left + counts, left))


def _fired(armed: NDArray[np.int64], left: NDArray[np.int64]) -> _Photons:
    """Photons per pulse of all pixels (pixel,) while pulses fired (Coates 1968).

    With the variance of Greenwood (1926). Half a pulse more on either side removes most of the bias
    of the logarithm (Anscombe 1956).
    """
    before, after = armed + 0.5, left + 0.5
    variance = 1 / after - 1 / before
    rate = np.log(before / after)
    return _Photons(float(rate.sum()), float(variance.sum()), 1 / float(after.min()))
