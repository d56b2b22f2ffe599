"""The exact first-photon likelihood, with the light estimated from the capture.

No estimator that looks at single pixels can find more of them than this one does with the true
light (`core.estimators.oracle`), where all delays are equally likely; see
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
from core.inference.posterior import most_likely
from core.parameters import Choice, Number, check_fields, parameter

Depths = Literal["alike", "learned"]


@dataclass(frozen=True)
class LikelihoodParameters:
    """Settings of the likelihood.

    Raises
    ------
    ValueError
        If a value lies outside its bounds.
    """

    steps_per_bin: int = parameter(
        2,
        Number("Steps per bin", 1, 8, whole=True, least=1, most=64),
        "Delays tried within each bin; a parabola refines between them.",
    )
    depths: Depths = parameter(
        "alike",
        Choice("Depths", ("alike", "learned")),
        "What is held of a surface's depth beforehand: all depths of the gate are alike, or the "
        "image's other pixels tell which ones occur.",
    )

    def __post_init__(self) -> None:
        check_fields(self)


def locate(
    capture: Capture, flux: FluxModel, parameters: LikelihoodParameters
) -> tuple[Floats, Floats]:
    """Delay of the largest posterior density, and its log likelihood ratio to no echo."""
    if parameters.depths == "alike":
        flux = replace(flux, depth=np.ones_like(flux.depth))
    return most_likely(capture, flux, parameters.steps_per_bin)


def curve(histogram: Floats, conditions: Conditions, parameters: LikelihoodParameters) -> Floats:
    """The log likelihood ratio for the typical signal and background."""
    return log_likelihood_ratio(histogram, conditions)


def _spares(capture: Capture) -> str:
    if flux_prior_of(capture).levels.size == detailed_flux_prior_of(capture).levels.size:
        return ""
    return "the likelihood takes one level of signal for all pixels: none tells its own"


ESTIMATOR = Estimator(
    "Likelihood, light estimated",
    LikelihoodParameters,
    curve,
    locate,
    finds_delay=True,
    undoes_pile_up=True,
    spares=_spares,
)
