"""Compilation and imports ahead of the first use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.effects import Motion
from core.estimators import ESTIMATORS, estimate
from core.inference import fit_of
from core.inspection import pixel_report
from core.kernels.parallel import SERIAL_BELOW
from core.scene import Scene, scenes
from core.simulation import simulate
from core.tracking import PRESETS, track, tracking_signals


def warm_up() -> None:
    """Compile every kernel and import what a pixel's report needs, so that no later call has to.

    Takes seconds on a new machine. Compiled code is cached on disk; later starts take a tenth.
    """
    acquisition = Acquisition(n_pulses=1)
    scene = Scene(np.full((1, 1), 50.0), acquisition=acquisition)
    small = simulate(scene, acquisition, Flux())
    pixels = SERIAL_BELOW // acquisition.n_bins + 1
    large = Capture(np.zeros((pixels, 1, acquisition.n_bins), np.uint16), acquisition)
    # The image posterior uses neighbours only where they agree.
    wall = scenes["wall"](16)
    estimate(simulate(wall, wall.acquisition, Flux(sbr=1.0)), "image_posterior")
    passing = replace(wall, motion=Motion(speed_m_per_s=20.0, pulse_rate_hz=20e3))
    estimate(simulate(passing, wall.acquisition, Flux(sbr=1.0), n_groups=8), "velocity")
    estimate(small, "peak", returns=2)
    images = {method: estimate(small, method) for method in ESTIMATORS}
    fit_of(small)
    pixel_report(small, images["tracking"], 0, 0)  # `scipy.signal` takes a second to import
    track(large.blocks, PRESETS["recommended"])
    tracking_signals(small.cube, PRESETS["recommended"])
