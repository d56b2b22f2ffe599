"""Whether a model needs a part: the rule, and what is known of the part when it is judged.

A part of a scene is needed where single histograms show that it is there
(`core.inference.resolution`, in more than a few pixels), or where the answers move by more than
`MARGIN_RD` or `MARGIN_BINS`. A correction that an estimator makes is needed where the answers
become better by as much; where no truth tells that, it is judged like a part.

Neither is needed where hardly a histogram could show it, or where the change's whole 95 % interval
lies within the margins (the equivalence test of Schuirmann 1987; a correction may do harm besides).
Otherwise the data do not tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from core.corrections import CORRECTIONS
from core.inference.resolution import ERROR, FEW, Difference
from core.metrics import Interval
from core.scene import PARTS

Verdict = Literal["needed", "not needed", "cannot tell"]

MARGIN_RD = 0.005
"""Of the restoration degree within 3 bins: one pixel in 200."""

MARGIN_BINS = 0.5
"""Of the RMSE, in bins: what rounding to whole bins does at most."""

UNKNOWN = Interval(math.nan, math.nan, math.nan)

TITLES = CORRECTIONS | PARTS


@dataclass(frozen=True)
class Requirement:
    """One part of a scene, or one correction of an estimator, and whether it is needed."""

    part: str
    """A key of `core.PARTS`, or of `core.CORRECTIONS`."""
    verdict: Verdict
    why: str
    """One sentence."""
    total_variation: float = math.nan
    """How far it moves the trigger probabilities of a pulse, mean over the pixels; NaN where that
    is not known."""
    worst: float = math.nan
    """The same in the pixel where it is largest."""
    resolvable: float = math.nan
    """From where on the pulses tell a difference of this shape: median over the pixels; NaN where
    there is none."""
    told_share: float = math.nan
    """Share of the pixels in which they do."""
    rd_change: Interval = UNKNOWN
    """With it less without, paired; of the restoration degree within 3 bins."""
    rmse_change_m: Interval = UNKNOWN
    """Likewise."""
    time_ratio: Interval = UNKNOWN
    """With it over without: of simulating for a part, of ranging for a correction."""


def judged(
    part: str,
    apart: Difference,
    bin_length_m: float,
    rd_change: Interval = UNKNOWN,
    rmse_change_m: Interval = UNKNOWN,
    time_ratio: Interval = UNKNOWN,
    note: str = "",
) -> Requirement:
    """Give a verdict on a part or a correction of which something is known.

    Parameters
    ----------
    apart : Difference
        The models with and without it, per pixel.
    note : str
        What is to be added to the reason.
    """
    rd = _in_margins(rd_change, MARGIN_RD)
    rmse = _in_margins(rmse_change_m, MARGIN_BINS * bin_length_m)
    if part in CORRECTIONS and not math.isnan(rd.value):
        verdict, why = _verdict_on_correction(apart, rd, rmse)
    else:
        verdict, why = _verdict_on_part(apart, rd, rmse)
    known = apart.resolvable[np.isfinite(apart.resolvable)]
    return Requirement(
        part,
        verdict,
        f"{why}; {note}" if note else why,
        float(np.mean(apart.total_variation)),
        float(np.max(apart.total_variation)),
        float(np.median(known)) if known.size else math.nan,
        float(np.mean(apart.told)),
        rd_change,
        rmse_change_m,
        time_ratio,
    )


def _in_margins(change: Interval, margin: float) -> Interval:
    return Interval(change.value / margin, change.low / margin, change.high / margin)


_HIDDEN = f"nothing is likelier by {ERROR:.0%} with it, in nearly all pixels"
_VARIES = "the interval of the answers' change reaches beyond a margin"


def _verdict_on_correction(apart: Difference, rd: Interval, rmse: Interval) -> tuple[Verdict, str]:
    """Of changes in units of their margins, which are known."""
    if rd.low > 1 or rmse.high < -1:
        return "needed", "answers are better with it"
    if rd.high <= 1 and rmse.low >= -1:
        return "not needed", "answers are no better with it"
    return ("not needed", _HIDDEN) if apart.is_hidden else ("cannot tell", _VARIES)


def _verdict_on_part(apart: Difference, rd: Interval, rmse: Interval) -> tuple[Verdict, str]:
    """Of changes in units of their margins, NaN where not known."""
    told_share, changes = float(np.mean(apart.told)), (rd, rmse)
    shown = f"histograms show it in {told_share:.0%} of the pixels"
    if told_share > FEW:
        return "needed", shown
    if any(each.low > 1 or each.high < -1 for each in changes):
        return "needed", "single histograms hardly show it, but answers move"
    if apart.is_hidden:
        return "not needed", _HIDDEN
    if all(each.low >= -1 and each.high <= 1 for each in changes):
        return "not needed", f"{shown}, and answers stay"
    unknown = "how far answers move is not known"
    return "cannot tell", f"{shown}, and {unknown if math.isnan(rd.value) else _VARIES}"
