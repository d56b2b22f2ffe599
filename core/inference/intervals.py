"""Intervals of the range of a surface, from the photons of its pixel.

Given that a surface lies within `interval_tolerance_bins` of an estimate, its delay ``d`` has the
posterior density ::

    p(d) ∝ Σ_l share_l L_l(d)

over the signal levels ``l`` of `core.inference.flux`, with the likelihood ``L_l`` of the whole
histogram (`core.inference.likelihood`). Delays near the estimate are as likely before: how the
delays of the image are distributed is learned from the same photons, and would count those of the
pixel twice. The levels are a grid, whose errors would bias intervals of
many photons: signal and background of each are fitted to the pixel. What the fit leaves uncertain
makes the delay uncertain, too: the density is raised to the power ``1 / ψ``, where ψ is the
variance of the delay with unknown fluxes over that with known ones, by the Fisher information. The
interval is about the surface and not about the method: it is the same for all estimates with the
same window.

Where surfaces move while the pulses are sent, and the image has their velocity and the capture
groups of its pulses, the likelihood is that of the groups, each at the range that the surface has
reached at the estimated velocity, with the fluxes at that velocity. Its error hardly matters: the
range is that in the middle of the recording.

Where the counts near the echo differ from the model by more than chance (another pulse, a second
surface), the density is raised to the power ``1 / φ``, with the dispersion φ of these counts
(quasi-likelihood, McCullagh & Nelder 1989): many photons do not make up for a model that is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats, Pulse
from core.capture import Capture, cached_per_capture
from core.checks import require, require_pixel
from core.inference.flux import LEVEL_SPAN, LEVELS, flux_model_of
from core.inference.flux_model import FluxModel
from core.inference.motion import RadialVelocity, flux_at_rest
from core.inference.posterior import TOLERANCE_BINS
from core.metrics import Interval
from core.pulse_groups import PulseGroups

if TYPE_CHECKING:
    from core.estimators import RangeImage

_COARSE_NODES = 25  # a quarter of a bin apart over `TOLERANCE_BINS`
_HALF_PULSE = 2.0  # standard deviations of a pulse, of which its length is twice as many
_PHASES = 4  # parts of a bin to which displacements are rounded, evenly to either side
_NODES = 64  # delays at which the density is evaluated
_DROP = 12.0  # log density below the maximum, at which a delay is negligible
_MOST_ZOOMS = 12
_LEVEL_ERROR = LEVEL_SPAN ** (0.5 / (LEVELS - 1)) - 1  # relative, of half a step between levels
_FITTING_STEPS = 5
_LEAST_KNOWN = 0.1  # of the information on a delay; less would be left by rounding
_N_FITTED = 3  # delay, signal and background
_CLEAR_DEVIATIONS = 5.0  # of the dispersion of the counts, beyond which it is hardly chance
_TAIL = 1e-6  # share of the photons of an echo that is left out on either side
_AT_ONCE = 2**17  # numbers that fit in the cache


class RangeInterval(NamedTuple):
    """Limits of the range of each pixel in metres, shape (row, col), NaN without an estimate."""

    low_m: Floats
    high_m: Floats


def range_interval(capture: Capture, image: RangeImage, level: float = 0.95) -> RangeInterval:
    """Compute the central posterior interval of the range of each pixel, see `range_intervals`."""
    return range_intervals(capture, image, (level,))[0]


def range_intervals(
    capture: Capture, image: RangeImage, levels: Sequence[float] = (0.68, 0.95)
) -> tuple[RangeInterval, ...]:
    """Compute central posterior intervals of the range of each pixel, together for all levels.

    They are calibrated: of the estimates within `interval_tolerance_bins` of the surface, a share
    of each level have an interval that contains the range of the surface. Whether a surface is
    there is what `RangeImage.confidence` says. Echoes that fire nearly every pulse, of more than
    about four photons per pulse, hide their flux: their intervals are too narrow. So are those of
    surfaces that move, unless the image has their velocity, from the method `velocity`, and this is
    right: otherwise they are computed as if the surfaces were at rest.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        Estimate of the capture by any method.
    levels : sequence of float
        Probability of each interval.

    Raises
    ------
    ValueError
        If a level is not between 0 and 1, or the shapes differ.
    """
    shape = image.bin.shape
    require("image", f"shape {shape}", shape == capture.shape, f"shape {capture.shape}")
    tails = _all_tails(levels)
    limits = np.full((tails.size, capture.counts.size), np.nan)
    pixels = np.flatnonzero(image.valid)
    moved = _moving(capture, image.velocity)
    n_phases = 1 if moved is None else _PHASES
    n_bins = max(_NODES * n_phases * _n_window_bins(capture), capture.acquisition.n_bins)
    at_once = max(1, _AT_ONCE // n_bins)
    for first in range(0, pixels.size, at_once):
        some = pixels[first : first + at_once]
        limits[:, some] = _quantiles_bins(capture, some, image.bin.ravel()[some], tails, moved)
    limits_m = capture.acquisition.bin_to_range_m(limits.reshape(-1, 2, *shape))
    return tuple(RangeInterval(*each) for each in limits_m)


def pixel_range_intervals(
    capture: Capture,
    image: RangeImage,
    row: int,
    col: int,
    levels: Sequence[float] = (0.68, 0.95),
) -> tuple[Interval, ...]:
    """Return the `range_interval` of one pixel for each level, without a pass over the image.

    Returns
    -------
    tuple of Interval
        The estimate and its limits in metres; NaN without an estimate.

    Raises
    ------
    ValueError
        If there is no such pixel, or a level is not between 0 and 1.
    """
    require_pixel(row, col, capture.shape)
    estimate_m = float(image.range_m[row, col])
    tails = _all_tails(levels)
    limits_m = np.full(tails.size, np.nan)
    if image.valid[row, col]:
        at_bin, moved = float(image.bin[row, col]), _moving(capture, image.velocity)
        limits = _limits_bins(capture, row, col, at_bin, tuple(tails), moved)
        limits_m = capture.acquisition.bin_to_range_m(limits)
    return tuple(Interval(estimate_m, *each) for each in limits_m.reshape(-1, 2).tolist())


@cached_per_capture
def _limits_bins(
    capture: Capture,
    row: int,
    col: int,
    estimate_bin: float,
    shares: tuple[float, ...],
    moved: RadialVelocity | None,
) -> Floats:
    """Quantiles (share,) of the delay of a pixel near an estimate, which few settings move."""
    pixel = np.array([row * capture.shape[1] + col])
    at_bin = np.array([estimate_bin])
    return _quantiles_bins(capture, pixel, at_bin, np.array(shares), moved)[:, 0]


def delay_range_interval(
    capture: Capture, image: RangeImage, row: int, col: int, delay_bins: Floats, level: float = 0.95
) -> RangeInterval:
    """Return the interval of a surface near each of some delays (delay,) of a pixel, in metres."""
    pixels = np.full(delay_bins.size, row * capture.shape[1] + col)
    moved = _moving(capture, image.velocity)
    limits = _quantiles_bins(capture, pixels, delay_bins, _all_tails([level]), moved)
    return RangeInterval(*capture.acquisition.bin_to_range_m(limits))


def _all_tails(levels: Sequence[float]) -> Floats:
    """Probabilities below the lower and the upper limit of each central interval in turn."""
    for level in levels:
        require("level", level, 0 < level < 1, "between 0 and 1")
    return np.array([tail for level in levels for tail in ((1 - level) / 2, (1 + level) / 2)])


def interval_tolerance_bins(capture: Capture) -> int:
    """Distance from an estimate in bins at which its interval is cut: that of a right estimate.

    It is `TOLERANCE_BINS`, or half the length of a pulse that is longer.
    """
    acquisition = capture.acquisition
    half_pulse = math.ceil(_HALF_PULSE * capture.pulse.sigma_s / acquisition.bin_width_s)
    return max(TOLERANCE_BINS, min(half_pulse, acquisition.n_bins))


def _moving(capture: Capture, velocity: RadialVelocity | None) -> RadialVelocity | None:
    """Return the velocity of the surfaces if some move and the order of the pulses is known."""
    if velocity is None or capture.groups is None or not velocity.bins.any():
        return None
    return velocity


def _travel_bins(groups: PulseGroups, velocity: RadialVelocity) -> Floats:
    """Displacement of each pixel over the recording, shape (row, col)."""
    return np.asarray(velocity.bins * (sum(groups.n_pulses) / 1000))


@cached_per_capture
def _flux_of_moving(capture: Capture, velocity: RadialVelocity) -> FluxModel:
    groups = capture.groups
    assert groups is not None
    return flux_at_rest(capture, groups, _travel_bins(groups, velocity))


def _quantiles_bins(
    capture: Capture,
    pixels: NDArray[np.intp],
    estimate_bin: Floats,
    shares: Floats,
    moved: RadialVelocity | None,
) -> Floats:
    """Quantiles of the delay of some pixels, given as flat indices, shape (share, pixel)."""
    n_bins, tolerance_bins = capture.acquisition.n_bins, interval_tolerance_bins(capture)
    low = np.clip(estimate_bin - tolerance_bins, 0.0, n_bins)
    high = np.clip(estimate_bin + tolerance_bins, 0.0, n_bins)
    window = _window(capture, pixels, estimate_bin, moved)
    delay = _nodes(low, high, _COARSE_NODES)
    best = np.argmax(_log_density(window, delay), axis=1)[:, np.newaxis]
    at = np.take_along_axis(delay, best, axis=1)
    share = _share(window, at)
    window = _fitted(window, share)
    widening = _flux_widening(window, at, share)
    delay, density = _zoomed(window, low, high, widening)
    best = np.argmax(density, axis=1)[:, np.newaxis]
    dispersion = _dispersion(window, np.take_along_axis(delay, best, axis=1))
    wide = dispersion[:, 0] > 1
    if wide.any():
        more = widening[wide] * dispersion[wide]
        delay[wide], density[wide] = _zoomed(window.some(wide), low[wide], high[wide], more)
    # Cumulative density by trapezoids, relative to the whole: the steps of a pixel are equal.
    mass = np.zeros_like(density)
    np.cumsum((density[:, 1:] + density[:, :-1]) / 2, axis=1, out=mass[:, 1:])
    mass /= mass[:, -1:]
    return np.stack([_inverse(mass, delay, share) for share in shares])


def _inverse(mass: Floats, delay: Floats, share: float) -> Floats:
    """Delay (pixel,) at which the increasing `mass` (pixel, node) is `share`."""
    above = np.argmax(mass >= share, axis=1)[:, np.newaxis]
    ends = np.concatenate([above - 1, above], axis=1)
    (m0, m1), (d0, d1) = (np.take_along_axis(x, ends, axis=1).T for x in (mass, delay))
    return np.asarray(d0 + (d1 - d0) * (share - m0) / (m1 - m0))


class _Window(NamedTuple):
    """Counts and fluxes of some pixels in the bins that an echo near their estimates can fill.

    Groups of pulses are displaced to where the surface is in the middle of the recording, by whole
    bins; those of each phase, the part of a bin that remains, are added up. The rest of the gate is
    added up in one further bin, in which there is no echo, and pulses count by the background that
    they meet, relative to that of the window.
    """

    pulse: Pulse
    bin_width_s: float
    edges: Floats
    """Edges of the bins, shape (pixel, phase, edge)."""
    fired: Floats
    """Counts, shape (pixel, bin), of one phase after the other; 0 outside the gate."""
    unfired: Floats
    """Pulses that did not fire by the end of the bin, likewise; for all photons 1 a bin."""
    is_first: bool
    """Whether only the first photon of a pulse is detected."""
    signal: Floats
    """Shape (level, pixel), without the level "no echo"."""
    background: Floats
    """Per bin, likewise."""
    log_weight: Floats
    """Logarithm of the prior probability of the level, likewise."""
    n_bins: int
    """Bins of the gate."""

    def some(self, pixels: NDArray[np.bool_]) -> _Window:
        """Return the window of some pixels."""
        return self._replace(
            edges=self.edges[pixels],
            fired=self.fired[pixels],
            unfired=self.unfired[pixels],
            signal=self.signal[:, pixels],
            background=self.background[:, pixels],
            log_weight=self.log_weight[:, pixels],
        )


def _n_window_bins(capture: Capture) -> int:
    first, end = _echo_bins(capture)
    return end - first + 2 * interval_tolerance_bins(capture) + 1


def _echo_bins(capture: Capture) -> tuple[int, int]:
    """First and last edge of the bins that an echo fills, relative to its delay, in the gate."""
    n_bins, width_s = capture.acquisition.n_bins, capture.acquisition.bin_width_s
    first, end = (capture.pulse.quantile_s(share) / width_s for share in (_TAIL, 1 - _TAIL))
    return math.floor(max(first, -n_bins)), math.ceil(min(end, n_bins))


class _Counted(NamedTuple):
    """Pulses of some pixels that are counted together."""

    counts: Floats
    """Shape (pixel, bin)."""
    unfired: Floats
    """Likewise, as `_Window.unfired`."""
    moved_bins: NDArray[np.intp]
    """Whole bins by which the surface is displaced, shape (pixel,)."""
    phase: NDArray[np.intp]
    """Remaining phase, likewise."""


def _at_rest(capture: Capture, pixels: NDArray[np.intp]) -> Iterator[_Counted]:
    """Yield all pulses together."""
    counts = capture.cube.reshape(-1, capture.cube.shape[2])[pixels].astype(float)
    n_pulses, none = capture.gated_pulses, np.zeros(pixels.size, np.intp)
    unfired = np.ones_like(counts) if n_pulses is None else n_pulses - np.cumsum(counts, axis=1)
    yield _Counted(counts, unfired, none, none)


def _in_groups(
    capture: Capture, pixels: NDArray[np.intp], moved: RadialVelocity
) -> Iterator[_Counted]:
    """Yield the groups of pulses."""
    groups = capture.groups
    assert groups is not None
    travel_bins = _travel_bins(groups, moved).ravel()[pixels]
    total = sum(groups.n_pulses)
    for cube, sent, middle in zip(groups.counts, groups.n_pulses, groups.middle, strict=True):
        counts = cube.reshape(-1, cube.shape[2])[pixels].astype(float)
        if capture.gated_pulses is None:
            unfired = np.full_like(counts, sent / total)
        else:
            unfired = sent - np.cumsum(counts, axis=1)
        steps = np.rint(middle * travel_bins * _PHASES).astype(np.intp)
        yield _Counted(counts, unfired, *np.divmod(steps, _PHASES))


def _window(
    capture: Capture,
    pixels: NDArray[np.intp],
    estimate_bin: Floats,
    moved: RadialVelocity | None,
) -> _Window:
    if moved is None:
        n_phases, flux, parts = 1, flux_model_of(capture), _at_rest(capture, pixels)
    else:
        n_phases, flux = _PHASES, _flux_of_moving(capture, moved)
        parts = _in_groups(capture, pixels, moved)
    n_bins = capture.cube.shape[2]
    signal, background = (x.reshape(len(x), -1)[1:, pixels] for x in (flux.signal, flux.background))
    first = np.floor(estimate_bin).astype(np.intp) - interval_tolerance_bins(capture)
    first += _echo_bins(capture)[0]
    n_window_bins = _n_window_bins(capture) + (n_phases > 1)
    bins = first[:, np.newaxis] + np.arange(n_window_bins)
    # A window is short: its background is that at the estimate.
    at = np.clip(estimate_bin, 0, n_bins - 1).astype(np.intp)
    here = flux.relative_background[at]
    weight = flux.relative_background / here[:, np.newaxis]
    each = np.arange(pixels.size)
    found = np.zeros((2, pixels.size, n_phases, n_window_bins))
    rest = np.zeros((2, pixels.size))
    for part in parts:
        met = bins + part.moved_bins[:, np.newaxis]
        inside = (met >= 0) & (met < n_bins)
        some = each[:, np.newaxis], np.clip(met, 0, n_bins - 1)
        for i, (values, beyond) in enumerate(
            ((part.counts, part.counts), (part.unfired, part.unfired * weight))
        ):
            found[i, each, part.phase] += np.where(inside, values[some], 0.0)
            rest[i] += beyond.sum(axis=1) - np.where(inside, beyond[some], 0.0).sum(axis=1)
    fired, unfired = np.concatenate(
        [found.reshape(2, pixels.size, -1), rest[..., np.newaxis]], axis=2
    )
    log_share = np.log(np.maximum(flux.share[1:, np.newaxis], np.finfo(float).tiny))
    edges = np.concatenate([bins, bins[:, -1:] + 1], axis=1).astype(float)
    return _Window(
        capture.pulse,
        capture.acquisition.bin_width_s,
        edges[:, np.newaxis] - np.arange(n_phases)[:, np.newaxis] / n_phases,
        fired,
        unfired,
        capture.gated_pulses is not None,
        signal,
        background / n_bins * here,
        np.broadcast_to(log_share, signal.shape),
        n_bins,
    )


def _share(window: _Window, delay: Floats) -> Floats:
    """Share of an echo's photons in each bin (pixel, node, bin), at delays (pixel, node)."""
    until = window.edges[:, np.newaxis] - delay[..., np.newaxis, np.newaxis]
    until *= window.bin_width_s
    share = np.zeros((*delay.shape, window.fired.shape[1]))
    share[..., :-1] = np.diff(window.pulse.cdf(until), axis=3).reshape(*delay.shape, -1)
    return share


def _dispersion(window: _Window, delay: Floats) -> Floats:
    """Mean squared deviation of counts from the model in units of the variance, shape (pixel, 1).

    It is that of the level that fits best, in the bins of the window, given delays (pixel, 1); 1
    where it may be chance.
    """
    # The last bin stands for the rest of the gate.
    share, fired, unfired = (
        each[:, :-1] for each in (_share(window, delay)[:, 0], window.fired, window.unfired)
    )
    rate = window.background[..., np.newaxis] + window.signal[..., np.newaxis] * share
    if window.is_first:
        armed, fires = unfired + fired, -np.expm1(-rate)
        expected, variance = armed * fires, armed * fires * (1 - fires)
    else:
        expected = variance = unfired * rate
    is_seen, floored = variance > 0, np.maximum(variance, 1.0)  # one count contradicts no model
    n_free = np.maximum(is_seen.sum(axis=-1) - _N_FITTED, 1)
    dispersion = (is_seen * (fired - expected) ** 2 / floored).sum(axis=-1) / n_free
    # The squared deviation of a count of mean μ, in units of μ, has the variance 2 + 1 / μ.
    chance = np.sqrt((is_seen * (2.0 + 1.0 / floored)).sum(axis=-1)) / n_free
    dispersion = np.where(dispersion > 1 + _CLEAR_DEVIATIONS * chance, dispersion, 1.0)
    return np.asarray(dispersion.min(axis=0)[:, np.newaxis])


def _log_density(window: _Window, delay: Floats) -> Floats:
    """Logarithm of ``p(d)`` up to a constant of each pixel, at delays (pixel, node)."""
    return np.asarray(np.logaddexp.reduce(_log_levels(window, _share(window, delay))))


def _log_levels(window: _Window, share: Floats) -> Floats:
    """Logarithm of the contribution of each level to ``p(d)``.

    From `_share` (pixel, node, bin), shape (level, pixel, node).
    """
    fired, unfired = window.fired[:, np.newaxis], window.unfired.sum(axis=1)
    unfired_echo = np.vecdot(share, window.unfired[:, np.newaxis])
    log = np.empty((len(window.signal), *share.shape[:2]))
    levels = zip(window.signal, window.background, window.log_weight, strict=True)
    for level, (signal, background, weight) in enumerate(levels):
        rate = share * signal[:, np.newaxis, np.newaxis]
        rate += background[:, np.newaxis, np.newaxis]
        if window.is_first:
            np.negative(np.expm1(np.negative(rate, out=rate), out=rate), out=rate)
        found = np.vecdot(np.log(rate, out=rate), fired)
        found -= signal[:, np.newaxis] * unfired_echo
        found += (weight - unfired * background)[:, np.newaxis]
        log[level] = found
    return log


def _fitted(window: _Window, share: Floats) -> _Window:
    """Fit each level's signal and background to each pixel, given `_share` (pixel, 1, bin).

    By Newton's method, the log likelihood of the pixel is maximised together with that of a normal
    prior, whose standard deviation is half a step between levels for both fluxes.
    """
    p, fired, unfired = share[:, 0], window.fired, window.unfired
    signal, background = window.signal, window.background
    n_bins, precision = window.n_bins, _flux_precision(signal)
    s, b = signal, background
    for _ in range(_FITTING_STEPS):
        rate = b[..., np.newaxis] + s[..., np.newaxis] * p
        odds = np.expm1(rate) if window.is_first else rate
        slope = fired / odds - unfired
        curvature = fired / odds * (1 / odds + window.is_first)
        slope_s = np.vecdot(slope, p) - precision * (s - signal)
        slope_b = slope.sum(axis=-1) - precision * n_bins**2 * (b - background)
        ss = np.vecdot(curvature, p**2) + precision
        sb = np.vecdot(curvature, p)
        bb = curvature.sum(axis=-1) + precision * n_bins**2
        determinant = ss * bb - sb**2
        # At most by half and to twice, so that both remain positive.
        s = np.clip(s + (bb * slope_s - sb * slope_b) / determinant, s / 2, 2 * s)
        b = np.clip(b + (ss * slope_b - sb * slope_s) / determinant, b / 2, 2 * b)
    penalty = precision * ((s - signal) ** 2 + (n_bins * (b - background)) ** 2) / 2
    return window._replace(signal=s, background=b, log_weight=window.log_weight - penalty)


def _flux_precision(signal: Floats) -> Floats:
    """Reciprocal prior variance of the signal of levels, and of their background over the gate."""
    return np.asarray(1 / (_LEVEL_ERROR * signal) ** 2)


def _flux_widening(window: _Window, delay: Floats, share: Floats) -> Floats:
    """Variance of a delay whose fluxes are fitted, too, over that if they were known, (pixel, 1).

    By the Fisher information at delays (pixel, 1) and their `_share`, for the likeliest level.
    Where an echo fires nearly every pulse, a brighter one looks like an earlier one.
    """
    density = np.zeros_like(window.fired)
    until_s = (window.edges - delay[..., np.newaxis]) * window.bin_width_s
    share_per_s = -np.diff(window.pulse.density(until_s), axis=2)
    density[:, :-1] = share_per_s.reshape(len(delay), -1) * window.bin_width_s
    level = np.argmax(_log_levels(window, share), axis=0).T
    signal, background = (
        np.take_along_axis(each, level, axis=0)[0] for each in (window.signal, window.background)
    )
    s, p = signal[:, np.newaxis], share[:, 0]
    rate = background[:, np.newaxis] + s * p
    armed = window.unfired + window.fired if window.is_first else window.unfired
    information = armed / (np.expm1(rate) if window.is_first else rate)
    precision = _flux_precision(signal)
    d = s * density
    dd, ds, db = (np.vecdot(information, d * each) for each in (d, p, 1.0))
    ss = np.vecdot(information, p**2) + precision
    sb = np.vecdot(information, p)
    bb = information.sum(axis=1) + precision * window.n_bins**2
    lost = (bb * ds**2 - 2 * sb * ds * db + ss * db**2) / (ss * bb - sb**2)
    known = 1 - lost / np.maximum(dd, np.finfo(float).tiny)
    return np.asarray(1 / np.maximum(known, _LEAST_KNOWN))[:, np.newaxis]


def _nodes(low: Floats, high: Floats, n_nodes: int) -> Floats:
    """Equidistant delays from `low` to `high` (pixel,), shape (pixel, node)."""
    return np.linspace(low, high, n_nodes, axis=1)


def _zoomed(window: _Window, low: Floats, high: Floats, widening: Floats) -> tuple[Floats, Floats]:
    """Delays between limits (pixel,) that matter, and their relative densities, (pixel, node).

    The densities are raised to the power ``1 / widening``, (pixel, 1).
    """
    for _ in range(_MOST_ZOOMS):
        delay = _nodes(low, high, _NODES)
        log = _log_density(window, delay)
        log -= log.max(axis=1, keepdims=True)
        log /= widening
        inside = log > -_DROP
        first = np.maximum(np.argmax(inside, axis=1) - 1, 0)
        last = np.minimum(_NODES - np.argmax(inside[:, ::-1], axis=1), _NODES - 1)
        is_filled = 3 * (last - first) >= 2 * _NODES
        if is_filled.all():
            break
        # Each pixel stops by itself, so that it does not matter which others are computed.
        ends = np.stack([np.where(is_filled, 0, first), np.where(is_filled, -1, last)], axis=1)
        low, high = np.take_along_axis(delay, ends % _NODES, axis=1).T
    return delay, np.exp(log)
