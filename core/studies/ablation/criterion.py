"""The rule that decides whether a model needs a part.

A part of a scene is needed if single histograms reveal it (`core.inference.resolution`) in more
than a few pixels, or if estimates change by more than `MARGIN_RD` or `MARGIN_BINS` without it. A
correction of an estimator is needed if it improves the estimates by as much; without a truth to
compare with, it is judged like a part.

Neither is needed if hardly a histogram could reveal it, or if the whole 95 % interval of the change
lies within the margins (the equivalence test of Schuirmann 1987; a correction may do harm, too).
Otherwise the data do not decide.

An extension of the estimator is judged like a correction, by its estimates alone.

A part of a capture is tested on all pixels together (`core.studies.ablation.pooled`). It is needed
if an effect is seen that is large enough to matter, and not needed only where such an effect would
have been seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from core.corrections import CORRECTIONS
from core.deprecation import renamed
from core.inference.resolution import ERROR, FEW, Difference
from core.metrics import Interval
from core.scene import PARTS
from core.studies.ablation.evidence import POWER, Evidence, Verdict
from core.typesetting import probability_text

MARGIN_RD = 0.005
"""Smallest relevant change of the restoration degree within 3 bins: one pixel in 200."""

MARGIN_BINS = 0.5
"""Smallest relevant change of the RMSE, in bins: the largest error of rounding to whole bins."""

UNKNOWN = Interval(math.nan, math.nan, math.nan)

EXTENSIONS = {
    "neighbours": "evidence of neighbouring pixels",
    "second_return": "search for a second return",
    "velocity": "search for a velocity",
}
"""Extensions of an estimator that ranges each pixel by itself, with one surface at rest."""

TITLES = CORRECTIONS | EXTENSIONS | PARTS


@dataclass(frozen=True)
class Requirement:
    """Whether a part of a scene, or a correction or extension of an estimator, is needed.

    What is not known is NaN.
    """

    part: str
    """A key of `core.PARTS`, `core.CORRECTIONS` or `EXTENSIONS`."""
    verdict: Verdict
    why: str
    total_variation: float = math.nan
    """Mean change of the trigger probabilities of a pulse over the pixels."""
    worst: float = math.nan
    """The same in the pixel where it is largest."""
    resolvable: float = math.nan
    """Smallest difference of this shape that one pixel's pulses reveal, median over the pixels."""
    detectable_share: float = math.nan
    """Share of the pixels whose pulses reveal it."""
    rd_change: Interval = UNKNOWN
    """Restoration degree within 3 bins with it minus without it, paired."""
    rmse_change_m: Interval = UNKNOWN
    """RMSE with it minus without it, paired."""
    time_ratio: Interval = UNKNOWN
    """With it over without it: time of simulating for a part, otherwise of ranging."""
    effect: float = math.nan
    """Size in a capture, tested on all pixels together, in the unit that `why` states."""
    smallest_effect: float = math.nan
    """Effect that would have been seen with a probability of `evidence.POWER`."""
    p_value: float = math.nan
    """Probability of as much evidence of an effect if there is none."""

    told_share = renamed("detectable_share")


def judged(
    part: str,
    difference: Difference,
    bin_length_m: float,
    rd_change: Interval = UNKNOWN,
    rmse_change_m: Interval = UNKNOWN,
    time_ratio: Interval = UNKNOWN,
    note: str = "",
) -> Requirement:
    """Decide whether a part or a correction is needed.

    Parameters
    ----------
    difference : Difference
        Between the models with and without it, per pixel.
    note : str
        Added to the reason.
    """
    rd = _in_margins(rd_change, MARGIN_RD)
    rmse = _in_margins(rmse_change_m, MARGIN_BINS * bin_length_m)
    is_correction = part in CORRECTIONS and not math.isnan(rd.value)
    verdict, why = (_judge_correction if is_correction else _judge_part)(difference, rd, rmse)
    known = difference.resolvable[np.isfinite(difference.resolvable)]
    return Requirement(
        part,
        verdict,
        f"{why}; {note}" if note else why,
        float(np.mean(difference.total_variation)),
        float(np.max(difference.total_variation)),
        float(np.median(known)) if known.size else math.nan,
        float(np.mean(difference.is_resolved)),
        rd_change,
        rmse_change_m,
        time_ratio,
    )


def improved(
    part: str,
    bin_length_m: float,
    rd_change: Interval,
    rmse_change_m: Interval = UNKNOWN,
    time_ratio: Interval = UNKNOWN,
    note: str = "",
) -> Requirement:
    """Decide whether an extension of an estimator is needed, by the change of its estimates.

    Parameters
    ----------
    rmse_change_m : Interval
        Where it is not known, the change of the restoration degree decides.
    note : str
        Added to the reason.
    """
    rd = _in_margins(rd_change, MARGIN_RD)
    rmse = _in_margins(rmse_change_m, MARGIN_BINS * bin_length_m)
    known = Interval(0.0, 0.0, 0.0) if math.isnan(rmse.value) else rmse
    verdict, why = _judge_changes(rd, known) or ("cannot tell", _VARIES)
    return Requirement(
        part,
        verdict,
        f"{why}; {note}" if note else why,
        rd_change=rd_change,
        rmse_change_m=rmse_change_m,
        time_ratio=time_ratio,
    )


def tested(
    part: str, evidence: Evidence, margin: float, found: str, explained: float = 0.0, note: str = ""
) -> Requirement:
    """Decide whether a capture needs a part by the evidence of an effect.

    Parameters
    ----------
    margin : float
        Smallest effect that matters.
    found : str
        What was found, with a place for the effect.
    explained : float
        Largest effect that second surfaces may cause, if they are seen.
    note : str
        Added to the reason.
    """
    verdict, smallest = evidence.verdict(margin, explained), evidence.smallest
    chance = f"p-value {probability_text(evidence.p_value)}"
    seen = f"would have been seen with a probability of {_percent(POWER)}"
    if math.isfinite(smallest):
        seen = f"{_percent(smallest)} {seen}, and {_percent(margin)} matters"
    elif evidence.is_seen:
        seen = f"{_percent(margin)} matters"
    else:
        seen = f"no effect {seen}"
    doubt = f"up to {_percent(explained)} may come from second surfaces"
    clauses = (
        f"{found.format(_percent(evidence.effect))} ({chance}); {seen}",
        doubt if explained and verdict == "cannot tell" else "",
        note,
    )
    return Requirement(
        part,
        verdict,
        "; ".join(filter(None, clauses)),
        effect=evidence.effect,
        smallest_effect=smallest,
        p_value=evidence.p_value,
    )


def unknown(part: str, why: str) -> Requirement:
    """Return that a capture does not decide, and why."""
    return Requirement(part, "cannot tell", why)


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"


def _in_margins(change: Interval, margin: float) -> Interval:
    return Interval(change.value / margin, change.low / margin, change.high / margin)


_HIDDEN = f"it makes no histogram likelier by {ERROR:.0%}, in nearly all pixels"
_VARIES = "the interval of the change exceeds a margin"


def _judge_correction(difference: Difference, rd: Interval, rmse: Interval) -> tuple[Verdict, str]:
    """Judge by known changes in units of their margins."""
    found = _judge_changes(rd, rmse)
    if found is None:
        return ("not needed", _HIDDEN) if difference.is_hidden else ("cannot tell", _VARIES)
    return found


def _judge_changes(rd: Interval, rmse: Interval) -> tuple[Verdict, str] | None:
    """Judge by known changes in units of their margins; None where they do not decide."""
    if rd.low > 1 or rmse.high < -1:
        return "needed", "estimates are better with it"
    if rd.high <= 1 and rmse.low >= -1:
        return "not needed", "estimates are no better with it"
    return None


def _judge_part(difference: Difference, rd: Interval, rmse: Interval) -> tuple[Verdict, str]:
    """Judge by changes in units of their margins, NaN where unknown."""
    share, changes = float(np.mean(difference.is_resolved)), (rd, rmse)
    shown = f"histograms reveal it in {share:.0%} of the pixels"
    if share > FEW:
        return "needed", shown
    if any(each.low > 1 or each.high < -1 for each in changes):
        return "needed", "single histograms hardly reveal it, but estimates change"
    if difference.is_hidden:
        return "not needed", _HIDDEN
    if all(each.low >= -1 and each.high <= 1 for each in changes):
        return "not needed", f"{shown}, and estimates do not change"
    unknown = "the change of the estimates is unknown"
    return "cannot tell", f"{shown}, and {unknown if math.isnan(rd.value) else _VARIES}"
