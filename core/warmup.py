"""Compilation and imports ahead of the first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from core.acquisition import Acquisition, Flux
from core.effects import Motion
from core.estimators import ESTIMATORS, estimate
from core.inference import fit_of
from core.inspection import pixel_report
from core.scene import Scene, scenes
from core.simulation import simulate
from core.tracking import PRESETS, tracking_signals


def warm_up(progress: Callable[[int, int], None] = lambda done, of: None) -> None:
    """Compile every kernel and import what a pixel's report needs, so that no later call has to.

    Takes a minute on a new machine. Compiled code is cached on disk; later starts take seconds.

    Parameters
    ----------
    progress : callable
        ``(steps done, steps in all)``, called before the first step and after each.
    """
    acquisition = Acquisition(n_pulses=1)
    small = simulate(Scene(np.full((1, 1), 50.0), acquisition=acquisition), acquisition, Flux())
    steps: list[Callable[[], object]] = [
        *(partial(estimate, small, method) for method in ESTIMATORS),
        partial(estimate, small, "peak", returns=2),
        _use_neighbours,
        partial(fit_of, small),
        # `scipy.signal` takes a second to import.
        lambda: pixel_report(small, estimate(small, "tracking"), 0, 0),
        partial(tracking_signals, small.cube, PRESETS["recommended"]),
    ]
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
