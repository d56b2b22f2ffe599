"""Compilation and imports ahead of the first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np

from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.effects import Motion
from core.estimators import ESTIMATORS, RangeImage, estimate
from core.inference import fit_of, flux_model_of
from core.inspection import pixel_report
from core.scene import Scene, scenes
from core.simulation import simulate
from core.tracking import PRESETS, tracking_signals


def warm_up(
    progress: Callable[[int, int], None] = lambda done, of: None, only: str | None = None
) -> None:
    """Compile kernels and import what a pixel's report needs, so that no later call has to.

    Takes a minute or two on a new machine. Compiled code is cached on disk; later starts take
    seconds.

    Parameters
    ----------
    progress : callable, optional
        ``(steps done, steps in all)``, called before the first step and after each.
    only : str, optional
        Estimator whose images and pixels are shown first: the rest is left for later. By default,
        nothing is left.
    """

    @cache
    def small() -> Capture:
        acquisition = Acquisition(n_pulses=1)
        scene = Scene(np.full((1, 1), 50.0), acquisition=acquisition)
        return simulate(scene, acquisition, Flux())

    def estimated(method: str, returns: int = 1) -> RangeImage:
        return estimate(small(), method, returns=returns)

    steps: list[Callable[[], object]] = [
        small,
        lambda: tracking_signals(small().cube, PRESETS["recommended"]),
        lambda: flux_model_of(small()),
        *(partial(estimated, method) for method in ([only] if only else ESTIMATORS)),
        # `scipy.signal` takes a second to import.
        lambda: pixel_report(small(), estimated(only or "tracking"), 0, 0),
    ]
    if only is None:
        steps += [partial(estimated, "peak", 2), _use_neighbours, lambda: fit_of(small())]
    progress(0, len(steps))
    for done, step in enumerate(steps, 1):
        step()
        progress(done, len(steps))


def _use_neighbours() -> None:
    """Compile what the image posterior and velocities need where neighbours agree."""
    wall = scenes["wall"](16)
    estimate(simulate(wall, wall.acquisition, Flux(sbr=1.0)), "image_posterior")
    passing = replace(wall, motion=Motion(speed_m_per_s=20.0, pulse_rate_hz=20e3))
    estimate(simulate(passing, wall.acquisition, Flux(sbr=1.0), n_groups=8), "velocity")
