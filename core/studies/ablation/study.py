"""What a scene, or a capture, requires of its model: every part and every correction judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.checks import require
from core.corrections import CORRECTIONS, without_correction
from core.estimators import ESTIMATORS
from core.inference import resolution
from core.inference.resolution import Difference, difference
from core.metrics import Interval
from core.scene import Scene, parts_of, without
from core.simulation import pulses_sent, simulate, triggered_by_each_edge
from core.studies.ablation import capture_parts, corrections
from core.studies.ablation.criterion import MARGIN_RD, TITLES, Requirement, judged
from core.studies.outputs import Table


def requirements(
    seen: Scene | Capture,
    flux: Flux | None = None,
    *,
    acquisition: Acquisition | None = None,
    pulse: Pulse = Pulse(),
    method: str = "likelihood",
    seeds: Sequence[int] = range(16),
    progress: Callable[[int, int], None] = lambda done, of: None,
    cancelled: Callable[[], bool] = lambda: False,
) -> tuple[Requirement, ...]:
    """Judge every part that a scene has, and every correction that an estimator makes.

    Parameters
    ----------
    seen : Scene or Capture
        A scene's parts are known: what they move is computed from the model, and on captures with
        and without them. A capture's are looked for in its counts.
    flux, acquisition, pulse
        How a scene is lit and recorded: the usual flux, its own acquisition where None.
    method : str
        A key of `core.ESTIMATORS`: whose answers move.
    seeds : sequence of int
        Of a scene's captures, at least 2; what is compared shares them.
    progress : callable
        ``(rows done, rows in all)``, called after each row.
    cancelled : callable
        Asked before each row: once it says True, the rows that are left are not computed.

    Returns
    -------
    tuple of Requirement

    Raises
    ------
    ValueError
        If the method is unknown, seeds are fewer than 2, or a scene's pulses are not known.
    """
    require("method", method, method in ESTIMATORS, " or ".join(map(repr, ESTIMATORS)))
    rows: list[Callable[[], Requirement]]
    if isinstance(seen, Capture):
        rows = capture_parts.rows(seen, method)
    else:
        require("seeds", seeds, len(seeds) >= 2, "at least 2 of them")
        gate = acquisition or seen.acquisition
        study = _Study(seen, gate, flux or Flux(), pulse, method, tuple(seeds))
        rows = [partial(_correction, study, name) for name in CORRECTIONS]
        rows += [partial(_part, study, name) for name in parts_of(seen)]
    found: list[Requirement] = []
    for row in rows:
        if cancelled():
            break
        found.append(row())
        progress(len(found), len(rows))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Study:
    """A scene, how it is lit, recorded and ranged, and what comes of it."""

    scene: Scene
    acquisition: Acquisition
    flux: Flux
    pulse: Pulse
    method: str
    seeds: tuple[int, ...]

    @property
    def n_pulses(self) -> int:
        """Pulses sent."""
        return pulses_sent(self.acquisition)

    @cached_property
    def captures(self) -> list[Capture]:
        """One for each seed."""
        return [self.captured(seed) for seed in self.seeds]

    @cached_property
    def scores(self) -> Floats:
        """Of each capture, shape (seed, 2)."""
        return self.scored(self.captures)

    @cached_property
    def probability(self) -> Floats:
        """Of a pulse to trigger in each bin, shape (pixel, bin)."""
        edges = triggered_by_each_edge(self.scene, self.acquisition, self.flux, self.pulse)
        return np.maximum(np.diff(edges), 0.0)  # but for rounding

    def captured(self, seed: int) -> Capture:
        """One capture."""
        return simulate(self.scene, self.acquisition, self.flux, self.pulse, seed)

    def scored(self, captures: Sequence[Capture]) -> Floats:
        """`corrections.score` of each capture, shape (capture, 2)."""
        truth_m = np.asarray(self.scene.range_m, float)
        answers = ((corrections.answers_m(each, self.method), each) for each in captures)
        return np.array([corrections.score(found_m, truth_m, each) for found_m, each in answers])

    def apart(self, other: _Study) -> Difference:
        """The models of one pulse, compared pixel by pixel."""
        return difference(self.probability, other.probability, self.n_pulses)


def _part(study: _Study, part: str) -> Requirement:
    bare = replace(study, scene=without(study.scene, part))
    return judged(
        part,
        study.apart(bare),
        study.acquisition.bin_length_m,
        *corrections.changes(study.scores, bare.scores),
        corrections.time_ratio(partial(study.captured, 0), partial(bare.captured, 0)),
    )


def _correction(study: _Study, correction: str) -> Requirement:
    made = [corrections.with_correction(each, correction) for each in study.captures]
    spared = [without_correction(each, correction) for each in study.captures]
    if correction == "pile_up":
        apart = resolution.pile_up(study.probability.sum(axis=1), study.n_pulses)
    elif correction == "signal_levels":
        apart = corrections.levels_apart(study.captures[0])
    else:
        apart = study.apart(
            replace(study, acquisition=spared[0].acquisition, pulse=spared[0].pulse)
        )
    return judged(
        correction,
        apart,
        study.acquisition.bin_length_m,
        *corrections.changes(study.scored(made), study.scored(spared)),
        corrections.ranging_ratio(made[0], spared[0], study.method),
    )


def table(rows: Sequence[Requirement], title: str) -> Table:
    """What was found, one row for each part and correction."""
    return Table(
        "requirements",
        title,
        (
            "part or correction",
            "verdict",
            "total variation",
            "worst",
            "told from",
            "pixels told",
            "RD",
            "RMSE m",
            "time",
            "why",
        ),
        tuple(
            (
                TITLES[row.part],
                row.verdict,
                _number(row.total_variation),
                _number(row.worst),
                _number(row.resolvable),
                "" if np.isnan(row.told_share) else f"{row.told_share:.0%}",
                _interval(row.rd_change, "+.4f"),
                _interval(row.rmse_change_m, "+.3f"),
                _interval(row.time_ratio, ".2f"),
                row.why,
            )
            for row in rows
        ),
        NOTE,
    )


RULE = (
    "A part of a scene is needed where the pulses of more than 1 % of the pixels tell a model with "
    "it from one without (the likelihood-ratio test errs in at most 5 %), or where the answers "
    f"move by more than {MARGIN_RD:g} in RD or half a bin in RMSE; a correction is needed where it "
    "makes them better by as much. Neither is needed where nothing is likelier by 5 % with it in "
    "99 % of the pixels, or where the whole 95 % interval of both changes lies within these "
    "margins. Otherwise the data do not tell."
)

NOTE = (
    "Total variation: how far the part, or what the correction corrects, moves the trigger "
    "probabilities of a pulse, mean over the pixels and in the worst; told from: where the pulses "
    "of one pixel show a difference of this shape with errors of 5 %. RD within 3 bins, RMSE and "
    "time are with it against without it, with 95 % intervals: of the answers and of ranging for a "
    "correction, of simulating for a part."
)


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.2g}"


def _interval(interval: Interval, form: str) -> str:
    if np.isnan(interval.value):
        return ""
    value, low, high = (format(x, form) for x in (interval.value, interval.low, interval.high))
    return f"{value} [{low}, {high}]"
