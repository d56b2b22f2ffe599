"""The exact likelihood of surfaces that move while the pulses are sent.

Needs the order of the pulses, `Capture.groups`: the velocity of each pixel is found by the evidence
of the pixels around it (`core.inference.motion`), and the range is that in the middle of the
recording. Fluxes are estimated at that velocity, and then the velocity again with these.

Where everything is at rest, and for captures without groups, it is the likelihood
(`core.estimators.likelihood`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.estimators.base import Estimator
from core.estimators.likelihood import ESTIMATOR as LIKELIHOOD
from core.estimators.likelihood import LikelihoodParameters, curve
from core.estimators.likelihood import locate as locate_at_rest
from core.inference.flux import flux_model_of
from core.inference.flux_model import FluxModel
from core.inference.motion import (
    MovingSurfaces,
    RadialVelocity,
    Velocity,
    flux_at_rest,
    moving_surfaces,
    shared_velocity,
)
from core.inference.posterior import mass_near, tolerance_probability
from core.inference.refinement import sharpened
from core.parameters import Number, Settings, parameter

_COARSE_BINS = 2  # between the displacements from which fluxes are estimated


@dataclass(frozen=True)
class VelocityParameters(Settings):
    """Settings of the likelihood with velocity."""

    neighbourhood: int = parameter(
        4,
        Number("Neighbourhood", 0, 10, whole=True, least=0, most=32),
        "Pixels on each side whose evidence is added to find the velocity of a pixel; 0 for each "
        "pixel by itself.",
    )
    most_bins: int = parameter(
        24,
        Number("Largest displacement", 4, 64, whole=True, unit="bins", least=2, most=256),
        "Displacement of a surface from the first to the last pulse, either way, up to which "
        "velocities are tried.",
    )


class Motion(NamedTuple):
    """Velocities of a capture, and surfaces in the middle of the recording."""

    velocity: Velocity
    surfaces: MovingSurfaces | None
    """None where everything is at rest."""


@cached_per_capture
def motion_of(capture: Capture, parameters: VelocityParameters) -> Motion | None:
    """Estimate the motion of a capture; None where the order of its pulses is not known."""
    groups, size = capture.groups, 2 * parameters.neighbourhood + 1
    if groups is None:
        return None
    flux = flux_model_of(capture)
    velocity = shared_velocity(capture, groups, flux, parameters.most_bins, size, _COARSE_BINS)
    if not velocity.travel_bins.any():
        return Motion(velocity, None)
    flux = flux_at_rest(capture, groups, velocity.travel_bins)
    velocity = shared_velocity(capture, groups, flux, parameters.most_bins, size)
    surfaces = moving_surfaces(capture, groups, flux, velocity.travel_bins)
    is_at_rest = velocity.travel_bins == 0
    sharp_bin = sharpened(capture, flux, np.where(is_at_rest, surfaces.delay_bin, np.nan))
    delay_bin = np.where(is_at_rest, sharp_bin, surfaces.delay_bin)
    return Motion(velocity, surfaces._replace(delay_bin=delay_bin))


def _surfaces(capture: Capture, parameters: VelocityParameters) -> MovingSurfaces | None:
    """Return the surfaces of a capture in which something moves."""
    motion = motion_of(capture, parameters)
    return None if motion is None else motion.surfaces


def _locate(
    capture: Capture, flux: FluxModel, parameters: VelocityParameters
) -> tuple[Floats, Floats]:
    found = _surfaces(capture, parameters)
    if found is None:
        return locate_at_rest(capture, flux, LikelihoodParameters())
    return found.delay_bin, found.score


def _confidence(
    capture: Capture, flux: FluxModel, delay_bin: Floats, parameters: VelocityParameters
) -> Floats:
    motion = motion_of(capture, parameters)
    if motion is None or motion.surfaces is None:
        return tolerance_probability(capture, delay_bin)
    near = mass_near(motion.surfaces.surface, 1, delay_bin, capture.acquisition.n_bins)
    # At the end of the velocities tried a surface may be faster, and its echo elsewhere.
    return np.where(np.isinf(motion.velocity.sd_bins), 0.0, near)


def _velocity(capture: Capture, parameters: VelocityParameters) -> RadialVelocity | None:
    motion, groups = motion_of(capture, parameters), capture.groups
    return None if motion is None or groups is None else motion.velocity.of(capture, groups)


def _omits(capture: Capture) -> str:
    at_rest = "surfaces are taken to be at rest: the capture keeps no groups of pulses in order"
    alike = (
        "intervals of velocities are too narrow where these differ from pixel to pixel by less "
        "than the photons show"
    )
    clauses = (LIKELIHOOD.omits(capture), alike if capture.groups else at_rest)
    return "; ".join(filter(None, clauses))


ESTIMATOR = Estimator(
    "Likelihood with velocity",
    VelocityParameters,
    curve,
    _locate,
    finds_delay=True,
    undoes_pile_up=True,
    omits=_omits,
    whole_image=True,
    confidence=_confidence,
    follows_motion=True,
    velocity=_velocity,
)
