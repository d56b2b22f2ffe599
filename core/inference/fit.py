"""Goodness of fit of the model behind every confidence: one echo of the pulse, smooth background.

A delay and fluxes are drawn from the posterior of each pixel. If the model holds, the counts given
such a draw are distributed as given the true values (Johnson 2004), so that no allowance is needed
for what is estimated, nor for delays that no histogram determines. The counts of a window of the
gate are then binomial in the pulses still armed (Poisson if all photons are counted), independently
of earlier windows. A randomized quantile residual (Dunn & Smyth 1996) turns each into a standard
normal number, for any number of photons, and the sum of their squares gives the p-value of a pixel.

A draw leaves out the first and the last thousandth of an echo, so that echoes of 10⁷ photons never
fit.

Draws from a posterior are distributed as the truth if the prior is that of the pixels. Before the
counts are known, any bin is as likely, but not any place in it: on a wall that faces the instrument
all echoes begin at the same. How often they begin at each place is learned from the capture.

Residuals of many pixels together show what one pixel cannot: those away from the echoes, by bin of
the gate, the shape of the background, those around the echoes the shape of the pulse.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.background import echo_window, nodes_of
from core.inference.flux import SAMPLE, flux_model_of
from core.inference.likelihood import (
    NUMBERS_AT_ONCE,
    LikelihoodInput,
    delay_densities,
    pixels_of,
    prepare,
)
from core.kernels.echo_draws import UNIFORMS, fill_delay_logs, redraw
from core.kernels.parallel import on_threads
from core.kernels.posterior import learn_shares
from core.kernels.streams import uniforms

SIGNIFICANCE = 0.01
"""Probability that a capture which the model describes is taken for one that it does not."""

SMALL = 0.05
"""P-value below which maps distinguish pixels."""

_WINDOWS = 16  # of the gate, at most, whose counts are tested in each pixel
GROUPS = 32  # of bins, at most, over which residuals of all pixels are added
FEWEST = 5.0  # expected counts of a group, for a normal sum
_STEPS_PER_BIN = 128  # delays at which an echo is tabulated
_PHASES = 64  # of delays in a bin
_COARSE_PHASES = 16
_DELAY_COST = 20  # counts that other kernels process in the time of one delay
_SEED = np.uint64(0)


class Check(NamedTuple):
    """One way in which counts can contradict the model."""

    reason: str
    """The contradiction and its size, as a clause."""
    p_value: float
    """Probability of residuals as large if the model holds."""
    effect: float
    """Size of the deviation, see `Fit`."""


class Fit(NamedTuple):
    """Whether one echo of the pulse over the background describes some pixels of a capture.

    Effects of `background` and `pulse` are noise-weighted root mean squares.
    """

    background: Check
    """Effect: deviation of the background from its shape over the gate, relative to it."""
    pulse: Check
    """Effect: deviation of the echoes from the pulse, relative to the pulse."""
    pixels: Check
    """Effect: share of the pixels that do not fit, beyond those expected by chance."""

    @property
    def failed(self) -> tuple[Check, ...]:
        """Checks that contradict the model; all three together do so wrongly in 1 % of captures."""
        return tuple(each for each in self if each.p_value < SIGNIFICANCE / len(self))

    @property
    def fits(self) -> bool:
        """Whether no check contradicts the model."""
        return not self.failed

    @property
    def remark(self) -> str:
        """A clause on confidences; empty if the model fits."""
        return "" if self.fits else f"confidences are unreliable: {self._reasons}"

    @property
    def verdict(self) -> str:
        """A sentence: whether the model fits, and otherwise why not."""
        if self.fits:
            return "The model fits: no deviation from it is significant."
        return f"The model does not fit: {self._reasons}."

    @property
    def _reasons(self) -> str:
        return ", and ".join(check.reason for check in self.failed)


class Deviation(NamedTuple):
    """Sums of residuals of many pixels; if the model holds, their squares are chi-square."""

    squares: float
    """Sum of the squares of normal numbers."""
    freedom: int
    """Degrees of freedom; 0 if the counts are too few for a test."""
    unit: float
    """Square root of the squares that a deviation as large as the model itself adds."""

    @property
    def p_value(self) -> float:
        """Probability of squares as large if the model holds."""
        return float(scipy.special.chdtrc(self.freedom, self.squares)) if self.freedom else 1.0

    @property
    def effect(self) -> float:
        """Size of the deviation relative to the model, without that expected by chance."""
        return float(np.sqrt(max(self.squares - self.freedom, 0.0))) / self.unit


@cached_per_capture
def fit_of(capture: Capture) -> Fit:
    """Test the model on the pixels from which the fluxes are estimated; on fewer in a long gate."""
    return fit_in(capture, _sample(capture))


def _sample(capture: Capture) -> NDArray[np.intp]:
    """Return the pixels from which the fluxes are estimated, of which few in a long gate."""
    drawn = np.random.default_rng(0).permutation(capture.counts.size)[:SAMPLE]
    return np.sort(drawn[: _most_at_once(capture)])


def has_fit(capture: Capture) -> bool:
    """Return whether `fit_of` has been computed."""
    return fit_of.is_cached(capture)


def fit_in(capture: Capture, pixels: NDArray[np.intp]) -> Fit:
    """Test the model on pixels given as flat indices (pixel,), at least one.

    Of more pixels than are held in memory together, a random sample is tested.
    """
    if pixels.size > (most := _most_at_once(capture)):
        pixels = np.sort(np.random.default_rng(0).permutation(pixels)[:most])
    residuals = drawn_residuals(capture, pixels)
    return Fit(
        _check(
            "the background over the gate differs by {:.1%} from a smooth shape",
            background_deviation(capture, residuals),
        ),
        _check(
            "echoes differ by {:.1%} from the shape of the pulse (another pulse, jitter or motion)",
            pulse_deviation(capture, residuals),
        ),
        _pixels(_p_values(capture, residuals)),
    )


@cached_per_capture
def fit_p_values(capture: Capture) -> Floats:
    """P-value of each pixel, shape (row, col): uniform if the model holds."""
    return fit_p_values_of(capture, np.arange(capture.counts.size)).reshape(capture.shape)


def share_below(p_values: Floats) -> str:
    """Return how many p-values of pixels are small, as a sentence."""
    share = float(np.mean(p_values < SMALL))
    expected = f"{100 * SMALL:g} % are expected if the model holds"
    return f"{100 * share:.1f} % of the pixels have a p-value below {SMALL:g}; {expected}."


def fit_p_values_of(capture: Capture, pixels: NDArray[np.intp]) -> Floats:
    """Return the `fit_p_values` of pixels given as flat indices (pixel,), shape (pixel,)."""
    parts = in_parts(capture, pixels)
    return np.concatenate([_p_values(capture, drawn_residuals(capture, part)) for part in parts])


def in_parts(capture: Capture, pixels: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Divide pixels (pixel,) into parts that are held in memory together."""
    return np.array_split(pixels, -(-pixels.size // _most_at_once(capture)))


def _most_at_once(capture: Capture) -> int:
    """Return how many pixels are held in memory together."""
    return max(1, NUMBERS_AT_ONCE // capture.acquisition.n_bins)


class Residuals(NamedTuple):
    """Counts and what the model expects of them for drawn delays and fluxes; (pixel, bin)."""

    pixels: NDArray[np.intp]
    """Flat indices, (pixel,)."""
    delay_bin: Floats
    """(pixel,), NaN for no echo."""
    counts: Floats
    armed: Floats
    """Pulses armed in each bin, 1 if the number of pulses is unknown."""
    background: Floats
    """Photons per pulse in each bin."""
    signal: Floats
    expected: Floats
    """Counts expected of the armed pulses."""
    variance: Floats

    @property
    def difference(self) -> Floats:
        """Counts minus expected ones: not correlated, with mean 0 if the model holds."""
        return self.counts - self.expected


def drawn_residuals(
    capture: Capture, pixels: NDArray[np.intp], streams: NDArray[np.intp] | None = None
) -> Residuals:
    """Draw delay and fluxes of pixels, and compare their counts with what the model expects.

    Parameters
    ----------
    capture : Capture
    pixels : ndarray, shape (pixel,)
        Flat indices.
    streams : ndarray, shape (pixel,), optional
        Numbers of the random streams, by default `pixels`; others give other draws.
    """
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    cube = capture.cube.reshape(-1, n_bins)[pixels]
    streams = pixels if streams is None else streams
    delay_bin, signals, backgrounds = _drawn(capture, pixels, cube, streams)
    counts = cube.astype(float)
    background = backgrounds[:, np.newaxis] * flux_model_of(capture).relative_background
    share = capture.pulse.bin_probability(delay_bin, n_bins, capture.acquisition.bin_width_s)
    signal = signals[:, np.newaxis] * share
    armed = np.ones_like(counts)
    if n_pulses is not None:
        armed = n_pulses - np.cumsum(counts, axis=1) + counts
    expected, variance = _moments(capture, armed, signal + background)
    return Residuals(pixels, delay_bin, counts, armed, background, signal, expected, variance)


def over_uniform_background(capture: Capture, residuals: Residuals) -> Residuals:
    """Return the residuals of the same draws over a background of the same mean, but uniform."""
    mean = residuals.background.mean(axis=1, keepdims=True)
    background = np.broadcast_to(mean, residuals.background.shape)
    expected, variance = _moments(capture, residuals.armed, residuals.signal + background)
    return residuals._replace(background=background, expected=expected, variance=variance)


def _moments(capture: Capture, armed: Floats, rate: Floats) -> tuple[Floats, Floats]:
    """Mean and variance of counts of armed pulses."""
    if capture.gated_pulses is None:
        return armed * rate, armed * rate
    fires = -np.expm1(-rate)
    return armed * fires, armed * fires * (1 - fires)


def _drawn(
    capture: Capture,
    pixels: NDArray[np.intp],
    cube: NDArray[np.unsignedinteger],
    streams: NDArray[np.intp],
) -> tuple[Floats, Floats, Floats]:
    """Draw delay (NaN for no echo), signal, and background per bin of pixels, (pixel,) each."""
    if np.array_equal(pixels, _sample(capture)) and np.array_equal(pixels, streams):
        given, drawn = _drawn_of_sample(capture)
    else:
        given, drawn = _drawn_at_any_phase(capture, pixels, cube, streams)
    state = drawn.copy()
    if (shares := _phase_shares(capture)) is not None:
        delay, log = _delay_logs(given, state)
        density = np.exp(log - log.max(axis=1, keepdims=True)) * np.resize(shares, log.shape[1])
        uniform = uniforms(_SEED, streams, UNIFORMS + 3 + _WINDOWS, 1)
        chosen = _drawn_index(np.cumsum(density, axis=1)[..., np.newaxis], uniform)
        state[:, 0] = np.take_along_axis(delay, chosen, axis=1)[:, 0]
    return state[:, 0], np.exp(state[:, 1]), np.exp(state[:, 2])


@cached_per_capture
def _drawn_of_sample(capture: Capture) -> tuple[tuple[Any, ...], Floats]:
    """Draw delays, signals and backgrounds of the pixels of `fit_of` as `_drawn_at_any_phase`."""
    pixels = _sample(capture)
    cube = capture.cube.reshape(-1, capture.acquisition.n_bins)[pixels]
    return _drawn_at_any_phase(capture, pixels, cube, pixels)


@cached_per_capture
def _phase_shares(capture: Capture) -> Floats | None:
    """Estimate how often delays are at each phase of a bin, shape (phase,).

    None if any phase is as likely: drawn delays do not contradict that, or the gain in log
    likelihood does not exceed the number of phases (Akaike 1974).
    """
    given, state = _drawn_of_sample(capture)
    drawn = np.histogram(state[:, 0] % 1, _COARSE_PHASES, (0.0, 1.0))[0]
    squares = ((drawn - drawn.mean()) ** 2).sum() / max(drawn.mean(), 1.0)
    if scipy.special.chdtrc(_COARSE_PHASES - 1, squares) > SIGNIFICANCE:
        return None
    log = _delay_logs(given, state)[1]
    density = np.exp(log - log.max(axis=1, keepdims=True)).reshape(len(log), -1, _PHASES)
    at_phase = density.sum(axis=1)
    at_any = at_phase.mean(axis=1, keepdims=True)
    likelihood = np.hstack([at_any, at_phase]) / at_any
    share = np.full(1 + _PHASES, 1 / (1 + _PHASES))
    learn_shares(likelihood, share)
    gain = np.log(likelihood @ share).sum()
    return share[0] / _PHASES + share[1:] if gain > _PHASES else None


def _delay_logs(given: tuple[Any, ...], state: Floats) -> tuple[Floats, Floats]:
    """Return equidistant delays around drawn ones and the logarithms of their densities.

    Both of shape (pixel, delay), at `_PHASES` in each of three bins. The densities are posterior
    ones given drawn signal and background, if any delay is as likely before.
    """
    every = (np.arange(3 * _PHASES) + 0.5) / _PHASES - 1
    delay = np.floor(state[:, :1]) + every
    log = np.empty(delay.shape)
    on_threads(fill_delay_logs, len(log), log.size * _DELAY_COST, *given, state, delay, log)
    return delay, log


def _drawn_at_any_phase(
    capture: Capture,
    pixels: NDArray[np.intp],
    cube: NDArray[np.unsignedinteger],
    streams: NDArray[np.intp],
) -> tuple[tuple[Any, ...], Floats]:
    """Draw delays (NaN for no echo), logarithms of signals and of backgrounds per bin, (pixel, 3).

    Any delay is as likely before the counts are known. Returns what the kernels of
    `core.kernels.echo_draws` need to know before the draws.
    """
    n_bins = cube.shape[1]
    flux = flux_model_of(capture).of_pixels(pixels[np.newaxis])
    prepared = prepare(capture, cube[np.newaxis], flux, 1)
    delay_bin, level = _drawn_levels(prepared, uniforms(_SEED, streams, UNIFORMS, 3))
    every = np.arange(pixels.size)
    signal, background = (each[level, 0, every] for each in (flux.signal, flux.background))
    steps = np.linspace(0.0, 1.0, _STEPS_PER_BIN + 1)
    echo, first = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s, steps)
    log_signal = np.log(np.where(level > 0, signal, 1.0))
    state = np.stack([delay_bin, log_signal, np.log(background / n_bins)], axis=1)
    given = (
        cube.astype(np.uint32),  # compiled for one type of counts
        capture.gated_pulses or 0,
        echo,
        first,
        (flux.relative_background, *nodes_of(flux.relative_background)),
    )
    on_threads(
        redraw,
        len(cube),
        cube.size * UNIFORMS,  # a pass over the counts for every number drawn
        *given,
        streams,
        state,
    )
    return given, state


def _drawn_levels(prepared: LikelihoodInput, uniform: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Draw a delay from those of `delay_densities`, NaN for no echo, and its level of signal.

    Takes three uniform numbers of each pixel, (pixel, 3); returns shapes (pixel,).
    """
    n_pixels, lanes, n_delays = len(uniform), prepared.counts.shape[2], prepared.depth.size
    in_blocks = np.resize(uniform, (-(-n_pixels // lanes), lanes, 3))
    delay_bin, level = np.empty(n_pixels), np.empty(n_pixels, np.intp)
    for some, density, top, weighted in delay_densities(prepared):
        unit = np.maximum(top, prepared.log_share[0])
        before = np.cumsum(density, axis=1, dtype=float)
        seen = np.exp(top - unit) * before[:, -1] / n_delays
        for_echo, for_delay, for_level = np.moveaxis(in_blocks[some], -1, 0)
        has_echo = for_echo * (seen + np.exp(prepared.log_share[0] - unit)) < seen
        delay = _drawn_index(before, for_delay)
        at = delay[:, np.newaxis, np.newaxis]
        log = np.take_along_axis(weighted, at, axis=2)[:, :, 0].astype(float)
        shares = np.cumsum(np.exp(log - log.max(axis=1, keepdims=True)), axis=1)
        here = pixels_of(some, prepared, slice(0, n_pixels))
        size = here.stop - here.start
        delay_bin[here] = np.where(has_echo, delay + 0.5, np.nan).ravel()[:size]
        level[here] = np.where(has_echo, 1 + _drawn_index(shares, for_level), 0).ravel()[:size]
    return delay_bin, level


def _drawn_index(cumulative: Floats, uniform: Floats) -> NDArray[np.intp]:
    """Draw indices with cumulative weights (block, index, lane), shape (block, lane)."""
    limit = (uniform * cumulative[:, -1])[:, np.newaxis]
    return np.asarray((cumulative[:, :-1] <= limit).sum(axis=1))


def _p_values(capture: Capture, residuals: Residuals) -> Floats:
    """P-value of each pixel, shape (pixel,)."""
    n_bins = capture.acquisition.n_bins
    n_windows = min(max(1, n_bins // capture.echo_bins), _WINDOWS)
    first = np.arange(n_windows) * n_bins // n_windows
    rate = residuals.signal + residuals.background
    counts, mean = (np.add.reduceat(each, first, axis=1) for each in (residuals.counts, rate))
    armed = None if capture.gated_pulses is None else residuals.armed[:, first]
    uniform = uniforms(_SEED, residuals.pixels, UNIFORMS + 3, n_windows)
    squares = quantile_residuals(counts, armed, mean[np.newaxis], uniform) ** 2
    return np.asarray(scipy.special.chdtrc(n_windows, squares.sum(axis=1)))


def quantile_residuals(
    counts: Floats, armed: Floats | None, rate: Floats, uniform: Floats
) -> Floats:
    """Randomized quantile residuals of counts, binomial in armed pulses or Poisson if None.

    `rate` has a first axis of draws, over which the distributions are averaged. Residuals come from
    the shorter tail, so that none is infinite.
    """
    special = scipy.special
    if armed is None:
        is_low = counts < rate.mean(axis=0)
        beyond = np.where(
            is_low, special.gammaincc(counts, rate), special.gammainc(counts + 1, rate)
        )
        log = special.xlogy(counts, rate) - rate - special.gammaln(counts + 1)
    else:
        fires, unfired = -np.expm1(-rate), armed - counts
        is_low = counts < armed * fires.mean(axis=0)
        beyond = special.betainc(
            np.where(is_low, unfired + 1, counts + 1),
            np.where(is_low, counts, unfired),
            np.where(is_low, 1 - fires, fires),
        )
        beyond = np.where(np.where(is_low, counts, unfired) > 0, beyond, 0.0)
        log = special.gammaln(armed + 1) - special.gammaln(counts + 1)
        log = log + special.xlogy(counts, fires) - rate * unfired - special.gammaln(unfired + 1)
    tail = beyond + np.exp(log) * np.where(is_low, uniform, 1 - uniform)
    normal = special.ndtri(np.clip(tail.mean(axis=0), np.finfo(float).tiny, 1.0))
    return np.asarray(np.where(is_low, normal, -normal))


def background_deviation(capture: Capture, residuals: Residuals) -> Deviation:
    """Compare the background, away from echoes, with its shape over the gate."""
    n_bins = capture.acquisition.n_bins
    away = np.isnan(echo_offset(capture, residuals.delay_bin))
    n_groups = min(n_bins, GROUPS)

    def pooled(values: Floats) -> Floats:
        return _grouped((values * away).sum(axis=0), n_groups)

    return _deviation(
        pooled(residuals.difference),
        pooled(residuals.variance),
        pooled(residuals.expected)[np.newaxis],
    )


def pulse_deviation(capture: Capture, residuals: Residuals) -> Deviation:
    """Compare the mean echo with the pulse."""
    n_bins = capture.acquisition.n_bins
    has_echo = np.isfinite(residuals.delay_bin)
    offset = np.arange(*echo_window(capture))
    n_groups = min(offset.size, GROUPS)
    at = np.floor(residuals.delay_bin[has_echo]).astype(np.intp)[:, np.newaxis] + offset
    inside, at = (at >= 0) & (at < n_bins), np.clip(at, 0, n_bins - 1)

    def pooled(values: Floats) -> Floats:
        around = np.take_along_axis(values[has_echo], at, axis=1) * inside
        return _grouped(around.sum(axis=0), n_groups)

    rate = residuals.signal + residuals.background
    exposed = residuals.expected / rate
    return _deviation(
        pooled(residuals.difference),
        pooled(residuals.variance),
        np.stack([pooled(residuals.signal * exposed), pooled(residuals.background * exposed)]),
    )


def echo_offset(capture: Capture, delay_bin: Floats) -> Floats:
    """Bins from the beginning of the window around each delay (pixel,), shape (pixel, bin).

    NaN outside the window, which holds echoes of the pulse or similar ones.
    """
    first, end = echo_window(capture)
    bins = np.arange(capture.acquisition.n_bins)
    offset = bins - np.floor(delay_bin)[:, np.newaxis] - first  # NaN without an echo
    return np.where((offset >= 0) & (offset < end - first), offset, np.nan)


def _grouped(values: Floats, n_groups: int) -> Floats:
    """Sums of neighbouring values (n,) in groups of equal size, shape (group,)."""
    return np.asarray(np.add.reduceat(values, np.arange(n_groups) * values.size // n_groups))


def _deviation(difference: Floats, variance: Floats, free: Floats) -> Deviation:
    """Test whether sums of residuals (group,) are 0 apart from multiples of `free` (n, group).

    The effect is relative to the first of these.
    """
    enough = variance >= FEWEST
    freedom = int(np.count_nonzero(enough)) - len(free)
    scale = np.sqrt(variance[enough])
    shapes = free[:, enough] / scale
    if freedom < 1 or not shapes.any(axis=1).all():  # too few counts for a test
        return Deviation(0.0, 0, 1.0)
    normal = difference[enough] / scale
    rest = normal - shapes.T @ np.linalg.lstsq(shapes.T, normal)[0]
    return Deviation(float(rest @ rest), freedom, float(np.linalg.norm(shapes[0])))


def _check(reason: str, deviation: Deviation) -> Check:
    """Return a check whose `reason` has a place for the effect."""
    return Check(reason.format(deviation.effect), deviation.p_value, deviation.effect)


def _pixels(p_values: Floats) -> Check:
    """Compare the number of pixels that do not fit with that expected by chance."""
    failing, n = int(np.count_nonzero(p_values < SIGNIFICANCE)), p_values.size
    p_value = float(scipy.special.bdtrc(failing - 1, n, SIGNIFICANCE))
    effect = max(failing / n - SIGNIFICANCE, 0.0)
    reason = f"{effect:.1%} of the pixels differ from one echo, as by a second surface"
    return Check(reason, p_value, effect)
