"""Shape of the background over the gate: how the likelihood uses it, and how it is estimated.

The background of a pixel is its own total times a shape that all pixels share, 1 on average over
the bins. A slope, the decay of an afterglow at the opening of the gate, or backscatter differ from
the uniform background of ambient light and dark counts.

**Likelihood.** The gain ``ln((1 - exp(-b - s)) / (1 - exp(-b)))`` of a count is no longer the same
in all bins. It is a smooth function of ``ln b``, and so a sum ``Σ_j ℓ_j(ln b) gain(b_j)`` over a
few backgrounds ``b_j``, the nodes of a polynomial interpolation. The likelihood is then that of a
uniform background with as many histograms, ``ℓ_j(ln b_k) n_k``. A uniform background has one node.

**Estimate.** From a sample of the pixels, with the posterior of their delays: a bin of a pixel
counts with the probability that no echo is near it. If the model holds, what is counted is
distributed as background, wherever the surfaces lie and however many pixels have one. The logarithm
of the shape is a sum of Legendre polynomials of the time in the gate, fitted to the counts of all
pixels (iteratively reweighted least squares). Its degree maximises the likelihood minus a penalty
for each polynomial (Ledwina 1994, "Data-driven version of Neyman's smooth test of fit"), so that a
uniform background is found uniform but for `SIZE` of the captures.

Surfaces that most pixels see in addition, as through a net or a pane, are not background. They show
as peaks as wide as the pulse: where up to four echoes over a uniform background are likelier than
the shape, both with their penalties, the background is taken as uniform, and the goodness of fit
(`core.inference.fit`) warns. Such surfaces at many depths cannot be distinguished from background.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.kernels.background import add_echo_free

SIZE = 1e-3
"""Bound on the probability that a uniform background is taken for another."""

_PENALTY = 12.0  # of a polynomial in twice the log likelihood: 1 in 1900 of the first exceed it
_DEGREE = 12  # highest
_FITTING_STEPS = 8
_RANGE = 3.0  # largest logarithm of the shape, on either side of 0
_ERROR = 1e-5  # of the interpolation, relative
_BEFORE, _BEHIND = 1, 4  # lengths of a pulse around a delay that may hold an echo of another shape
_NOISE = 3.0  # standard deviations of a sum of squares
_MOST_FIRING = 0.5  # of the pulses that reach a bin, for a rate that few of them decide
_FEWEST_COUNTS = 0.5
_PHASES = np.array([0.25, 0.75])  # of delays in a bin that are tried
_MOST_ECHOES = 4  # of surfaces that pixels see in addition
_MIXING_STEPS = 60
_TINY = 1e-300  # instead of 0
_END = 0.1  # of the gate, on either side
_WIGGLES = 0.1  # of a slope, that are no second direction


class Nodes(NamedTuple):
    """Interpolation between a few backgrounds."""

    node: Floats
    """Backgrounds relative to the mean, shape (node,)."""
    weight: Floats
    """Weight of each in each bin, shape (node, bin)."""


def nodes_of(shape: Floats) -> Nodes:
    """Return the interpolation for the background shape of bins (bin,), 1 on average.

    Chebyshev nodes in the logarithm. The nearest singularities of the gain lie at ±iπ from real
    logarithms, which determines how fast the error falls with the number of nodes.
    """
    log = np.log(shape)
    middle, half = (log.max() + log.min()) / 2, (log.max() - log.min()) / 2
    if half == 0:
        return Nodes(np.ones(1), np.ones((1, shape.size)))
    ratio = math.pi / half
    n_nodes = math.ceil(-math.log(_ERROR) / math.asinh(ratio))
    at = middle + half * np.cos(math.pi * (np.arange(n_nodes) + 0.5) / n_nodes)
    apart = at[:, np.newaxis] - at
    np.fill_diagonal(apart, 1.0)
    off = log - np.repeat(at[np.newaxis], n_nodes, axis=0)[..., np.newaxis]
    off[np.arange(n_nodes), np.arange(n_nodes)] = 1.0
    weight = off.prod(axis=1) / apart.prod(axis=1)[:, np.newaxis]
    return Nodes(np.exp(at), weight)


def echo_window(capture: Capture) -> tuple[int, int]:
    """First bin and end, relative to that of the delay, of echoes of the pulse or similar ones."""
    length = capture.echo_bins
    return -1 - _BEFORE * length, 2 + _BEHIND * length


class EchoFree(NamedTuple):
    """Sums over the pixels of what they see in each bin, without an echo; each of shape (bin,)."""

    counts: Floats
    expected: Floats
    """Counts expected of the background of each pixel, relative to its shape."""
    armed: Floats
    """Armed pulses; pixels if all photons are counted."""


def echo_free(
    density: NDArray[np.float32],
    prior: Floats,
    background: Floats,
    counts: NDArray[np.unsignedinteger],
    n_pulses: int | None,
    echo_window: tuple[int, int],
    guess: Floats,
) -> EchoFree:
    """Add up the bins of pixels, each with the probability that it holds no echo.

    Parameters
    ----------
    density : ndarray, shape (pixel, level, bin)
        Likelihood of each signal level and of a delay in each bin. The first level is no echo.
    prior : ndarray, shape (level, bin)
        Prior probability of each.
    background : ndarray, shape (pixel, level)
        Background per pulse over the gate for each level.
    counts : ndarray, shape (pixel, bin)
    n_pulses : int or None
        None if all photons are counted.
    echo_window : (int, int)
        First bin and end, relative to that of a delay, that an echo may fill.
    guess : ndarray, shape (bin,)
        Shape of the background for which `density` was computed.
    """
    sums = np.zeros((3, guess.size))
    add_echo_free(
        density,
        prior,
        np.array(background, order="C"),
        counts.astype(np.uint32),  # compiled for one type of counts
        n_pulses or 0,
        echo_window,
        guess,
        sums,
    )
    return EchoFree(*sums)


def mean_background(free: EchoFree, is_first: bool, guess: Floats) -> float:
    """Estimate the mean background per pulse over the gate from bins without an echo.

    Takes the shape for which `free` was found. NaN if no bin is free of echoes, or if more than
    half of the pulses that reach one fire there.
    """
    exposed = float((free.armed * guess).sum())
    if exposed == 0:
        return math.nan
    rate = max(float(free.counts.sum()), _FEWEST_COUNTS) / exposed
    if is_first and rate > _MOST_FIRING:
        return math.nan
    return guess.size * (-math.log1p(-rate) if is_first else rate)


def fitted_shape(free: EchoFree, capture: Capture) -> Floats | None:
    """Fit the background shape to the counts in bins without an echo.

    Returns
    -------
    ndarray, shape (bin,), or None
        None if the counts do not contradict a uniform background, if the shape explains less of the
        contradiction than it leaves, or if a few echoes explain more: other surfaces, and not
        background.
    """
    seen, expected = free.counts, free.expected
    basis = _polynomials(seen.size)
    # A weak prior of smooth logarithms, for gaps that echoes leave in the gate.
    prior = np.diag(np.arange(basis.shape[1], dtype=float))
    log = np.zeros(seen.size)
    for _ in range(_FITTING_STEPS):
        mean = expected * np.exp(log)
        root = np.sqrt(mean)
        residual = np.divide(seen - mean, root, out=np.zeros_like(root), where=root > 0)
        q, r = np.linalg.qr(np.concatenate([root[:, np.newaxis] * basis, prior]))
        found = q[: root.size].T @ (root * log + residual)
        gain = np.cumsum(found[1:] ** 2 - _PENALTY)
        if not gain.max(initial=0.0) > 0:
            return None
        n = 2 + int(gain.argmax())
        log = basis[:, :n] @ scipy.linalg.solve_triangular(r[:n, :n], found[:n])
        log = np.clip(log, -_RANGE, _RANGE)
    shape, is_seen = np.exp(log), expected > 0
    mean = (expected * shape)[is_seen]
    left = float(((seen[is_seen] - mean) ** 2 / mean - 1).sum())
    noise = _NOISE * math.sqrt(2 * mean.size)
    is_smooth = left - noise < float((found[1:n] ** 2).sum())
    if not is_smooth or _echo_misfit(free, capture) < _misfit(seen, expected * shape, n - 1):
        return None
    return np.asarray(shape / shape.mean())


def _misfit(seen: Floats, mean: Floats, n_terms: int) -> float:
    """Twice the negative log likelihood of counts (bin,), with a penalty for each term."""
    excess = scipy.special.kl_div(seen, np.maximum(mean, _TINY)).sum()
    return 2 * float(excess) + _PENALTY * n_terms


def _echo_misfit(free: EchoFree, capture: Capture) -> float:
    """Return the least `_misfit` of up to `_MOST_ECHOES` echoes over a uniform background.

    Echoes of a surface that many pixels see have the shape of the pulse, scattered light and
    ambient light are broader. Only at the beginning of the gate scattered light may be as short.
    """
    components, least = free.expected[np.newaxis], math.inf
    for n_echoes in range(_MOST_ECHOES + 1):
        mean = np.maximum(_mixed(free.counts, components), _TINY)
        least = min(least, _misfit(free.counts, mean, 2 * n_echoes))
        components = np.vstack([components, _next_echo(free, mean, capture)])
    return least


def _next_echo(free: EchoFree, mean: Floats, capture: Capture) -> Floats:
    """Expected counts (bin,) of the echo of a photon that the residuals show most significantly.

    By the score test of its photons, ``(Σ_k c_k (n_k / μ_k - 1))² / Σ_k c_k² / μ_k``.
    """
    n_bins = mean.size
    echoes, first = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s, _PHASES)
    slope, bend = free.armed * (free.counts / mean - 1), free.armed**2 / mean
    along = np.stack([_correlated(slope, echo, first) for echo in echoes])
    across = np.stack([_correlated(bend, echo**2, first) for echo in echoes])
    score = np.maximum(along, 0.0) / np.sqrt(np.maximum(across, _TINY))
    score[:, : capture.echo_bins] = 0.0
    phase, delay = np.unravel_index(score.argmax(), score.shape)
    at_delay = np.zeros(n_bins)
    at_delay[delay] = 1.0
    return free.armed * _correlated(at_delay, echoes[phase, ::-1], 1 - first - len(echoes[phase]))


def _correlated(values: Floats, taps: Floats, first: int) -> Floats:
    """Compute ``Σ_t taps_t values_(k + first + t)`` for each bin k, shape (bin,)."""
    padded = np.pad(values, (max(-first, 0), max(first, 0) + taps.size - 1))
    return np.correlate(padded, taps, "valid")[max(first, 0) :][: values.size]


def _mixed(counts: Floats, components: Floats) -> Floats:
    """Fit counts (bin,) by a mixture of components (component, bin), by maximum likelihood."""
    area = np.maximum(components.sum(axis=1), _TINY)
    share = np.full(len(area), counts.sum() / area.size) / area
    for _ in range(_MIXING_STEPS):
        mean = np.maximum(np.vecmat(share, components), _TINY)
        share = share * np.matvec(components, counts / mean) / area
    return np.asarray(np.vecmat(share, components))


@lru_cache(maxsize=16)
def _polynomials(n_bins: int) -> Floats:
    """Orthonormal Legendre polynomials of the time in the gate, shape (bin, degree)."""
    degree = min(_DEGREE, n_bins - 1)
    time = (2 * np.arange(n_bins) + 1) / n_bins - 1
    norm = np.sqrt(2 * np.arange(degree + 1.0) + 1)
    return np.asarray(np.polynomial.legendre.legvander(time, degree) * norm, float)


def peaks_inside(shape: Floats) -> bool:
    """Return whether a background shape (bin,) is largest at neither end of the gate.

    Scattered light and afterglow fall from its beginning.
    """
    end = max(1, round(_END * shape.size))
    return bool(end <= shape.argmax() < shape.size - end)


def shape_text(shape: Floats | None) -> str:
    """Describe a background shape (bin,), None for a uniform one, by a clause."""
    if shape is None:
        return "the background is uniform over the gate"
    first, last = float(shape[0]), float(shape[-1])
    low, high = float(shape.min()), float(shape.max())
    if high - low <= (1 + _WIGGLES) * abs(last - first):
        direction = "rises" if last > first else "falls"
        return f"the background {direction} by {abs(last / first - 1) * 100:.0f} % over the gate"
    return (
        f"the background varies over the gate, from {low:.2g} of its mean in bin "
        f"{shape.argmin()} to {high:.2g} in bin {shape.argmax()}"
    )
