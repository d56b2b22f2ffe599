"""Exact first-photon likelihood of the delay and signal level of an echo.

With background ``b`` and signal ``s_k(d) = S p_k(d)`` photons per pulse in bin ``k``, ``n_k``
detections and ``A_k`` armed pulses, the log likelihood ratio of an echo at delay ``d`` to no echo
is ::

    T(d) = Σ_k [ n_k ln((1 - exp(-b - s_k)) / (1 - exp(-b))) - (A_k - n_k) s_k ]

which is exact for the trigger probabilities of Eq. 1. Where the background varies over the gate, it
is ``b_k``, that of the bin (`core.inference.background`). If the number of pulses is unknown, or a
pulse may fire more than once, counts are Poisson: the terms are ``n_k ln(1 + s_k / b)`` and
``-s_k``, with photons per pixel instead of per pulse.

`log_likelihood_ratio` is the equation as written. `core.kernels.posterior` computes the tables of
all pixels, levels and delays in float32, a few blocks of pixels at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture
from core.inference.background import nodes_of
from core.inference.flux_model import FluxModel
from core.kernels.blocks import LANES, lane_counts
from core.kernels.confidence import fill_densities, fill_evidence, fill_peaks
from core.kernels.parallel import on_threads
from core.kernels.posterior import fill_blocks
from core.kernels.rates import fill_rates

NUMBERS_AT_ONCE = 2**19  # numbers that fit in the cache
_SAMPLE_NUMBERS = 2**25  # likelihoods of the levels and delays of the sample: 128 MiB
TABLE_NUMBERS = 2**22  # likelihoods of the levels and delays of a block: 16 MiB
_FEWEST_LANES = 2  # numpy sums a single lane pairwise, which rounds differently
FLUX_NUMBERS = 2**20  # backgrounds of levels and pixels that are laid out at once
_LEAST_BACKGROUND = 1e-100  # photons; without any, the likelihood ratio of one count is infinite
_PASSES = 8  # over the counts that take as long as the likelihood of a level
_NEGLIGIBLE = 1e-12  # signal of a bin as a share of its background


class Conditions(NamedTuple):
    """Acquisition and fluxes of histograms (..., bin)."""

    acquisition: Acquisition
    pulse: Pulse
    n_pulses: int | None
    """Pulses sent for first photons; None for all photons and if unknown."""
    signal: Floats
    """Signal photons per pulse, (...) or scalar; per histogram if `n_pulses` is None."""
    background: Floats
    """Background photons per pulse over the gate, likewise."""
    contrast: float
    """Mean signal over mean background of the image."""
    pile_up: bool = True
    """`FluxModel.pile_up`."""
    background_shape: Floats | None = None
    """`FluxModel.background_shape`."""


def windowed_sums(values: Floats, width: int) -> Floats:
    """Sum each window of `width` bins inside the gate; from (pixel, bin) to (pixel, window)."""
    until = sums_before(values)
    return np.asarray(until[:, width:] - until[:, :-width])


def sums_before(values: Floats) -> Floats:
    """Sum the bins before each edge; from (pixel, bin) to (pixel, edge)."""
    until = np.zeros((len(values), values.shape[1] + 1))  # `numpy.pad` is slow
    np.cumsum(values, axis=1, out=until[:, 1:])
    return until


def rate_and_n_armed(histogram: Floats, n_pulses: int | None) -> tuple[Floats, Floats]:
    """Rate of each bin with pile-up corrected (Coates 1968), and its number of armed pulses.

    Parameters
    ----------
    histogram : ndarray, shape (..., bin)
        Counts, or expected counts.
    n_pulses : int or None
        Pulses sent; None if unknown, or if a pulse may fire more than once.

    Returns
    -------
    rate : ndarray, shape (..., bin)
        Detections per pulse of a detector that is always armed. If all armed pulses fire in a bin,
        half a pulse less is counted, so that the rate is finite; later bins are 0. The counts
        themselves if `n_pulses` is None.
    armed : ndarray, shape (..., bin)
        Pulses armed before each bin; 1 everywhere if `n_pulses` is None.
    """
    if n_pulses is None:
        return histogram, np.ones_like(histogram)
    counts = np.ascontiguousarray(histogram, float).reshape(-1, histogram.shape[-1])
    counts.setflags(write=False)  # writability is part of a numba type: compile for one
    rate, armed = np.empty((2, *counts.shape))
    fill_rates(counts, float(n_pulses), rate, armed)
    return rate.reshape(histogram.shape), armed.reshape(histogram.shape)


def log_likelihood_ratio(
    histogram: Floats, conditions: Conditions, rate: Floats | None = None
) -> Floats:
    """Compute ``T(d)`` of the module's docstring at the beginning of each bin, as written.

    Parameters
    ----------
    histogram : ndarray, shape (..., bin)
    conditions : Conditions
    rate : ndarray, shape (..., bin), optional
        Photons per pulse in each bin without the echo, ``b``, if they are not those of
        `Conditions.background`: those of other echoes, too.

    Returns
    -------
    ndarray, shape (..., bin)
    """
    acquisition, n_pulses = conditions.acquisition, conditions.n_pulses
    n_bins = acquisition.n_bins
    # At whole bins an echo is one filter, of its share in the bin `step` bins after the delay.
    echo = conditions.pulse.bin_probability(n_bins - 1.0, 2 * n_bins - 1, acquisition.bin_width_s)
    level = np.maximum(conditions.background, _LEAST_BACKGROUND)[..., np.newaxis] / n_bins
    unfired = np.ones_like(histogram)
    if n_pulses is not None:
        unfired = n_pulses - np.cumsum(histogram, axis=-1)
    if rate is None and conditions.background_shape is not None:
        rate = level * conditions.background_shape
    b = level if rate is None else rate
    odds = np.exp(-b) / np.expm1(-b)  # of no photon to some, negative
    ratio = np.zeros_like(histogram)
    signal = np.asarray(conditions.signal)[..., np.newaxis]
    # At ten pulse widths from an echo, its photons change no digit of a realistic background.
    for at in np.flatnonzero(signal.max() * echo > _NEGLIGIBLE * b.min()):
        s, step = signal * echo[at], int(at) - n_bins + 1
        delay = slice(max(-step, 0), n_bins - max(step, 0))
        met = slice(max(step, 0), n_bins - max(-step, 0))
        here = slice(None) if rate is None else met
        if n_pulses is None:
            gain = np.log1p(s / b[..., here])
        else:  # of b + s to b: log (1 - exp(-b - s)) / (1 - exp(-b))
            gain = np.log1p(odds[..., here] * np.expm1(-s))
        ratio[..., delay] += gain * histogram[..., met] - s * unfired[..., met]
    return ratio


def log_rate_ratio(histogram: Floats, n_pulses: int | None, rate: Floats, other: Floats) -> Floats:
    """Log likelihood ratio of one rate to another.

    Parameters
    ----------
    histogram : ndarray, shape (..., bin)
    n_pulses : int or None
        As `Conditions.n_pulses`.
    rate, other : ndarray, shape (..., bin)
        Photons per pulse in each bin, positive.

    Returns
    -------
    ndarray, shape (...)
    """
    if n_pulses is None:
        return np.asarray((np.log(rate / other) * histogram - (rate - other)).sum(axis=-1))
    unfired = n_pulses - np.cumsum(histogram, axis=-1)
    gain = np.log(np.expm1(-rate) / np.expm1(-other))
    return np.asarray((gain * histogram - (rate - other) * unfired).sum(axis=-1))


class LikelihoodInput(NamedTuple):
    """A cube and its fluxes, in the layout of the kernels."""

    counts: NDArray[np.unsignedinteger]
    """Shape (block, bin, lane); fewer than `LANES` lanes if the table of delays is large."""
    signal: Floats
    """Shape (level, block, lane)."""
    background: Floats
    log_share: Floats
    depth: NDArray[np.float32]
    """`FluxModel.depth`, shape (delay,)."""
    echo: NDArray[np.float32]
    """Share of the photons of an echo per bin, shape (step, tap)."""
    echo_tail: NDArray[np.float32]
    """Share of them in that bin and later ones, shape (step, tap + 1)."""
    first_tap: int
    """Bins from a delay to the first tap of its echo."""
    n_pulses: int
    """0 if unknown."""
    background_shape: Floats
    """`FluxModel.relative_background`, shape (bin,)."""
    node: Floats
    """`core.inference.background.Nodes`, shape (node,)."""
    node_weight: Floats
    """Likewise, shape (node, bin)."""
    n_pixels: int
    work: int
    """Work of a likelihood of the whole image, in counts for `core.kernels.parallel.on_threads`."""


def prepare(
    capture: Capture, cube: NDArray[np.unsignedinteger], flux: FluxModel, steps_per_bin: int
) -> LikelihoodInput:
    """Lay out pixels (row, col, bin) and their fluxes, all at once."""
    lanes = lanes_of(flux.share.size, cube.shape[2] * steps_per_bin)
    flat = cube.reshape(-1, cube.shape[2])
    everyone = _Part(lane_counts(flat, lanes), slice(0, len(flat)), cube.size)
    return _with_echo(capture, everyone, flux, steps_per_bin)


def prepared_groups(
    capture: Capture, flux: FluxModel, steps_per_bin: int
) -> Iterator[tuple[slice, LikelihoodInput]]:
    """Lay out all pixels of a capture and their fluxes in groups that bound the memory.

    Yields
    ------
    pixels : slice
        Flat indices.
    prepared : LikelihoodInput
    """
    n_levels, n_pixels, n_bins = flux.share.size, capture.counts.size, capture.cube.shape[2]
    lanes = lanes_of(n_levels, n_bins * steps_per_bin)
    at_once = lanes * max(1, FLUX_NUMBERS // (n_levels * lanes))
    if lanes < LANES:
        at_once = lanes * max(1, TABLE_NUMBERS // (n_bins * lanes))
    flat = capture.cube.reshape(-1, n_bins)
    for first in range(0, n_pixels, at_once):
        some = slice(first, min(first + at_once, n_pixels))
        if lanes < LANES:
            counts = lane_counts(flat[some], lanes)
        else:
            counts = capture.blocks.counts[first // LANES : -(-some.stop // LANES)]
        part = _Part(counts, some, capture.cube.size)
        yield some, _with_echo(capture, part, flux, steps_per_bin)


def sampled_numbers(n_levels: int, n_bins: int) -> int:
    """Largest table of levels and delays of a sample of the pixels, in numbers."""
    return max(_SAMPLE_NUMBERS, n_levels * n_bins)


def lanes_of(n_levels: int, n_delays: int) -> int:
    """Pixels processed together, so that a table of their levels and delays stays small."""
    lanes = LANES
    while lanes > _FEWEST_LANES and n_levels * n_delays * lanes > TABLE_NUMBERS:
        lanes //= 2
    return lanes


def pixels_of(blocks: slice, prepared: LikelihoodInput, pixels: slice) -> slice:
    """Pixels of the image in some blocks of a group."""
    lanes, first = prepared.counts.shape[2], pixels.start
    return slice(first + blocks.start * lanes, min(first + blocks.stop * lanes, pixels.stop))


class _Part(NamedTuple):
    """Some pixels of an image in the layout of the kernels."""

    counts: NDArray[np.unsignedinteger]
    """`LikelihoodInput.counts`."""
    pixels: slice
    """Their flat indices in the image."""
    n_counts: int
    """Counts in the cube of the whole image."""


def _with_echo(
    capture: Capture, part: _Part, flux: FluxModel, steps_per_bin: int
) -> LikelihoodInput:
    """Combine a part of an image with the fluxes of the image."""
    acquisition, lanes = capture.acquisition, part.counts.shape[2]
    echo = _echo_of(capture.pulse, acquisition.n_bins, acquisition.bin_width_s, steps_per_bin)
    log_share = np.log(np.maximum(flux.share, np.finfo(float).tiny))
    return LikelihoodInput(
        part.counts,
        _in_lanes(flux.signal, part.pixels, lanes),
        _in_lanes(flux.background, part.pixels, lanes),
        log_share,
        np.repeat(flux.depth, steps_per_bin).astype(np.float32),
        *echo,
        capture.gated_pulses or 0,
        flux.relative_background,
        *nodes_of(flux.relative_background),
        part.pixels.stop - part.pixels.start,
        part.n_counts * steps_per_bin * (flux.share.size - 1) * _PASSES,
    )


@lru_cache(maxsize=64)
def _echo_of(
    pulse: Pulse, n_bins: int, bin_width_s: float, steps_per_bin: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], int]:
    """Return `LikelihoodInput.echo`, `echo_tail` and `first_tap`, which must not be changed."""
    # Delays are the centres of steps, so that steps fill the gate and every bin.
    delay = (np.arange(steps_per_bin) + 0.5) / steps_per_bin
    echo, first = pulse.taps(n_bins, bin_width_s, delay)
    tail = np.cumsum(echo[:, ::-1], axis=1)[:, ::-1]
    return echo.astype(np.float32), np.pad(tail, ((0, 0), (0, 1))).astype(np.float32), first


def _in_lanes(image: Floats, pixels: slice, lanes: int) -> Floats:
    """Lay out (level, row, col) as (level, block, lane), padded with the last pixel."""
    flat = image.reshape(len(image), -1)[:, pixels]
    n_pixels = flat.shape[1]
    filled = np.empty((len(image), -(-n_pixels // lanes) * lanes))
    filled[:, :n_pixels], filled[:, n_pixels:] = flat, flat[:, -1:]  # `numpy.pad` is slow
    return filled.reshape(len(image), -1, lanes)


def level_evidence(prepared: LikelihoodInput, depth: NDArray[np.float32] | None = None) -> Floats:
    """Log likelihood ratio of each level to no echo, (pixel, level).

    `depth` is the prior density of the delay relative to uniform, shape (delay,); uniform if None.
    """
    n_levels, n_blocks, lanes = prepared.signal.shape
    evidence = np.empty((n_blocks, lanes, n_levels))
    depth = np.ones_like(prepared.depth) if depth is None else depth
    in_steps = np.ascontiguousarray(depth.reshape(-1, len(prepared.echo)).T)
    on_threads(fill_evidence, n_blocks, prepared.work, prepared, in_steps, evidence)
    return evidence.reshape(-1, n_levels)[: prepared.n_pixels]


def level_densities(prepared: LikelihoodInput) -> NDArray[np.float32]:
    """Likelihood of each level and delay relative to the pixel's maximum (pixel, level, delay)."""
    n_levels, n_blocks, lanes = prepared.signal.shape
    density = np.empty((n_blocks, lanes, n_levels, prepared.depth.size), np.float32)
    on_threads(fill_densities, n_blocks, prepared.work, prepared, density)
    return density.reshape(-1, *density.shape[2:])[: prepared.n_pixels]


def delay_densities(
    prepared: LikelihoodInput,
) -> Iterator[tuple[slice, NDArray[np.float32], Floats, NDArray[np.float32]]]:
    """Likelihood ratio of each delay to no echo, averaged over the signal levels.

    Yields
    ------
    blocks : slice
    density : ndarray, shape (block, delay, lane)
        In units of ``exp(top)``.
    top : ndarray, shape (block, lane)
    weighted : ndarray, shape (block, level, delay, lane)
        Logarithm of the contribution of each level, without `FluxModel.depth`.
    """
    weight = prepared.log_share[1:, np.newaxis, np.newaxis].astype(np.float32)
    for some, log in _log_likelihoods(prepared):
        weighted = np.add(log[:, 1:], weight, out=log[:, 1:])
        top = weighted.max(axis=(1, 2), keepdims=True)
        part = weighted - top
        density = np.exp(part, out=part).sum(axis=1)
        density *= prepared.depth[:, np.newaxis]
        yield some, density, top[:, 0, 0].astype(float), weighted


def likeliest_delays(prepared: LikelihoodInput) -> tuple[NDArray[np.intp], Floats]:
    """Find the maximum of the density of `delay_densities` of each pixel.

    Returns
    -------
    delay : ndarray, shape (block, lane)
    log : ndarray, shape (block, lane, 3)
        Logarithm of the density before, at and after it; at the edges of the gate, at it.
    """
    shape = prepared.signal.shape[1:]
    best, around = np.empty(shape, np.intp), np.empty((*shape, 3))
    on_threads(fill_peaks, len(best), prepared.work, prepared, best, around)
    return best, around


def _log_likelihoods(prepared: LikelihoodInput) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Log likelihood ratio of each level and delay to no echo, some blocks at a time.

    Yields
    ------
    blocks : slice
    log : ndarray, shape (block, level, delay, lane)
    """
    n_levels, n_blocks, lanes = prepared.signal.shape
    n_delays = prepared.counts.shape[1] * prepared.echo.shape[0]
    at_once = max(1, NUMBERS_AT_ONCE // (n_levels * n_delays * lanes))
    for first in range(0, n_blocks, at_once):
        some = slice(first, min(first + at_once, n_blocks))
        log = np.empty((some.stop - first, n_levels, n_delays, lanes), np.float32)
        on_threads(fill_blocks, len(log), prepared.work, first, prepared, log)
        yield some, log
