"""Exact first-photon likelihood of an echo's delay and signal level.

With background ``b`` and signal ``s_k(d) = S p_k(d)`` photons per pulse in bin ``k``, ``n_k``
detections and ``A_k`` armed pulses, the log likelihood ratio of an echo at delay ``d`` to no echo
is ::

    T(d) = Σ_k [ n_k ln((1 - exp(-b - s_k)) / (1 - exp(-b))) - (A_k - n_k) s_k ]

which is exact for the trigger probabilities of Eq. 1. Where the number of pulses is unknown, or
where a pulse may fire more than once, counts are Poisson: ``ln(1 + s_k / b)`` and ``-s_k``, with
photons per pixel instead of per pulse.

`log_likelihood_ratio` is the equation as written. The tables of all pixels, levels and delays are
computed in float32 by `core.kernels.posterior`, a few blocks of pixels at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.capture import Capture
from core.inference.flux_model import FluxModel
from core.kernels.blocks import LANES, lane_counts
from core.kernels.parallel import entering
from core.kernels.posterior import fill_blocks

_AT_ONCE = 2**19  # numbers: what is made of them should find them in the cache
_SAMPLE_NUMBERS = 2**25  # likelihoods of the sample's levels and delays that are held: 128 MiB
_TABLE_NUMBERS = 2**22  # likelihoods of a block's levels and delays: 16 MiB
_FEWEST_LANES = 2  # a single lane would be summed pairwise by numpy, which rounds differently
_FLUX_NUMBERS = 2**20  # backgrounds of levels and pixels that are laid out at once
_DARKEST = 1e-100  # photons: with none at all one count would outweigh every other, without end


class Conditions(NamedTuple):
    """What is known of histograms (..., bin) besides their counts."""

    acquisition: Acquisition
    pulse: Pulse
    n_pulses: int | None
    """Pulses sent, where counts are first photons; None where that is not known."""
    signal: Floats
    """Signal photons per pulse, (...) or scalar; per histogram where `n_pulses` is None."""
    background: Floats
    """Background photons per pulse over the gate, likewise."""
    contrast: float
    """Signal over background, both as they are on average over the image."""
    pile_up: bool = True
    """`FluxModel.pile_up`."""


def rate_and_n_armed(histogram: Floats, n_pulses: int | None) -> tuple[Floats, Floats]:
    """Rate of each bin with the pile-up undone (Coates 1968), and the pulses that tell of it.

    Parameters
    ----------
    histogram : ndarray, shape (..., bin)
        Counts, or expected counts.
    n_pulses : int or None
        Pulses sent; None where that is not known, or where a pulse fires more than once.

    Returns
    -------
    rate : ndarray, shape (..., bin)
        Detections per pulse were the detector always armed. A bin in which every armed pulse fired
        counts half a pulse less, so that its rate is finite; those behind it count 0. The counts
        themselves where `n_pulses` is None.
    armed : ndarray, shape (..., bin)
        Pulses armed before each bin; 1 everywhere where `n_pulses` is None.
    """
    if n_pulses is None:
        return histogram, np.ones_like(histogram)
    armed = n_pulses - np.cumsum(histogram, axis=-1) + histogram
    fired = np.divide(histogram, armed, out=np.zeros_like(histogram), where=armed > 0)
    most = 1 - 0.5 / np.maximum(armed, 1.0)
    return np.asarray(-np.log1p(-np.minimum(fired, most))), np.maximum(armed, 0.0)


def log_likelihood_ratio(histogram: Floats, conditions: Conditions) -> Floats:
    """``T(d)`` of the module's docstring at each bin's beginning, as written.

    Parameters
    ----------
    histogram : ndarray, shape (..., bin)
    conditions : Conditions

    Returns
    -------
    ndarray, shape (..., bin)
    """
    acquisition, n_pulses = conditions.acquisition, conditions.n_pulses
    n_bins = acquisition.n_bins
    # An echo at whole bins is one filter: its share in the bin that lies `step` behind the delay.
    echo = conditions.pulse.bin_probability(n_bins - 1.0, 2 * n_bins - 1, acquisition.bin_width_s)
    b = np.maximum(conditions.background, _DARKEST)[..., np.newaxis] / n_bins
    unfired = np.ones_like(histogram)
    if n_pulses is not None:
        unfired = n_pulses - np.cumsum(histogram, axis=-1)
    ratio = np.zeros_like(histogram)
    for at in np.flatnonzero(echo):
        s, step = np.asarray(conditions.signal)[..., np.newaxis] * echo[at], int(at) - n_bins + 1
        gain = np.log1p(s / b) if n_pulses is None else np.log(np.expm1(-(b + s)) / np.expm1(-b))
        delay = slice(max(-step, 0), n_bins - max(step, 0))
        met = slice(max(step, 0), n_bins - max(-step, 0))
        ratio[..., delay] += gain * histogram[..., met] - s * unfired[..., met]
    return ratio


class LikelihoodInput(NamedTuple):
    """A cube and its light, as the kernels take them."""

    counts: NDArray[np.unsignedinteger]
    """Shape (block, bin, lane): `LANES` lanes, fewer where a table of all delays would be large."""
    signal: Floats
    """Shape (level, block, lane)."""
    background: Floats
    log_share: Floats
    depth: NDArray[np.float32]
    """`FluxModel.depth`, shape (delay,)."""
    echo: NDArray[np.float32]
    """Share of an echo's photons per bin, shape (step, tap)."""
    first_tap: int
    """Bins from a delay to its echo's first tap."""
    n_pulses: int
    """0 where not known."""
    n_pixels: int
    n_counts: int
    """Number of counts in the whole cube that these pixels are a part of."""


def prepare(
    capture: Capture, cube: NDArray[np.unsignedinteger], flux: FluxModel, steps_per_bin: int
) -> LikelihoodInput:
    """Pixels (row, col, bin) and their light, all at once."""
    lanes = lanes_of(flux.share.size, cube.shape[2] * steps_per_bin)
    flat = cube.reshape(-1, cube.shape[2])
    everyone = _Part(lane_counts(flat, lanes), slice(0, len(flat)), cube.size)
    return _with_echo(capture, everyone, flux, steps_per_bin)


def prepared_groups(
    capture: Capture, flux: FluxModel, steps_per_bin: int
) -> Iterator[tuple[slice, LikelihoodInput]]:
    """All pixels of a capture and their light, so many at a time as keep what is laid out small.

    Yields
    ------
    pixels : slice
        Flat indices.
    prepared : LikelihoodInput
    """
    n_levels, n_pixels, n_bins = flux.share.size, capture.counts.size, capture.cube.shape[2]
    lanes = lanes_of(n_levels, n_bins * steps_per_bin)
    at_once = lanes * max(1, _FLUX_NUMBERS // (n_levels * lanes))
    if lanes < LANES:
        at_once = lanes * max(1, _TABLE_NUMBERS // (n_bins * lanes))
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
    """Largest table of levels and delays that is held of a sample of the pixels, in numbers."""
    return max(_SAMPLE_NUMBERS, n_levels * n_bins)


def lanes_of(n_levels: int, n_delays: int) -> int:
    """Pixels treated together, so that a table of their levels and delays stays small."""
    lanes = LANES
    while lanes > _FEWEST_LANES and n_levels * n_delays * lanes > _TABLE_NUMBERS:
        lanes //= 2
    return lanes


def pixels_of(blocks: slice, prepared: LikelihoodInput, pixels: slice) -> slice:
    """Which of the image's pixels some blocks of a group hold."""
    lanes, first = prepared.counts.shape[2], pixels.start
    return slice(first + blocks.start * lanes, min(first + blocks.stop * lanes, pixels.stop))


class _Part(NamedTuple):
    """Some pixels of an image, laid out."""

    counts: NDArray[np.unsignedinteger]
    """As `LikelihoodInput.counts`."""
    pixels: slice
    """Their flat indices in the image."""
    of_counts: int
    """Counts of the whole image."""


def _with_echo(
    capture: Capture, part: _Part, flux: FluxModel, steps_per_bin: int
) -> LikelihoodInput:
    """A part of an image with its light, that of the image being given."""
    acquisition, lanes = capture.acquisition, part.counts.shape[2]
    # Delays stand for the step around them, so that whole steps fill the gate and any whole bins.
    delay = (np.arange(steps_per_bin) + 0.5) / steps_per_bin
    echo, first = capture.pulse.taps(acquisition.n_bins, acquisition.bin_width_s, delay)
    log_share = np.log(np.maximum(flux.share, np.finfo(float).tiny))
    return LikelihoodInput(
        part.counts,
        _in_lanes(flux.signal, part.pixels, lanes),
        _in_lanes(flux.background, part.pixels, lanes),
        log_share,
        np.repeat(flux.depth, steps_per_bin).astype(np.float32),
        echo.astype(np.float32),
        first,
        capture.gated_pulses or 0,
        part.pixels.stop - part.pixels.start,
        part.of_counts,
    )


def _in_lanes(image: Floats, pixels: slice, lanes: int) -> Floats:
    """Some of (level, row, col) as (level, block, lane); the last block repeats its last pixel."""
    flat = image.reshape(len(image), -1)[:, pixels]
    filled = np.pad(flat, ((0, 0), (0, -flat.shape[1] % lanes)), mode="edge")
    return np.ascontiguousarray(filled.reshape(len(image), -1, lanes))


def level_evidence(prepared: LikelihoodInput, depth: NDArray[np.float32] | float = 1.0) -> Floats:
    """Log likelihood of each level over that of no echo, (pixel, level).

    How much more often a delay occurs than others is `depth`, of shape (delay, 1).
    """
    n_levels, n_blocks, lanes = prepared.signal.shape
    evidence = np.empty((n_blocks, lanes, n_levels))
    # Some levels at a time, each with the first one, which the others are compared with.
    table = prepared.depth.size * lanes
    at_once = max(1, _TABLE_NUMBERS // table - 1)
    evidence[..., 0] = 0.0
    for first in range(1, n_levels, at_once):
        levels = [0, *range(first, min(first + at_once, n_levels))]
        few = prepared
        if len(levels) < n_levels:
            few = prepared._replace(
                signal=prepared.signal[levels], background=prepared.background[levels]
            )
        for some, log in _log_likelihoods(few):
            top = log.max(axis=2)
            np.subtract(log, top[:, :, np.newaxis], out=log)
            density = np.exp(log, out=log)
            density *= depth
            mean = density.mean(axis=2)
            evidence[some, :, levels] = (top + np.log(mean)).transpose(0, 2, 1)
    return evidence.reshape(-1, n_levels)[: prepared.n_pixels]


def level_densities(prepared: LikelihoodInput) -> NDArray[np.float32]:
    """Likelihood of each level and delay over the pixel's largest; (pixel, level, delay)."""
    n_levels, n_blocks, lanes = prepared.signal.shape
    n_copied = n_blocks if n_blocks > 1 else 0
    densities = np.empty((n_copied, lanes, n_levels, prepared.depth.size), np.float32)
    for some, log in _log_likelihoods(prepared):
        np.subtract(log, log.max(axis=(1, 2), keepdims=True), out=log)
        density = np.exp(log, out=log).transpose(0, 3, 1, 2)
        if n_blocks == 1:
            densities = density  # as it lies: a copy would take as much again
        else:
            densities[some] = density
    return densities.reshape(-1, *densities.shape[2:])[: prepared.n_pixels]


def delay_densities(
    prepared: LikelihoodInput,
) -> Iterator[tuple[slice, NDArray[np.float32], Floats, NDArray[np.float32]]]:
    """Likelihood of each delay over that of no echo, all levels of signal weighted.

    Yields
    ------
    blocks : slice
    density : ndarray, shape (block, delay, lane)
        In units of ``exp(top)``.
    top : ndarray, shape (block, lane)
    weighted : ndarray, shape (block, level, delay, lane)
        Logarithms that the density is made of, level by level, `FluxModel.depth` left out.
    """
    weight = prepared.log_share[1:, np.newaxis, np.newaxis].astype(np.float32)
    for some, log in _log_likelihoods(prepared):
        weighted = np.add(log[:, 1:], weight, out=log[:, 1:])
        top = weighted.max(axis=(1, 2), keepdims=True)
        part = weighted - top
        density = np.exp(part, out=part).sum(axis=1)
        density *= prepared.depth[:, np.newaxis]
        yield some, density, top[:, 0, 0].astype(float), weighted


def delay_curves(
    prepared: LikelihoodInput,
) -> Iterator[tuple[slice, NDArray[np.float32], NDArray[np.float32]]]:
    """A curve that is highest where the density of `delay_densities` is, and what that is made of.

    Of one level there is nothing to average: its logarithms do, and exponentials are what costs.
    """
    if len(prepared.signal) > 2:
        for some, density, _, weighted in delay_densities(prepared):
            yield some, density, weighted
        return
    depth = np.log(prepared.depth)[:, np.newaxis]
    for some, log in _log_likelihoods(prepared):
        weighted = log[:, 1:] + np.float32(prepared.log_share[1])
        yield some, weighted[:, 0] + depth, weighted


def _log_likelihoods(prepared: LikelihoodInput) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Log likelihood of each level and delay over that of no echo, some blocks at a time.

    Yields
    ------
    blocks : slice
    log : ndarray, shape (block, level, delay, lane)
    """
    n_levels, n_blocks, lanes = prepared.signal.shape
    n_delays = prepared.counts.shape[1] * prepared.echo.shape[0]
    at_once = max(1, _AT_ONCE // (n_levels * n_delays * lanes))
    for first in range(0, n_blocks, at_once):
        some = slice(first, min(first + at_once, n_blocks))
        log = np.empty((some.stop - first, n_levels, n_delays, lanes), np.float32)
        with entering(prepared.n_counts):
            fill_blocks(first, prepared, log)
        yield some, log
