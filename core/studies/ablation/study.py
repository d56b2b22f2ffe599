"""Ablation: which parts of a model and which corrections a scene or a capture needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse, pulses_sent
from core.capture import Capture
from core.checks import require
from core.corrections import CORRECTIONS, without_correction
from core.estimators import ESTIMATORS
from core.inference import resolution
from core.inference.resolution import Difference, difference
from core.metrics import Interval
from core.scene import Scene, parts_of, without
from core.simulation import cumulative_trigger_probability, simulate
from core.studies.ablation import capture_parts, corrections, extensions
from core.studies.ablation.criterion import (
    EXTENSIONS,
    MARGIN_RD,
    TITLES,
    Requirement,
    judged,
)
from core.studies.ablation.evidence import POWER, SIZE
from core.studies.outputs import Table, table
from core.studies.statistics import MIN_REPEATS
from core.studies.timing import time_ratio


def requirements(
    subject: Scene | Capture,
    flux: Flux | None = None,
    *,
    acquisition: Acquisition | None = None,
    pulse: Pulse = Pulse(),
    method: str = "likelihood",
    seeds: Sequence[int] = range(16),
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> tuple[Requirement, ...]:
    """Judge every part of a scene, and every correction and extension of an estimator.

    Parameters
    ----------
    subject : Scene or Capture
        The parts of a scene are known: their effect is computed from the model, and from captures
        with and without them. Those of a capture are tested on the counts of all its pixels.
    flux, acquisition, pulse
        Conditions in which a scene is simulated; by default the default flux and the scene's own
        acquisition.
    method : str
        A key of `core.ESTIMATORS`, whose estimates are compared.
    seeds : sequence of int
        Seeds of a scene's captures, at least 2; compared captures share them.
    progress : callable
        ``(rows done, rows in all)``, called before the first row and after each; an exception that
        it raises cancels the work.

    Returns
    -------
    tuple of Requirement

    Raises
    ------
    ValueError
        If the method is unknown, seeds are fewer than 2, or a scene's number of pulses is unknown.
    """
    require("method", method, method in ESTIMATORS, " or ".join(map(repr, ESTIMATORS)))
    rows: list[Callable[[], Requirement]]
    if isinstance(subject, Capture):
        rows = capture_parts.rows(subject, method)
    else:
        require("seeds", seeds, len(seeds) >= 2, "at least 2 of them")
        gate = acquisition or subject.acquisition
        study = _Study(subject, gate, flux or Flux(), pulse, method, tuple(seeds))
        rows = [partial(_correction, study, name) for name in CORRECTIONS]
        rows += [partial(_extension, study, name) for name in EXTENSIONS]
        rows += [partial(_part, study, name) for name in parts_of(subject)]
    found: list[Requirement] = []
    progress(0, len(rows))
    for row in rows:
        found.append(row())
        progress(len(found), len(rows))
    return tuple(found)


EXTENDED_CAPTURES = MIN_REPEATS
"""Captures of a scene by which extensions are judged, at most: they take longest."""


@dataclass(frozen=True, eq=False)
class _Study:
    """Captures of a scene, ranged by one method."""

    scene: Scene
    acquisition: Acquisition
    flux: Flux
    pulse: Pulse
    method: str
    seeds: tuple[int, ...]

    @property
    def n_pulses(self) -> int:
        return pulses_sent(self.acquisition)

    @cached_property
    def captures(self) -> list[Capture]:
        return [self.capture(seed) for seed in self.seeds]

    @cached_property
    def scores(self) -> Floats:
        return self.scored(self.captures)

    @cached_property
    def probability(self) -> Floats:
        """Trigger probability of each bin, shape (pixel, bin)."""
        edges = cumulative_trigger_probability(self.scene, self.acquisition, self.flux, self.pulse)
        return np.maximum(np.diff(edges), 0.0)  # rounding may make it negative

    def capture(self, seed: int, n_groups: int | None = None) -> Capture:
        given = self.scene, self.acquisition, self.flux, self.pulse, seed
        return simulate(*given, n_groups=n_groups)

    def scored(self, captures: Sequence[Capture]) -> Floats:
        """Return `corrections.score` of each capture, shape (capture, 2)."""
        truth_m = np.asarray(self.scene.range_m, float)[np.newaxis]
        found = ((corrections.ranges_m(each, self.method)[np.newaxis], each) for each in captures)
        return np.array([corrections.score(range_m, truth_m, each) for range_m, each in found])

    def difference(self, other: _Study) -> Difference:
        return difference(self.probability, other.probability, self.n_pulses)


def _part(study: _Study, part: str) -> Requirement:
    other = replace(study, scene=without(study.scene, part))
    return judged(
        part,
        study.difference(other),
        study.acquisition.bin_length_m,
        *corrections.changes(study.scores, other.scores, study.acquisition.gate_length_m),
        time_ratio(partial(study.capture, 0), partial(other.capture, 0)),
    )


def _correction(study: _Study, correction: str) -> Requirement:
    corrected = [corrections.with_correction(each, correction) for each in study.captures]
    uncorrected = [without_correction(each, correction) for each in study.captures]
    if correction == "pile_up":
        found = resolution.pile_up(study.probability.sum(axis=1), study.n_pulses)
    elif correction == "signal_levels":
        found = corrections.level_deviation(study.captures[0])
    else:
        other = replace(study, acquisition=uncorrected[0].acquisition, pulse=uncorrected[0].pulse)
        found = study.difference(other)
    return judged(
        correction,
        found,
        study.acquisition.bin_length_m,
        *corrections.changes(
            study.scored(corrected), study.scored(uncorrected), study.acquisition.gate_length_m
        ),
        corrections.ranging_ratio(corrected[0], uncorrected[0], study.method),
    )


def _extension(study: _Study, extension: str) -> Requirement:
    seeds, truth_m = study.seeds[:EXTENDED_CAPTURES], np.asarray(study.scene.range_m, float)
    captures, truth_m = iter(study.captures[: len(seeds)]), truth_m[np.newaxis]
    if extension == "second_return":
        truth_m = study.scene.surfaces_m
    if extension == "velocity":
        n_groups = study.scene.groups_of(study.n_pulses)
        if n_groups is None:
            return Requirement(extension, "not needed", "the scene is at rest")
        captures = (study.capture(seed, n_groups) for seed in seeds)
    return extensions.judged_on_scene(extension, captures, truth_m, study.method)


def requirements_table(rows: Sequence[Requirement], title: str) -> Table:
    """Return one row each, without columns that are unknown in all rows."""
    columns: dict[str, Callable[[Requirement], str | float | Interval]] = {
        "part, correction or extension": lambda row: TITLES[row.part],
        "verdict": lambda row: row.verdict,
        "p": lambda row: row.p_value,
        "effect": lambda row: row.effect,
        "seen from": lambda row: row.smallest_effect,
        "total variation": lambda row: row.total_variation,
        "worst": lambda row: row.worst,
        "detectable from": lambda row: row.resolvable,
        "pixels": lambda row: row.detectable_share,
        "RD": lambda row: row.rd_change,
        "RMSE m": lambda row: row.rmse_change_m,
        "time": lambda row: row.time_ratio,
        "reason": lambda row: row.why,
    }
    return table(
        "requirements",
        title,
        rows,
        {name: cell for name, cell in columns.items() if any(map(_is_known, map(cell, rows)))},
        NOTE,
        {
            **dict.fromkeys(("p", "effect", "seen from"), ".2g"),
            **dict.fromkeys(("total variation", "worst", "detectable from"), ".2g"),
            "pixels": ".0%",
            "RD": "+.4f",
            "RMSE m": "+.3f",
            "time": ".2f",
        },
    )


def _is_known(value: str | float | Interval) -> bool:
    number = value.value if isinstance(value, Interval) else value
    return isinstance(number, str) or not math.isnan(number)


RULE = (
    "A part of a scene is needed if the pulses of more than 1 % of the pixels distinguish a model "
    "with it from one without it (likelihood-ratio test with errors of at most 5 %), or if "
    f"estimates change by more than {MARGIN_RD:g} in RD or half a bin in RMSE; a correction is "
    "needed if it improves them by as much. Neither is needed if it makes no histogram likelier by "
    "5 % in 99 % of the pixels, or if the whole 95 % interval of both changes lies within these "
    "margins. Otherwise the data do not decide."
)

RULE_OF_CAPTURES = (
    "A capture is tested on all its pixels together. A part or a correction is needed if an effect "
    f"is seen (p < {SIZE:g}) that is large enough to matter. It is not needed if an effect that "
    f"matters would have been seen with a probability of {POWER:.0%}, but was not, or is seen to "
    "be smaller. Otherwise the data do not decide. Where the truth is known, a correction is "
    f"needed if it improves estimates by more than {MARGIN_RD:g} in RD or half a bin in RMSE."
)

KINDS_NOTE = (
    "Corrections undo what a simpler estimator ignores; extensions go beyond one pixel by itself, "
    "with one surface at rest; parts belong to the scene."
)
COMPARISON_NOTE = (
    "RD within 3 bins, RMSE and time compare with and without it, with 95 % intervals; time is "
    "that of simulating for a part, otherwise of ranging, for an extension with its flux model. "
    f"Extensions are judged by {EXTENDED_CAPTURES} captures of a scene. For the search for a "
    "second return, RD is the share of all surfaces that are found, where a return more than there "
    "are surfaces counts as one that is not, and the RMSE is that of the return nearest to each "
    "surface."
)
NOTE = (
    f"{KINDS_NOTE} Total variation: how far the part, or what the correction corrects, changes the "
    "trigger probabilities of a pulse, mean over the pixels and in the worst. Detectable from: "
    "total variation that the pulses of one pixel reveal with errors of 5 %. Effect: estimated "
    "from all pixels of a capture, in the unit that the reason states. Seen from: effect that "
    f"would have been seen with a probability of {POWER:.0%}. {COMPARISON_NOTE}"
)
