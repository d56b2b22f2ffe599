"""What must hold whatever is set and whatever was recorded, each law a search for its worst case.

A law tells of each case how far it is from holding, in units of its own, and where that is; it
holds where no case exceeds its bound. The cases are those of `core.studies.sensitivity.extremes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from core.studies.sensitivity import estimator_invariants as answers
from core.studies.sensitivity import flux_invariants as light
from core.studies.sensitivity.extremes import Case, Grid
from core.tracking import CALM_M

DISAGREEING = 1e-3
"""Share of the pixels in which float32 and float64 may choose different bins."""


@dataclass(frozen=True)
class Law:
    """What must hold, and where to look for cases in which it does not."""

    name: str
    sentence: str
    bound: float
    unit: str
    """Of the bound: what is counted or measured."""
    cases: Callable[[Grid], Iterable[Case]]
    is_timed: bool = False
    """Whether its cases are ratios of times, which an idle machine alone tells."""


@dataclass(frozen=True)
class Verdict:
    """The worst case of a law."""

    law: Law
    cases: int
    worst: float
    where: str

    @property
    def holds(self) -> bool:
        """Whether even that is within the bound; a NaN is not."""
        return self.worst <= self.law.bound


def verdict(law: Law, grid: Grid) -> Verdict:
    """Hold a law against a grid."""
    count, worst, where = 0, -math.inf, ""
    for value, place in law.cases(grid):
        count += 1
        if math.isnan(value) or value > worst:
            worst, where = value, place
        if math.isnan(value):
            break
    return Verdict(law, count, worst, where)


LAWS = {
    law.name: law
    for law in (
        Law(
            "probability",
            "Trigger probabilities lie in [0, 1].",
            0.0,
            "beyond",
            light.beyond_0_and_1,
        ),
        Law("sum", "With that of no trigger they sum to 1.", 1e-12, "off by", light.sums),
        Law(
            "logarithm",
            "They are what their logarithms say, and 0 only where no number is so small.",
            1e-12,
            "share of the logarithm",
            light.logarithms,
        ),
        Law(
            "draws",
            "No more is drawn than pulses, nothing where nothing can be.",
            0.0,
            "counts",
            light.draws,
        ),
        Law(
            "Coates",
            "Coates' rates give the counts back that they were made from.",
            1e-9,
            "share of a count",
            light.round_trip,
        ),
        Law(
            "likelihood",
            "The likelihood is finite, with no signal and with no background, too.",
            0.0,
            "numbers",
            light.likelihood,
        ),
        Law(
            "limits",
            "Limits are numbers, and probabilities in [0, 1].",
            0.0,
            "numbers",
            light.any_limits,
        ),
        Law(
            "background",
            "More background never lowers the Cramér-Rao bound.",
            1e-9,
            "share of the bound",
            light.more_background,
        ),
        Law(
            "light",
            "Under any light answers lie in the gate, with a finite score and a confidence in "
            "[0, 1]; they are NaN and not valid where there is none.",
            0.0,
            "pixels",
            answers.any_light,
        ),
        Law(
            "settings",
            "The same for any histogram and any settings that are accepted.",
            0.0,
            "pixels",
            answers.any_settings,
        ),
        Law(
            "refusal", "What has no end is refused in words.", 0.0, "values taken", answers.refused
        ),
        Law(
            "threads",
            "Answers are the same for any number of threads.",
            0.0,
            "pixels",
            answers.threads,
        ),
        Law(
            "parts", "Answers are the same however the image is cut.", 0.0, "pixels", answers.chunks
        ),
        Law(
            "types",
            "Answers are the same for narrow and wide counts.",
            0.0,
            "pixels",
            answers.types,
        ),
        Law(
            "scale",
            "Counts have no unit: k times as many move no answer, beyond float32's rounding.",
            1.0,
            "roundings",
            answers.scales,
        ),
        Law(
            "evidence",
            "More counts in an echo's bin never move the answer away, nor lower its confidence.",
            0.0,
            "pixels",
            answers.evidence,
        ),
        Law(
            "confidence",
            "Confidence is not told where there is no reason for it: under no light does it exceed "
            "the share of right answers.",
            0.05,
            "by so much on average",
            answers.confidence,
        ),
        Law(
            "precision",
            f"From m = {CALM_M:g} on float32 and float64 choose other bins in a share of the "
            "pixels at most.",
            DISAGREEING,
            "share of the pixels",
            answers.disagreeing,
        ),
        Law(
            "rounding",
            "Where they do, the two scores differ by rounding.",
            1.0,
            "roundings",
            answers.rounding,
        ),
        Law(
            "likelihood in float32",
            "No delay is likelier in float64 than the one found in float32, beyond rounding.",
            1.0,
            "roundings",
            answers.likelihood_in_float32,
        ),
        Law(
            "compiled",
            "Compiled and plain kernels give the same answers, in bins and in confidence.",
            1e-3,
            "bins or probability",
            answers.compiled,
        ),
        Law(
            "subnormal",
            "Numbers that have lost digits slow nothing down beyond a factor of 2.",
            2.0,
            "times as long",
            answers.slow,
            is_timed=True,
        ),
    )
}
