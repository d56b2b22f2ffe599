"""Compilation and imports ahead of the first use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import get_args

import numpy as np

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture, Detection
from core.effects import Motion
from core.estimators import ESTIMATORS, RangeImage, estimate
from core.inference import fit_of, flux_model_of
from core.inference.faults import neighbour_median
from core.inspection import maps, pixel_report
from core.reductions import share_of_pulses
from core.scene import Scene, scenes
from core.simulation import simulate
from core.tracking import PRESETS, tracking_signals

_LARGE = 2**16


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

    @cache
    def large() -> Capture:
        return _with_large_counts(small())

    def estimated(method: str, of: Callable[[], Capture] = small, returns: int = 1) -> RangeImage:
        return estimate(of(), method, returns=returns)

    steps: list[Callable[[], object]] = [
        small,
        lambda: tracking_signals(small().cube, PRESETS["recommended"]),
        lambda: flux_model_of(small()),
        *(partial(estimated, method) for method in ([only] if only else ESTIMATORS)),
        lambda: pixel_report(small(), estimated(only or "tracking"), 0, 0),
        lambda: neighbour_median(small()),  # imports `scipy.ndimage`
    ]
    if only is None:
        steps += [
            partial(estimated, "peak", returns=2),
            _use_neighbours,
            partial(_thin_and_map, small),
            lambda: fit_of(small()),
            lambda: fit_of(_at_an_edge()),
            *(partial(estimated, method, large) for method in ESTIMATORS),
            partial(estimated, "peak", large, returns=2),
            lambda: fit_of(large()),
            partial(_thin_and_map, large),
        ]
    progress(0, len(steps))
    for done, step in enumerate(steps, 1):
        step()
        progress(done, len(steps))


def _with_large_counts(capture: Capture) -> Capture:
    """Multiply the counts of first photons beyond uint16, for which other kernels are compiled."""
    n_pulses = _LARGE * (capture.acquisition.n_pulses or 1)
    acquisition = replace(capture.acquisition, n_pulses=n_pulses)
    return replace(capture, cube=np.uint32(_LARGE) * capture.cube, acquisition=acquisition)


def _at_an_edge() -> Capture:
    """Capture of short echoes all at the edge of a bin, which the fit learns."""
    acquisition = Acquisition(n_pulses=1000)
    scene = Scene(np.full((8, 8), acquisition.bin_to_range_m(40.0)), acquisition=acquisition)
    pulse = Pulse(acquisition.bin_width_s / 3)
    return simulate(scene, acquisition, Flux(sbr=1.0), pulse)


def _thin_and_map(capture: Callable[[], Capture]) -> None:
    """Compile what draws a share of the pulses or photons of a capture, and what maps need."""
    for kind in get_args(Detection):
        share_of_pulses(replace(capture(), detection=kind), 0.5)
    maps["SBR"](capture())


def _use_neighbours() -> None:
    """Compile what the image posterior, its returns and velocities need where neighbours agree."""
    wall = scenes["wall"](16)
    capture = simulate(wall, wall.acquisition, Flux(sbr=1.0))
    estimate(capture, "image_posterior", returns=2)
    estimate(_with_large_counts(capture), "image_posterior")
    passing = replace(wall, motion=Motion(speed_m_per_s=20.0, pulse_rate_hz=20e3))
    estimate(simulate(passing, wall.acquisition, Flux(sbr=1.0), n_groups=8), "velocity")
