"""The exact first-photon likelihood, with fluxes estimated from the capture.

If fluxes are known (`core.estimators.oracle`), and delays and background are uniform over the gate,
then of all methods that look at single pixels the rule "window" has the highest expected
restoration degree within 3 bins, "mean" the lowest RMSE, and "median" the lowest mean error; see
`core.inference.posterior`.
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
from core.inference.posterior import Rule, least_loss
from core.inference.refinement import sharpened
from core.parameters import Choice, Number, Settings, parameter

Depths = Literal["alike", "learned"]


@dataclass(frozen=True)
class LikelihoodParameters(Settings):
    """Settings of the likelihood."""

    steps_per_bin: int = parameter(
        2,
        Number("Steps per bin", 1, 8, whole=True, least=1, most=64),
        "Delays tried within each bin; a parabola refines between them, and finer steps the delays "
        "of bright echoes.",
    )
    depths: Depths = parameter(
        "alike",
        Choice("Depth prior", ("alike", "learned")),
        "Prior of the depth: all depths of the gate alike, or learned from the other pixels of the "
        "image.",
    )
    rule: Rule = parameter(
        "density",
        Choice("Delay taken", ("density", "window", "mean", "median")),
        "Delay that is taken from the posterior: the likeliest (density), or the best for one "
        "figure: for the restoration degree that with most probability within 3 bins (window), for "
        "the RMSE the mean, for the mean absolute error the median.",
    )


def locate(
    capture: Capture, flux: FluxModel, parameters: LikelihoodParameters
) -> tuple[Floats, Floats]:
    """Return the delay by the rule and the largest log likelihood ratio.

    The rules "density" and "window" return a peak; for bright echoes it is refined in finer steps.
    """
    if parameters.depths == "alike":
        flux = replace(flux, depth=np.ones_like(flux.depth))
    delay, score = least_loss(capture, flux, parameters.steps_per_bin, parameters.rule)
    if parameters.rule in ("density", "window"):
        delay = sharpened(capture, flux, delay)
    return delay, score


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
