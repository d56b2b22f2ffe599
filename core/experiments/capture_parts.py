"""Parts and corrections that a capture itself may tell of, without knowing its scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from core import resolution
from core.acquisition import Floats
from core.capture import Capture
from core.experiments import corrections
from core.experiments.requirement import UNKNOWN, Requirement, judged
from core.metrics import Interval
from core.posterior import TOLERANCE_BINS
from core.resolution import Difference


def pile_up(capture: Capture, method: str) -> Requirement:
    """Whether early photons hide later ones, from the share of pulses that fired."""
    n_pulses = capture.armed_pulses
    if capture.detection == "all":
        nothing = Difference(np.zeros(1), np.zeros(1))
        why = "the capture holds all photons, none hides another"
        return judged("pile_up", nothing, capture.acquisition.bin_length_m, note=why)
    if n_pulses is None:
        return judged(
            "pile_up",
            None,
            capture.acquisition.bin_length_m,
            note="the number of pulses is not known",
        )
    return _corrected(
        capture, method, "pile_up", resolution.pile_up(capture.counts / n_pulses, n_pulses)
    )


def signal_levels(capture: Capture, method: str) -> Requirement:
    """Whether pixels tell that they return more or less than others."""
    return _corrected(capture, method, "signal_levels", corrections.levels_apart(capture))


def _corrected(capture: Capture, method: str, correction: str, apart: Difference) -> Requirement:
    made = corrections.with_correction(capture, correction)
    spared = corrections.without_correction(capture, correction)
    one_m, other_m = (corrections.answers_m(each, method) for each in (made, spared))
    bin_length_m = capture.acquisition.bin_length_m
    moved = np.mean(np.abs(one_m - other_m) > TOLERANCE_BINS * bin_length_m)
    return judged(
        correction,
        apart,
        bin_length_m,
        *_changes(capture, one_m, other_m),
        corrections.ranging_ratio(made, spared, method),
        note=f"it moves {moved:.1%} of the answers by more than {TOLERANCE_BINS} bins",
    )


def _changes(capture: Capture, one_m: Floats, other_m: Floats) -> tuple[Interval, Interval]:
    """Of restoration degree and RMSE, paired over the rows of the image."""
    if capture.truth_range_m is None:
        return UNKNOWN, UNKNOWN
    raise NotImplementedError


JUDGES: tuple[Callable[[Capture, str], Requirement], ...] = (pile_up, signal_levels)
