"""The exact first-photon likelihood, with fluxes estimated from the capture.

With the true fluxes (`core.estimators.oracle`) and uniform delays, no single-pixel estimator has a
higher restoration degree; see `core.inference.posterior`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.estimators.base import Estimator
from core.inference.flux import detailed_flux_prior_of, flux_prior_of
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions, log_likelihood_ratio
from core.inference.posterior import most_likely
from core.parameters import Choice, Number, Settings, parameter

Depths = Literal["alike", "learned"]


@dataclass(frozen=True)
class LikelihoodParameters(Settings):
    """Settings of the likelihood."""

    steps_per_bin: int = parameter(
        2,
        Number("Steps per bin", 1, 8, whole=True, least=1, most=64),
        "Delays tried within each bin; a parabola refines between them.",
    )
    depths: Depths = parameter(
        "alike",
        Choice("Depths", ("alike", "learned")),
        "Prior of the depth: uniform over the gate, or estimated from the other pixels of the "
        "image.",
    )


def locate(
    capture: Capture, flux: FluxModel, parameters: LikelihoodParameters
) -> tuple[Floats, Floats]:
    """Return the delay of the largest posterior density and its log likelihood ratio."""
    if parameters.depths == "alike":
        flux = replace(flux, depth=np.ones_like(flux.depth))
    return most_likely(capture, flux, parameters.steps_per_bin)


def curve(histogram: Floats, conditions: Conditions, parameters: LikelihoodParameters) -> Floats:
    """Return the log likelihood ratio for the typical signal and background."""
    return log_likelihood_ratio(histogram, conditions)


def _omits(capture: Capture) -> str:
    if flux_prior_of(capture).levels.size == detailed_flux_prior_of(capture).levels.size:
        return ""
    return "the likelihood uses one level of signal: no pixel has enough photons for its own"


ESTIMATOR = Estimator(
    "Likelihood, fluxes estimated",
    LikelihoodParameters,
    curve,
    locate,
    finds_delay=True,
    undoes_pile_up=True,
    omits=_omits,
)
