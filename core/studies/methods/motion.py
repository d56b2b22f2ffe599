"""Restoration degree and velocities of surfaces that move while the pulses are sent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from core.acquisition import Floats, Flux
from core.capture import Capture
from core.effects import Motion
from core.estimators import estimate
from core.inference.motion import flux_at_rest, moving_surfaces
from core.inference.posterior import TOLERANCE_BINS
from core.metrics import Interval
from core.pulse_groups import USUAL_GROUPS
from core.scene import scenes
from core.simulation import simulate
from core.studies.outputs import Table
from core.studies.statistics import mean_over_seeds
from core.studies.trials import mapped

SPEEDS = (0.0, 2.0, 5.0, 10.0, 20.0)
"""Bins per 1000 pulses, positive if the scene recedes."""

SBRS = (0.06, 0.04)
STILL = ("car", "uniform", "wall")
"""Scenes at rest."""

PULSE_RATE_HZ = 20e3
METHODS = ("likelihood, at rest", "velocity of each pixel", "shared velocity", "true velocity")

_RIGHT_BINS = 1.0
_SIGMAS = 1.96  # of 95 %


@dataclass(frozen=True)
class Moving:
    """A built-in scene that moves."""

    scene: str
    sbr: float
    per_1000_bins: float

    def capture(self, seed: int) -> Capture:
        """Draw a capture of 1000 pulses in groups."""
        drawn = {"seed": seed} if self.scene in ("uniform", "wall") else {}
        scene = scenes[self.scene](**drawn)
        acquisition = replace(scene.acquisition, n_pulses=1000)
        if self.per_1000_bins:
            bins_per_s = self.per_1000_bins * PULSE_RATE_HZ / 1000
            motion = Motion(bins_per_s * acquisition.bin_length_m, PULSE_RATE_HZ)
            scene = replace(scene, motion=motion)
        return simulate(scene, acquisition, Flux(sbr=self.sbr), seed=seed, n_groups=USUAL_GROUPS)


class Found(NamedTuple):
    """Results on one capture."""

    restored: tuple[float, ...]
    """Restoration degree within 3 bins of each of `METHODS`."""
    error_bins: float
    """RMS error of the shared velocity of target pixels, per 1000 pulses."""
    near: float
    """Share of target pixels whose shared velocity is within a bin per 1000 pulses."""
    covered: float
    """Share of target pixels whose 95 % interval holds the velocity."""


def found_in(piece: tuple[Moving, int]) -> Found:
    """Return the results on the capture of a seed."""
    moving, seed = piece
    capture = moving.capture(seed)
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    target, groups = np.isfinite(truth_bin), capture.groups
    assert groups is not None
    shared = estimate(capture, "velocity")
    true = np.full(capture.shape, moving.per_1000_bins)
    known = moving_surfaces(capture, groups, flux_at_rest(capture, groups, true), true)
    delays: tuple[Floats, ...] = (
        estimate(capture, "likelihood").bin,
        estimate(capture, "velocity", neighbourhood=0).bin,
        shared.bin,
        known.delay_bin,
    )
    right = (np.abs(each - truth_bin)[target] <= TOLERANCE_BINS + 1e-6 for each in delays)
    assert shared.velocity is not None
    error = (shared.velocity.bins - moving.per_1000_bins)[target]
    covered = np.abs(error) <= _SIGMAS * shared.velocity.sd_bins[target]
    return Found(
        tuple(float(each.mean()) for each in right),
        float(np.sqrt((error**2).mean())),
        float((np.abs(error) <= _RIGHT_BINS).mean()),
        float(covered.mean()),
    )


def tables(seeds: Sequence[int], processes: int = 1) -> Iterator[Table]:
    """Yield the tables; intervals are those of the mean over the seeds (95 %)."""
    moving = {sbr: [Moving("car", sbr, speed) for speed in SPEEDS] for sbr in SBRS}
    still = [Moving(scene, sbr, 0.0) for scene in STILL for sbr in SBRS]
    of_all = dict.fromkeys([*still, *(each for some in moving.values() for each in some)])
    pieces = [(each, seed) for each in of_all for seed in seeds]
    found = dict(mapped(found_in, pieces, processes))
    note = f"Mean of {len(seeds)} captures, with 95 % intervals, {USUAL_GROUPS} groups of pulses."
    speeds = tuple(f"{speed:g} bins" for speed in SPEEDS)
    for sbr, conditions in moving.items():
        yield Table(
            f"motion_{sbr:g}",
            f"Restoration degree within 3 bins, car receding in 1000 pulses, SBR {sbr:g}",
            ("method", *speeds),
            tuple(
                (method, *(_restored(found, each, seeds, place) for each in conditions))
                for place, method in enumerate(METHODS)
            ),
            note,
        )
    yield Table(
        "motion_still",
        "Restoration degree within 3 bins, scenes at rest",
        ("method", *(f"{each.scene}, SBR {each.sbr:g}" for each in still)),
        tuple(
            (method, *(_restored(found, each, seeds, place) for each in still))
            for place, method in enumerate(METHODS)
        ),
        note,
    )
    yield Table(
        "motion_velocity",
        "Shared velocity of the car, in bins per 1000 pulses",
        ("SBR", "result", *speeds),
        tuple(
            (
                f"{sbr:g}",
                title,
                *(
                    mean_over_seeds(found, each, seeds, attrgetter(name), most)
                    for each in conditions
                ),
            )
            for sbr, conditions in moving.items()
            for name, title, most in (
                ("error_bins", "RMS error", np.inf),
                ("near", "share within 1", 1.0),
                ("covered", "share in the 95 % interval", 1.0),
            )
        ),
        note,
    )


def _restored(
    found: Mapping[tuple[Moving, int], Found],
    condition: Moving,
    seeds: Sequence[int],
    place: int,
) -> Interval:
    """Return the mean restoration degree of one of `METHODS`."""
    return mean_over_seeds(found, condition, seeds, lambda of: of.restored[place])
