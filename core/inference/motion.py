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

from core.acquisition import Floats
from core.capture import Capture
from core.inference.flux import flux_model_of, flux_model_with, flux_prior_of
from core.inference.flux_model import FluxModel
from core.inference.likelihood import LikelihoodInput, prepared_groups
from core.inference.neighbours import box_sum
from core.inference.posterior import vertex
from core.kernels.blocks import lane_counts
from core.kernels.motion import fill_moving_delays, fill_velocity_evidence
from core.kernels.parallel import on_threads
from core.labels import Plane
from core.pulse_groups import PulseGroups

STEPS_PER_BIN = 4
"""Delays tried in each bin for moving surfaces. In steps of half a bin, the interpolation between
displacements would make velocities of a whole step per group less likely than others."""

_SIGMAS = 1.96  # of a 95 % interval
_AT_REST = 0.5  # prior probability of a velocity of 0
_FINE = 4  # velocities per bin for which delays are found


@dataclass(frozen=True, eq=False)
class RadialVelocity:
    """Radial velocity of the surface in each pixel, positive if it recedes.

    Parameters
    ----------
    bins : ndarray, shape (row, col)
        Velocity in bins per 1000 pulses.
    sd_bins : ndarray, shape (row, col)
        Standard deviation of its error, infinite where it is not known.
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
    """Standard deviation of its error; infinite at the end of the velocities tried."""

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
    capture: Capture, groups: PulseGroups, flux: FluxModel, travel_bins: NDArray[np.intp]
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
    """
    evidence = np.empty((capture.counts.size, travel_bins.size))
    displaced = _displacements(travel_bins, groups)
    for pixels, prepared, counts in _parts(capture, groups, flux):
        lanes = counts.shape[3]
        found = np.empty((travel_bins.size, counts.shape[1], lanes))
        given = prepared, counts, _exposure(capture, groups), displaced, found
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
    not ranged with velocities of chance.

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
    alone = velocity_evidence(capture, groups, flux, travel_bins)
    evidence = box_sum(alone, window_size, "constant")
    prior = np.full(travel_bins.size, (1 - _AT_REST) / max(2 * at_rest, 1))
    prior[at_rest] = _AT_REST
    best = (evidence + np.log(prior)).argmax(axis=2)
    around = np.clip(best + np.arange(-1, 2)[:, np.newaxis, np.newaxis], 0, travel_bins.size - 1)
    before, at, after = np.take_along_axis(evidence, np.moveaxis(around, 0, 2), axis=2).transpose(
        2, 0, 1
    )
    curvature = np.maximum(2 * at - before - after, 1e-9)
    inside = (best > 0) & (best < travel_bins.size - 1)
    shift = np.where(inside, np.clip((after - before) / (2 * curvature), -0.5, 0.5), 0.0)
    return Velocity(
        np.where(best == at_rest, 0.0, travel_bins[best] + step_bins * shift),
        np.where(inside, step_bins / np.sqrt(curvature), np.inf),
    )


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

    Motion spreads an echo over bins, so that its signal is taken for weaker. Here each group is
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
    prior = known._replace(
        levels=found.levels,
        share=found.share,
        background=found.background * share,
        own_weight=found.own_weight,
        contrast=found.contrast and found.contrast / share,
    )
    return flux_model_with(capture, prior)


def _displacements(travel_bins: NDArray[Any], groups: PulseGroups) -> Floats:
    """Displacement of each group in steps, shape (velocity, group)."""
    moved = np.multiply.outer(travel_bins.astype(float), groups.middle * STEPS_PER_BIN)
    return np.asarray(moved, float)


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
