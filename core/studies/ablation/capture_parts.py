"""Parts and corrections that the counts of a capture reveal, without knowledge of the scene.

What pixels share is tested on all of them together, and so is the share of the pixels that have a
property. "Not needed" means that an effect large enough to matter would have been seen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from core.capture import Capture
from core.corrections import without_correction
from core.inference import faults, resolution
from core.inference.flux import flux_model_of
from core.inference.resolution import FEW, Difference
from core.studies.ablation import corrections, extensions
from core.studies.ablation.criterion import (
    MARGIN_BINS,
    Requirement,
    judged,
    tested,
    unknown,
)
from core.studies.ablation.evidence import Evidence, evidence_of_share
from core.studies.ablation.pooled import pile_up_evidence, pooled_evidence, signal_evidence

MARGIN_PULSE = 0.1
"""Smallest relevant deviation of echoes from the pulse, relative to it.

A pulse of 1 ns in bins of 1 ns deviates as much if it is 1.2 times as wide; its mean then moves by
half a bin.
"""

MARGIN_BACKGROUND = 0.05
"""Smallest relevant deviation of the background from its mean, relative to it.

A background that falls by 16 % over the gate deviates as much. The restoration degree of the car at
SBR 0.06 falls by 0.007 if one that falls by 20 % is taken for a flat one.
"""

MARGIN_SIGNAL = 0.25
"""Smallest relevant scatter of the signal over the pixels, relative to its mean.

At SBR 0.04 to 0.1, random depths lose 0.003 to 0.01 of their restoration degree if signals that
scatter by 20 to 30 % are taken for equal ones.
"""


def rows(capture: Capture, method: str) -> list[Callable[[], Requirement]]:
    """Return one function per part, correction and extension."""
    return [
        *(partial(_timed, judge, capture, method) for judge in (pile_up, signal_levels)),
        *extensions.rows(capture, method),
        *(
            partial(judge, capture)
            for judge in (pulse_shape, second_surface, backscatter, faulty_pixels, motion, jitter)
        ),
    ]


def _timed(
    judge: Callable[[Capture, str], Requirement], capture: Capture, method: str
) -> Requirement:
    """Judge a correction, and compare the times of ranging with and without it."""
    found = judge(capture, method)
    if found.part == "pile_up" and capture.gated_pulses is None:
        return found
    captures = _with_and_without(capture, found.part)
    return replace(found, time_ratio=corrections.ranging_ratio(*captures, method))


def _with_and_without(capture: Capture, correction: str) -> tuple[Capture, Capture]:
    return (
        corrections.with_correction(capture, correction),
        without_correction(capture, correction),
    )


def pile_up(capture: Capture, method: str) -> Requirement:
    """Judge whether early photons hide later ones."""
    n_pulses = capture.gated_pulses
    if n_pulses is not None:
        apart = resolution.pile_up(capture.counts / n_pulses, n_pulses)
        found = "pile-up lets a flat background fall by {} of its mean (RMS)"
        evidence = pile_up_evidence(capture)
        return _corrected(capture, method, "pile_up", apart, evidence, MARGIN_BACKGROUND, found)
    if capture.detection == "all":
        why = "in multi-detection data no photon hides another"
        return Requirement("pile_up", "not needed", why, 0.0, 0.0, detectable_share=0.0)
    return unknown("pile_up", "the number of pulses is unknown")


def signal_levels(capture: Capture, method: str) -> Requirement:
    """Judge whether the signal differs from pixel to pixel."""
    apart, evidence = corrections.level_deviation(capture), signal_evidence(capture)
    if evidence is None:
        return unknown("signal_levels", "too few pixels have a certain estimate")
    found = "the signal scatters by {} of its mean over the pixels with a certain estimate"
    if math.isinf(evidence.smallest):
        found += ", which are too few to stand for all"
    return _corrected(capture, method, "signal_levels", apart, evidence, MARGIN_SIGNAL, found)


def _corrected(
    capture: Capture,
    method: str,
    correction: str,
    apart: Difference,
    evidence: Evidence,
    margin: float,
    found: str,
) -> Requirement:
    """Judge by the change of the estimates if the truth is known, or by evidence as `tested`."""
    with_m, without_m = (
        corrections.ranges_m(each, method) for each in _with_and_without(capture, correction)
    )
    bin_length_m = capture.acquisition.bin_length_m
    moved = np.mean(np.abs(with_m - without_m) > MARGIN_BINS * bin_length_m)
    note = f"it moves {moved:.2%} of the estimates by more than {MARGIN_BINS:g} bins"
    shown = tested(correction, evidence, margin, found, note=note)
    if capture.truth_range_m is None:
        return shown
    changes = corrections.changes_over_rows(capture, with_m[np.newaxis], without_m[np.newaxis])
    known = judged(correction, apart, bin_length_m, *changes, note=note)
    return replace(
        known, effect=shown.effect, smallest_effect=shown.smallest_effect, p_value=shown.p_value
    )


# -- Parts that all pixels share -------------------------------------------------------------------


def backscatter(capture: Capture) -> Requirement:
    """Judge whether the background varies over the gate, as in fog."""
    return tested(
        "backscatter",
        pooled_evidence(capture).background,
        MARGIN_BACKGROUND,
        "the background varies over the gate by {} of its mean",
        explained=_second_signal(capture) * flux_model_of(capture).contrast,
    )


def pulse_shape(capture: Capture) -> Requirement:
    """Judge whether echoes have the shape of the assumed pulse."""
    return tested(
        "pulse_shape",
        pooled_evidence(capture).pulse,
        MARGIN_PULSE,
        "echoes differ by {} from the shape of the pulse",
        explained=_second_signal(capture),
    )


def motion(capture: Capture) -> Requirement:
    """Judge whether echoes are widened by motion."""
    return _widening(capture, "motion")


def jitter(capture: Capture) -> Requirement:
    """Judge whether echoes are widened by jitter that the pulse does not include."""
    return _widening(capture, "jitter")


def _widening(capture: Capture, part: str) -> Requirement:
    pulse = pulse_shape(capture)
    if pulse.verdict == "not needed":
        return replace(pulse, part=part)
    return unknown(part, f"it widens echoes like another pulse: {pulse.why}")


# -- Shares of the pixels --------------------------------------------------------------------------


def second_surface(capture: Capture) -> Requirement:
    """Judge whether pixels see a second surface."""
    evidence = pooled_evidence(capture).second_surface
    if evidence is None:
        return unknown("second_surface", "too few pixels have an echo, or the gate is too short")
    found = "{} of the pixels see a second surface, as strong as the first"
    requirement = tested("second_surface", evidence, FEW, found)
    if requirement.verdict == "needed" and pulse_shape(capture).verdict == "needed":
        why = f"{requirement.why}; echoes of another shape may resemble it"
        return replace(requirement, verdict="cannot tell", why=why)
    return requirement


def _second_signal(capture: Capture) -> float:
    """Signal of second surfaces relative to that of the first ones, 0 if none are seen."""
    evidence = pooled_evidence(capture).second_surface
    return evidence.effect if evidence is not None and evidence.is_seen else 0.0


def faulty_pixels(capture: Capture) -> Requirement:
    """Judge whether single pixels detect significantly more or less than all their neighbours.

    A pixel is hot in this sense if it detects as many dark counts as photons.
    """
    found = faults.outlier_pixels(capture)
    if found is None:
        return unknown("faulty_pixels", "the image is too narrow")
    n_pulses, usual = capture.gated_pulses, faults.neighbour_median(capture)
    rng = np.random.default_rng(0)
    if n_pulses is None:
        twice = rng.poisson(2 * usual)
    else:
        twice = rng.binomial(n_pulses, 1 - (1 - usual / n_pulses) ** 2)
    seen = (
        faults.probability_of_more(twice, found.most, n_pulses) < faults.SIGNIFICANCE,
        faults.probability_of_fewer(0, found.least, n_pulses) < faults.SIGNIFICANCE,
    )
    hot, dead = (int(np.count_nonzero(each)) for each in (found.hot, found.dead))
    evidence = evidence_of_share(
        hot + dead,
        capture.counts.size,
        faults.SIGNIFICANCE,
        min(float(np.mean(each)) for each in seen),
    )
    note = f"{hot} hot and {dead} dead"
    return tested("faulty_pixels", evidence, FEW, "{} of the pixels are hot or dead", note=note)
