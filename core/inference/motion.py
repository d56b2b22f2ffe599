"""Radial velocity of surfaces, from groups of pulses in order (`core.pulse_groups`).

The exact log likelihood ratio (`core.inference.likelihood`) of each group of pulses is displaced by
the distance that a surface of one velocity has moved until then, and added to those of the others.
The evidence of a velocity is the mean likelihood over all delays in the middle of the recording and
over the signal levels. Pixels near each other mostly move alike, so that their evidence is added.

Velocities are displacements over the whole recording in bins, positive if a surface recedes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from core.acquisition import Floats
from core.capture import Capture
from core.inference.flux import flux_model_of, flux_model_with, flux_prior_of
from core.inference.flux_model import FluxModel
from core.inference.likelihood import LikelihoodInput, prepared_groups
from core.inference.neighbours import box_sum
from core.inference.posterior import vertex
from core.kernels.blocks import lane_counts
from core.kernels.motion import AT_ONCE, fill_moving_delays, fill_velocity_evidence
from core.kernels.parallel import on_threads
from core.labels import Plane
from core.pulse_groups import PulseGroups

STEPS_PER_BIN = 4
"""Delays tried in each bin for moving surfaces. In steps of half a bin, the interpolation between
displacements would make velocities of a whole step per group less likely than others."""

_SIGMAS = 1.96  # of a 95 % interval
_LEVEL = 0.95
_BISECTIONS = 40
_LEAST_CURVATURE = 1e-9
_TRIED_PER_BIN = 2  # delays whose mean is the evidence; one would depend on where in a bin they lie
_SINGLE = 0.01  # prior share of pixels with a velocity of their own
_PIXELS_KNOWN = 50.0  # pixels that this prior counts for
_SHARE_STEPS = 10
_CLEAR_DEVIATIONS = 2.0  # of the spread of the velocities of a neighbourhood, beyond chance
_FINE = 4  # velocities per bin for which delays are found


@dataclass(frozen=True, eq=False)
class RadialVelocity:
    """Radial velocity of the surface in each pixel, positive if it recedes.

    Parameters
    ----------
    bins : ndarray, shape (row, col)
        Velocity in bins per 1000 pulses.
    sd_bins : ndarray, shape (row, col)
        Standard deviation of its error, infinite where it is not known: half the width of the 95 %
        interval over 1.96. It allows for velocities that differ from pixel to pixel where the
        photons show this; smaller differences are not seen, and then intervals are too narrow.
    m_per_s : float, optional
        Metres per second of a bin per 1000 pulses; None where the pulse rate is not known.
    """

    bins: Floats
    sd_bins: Floats
    m_per_s: float | None = None

    @property
    def values(self) -> Floats:
        """Velocity in `unit`, shape (row, col)."""
        return self.bins * (self.m_per_s or 1.0)

    @property
    def unit(self) -> str:
        """Metres per second where the pulse rate is known."""
        return "bins per 1000 pulses" if self.m_per_s is None else "m/s"

    def text_at(self, row: int, col: int) -> str:
        """Velocity of a pixel with its 95 % interval, such as ``-20.1 m/s, -20.8 to -19.4 (95 %)``.

        Without an interval where the fastest velocity that was tried is the likeliest.
        """
        scale = self.m_per_s or 1.0
        value, half = float(self.values[row, col]), _SIGMAS * scale * float(self.sd_bins[row, col])
        found = f"{value:.3g} {self.unit}"
        if not math.isfinite(half):
            return f"{found} or more, the fastest that was tried"
        decimals = max(0, 1 - math.floor(math.log10(half)))
        low, high = f"{value - half:.{decimals}f}", f"{value + half:.{decimals}f}"
        return f"{value:.{decimals}f} {self.unit}, {low} to {high} (95 %)"

    def planes(self, valid: NDArray[np.bool_]) -> dict[str, Plane]:
        """Return velocities and their standard deviations as images, NaN where not `valid`."""
        meaning = "radial velocity of the surface, positive if it recedes"
        error = "standard deviation of the radial velocity"
        scales = {"bins": ("1", 1.0)}
        if self.m_per_s is not None:
            scales["m_per_s"] = "m s-1", self.m_per_s
        return {
            f"{name}_{suffix}": Plane(
                np.where(valid, values * scale, np.nan),
                unit,
                said + (", in bins per 1000 pulses" if suffix == "bins" else ""),
            )
            for suffix, (unit, scale) in scales.items()
            for name, values, said in (
                ("velocity", self.bins, meaning),
                ("velocity_sd", self.sd_bins, error),
            )
        }


class Velocity(NamedTuple):
    """Velocity of the surface in each pixel, each of shape (row, col)."""

    travel_bins: Floats
    """Displacement over the whole recording in bins, positive if the surface recedes."""
    sd_bins: Floats
    """As `RadialVelocity.sd_bins`; infinite at the end of the velocities tried."""

    def of(self, capture: Capture, groups: PulseGroups) -> RadialVelocity:
        """Return the velocities per 1000 pulses of a capture."""
        per_1000 = 1000 / sum(groups.n_pulses)
        rate_hz = groups.pulse_rate_hz
        m_per_s = rate_hz and capture.acquisition.bin_length_m * rate_hz / 1000
        return RadialVelocity(self.travel_bins * per_1000, self.sd_bins * per_1000, m_per_s)


class MovingSurfaces(NamedTuple):
    """Posterior of the delay in the middle of the recording, given the velocity of each pixel."""

    delay_bin: Floats
    """Likeliest delay, shape (row, col)."""
    score: Floats
    """Log likelihood ratio to no echo at it."""
    surface: NDArray[np.float32]
    """Probability of a surface in each bin, shape (row, col, bin)."""


def velocity_evidence(
    capture: Capture,
    groups: PulseGroups,
    flux: FluxModel,
    travel_bins: NDArray[np.intp],
    tried_per_bin: int = _TRIED_PER_BIN,
) -> Floats:
    """Log likelihood ratio of each velocity to no echo, shape (row, col, velocity).

    Parameters
    ----------
    capture : Capture
    groups : PulseGroups
        Those of the capture.
    flux : FluxModel
    travel_bins : ndarray of int, shape (velocity,)
        Displacements over the recording.
    tried_per_bin : int
        Delays tried in each bin, up to `STEPS_PER_BIN`.
    """
    evidence = np.empty((capture.counts.size, travel_bins.size))
    displaced = _displacements(travel_bins, groups)
    for pixels, prepared, counts in _parts(capture, groups, flux):
        lanes = counts.shape[3]
        found = np.empty((travel_bins.size, counts.shape[1], lanes))
        exposure, margin = _exposure(capture, groups), _margin_bins(displaced)
        given = prepared, counts, exposure, displaced, margin, tried_per_bin, found
        on_threads(fill_velocity_evidence, counts.shape[1], counts.size * travel_bins.size, *given)
        evidence[pixels] = found.reshape(travel_bins.size, -1).T[: pixels.stop - pixels.start]
    return evidence.reshape(*capture.shape, travel_bins.size)


def shared_velocity(
    capture: Capture,
    groups: PulseGroups,
    flux: FluxModel,
    most_bins: int,
    window_size: int,
    step_bins: int = 1,
) -> Velocity:
    """Find the velocity of each pixel by the evidence of the pixels around it.

    Half of the prior is rest, the other half spread evenly over the velocities: a scene at rest is
    not ranged with velocities of chance. Intervals are those without this preference.

    Parameters
    ----------
    capture : Capture
    groups : PulseGroups
        Those of the capture.
    flux : FluxModel
    most_bins : int
        Largest displacement over the recording.
    window_size : int
        Rows and columns of the neighbourhood, odd.
    step_bins : int
        Difference of the displacements tried; a parabola refines between them.
    """
    at_rest = most_bins // step_bins
    travel_bins = np.arange(-at_rest, at_rest + 1) * step_bins
    tried_per_bin = max(1, _TRIED_PER_BIN // step_bins)
    alone = velocity_evidence(capture, groups, flux, travel_bins, tried_per_bin)
    evidence = box_sum(alone, window_size, "constant")
    best = evidence.argmax(axis=2)
    at, slope, curvature = _parabola(evidence, best)
    inside = (best > 0) & (best < travel_bins.size - 1)
    curvature = np.maximum(curvature, _LEAST_CURVATURE)
    steps = np.where(inside, np.clip(slope / curvature, -0.5, 0.5), 0.0)
    sd_steps = 1 / np.sqrt(curvature)
    peak = at + slope * steps - curvature * steps**2 / 2
    # Share of the prior of a displacement by a step that lies in the peak.
    width = np.log(np.minimum(math.sqrt(2 * math.pi) * sd_steps, 1.0))
    odds = math.log(max(2 * at_rest, 1))  # of rest and of another velocity
    is_at_rest = evidence[:, :, at_rest] + odds >= peak + width
    found = np.where(is_at_rest, at_rest, best + steps)
    spread = _Spread(alone, evidence, best + steps, sd_steps, found)
    half = np.where(inside, _half_widths(spread, window_size), np.inf)
    return Velocity(step_bins * (found - at_rest), step_bins * half / _SIGMAS)


def _parabola(evidence: Floats, place: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Value, slope and negative curvature of the evidence (row, col, velocity) at some places."""
    around = np.stack([place - 1, place, place + 1], axis=2)
    around = np.clip(around, 0, evidence.shape[2] - 1)
    before, at, after = np.moveaxis(np.take_along_axis(evidence, around, axis=2), 2, 0)
    return at, (after - before) / 2, 2 * at - before - after


class _Spread(NamedTuple):
    """Evidence and estimates of velocities, in units of their steps, from the first one."""

    alone: Floats
    """Evidence of each pixel, shape (row, col, velocity)."""
    evidence: Floats
    """Evidence of the pixels around it, likewise."""
    likeliest: Floats
    """Maximum of that evidence, shape (row, col)."""
    sd: Floats
    """Standard deviation of the error of the maximum, likewise, by its curvature."""
    found: Floats
    """Estimate, likewise."""


def _disagreement(
    alone: Floats, likeliest: Floats, window_size: int
) -> tuple[Floats, Floats, Floats]:
    """Compare the evidence of pixels (row, col, velocity) with the maximum of their neighbourhood.

    Returns
    -------
    scatter : ndarray, shape (row, col)
        Variance of the velocities in the neighbourhood; 0 where it may be chance. The squared slope
        of the evidence of a pixel exceeds its curvature by the squared curvature times this.
    widening : ndarray, shape (row, col)
        Variance of the shared velocity over that by the curvature of the evidence.
    is_own : ndarray, shape (row, col)
        Probability that a pixel has a velocity of its own.
    """
    (rows, cols, n_steps), half = alone.shape, window_size // 2
    # Evidence of 0, as beyond the image, agrees with any velocity.
    around = [(half, half), (half, half)]
    wide = np.pad(np.pad(alone, [(0, 0), (0, 0), (1, 1)], mode="edge"), [*around, (0, 0)])
    own = np.pad(np.logaddexp.reduce(alone, axis=2) - math.log(n_steps), around)
    place = np.rint(likeliest).astype(np.intp)
    n_pixels, col = window_size**2, np.arange(window_size)[:, np.newaxis] + np.arange(cols)
    scatter, widening, is_own = np.empty((3, rows, cols))
    for row in range(rows):
        near = wide[row : row + window_size]
        before, at, after = (
            near[:, col, place[row] + step].reshape(n_pixels, cols) for step in range(3)
        )
        off = likeliest[row] - place[row]
        slope, information = (after - before) / 2, 2 * at - before - after
        score = slope - information * off
        beyond = score**2 - information  # 0 on average if all pixels have one velocity
        excess = beyond.sum(axis=0)
        chance = np.sqrt(n_pixels * beyond.var(axis=0))
        is_clear = (excess > _CLEAR_DEVIATIONS * chance) & (n_pixels > 1)
        known = np.maximum(information, _LEAST_CURVATURE)
        scatter[row] = np.where(is_clear, excess / (known**2).sum(axis=0), 0.0)
        widening[row] = np.where(is_clear, 1 + excess / known.sum(axis=0), 1.0)
        # Share of pixels with a velocity of their own, by expectation maximisation.
        shared = at + slope * off - information * off**2 / 2
        own_here = own[row : row + window_size][:, col].reshape(n_pixels, cols)
        ratio = np.exp(np.clip(own_here - shared, -500.0, 500.0))
        share = np.full(cols, _SINGLE)
        for _ in range(_SHARE_STEPS):
            total = (share * ratio / (1 - share + share * ratio)).sum(axis=0)
            share = (total + _SINGLE * _PIXELS_KNOWN) / (n_pixels + _PIXELS_KNOWN)
        middle = ratio[n_pixels // 2]
        is_own[row] = share * middle / (1 - share + share * middle)
    return scatter, widening, is_own


def _half_widths(spread: _Spread, window_size: int) -> Floats:
    """Distances (row, col) from the estimates that hold the velocities with 95 % probability.

    The velocity of a pixel is that of its neighbourhood or one of its own, uniform over those
    tried. How many have one of their own is learned in each neighbourhood. Where the velocities
    near the shared one scatter by more than chance, it is a pixel's with this scatter.
    """
    alone, evidence, likeliest, sd, found = spread
    n_steps = alone.shape[2]
    scatter, widening, is_own = _disagreement(alone, likeliest, window_size)
    # Distributions over the velocities tried; around the maximum, a normal one.
    steps, peak = np.arange(n_steps), evidence.max(axis=2, keepdims=True)
    is_far = np.abs(steps - np.rint(likeliest)[..., np.newaxis]) > 1
    far = np.where(is_far, np.exp(evidence - peak), 0.0)
    ends = np.rint(likeliest) - 1.5 - likeliest, np.rint(likeliest) + 1.5 - likeliest
    near = ndtr(ends[1] / sd) - ndtr(ends[0] / sd)
    mass = sd * near * math.sqrt(2 * math.pi)
    total = mass + far.sum(axis=2)
    is_scattered = scatter > 0
    limits = np.where(is_scattered, -np.inf, ends[0]), np.where(is_scattered, np.inf, ends[1])
    sd = np.sqrt(widening * sd**2 + scatter)
    share_near = (1 - is_own) * mass / total / np.where(is_scattered, 1.0, near)

    def near_until(at: Floats) -> Floats:
        return np.asarray(ndtr(np.clip(at - likeliest, *limits) / sd))

    by_step = (1 - is_own)[..., np.newaxis] * far / total[..., np.newaxis]
    of_own = np.exp(alone - np.logaddexp.reduce(alone, axis=2, keepdims=True))
    by_step += is_own[..., np.newaxis] * of_own
    distance = np.abs(steps - found[..., np.newaxis])
    low, high = np.zeros(found.shape), np.full(found.shape, float(n_steps))
    for _ in range(_BISECTIONS):
        half = (low + high) / 2
        held = share_near * (near_until(found + half) - near_until(found - half))
        held += (by_step * np.clip(half[..., np.newaxis] - distance + 0.5, 0.0, 1.0)).sum(axis=2)
        low, high = np.where(held < _LEVEL, half, low), np.where(held < _LEVEL, high, half)
    return high


def moving_surfaces(
    capture: Capture, groups: PulseGroups, flux: FluxModel, travel_bins: Floats
) -> MovingSurfaces:
    """Find the delay of each pixel in the middle of the recording, given its velocity.

    Parameters
    ----------
    capture : Capture
    groups : PulseGroups
        Those of the capture.
    flux : FluxModel
    travel_bins : ndarray, shape (row, col)
        Displacements over the recording.
    """
    tried, row_of = np.unique(np.rint(travel_bins.ravel() * _FINE), return_inverse=True)
    displaced = _displacements(tried / _FINE, groups)
    delay, score = np.empty((2, capture.counts.size))
    surface = np.empty((capture.counts.size, capture.cube.shape[2]), np.float32)
    for pixels, prepared, counts in _parts(capture, groups, flux):
        _, n_blocks, n_bins, lanes = counts.shape
        n_pixels = pixels.stop - pixels.start
        velocity = np.zeros(n_blocks * lanes, np.intp)
        velocity[:n_pixels] = row_of[pixels]
        best, around = np.empty((n_blocks, lanes), np.intp), np.empty((n_blocks, lanes, 3))
        found = np.empty((n_blocks, lanes, n_bins), np.float32)
        on_threads(
            fill_moving_delays,
            n_blocks,
            counts.size,
            prepared,
            counts,
            _exposure(capture, groups),
            displaced,
            _margin_bins(displaced),
            velocity.reshape(n_blocks, lanes),
            best,
            around,
            found,
        )
        at = vertex(best, STEPS_PER_BIN * n_bins - 1, np.moveaxis(around, 2, 0))
        delay[pixels] = at.ravel()[:n_pixels] / STEPS_PER_BIN
        score[pixels] = around[:, :, 1].ravel()[:n_pixels]
        surface[pixels] = found.reshape(-1, n_bins)[:n_pixels]
    shape = capture.shape
    return MovingSurfaces(delay.reshape(shape), score.reshape(shape), surface.reshape(*shape, -1))


def flux_at_rest(capture: Capture, groups: PulseGroups, travel_bins: Floats) -> FluxModel:
    """Estimate the fluxes of a capture as if its surfaces were at rest.

    Motion spreads an echo over bins, so that its signal is taken for weaker, and a part of it for a
    background that varies over the gate. Here each group is
    displaced by whole bins first, and only the bins that all groups then have are used. Where these
    are less than half of the gate, the fluxes are those of the capture as it is.

    Parameters
    ----------
    capture : Capture
    groups : PulseGroups
        Those of the capture.
    travel_bins : ndarray, shape (row, col)
        Displacements over the recording.
    """
    acquisition, known = capture.acquisition, flux_prior_of(capture)
    whole = np.rint(np.multiply.outer(groups.middle, travel_bins)).astype(np.intp)
    edge, n_bins = int(np.abs(whole).max()), acquisition.n_bins
    if edge == 0 or 4 * edge > n_bins:
        return flux_model_of(capture)
    bins = np.arange(edge, n_bins - edge)
    cube, n_fired = np.zeros((*capture.shape, bins.size), np.uint32), 0.0
    for counts, moved in zip(groups.counts, whole, strict=True):
        for row in range(capture.shape[0]):
            first = moved[row, :, np.newaxis]
            cube[row] += np.take_along_axis(counts[row], bins + first, axis=1)
            n_fired += float((counts[row] * (np.arange(n_bins) < edge + first)).sum())
    n_pulses = acquisition.n_pulses
    if capture.gated_pulses is not None:  # those armed at the first of the bins
        armed = round(capture.gated_pulses - n_fired / capture.counts.size)
        n_pulses = max(armed, int(cube.sum(axis=2).max()), 1)
    inner = Capture(
        cube,
        replace(acquisition, n_bins=bins.size, n_pulses=n_pulses),
        capture.pulse,
        detection=capture.detection,
    )
    found, share = flux_prior_of(inner), n_bins / bins.size
    shape = found.background_shape
    if shape is not None:  # beyond the bins in use, that of the nearest one
        shape = np.pad(shape, edge, mode="edge")
        share *= float(shape.mean())
        shape /= shape.mean()
    prior = known._replace(
        levels=found.levels,
        share=found.share,
        background=found.background * share,
        own_weight=found.own_weight,
        contrast=found.contrast and found.contrast / share,
        background_shape=shape,
        is_in_proportion=found.is_in_proportion,
    )
    return flux_model_with(capture, prior)


def _displacements(travel_bins: NDArray[Any], groups: PulseGroups) -> Floats:
    """Displacement of each group in steps, shape (velocity, group), completed as kernels need."""
    middle = np.append(groups.middle, np.zeros(-len(groups.middle) % AT_ONCE))
    return np.asarray(np.multiply.outer(travel_bins.astype(float), middle * STEPS_PER_BIN))


def _margin_bins(displaced: Floats) -> int:
    """Bins on either side of the gate that interpolated displacements in steps reach."""
    return math.ceil(float(np.abs(displaced).max()) / STEPS_PER_BIN) + 1


def _exposure(capture: Capture, groups: PulseGroups) -> Floats:
    """Pulses of each group; for all photons, of which fluxes are sums, shares of the pulses."""
    n_pulses = np.array(groups.n_pulses, float)
    return n_pulses / n_pulses.sum() if capture.gated_pulses is None else n_pulses


def _parts(
    capture: Capture, groups: PulseGroups, flux: FluxModel
) -> Iterator[tuple[slice, LikelihoodInput, NDArray[np.unsignedinteger]]]:
    """Lay out parts of a capture, so that the memory is bounded.

    Yields
    ------
    pixels : slice
        Flat indices.
    prepared : LikelihoodInput
    counts : ndarray, shape (group, block, bin, lane)
    """
    flat = groups.counts.reshape(len(groups.counts), -1, groups.counts.shape[3])
    for pixels, prepared in prepared_groups(capture, flux, STEPS_PER_BIN):
        lanes = prepared.counts.shape[2]
        yield pixels, prepared, np.stack([lane_counts(cube[pixels], lanes) for cube in flat])
