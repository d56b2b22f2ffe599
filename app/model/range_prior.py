"""Range prior of an estimator, by simulation: where its estimates lie without an echo."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from app.model.budget import spending
from app.model.state import ReductionSettings
from app.model.store import Answer, reduced
from core import ESTIMATORS, Capture, Scene, simulate
from core.cost import cost_of
from core.studies import outputs, range_prior

SIDE, ECHO_SIDE = 64, 32
"""Rows and columns of the image without an echo, and of one for each position of an echo."""


def has_range_prior(answer: Answer) -> bool:
    """Return whether it can be simulated: the flux must be known, but not to the estimator."""
    return answer.request.source.is_scene and not ESTIMATORS[answer.method].knows_flux


def range_prior_of(answer: Answer) -> outputs.Plot:
    """Plot the range prior of an answer's estimator, with its settings and its reduction."""
    request, light = answer.request, answer.request.illumination
    acquisition = answer.whole.acquisition

    @lru_cache(maxsize=1)  # the study begins with the image whose cost is predicted
    def simulated(range_m: float) -> Capture:
        side = SIDE if math.isnan(range_m) else ECHO_SIDE
        scene = Scene(np.full((side, side), range_m))
        return reduced(simulate(scene, acquisition, light.flux, seed=light.seed), request)

    empty = simulated(math.nan)
    cost = cost_of(empty, answer.method, answer.settings)
    n_images = 1 + range_prior.GROUPS * (ECHO_SIDE / SIDE) ** 2
    cost = replace(cost, seconds=n_images * cost.seconds)
    with spending(empty.cube.shape, "estimates without an echo", cost):
        plot = range_prior.range_prior(simulated, answer.method, answer.settings)
    about = (
        "Simulated with the fluxes and settings shown, pixels of one surface over a uniform "
        "background."
    )
    return replace(plot, note=f"{plot.note} {about}")


def slow_start(answer: Answer) -> str:
    """Return how far the small scale begins below the background; empty where it does not."""
    request = answer.request
    is_whole = request.reduction == ReductionSettings()
    if answer.method != "tracking" or not request.source.is_scene or not is_whole:
        return ""
    return range_prior.slow_start(
        answer.settings, answer.whole.acquisition, request.illumination.flux, answer.whole.pulse
    )
