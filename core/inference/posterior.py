"""Empirical Bayes posterior of the delay of each pixel.

The likelihood (`core.inference.likelihood`) is averaged over the signal levels of
`core.inference.flux`, and multiplied by the distribution of delays in the capture. The probability
mass around an estimate is its confidence, for any estimator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.flux import flux_model_of
from core.inference.flux_model import FluxModel
from core.inference.likelihood import (
    NUMBERS_AT_ONCE,
    LikelihoodInput,
    delay_densities,
    lanes_of,
    likeliest_delays,
    pixels_of,
    prepared_groups,
)
from core.kernels.confidence import fill_masses, fill_states
from core.kernels.messages import fill_window_masses
from core.kernels.parallel import on_threads

TOLERANCE_BINS = 3
"""Tolerance within which an estimate is right; it reproduces the paper's tables."""


def same_echo_bins(capture: Capture) -> int:
    """Distance below which delays belong to one echo: one pulse, and the tolerance at least."""
    return max(TOLERANCE_BINS, capture.echo_bins)


class Posterior(NamedTuple):
    """Posterior of the delay of each pixel."""

    tolerance_probability: NDArray[np.float32]
    """Probability of a surface within `TOLERANCE_BINS` of the beginning of each bin, shape
    (row, col, bin)."""
    surface: Floats
    """Probability of a surface anywhere in the gate, shape (row, col)."""


@cached_per_capture
def posterior_of(capture: Capture) -> Posterior:
    """Compute the posterior of a capture with the fluxes of `flux_model_of`."""
    n_bins = capture.cube.shape[2]
    within, surface = _masses(capture, np.zeros(capture.counts.size, np.intp), n_bins)
    return Posterior(within.reshape(capture.cube.shape), surface.reshape(capture.shape))


@cached_per_capture
def surface_probability(capture: Capture) -> Floats:
    """Probability of a surface anywhere in the gate, (row, col), as in `posterior_of`.

    Without its table, which is as large as the counts, unless that has been computed.
    """
    if has_posterior(capture):
        return posterior_of(capture).surface
    _, surface = _masses(capture, np.zeros(capture.counts.size, np.intp), 1)
    return surface.reshape(capture.shape)


def _masses(
    capture: Capture, first: NDArray[np.intp], n_windows: int
) -> tuple[NDArray[np.float32], Floats]:
    """Compute parts of `posterior_of`, the same to the last bit.

    Parameters
    ----------
    capture : Capture
    first : ndarray, shape (pixel,)
        First bin of each pixel.
    n_windows : int
        Number of bins.

    Returns
    -------
    tolerance_probability : ndarray, shape (pixel, window)
    surface : ndarray, shape (pixel,)
    """
    flux, n_pixels = flux_model_of(capture), first.size
    lanes = lanes_of(flux.share.size, capture.cube.shape[2])
    first = np.pad(first, (0, -n_pixels % lanes)).reshape(-1, lanes)
    within, surface = np.empty((*first.shape, n_windows), np.float32), np.empty(first.shape)
    for pixels, prepared in prepared_groups(capture, flux, 1):
        some = slice(pixels.start // lanes, -(-pixels.stop // lanes))
        parts = TOLERANCE_BINS, first[some], within[some], surface[some]
        on_threads(fill_masses, some.stop - some.start, prepared.work, prepared, *parts)
    return within.reshape(-1, n_windows)[:n_pixels], surface.ravel()[:n_pixels]


class States(NamedTuple):
    """Probability of each state of pixels, of shape (pixel, ...) or (row, col, ...)."""

    surface: NDArray[np.float32]
    """Probability of a surface in each bin, shape (..., bin)."""
    nothing: NDArray[np.float32]
    """Probability of no surface, shape (...)."""


def states_of(prepared: LikelihoodInput, none: float, least: float) -> States:
    """Return the probabilities of the states of pixels by themselves.

    Parameters
    ----------
    prepared : LikelihoodInput
        With one delay per bin.
    none : float
        Prior probability of nothing.
    least : float
        Lower bound of the probability of a bin.
    """
    _, n_blocks, lanes = prepared.signal.shape
    surface = np.empty((n_blocks, lanes, prepared.depth.size), np.float32)
    nothing = np.empty((n_blocks, lanes), np.float32)
    given = none, np.float32(least), surface, nothing
    on_threads(fill_states, n_blocks, prepared.work, prepared, *given)
    pixels = slice(prepared.n_pixels)
    return States(surface.reshape(-1, surface.shape[2])[pixels], nothing.ravel()[pixels])


def has_posterior(capture: Capture) -> bool:
    """Return whether `posterior_of` has been computed."""
    return posterior_of.is_cached(capture)


_estimated: WeakSet[Capture] = WeakSet()
"""Captures with one estimate, whose table would save time from the second one on."""


def tolerance_probability(capture: Capture, bins: Floats) -> Floats:
    """Probability of a surface within `TOLERANCE_BINS` of a delay, shape (row, col).

    The first call for a capture computes no more than these numbers; the second one computes
    `posterior_of`, from which later ones take them, the same to the last bit.

    Parameters
    ----------
    capture : Capture
    bins : ndarray, shape (row, col)
        Delays in fractional bins, from 0 to n_bins; NaN gives 0.
    """
    last = capture.cube.shape[2] - 1

    def from_table(below: NDArray[np.intp]) -> NDArray[np.float32]:
        # Flat indices: `numpy.take_along_axis` takes longer than everything else.
        first = np.arange(bins.size)[:, np.newaxis] * (last + 1)
        table = posterior_of(capture).tolerance_probability
        return np.asarray(table.take(first + _both(below, last)))

    if has_posterior(capture) or capture in _estimated:
        return probability_at(bins, last, from_table)
    _estimated.add(capture)
    return probability_at(bins, last, lambda below: _masses(capture, below, min(2, last + 1))[0])


def probability_at(
    bins: Floats, last: int, masses: Callable[[NDArray[np.intp]], NDArray[np.float32]]
) -> Floats:
    """Interpolate the probability of a surface within `TOLERANCE_BINS` of a delay of each pixel.

    Parameters
    ----------
    bins : ndarray, shape (row, col)
        Delays in fractional bins; NaN gives 0.
    last : int
        Last bin of the gate.
    masses : callable
        ``bin (pixel,) -> probability (pixel, 2)`` around this bin and the next one.
    """
    below = _bin_below(bins.ravel(), last)
    return _between(bins, below, masses(below))


def mass_near(by_bin: NDArray[np.float32], factor: int, delay_bin: Floats, n_bins: int) -> Floats:
    """Return the probability of a surface within `TOLERANCE_BINS` of a delay by a given posterior.

    Parameters
    ----------
    by_bin : ndarray, shape (row, col, merged bin)
        Probability of a surface in each merged bin.
    factor : int
        Bins in a merged one.
    delay_bin : ndarray, shape (row, col)
        Delays in fractional bins; NaN gives 0.
    n_bins : int
        Bins in the gate.
    """
    merged = by_bin.reshape(delay_bin.size, -1)

    def masses(first: NDArray[np.intp]) -> NDArray[np.float32]:
        window = np.empty((first.size, 2), np.float32)
        given = merged, factor, TOLERANCE_BINS, first, window
        on_threads(fill_window_masses, len(window), 2 * window.size * TOLERANCE_BINS, *given)
        return window

    return probability_at(delay_bin, n_bins - 1, masses)


def tolerance_probability_at(capture: Capture, row: int, col: int, bins: Floats) -> Floats:
    """Return `tolerance_probability` of one pixel at several delays (n,), shape (n,)."""
    table = posterior_of(capture).tolerance_probability[row, col]
    below = _bin_below(bins, table.size - 1)
    return _interpolated(bins, below, table[_both(below, table.size - 1)])


def _between(bins: Floats, below: NDArray[np.intp], ends: NDArray[np.float32]) -> Floats:
    """Interpolate at delays (row, col) between `ends` (pixel, 2), a part at a time."""
    found = np.empty(bins.size)
    for begin in range(0, bins.size, NUMBERS_AT_ONCE):
        some = slice(begin, begin + NUMBERS_AT_ONCE)
        found[some] = _interpolated(bins.ravel()[some], below[some], ends[some])
    return found.reshape(bins.shape)


def _bin_below(delay_bin: Floats, last: int) -> NDArray[np.intp]:
    """First of the two bins, up to the `last`, between which to interpolate at delays (n,)."""
    at = np.clip(np.nan_to_num(delay_bin), 0, last)
    return np.minimum(at.astype(np.intp), max(last - 1, 0))


def _both(below: NDArray[np.intp], last: int) -> NDArray[np.intp]:
    """The two bins between which to interpolate, from the first one, shape (n, 2)."""
    return np.stack([below, np.minimum(below + 1, last)], axis=1)


def _interpolated(delay_bin: Floats, below: NDArray[np.intp], ends: NDArray[np.float32]) -> Floats:
    """Interpolate at delays (n,) between numbers (n, 2) at the bins from `below`; 0 for NaN."""
    part = np.clip(np.nan_to_num(delay_bin) - below, 0.0, 1.0)
    between = ends[:, 0] + part * (ends[:, -1] - ends[:, 0])
    return np.where(np.isnan(delay_bin), 0.0, np.clip(between, 0.0, 1.0))


Rule = Literal["density", "window", "mean", "median"]


def least_loss(
    capture: Capture, flux: FluxModel, steps_per_bin: int, rule: Rule = "density"
) -> tuple[Floats, Floats]:
    """Find the delay of the least expected loss, if there is a surface.

    Parameters
    ----------
    capture : Capture
    flux : FluxModel
    steps_per_bin : int
        Delays tried within each bin.
    rule : str
        The loss: any error ("density", the likeliest delay), an error above `TOLERANCE_BINS`
        ("window", the highest expected restoration degree), the square of the error ("mean", the
        lowest RMSE) or its magnitude ("median", the lowest MAE).

    Returns
    -------
    delay_bin : ndarray, shape (row, col)
        In fractional bins; of the first two rules, refined by a parabola through the logarithm of
        the density.
    score : ndarray, shape (row, col)
        Log likelihood ratio to no echo at the likeliest delay.
    """
    delay, score = np.empty((2, capture.counts.size))
    for pixels, prepared in prepared_groups(capture, flux, steps_per_bin):
        for some, found, height in _answers(prepared, steps_per_bin, rule):
            here = pixels_of(some, prepared, pixels)
            size = here.stop - here.start
            delay[here] = (found / steps_per_bin).ravel()[:size]
            score[here] = height.ravel()[:size]
    return delay.reshape(capture.shape), score.reshape(capture.shape)


most_likely = least_loss  # deprecated name, to be removed after the next release


def _answers(
    prepared: LikelihoodInput, steps_per_bin: int, rule: Rule
) -> Iterator[tuple[slice, Floats, Floats]]:
    """Yield blocks, their delays in steps and their scores, (block, lane) each."""
    if rule == "density":
        step, around = likeliest_delays(prepared)
        found = vertex(step, prepared.depth.size - 1, np.moveaxis(around, 2, 0))
        yield slice(0, len(step)), found, around[:, :, 1]
        return
    for some, density, _, weighted in delay_densities(prepared):
        if rule == "window":
            step = _most_in_window(density, TOLERANCE_BINS * steps_per_bin)
            found = vertex(step, prepared.depth.size - 1, _log_around(prepared, weighted, step))
        elif rule == "mean":
            steps = np.arange(density.shape[1]) + 0.5
            found = np.einsum("bdl,d->bl", density, steps) / density.sum(axis=1, dtype=float)
        else:
            found = _median(density)
        yield some, found, _log_around(prepared, weighted, density.argmax(axis=1))[1]


def _log_around(
    prepared: LikelihoodInput, weighted: NDArray[np.float32], step: NDArray[np.intp]
) -> Floats:
    """Logarithm of the density before, at and after steps (block, lane), (3, block, lane)."""
    at, last = step[:, np.newaxis], weighted.shape[2] - 1
    around = np.concatenate([np.maximum(at - 1, 0), at, np.minimum(at + 1, last)], axis=1)
    # From logarithms, since the density next to a strong echo underflows to 0.
    log = np.take_along_axis(weighted, around[:, np.newaxis], axis=2).astype(float)
    log = np.logaddexp.reduce(log, axis=1) + np.log(prepared.depth[around])
    return np.asarray(log.transpose(1, 0, 2))


def vertex(step: NDArray[np.intp], last: int, log: Floats) -> Floats:
    """Refine steps from 0 to `last` by a parabola through the logarithms before, at and after."""
    left, middle, right = log
    curvature = np.minimum(left - 2 * middle + right, -1e-9)
    inside = (step > 0) & (step < last)
    shift = np.where(inside, np.clip(0.5 * (left - right) / curvature, -0.5, 0.5), 0.0)
    return np.asarray(step + 0.5 + shift, float)


def _most_in_window(density: NDArray[np.float32], half: int) -> NDArray[np.intp]:
    """Return the step with most of the density (block, step, lane) within `half` steps of it.

    Around a narrow peak, windows hold the same: of those within a thousandth, the densest step.
    """
    below = np.zeros((density.shape[0], density.shape[1] + 1, density.shape[2]))
    np.cumsum(density, axis=1, out=below[:, 1:])
    steps, n = np.arange(density.shape[1]), density.shape[1]
    first, last = steps - half, steps + half
    mass = below[:, np.minimum(last + 1, n)] - below[:, np.maximum(first, 0)]
    # Of the outermost steps, half is inside.
    mass[:, first >= 0] -= 0.5 * density[:, first[first >= 0]]
    mass[:, last < n] -= 0.5 * density[:, last[last < n]]
    is_best = mass >= (1 - 1e-3) * mass.max(axis=1, keepdims=True)
    return np.asarray(np.where(is_best, density, -1.0).argmax(axis=1))


def _median(density: NDArray[np.float32]) -> Floats:
    """Return where half the density (block, step, lane) is reached, in steps, (block, lane)."""
    upto = np.cumsum(density, axis=1, dtype=float)
    half = 0.5 * upto[:, -1:]
    at = (upto >= half).argmax(axis=1)[:, np.newaxis]
    here = np.take_along_axis(density, at, axis=1)
    beyond = (np.take_along_axis(upto, at, axis=1) - half) / np.maximum(here, 1e-30)
    return np.asarray((at + 1 - np.clip(beyond, 0.0, 1.0))[:, 0])
