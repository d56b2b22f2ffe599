"""Several surfaces in a pixel: echoes fitted one after the other, each tested before accepted.

A pixel at an edge, behind a net or a window sees several surfaces. Echoes of the capture's pulse
are fitted by maximum likelihood together with the background (`core.kernels.returns`), first one,
then two, and so on. One more is accepted if the log likelihood then rises by more than it does in a
given share of pixels with one surface. That gain is found by simulation: histograms are drawn from
the fits of one echo to pixels of the capture, and fitted like the pixels.

Two echoes closer than `resolved_bins` are fitted as one, since the pulse does not resolve them. Its
tail is part of the fit: a tail taken for a Gaussian poses as a second surface.

The confidence of a return is the probability of a surface within `TOLERANCE_BINS` of it, given the
others (`core.inference.further_echo`), as in the report on a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import lru_cache
from numbers import Integral
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats, Pulse
from core.capture import Capture, cached_per_capture
from core.checks import require
from core.inference.background import EchoFree, fitted_shape
from core.inference.flux import flux_prior_of
from core.inference.further_echo import further_echo_log_odds, probability_within
from core.inference.likelihood import rate_and_n_armed
from core.inference.posterior import TOLERANCE_BINS, posterior_of
from core.kernels.parallel import on_threads
from core.kernels.returns import EchoModel, fill_returns
from core.labels import Plane
from core.trigger import draw_counts

MOST_RETURNS = 4
"""Returns of a pixel, at most."""

FALSE_RETURN = 0.01
"""Share of pixels with one surface that may get a second return, unless another is asked for."""

_STEPS = 8  # of the delay in a bin; echoes are interpolated between them
_DRAWN = 4096  # pixels with one surface
_LEAST_FALSE_RETURN = 1e-3  # that so many pixels resolve
_LIKELY = 0.5  # probability of a surface from which a pixel has one
_FEWEST = 16  # pixels that stand for those with a surface
_LEAST_GAIN = 2.0  # smaller gains are not computed
_BIN_COST = 100  # counts that other kernels process in the time of one
_PIXELS_AT_ONCE = 256
_SHAPE_PIXELS = 512  # from which the shape of the background is estimated
_SURE_GAIN = 6.0  # in log likelihood, for which an echo is no background

_MEANINGS = (
    ("range_m", "m", "range of return"),
    ("strength", "1", "signal photons per pulse of return"),
    ("confidence", "1", "probability of a surface within 3 bins of return"),
)


@dataclass(frozen=True, eq=False)
class Returns:
    """Surfaces that pixels see, one element each, ordered by pixel and range.

    Parameters
    ----------
    row, col : ndarray of int, shape (n,)
        Pixel.
    number : ndarray of int, shape (n,)
        1 for the nearest surface of a pixel, and so on.
    bin : ndarray of float, shape (n,)
        Delay in fractional bins.
    range_m : ndarray of float, shape (n,)
    strength : ndarray of float, shape (n,)
        Signal photons per pulse, or photons where the number of pulses is unknown.
    confidence : ndarray of float, shape (n,)
        Probability of a surface within 3 bins, given the other returns of the pixel.
    """

    row: NDArray[np.intp]
    col: NDArray[np.intp]
    number: NDArray[np.intp]
    bin: Floats
    range_m: Floats
    strength: Floats
    confidence: Floats

    def __len__(self) -> int:
        return len(self.row)

    def count(self, shape: tuple[int, int]) -> NDArray[np.intp]:
        """Return the number of returns of each pixel of an image of a shape (row, col)."""
        flat = np.ravel_multi_index((self.row, self.col), shape)
        return np.bincount(flat, minlength=shape[0] * shape[1]).reshape(shape)

    def at(self, row: int, col: int) -> Returns:
        """Return those of one pixel."""
        return self.where((self.row == row) & (self.col == col))

    def where(self, chosen: NDArray[np.bool_]) -> Returns:
        """Return some of them, (n,), with their numbers."""
        return Returns(*(getattr(self, each.name)[chosen] for each in fields(self)))

    def most_probable(self, shape: tuple[int, int]) -> NDArray[np.intp]:
        """Return the index of the most probable return of each pixel, -1 where there is none.

        Of those as probable to a thousandth, the strongest.
        """
        best = np.full(shape, -1)
        order = np.lexsort((self.strength, np.round(self.confidence, 3)))
        best[self.row[order], self.col[order]] = order
        return best

    @property
    def most(self) -> int:
        """Largest number of a return."""
        return int(self.number.max(initial=0))

    def image(self, name: str, number: int, shape: tuple[int, int]) -> Floats:
        """Return a field of the returns of one number as an image; NaN where there is none."""
        these, values = self.number == number, np.full(shape, np.nan)
        values[self.row[these], self.col[these]] = getattr(self, name)[these]
        return values

    def planes(self, shape: tuple[int, int]) -> dict[str, Plane]:
        """Return images with unit and meaning, by name: number of returns, and each return."""
        counted = Plane(self.count(shape), "1", "number of returns of the pixel")
        return {"returns": counted, **dict(self._planes(shape))}

    def _planes(self, shape: tuple[int, int]) -> Iterator[tuple[str, Plane]]:
        for number in range(1, self.most + 1):
            for name, unit, meaning in _MEANINGS:
                image = self.image(name, number, shape)
                yield f"return_{number}_{name}", Plane(image, unit, f"{meaning} {number}")


class Echoes(NamedTuple):
    """Echoes that were fitted to pixels."""

    background: Floats
    """Photons per pulse over the gate, shape (pixel,)."""
    signal: Floats
    """Photons per pulse of each echo, shape (pixel, echo); 0 where there are fewer echoes."""
    delay: Floats
    """Delays in bins, likewise."""
    gain: Floats
    """Gain in log likelihood by each echo, and by the first that was not accepted, likewise."""
    number: NDArray[np.intp]
    """Echoes, shape (pixel,)."""


def resolved_bins(capture: Capture) -> float:
    """Least distance of two returns of a pixel: the shortest time that holds half of an echo.

    A bin at least.
    """
    return max(1.0, _half_echo_s(capture.pulse) / capture.acquisition.bin_width_s)


@lru_cache(maxsize=64)
def _half_echo_s(pulse: Pulse) -> float:
    """Return the length of the shortest time that holds half of the photons of an echo."""
    time_s = np.linspace(pulse.quantile_s(1e-3), pulse.quantile_s(1 - 1e-3), 4097)
    before = pulse.cdf(time_s.copy())
    until_s = np.interp(before + 0.5, before, time_s, right=np.inf)
    return float((until_s - time_s).min())


def returns_of(
    capture: Capture,
    bins: Floats,
    confidence: Floats,
    most: int = 2,
    false_return: float = FALSE_RETURN,
) -> Returns:
    """Find the surfaces of each pixel.

    Parameters
    ----------
    capture : Capture
    bins, confidence : ndarray, shape (row, col)
        Delay of an estimate of one surface and its confidence, which are those of the return where
        a pixel has one; a pixel whose delay is NaN has no return.
    most : int
        Returns of a pixel, from 1 to `MOST_RETURNS`.
    false_return : float
        Share of pixels with one surface that may get a second return, 0.001 to 1.

    Raises
    ------
    ValueError
        If an argument is out of its bounds.
    """
    allowed = isinstance(most, Integral) and 1 <= most <= MOST_RETURNS
    require("returns", most, allowed, f"an integer from 1 to {MOST_RETURNS}")
    pixels = np.flatnonzero(np.isfinite(bins))
    cube = capture.cube.reshape(-1, capture.cube.shape[2])[pixels]
    least = least_gain(capture, false_return) if most > 1 else np.inf
    found = fitted_echoes(capture, cube, most, least)
    there = np.arange(most) < found.number[:, np.newaxis]
    likely = _confidence(capture, cube, found.delay, found.number)
    return as_returns(capture, bins, confidence, Surfaces(found.delay, found.signal, likely, there))


class Surfaces(NamedTuple):
    """Surfaces of pixels, each of shape (pixel, surface)."""

    delay: Floats
    """In bins."""
    signal: Floats
    """As `Conditions.signal`."""
    confidence: Floats
    there: NDArray[np.bool_]
    """Which of them there are."""


def as_returns(capture: Capture, bins: Floats, confidence: Floats, surfaces: Surfaces) -> Returns:
    """Return the surfaces of pixels that have several, and the estimates of others.

    Parameters
    ----------
    capture, bins, confidence
        As for `returns_of`.
    surfaces : Surfaces
        Of the pixels with an estimate, row by row.
    """
    pixels, there = np.flatnonzero(np.isfinite(bins)), surfaces.there.copy()
    order = np.where(there, surfaces.delay, np.inf).argsort(axis=1)
    delay, signal, likely = (np.take_along_axis(each, order, axis=1) for each in surfaces[:3])
    single = np.flatnonzero(there.sum(axis=1) < 2)
    bin_of_one = bins.ravel()[pixels[single]]
    # The strength is known where the estimate is the likeliest echo of the pixel.
    is_other = ~(np.abs(delay[single, 0] - bin_of_one) <= TOLERANCE_BINS)
    signal[single[is_other], 0] = np.nan
    delay[single, 0] = bin_of_one
    likely[single, 0] = confidence.ravel()[pixels[single]]
    there = np.arange(there.shape[1]) < np.maximum(there.sum(axis=1), 1)[:, np.newaxis]
    pixel, rank = np.nonzero(there)
    row, col = np.unravel_index(pixels[pixel], capture.shape)
    per_pulse = 1 if capture.gated_pulses else capture.acquisition.n_pulses or 1
    delays = delay[there]
    return Returns(
        row,
        col,
        rank + 1,
        delays,
        capture.acquisition.bin_to_range_m(delays),
        signal[there] / per_pulse,
        likely[there],
    )


@cached_per_capture
def least_gain(capture: Capture, false_alarm: float = FALSE_RETURN) -> float:
    """Gain in log likelihood by a second echo that a share of pixels with one surface exceed.

    Raises
    ------
    ValueError
        If `false_alarm` is out of its bounds.
    """
    accepted = _LEAST_FALSE_RETURN <= false_alarm <= 1
    require("false_return", false_alarm, accepted, f"{_LEAST_FALSE_RETURN} to 1")
    gains = _gains_of_one_surface(capture)
    kept = min(int(false_alarm * (gains.size + 1)), gains.size)
    return max(float(np.partition(gains, -kept)[-kept]), _LEAST_GAIN) if kept else float("inf")


@cached_per_capture
def _gains_of_one_surface(capture: Capture) -> Floats:
    """Return the gains by a second echo in histograms that are drawn with one echo."""
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    rng = np.random.default_rng(0)
    seen = np.flatnonzero(capture.counts)
    if not seen.size:
        return np.zeros(1)
    likely = np.flatnonzero(posterior_of(capture).surface >= _LIKELY)  # sky is no surface
    seen = likely if likely.size >= _FEWEST else seen
    pixels = np.sort(rng.choice(seen, min(_DRAWN, seen.size), replace=False))
    one = fitted_echoes(capture, capture.cube.reshape(-1, n_bins)[pixels], 1, 0.0)
    again = np.resize(np.arange(pixels.size), _DRAWN)
    gains = []
    at_once = max(1, 2**20 // n_bins)
    for first in range(0, _DRAWN, at_once):
        some = again[first : first + at_once]
        echo = capture.pulse.bin_probability(
            one.delay[some, 0], n_bins, capture.acquisition.bin_width_s
        )
        rate = one.signal[some] * echo
        rate += one.background[some, np.newaxis] * _background_shares(capture)
        counts = draw_counts(rate, n_pulses, rng)
        gains.append(fitted_echoes(capture, counts, 2, _LEAST_GAIN).gain[:, 1])
    return np.concatenate(gains)


def fitted_echoes(
    capture: Capture,
    counts: NDArray[np.unsignedinteger],
    most: int,
    least: float,
    background: Floats | None = None,
) -> Echoes:
    """Fit echoes of a capture's pulse to histograms of its kind.

    Parameters
    ----------
    capture : Capture
    counts : ndarray, shape (..., bin)
    most : int
        Echoes of a pixel.
    least : float
        Gain in log likelihood from which one more is accepted.
    background : ndarray, shape (bin,), optional
        Share of the background in each bin; that of the capture if None.
    """
    flat = pixel_counts(counts)
    values, gain = np.zeros((len(flat), 1 + 2 * most)), np.zeros((len(flat), most))
    number = np.zeros(len(flat), np.intp)
    model = echo_model(capture, background)
    given = flat, model, float(least), values, gain, number
    on_threads(fill_returns, len(flat), flat.size * _BIN_COST, *given)
    echo, many = np.arange(most), number[:, np.newaxis]
    there = echo < many
    signal, delay = (
        np.where(there, np.take_along_axis(values, np.where(there, first + echo, 0), axis=1), 0.0)
        for first in (1, 1 + many)
    )
    return Echoes(values[:, 0], signal, delay, gain, number)


def pixel_counts(counts: NDArray[np.unsignedinteger]) -> NDArray[np.uint32]:
    """Return histograms (..., bin) as the kernels need them, (pixel, bin)."""
    flat = np.ascontiguousarray(counts.reshape(-1, counts.shape[-1]), np.uint32)
    flat.setflags(write=False)  # writability is part of a numba type: compile for one
    return flat


def echo_model(capture: Capture, background: Floats | None = None) -> EchoModel:
    """Return what the kernels need to know of a capture; `background` as for `fitted_echoes`."""
    n_bins, width_s = capture.acquisition.n_bins, capture.acquisition.bin_width_s
    echo, first = capture.pulse.taps(n_bins, width_s, np.linspace(0.0, 1.0, _STEPS + 1))
    n_pulses = capture.gated_pulses
    shares = _background_shares(capture) if background is None else background
    return EchoModel(
        echo,
        first,
        shares,
        bool((shares == shares[0]).all()),
        n_pulses is not None,
        float(n_pulses or 1),
        resolved_bins(capture),
    )


@cached_per_capture
def _background_shares(capture: Capture) -> Floats:
    """Share of the background in each bin.

    The shape of the flux model takes surfaces that all pixels see for background. Where it is not
    uniform, it is estimated again from the bins that hold none of the echoes fitted to a sample of
    the pixels.
    """
    n_bins = capture.acquisition.n_bins
    uniform = np.full(n_bins, 1 / n_bins)
    if flux_prior_of(capture).background_shape is None:
        return uniform
    seen = np.flatnonzero(capture.counts)
    pixels = np.sort(np.random.default_rng(0).permutation(seen)[:_SHAPE_PIXELS])
    counts = capture.cube.reshape(-1, n_bins)[pixels]
    found = fitted_echoes(capture, counts, MOST_RETURNS, _SURE_GAIN, uniform)
    echo, first = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s)
    after = np.arange(n_bins) - np.floor(found.delay)[..., np.newaxis]
    there = (np.arange(MOST_RETURNS) < found.number[:, np.newaxis])[..., np.newaxis]
    free = ~(there & (after >= first - 1) & (after <= first + echo.size)).any(axis=1)
    armed = rate_and_n_armed(counts.astype(float), capture.gated_pulses)[1]
    expected = armed * found.background[:, np.newaxis] * uniform
    sums = (np.where(free, each, 0.0).sum(axis=0) for each in (counts, expected, armed))
    shape = fitted_shape(EchoFree(*sums), capture)
    return uniform if shape is None else shape / n_bins


def _confidence(
    capture: Capture,
    cube: NDArray[np.unsignedinteger],
    delay: Floats,
    number: NDArray[np.intp],
) -> Floats:
    """Probability of a surface near each delay given the others, shape (pixel, echo).

    `cube` is of shape (pixel, bin); 0 for pixels of fewer than two echoes.
    """
    bins, found = np.arange(cube.shape[1]), np.zeros(delay.shape)
    apart_bins = resolved_bins(capture)
    for many in range(2, delay.shape[1] + 1):
        pixels = np.flatnonzero(number == many)
        for first in range(0, pixels.size, _PIXELS_AT_ONCE):
            some = pixels[first : first + _PIXELS_AT_ONCE]
            for echo in range(many):
                others = np.delete(delay[some, :many], echo, axis=1)
                histograms = cube[some].astype(float)
                odds = further_echo_log_odds(capture, histograms, others, apart_bins)
                away = np.abs(bins + 0.5 - delay[some, echo, np.newaxis])
                found[some, echo] = probability_within(odds, away <= TOLERANCE_BINS)
    return found
