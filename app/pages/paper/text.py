"""What the page "Paper" says."""

from __future__ import annotations

SECTIONS_HELP = "Each figure and table of the paper, computed here and now."

SIDEBAR_AWAY = "This page has its own controls; those of the other pages are put away."

RECONSTRUCTION = "reconstruction, from its abstract"

TITLES_OF_PRESETS = {
    "tracking": "Tracking differentiator, recommended",
    "tracking as printed": "Tracking differentiator, as printed",
}

JUMP = """
Most pulses are spent on background before the echo comes: the probability that a bin triggers falls
from bin to bin (Figure 1). The echo is a jump in it, which the first difference shows (Figure 2).
"""
SCALES = """
Above, one pixel's histogram, with the small scale that follows its trend and the large scale that
follows a jump. Figure 4 shows such pixels. Below, Figure 5: the height of the residual against the
echo's place. Where it falls to what noise alone reaches, the echo is lost.
"""
WEIGHTS = """
The residual times a weight is the enhanced signal; its largest value is the answer. The weight
decides between a late echo and early noise, and so carries a guess about range.
"""
TABLE_2 = """
The paper's method on the car under six SBRs, by the recommended preset and by the settings as
printed; below them the likelihood, and the oracle that is told the true light.
"""
TABLE_3 = """
Every method on the car at the SBR you choose. The paper prints this table for 0.06; at its five
other SBRs it prints its own method alone, in Table 2.
"""
IMAGES = """
The restored range images. A tap on a picture, or a row and a column, compare a pixel in all.
"""
UNSAID = """
What a method assumes without saying so, how its merit depends on the echo's place, what physics
allows, and what does not follow from the paper's own tables.
"""
READING_TRIALS = (
    "Below each figure its 95 % interval. A difference is ours minus the printed value: better, "
    "worse, or so small that chance may do it. All methods see the same captures, one for each "
    "repetition. Reconstructions were rebuilt from abstracts: their distance from the paper says "
    "little about the method."
)
OUTSIDE_NOTE = "Grey: answers beyond both ends of the scale."
PLACE_HELP = "Of the pixel whose range stands above each picture; a tap on one chooses it, too."
NEEDS_TWO = "The table begins with the second repetition: an interval needs two."

COLUMN_HELP: dict[str, tuple[str, int]] = {
    "SBR": ("Signal over background, both in photons per pulse.", -1),
    "method": ("As this app calls it.", 1),
    "RD, 3 bins": ("Share of target pixels within 3 bins of the truth: the paper's RD.", -1),
    "RMSE m": ("Root mean square error over target pixels with an answer.", 1),
    "printed RD": ("As the paper prints it.", -1),
    "printed RMSE m": ("As the paper prints it.", 1),
    "difference": ("Ours minus the printed value.", -1),
    "RD, 1 bin": ("Share of target pixels within 1 bin of the truth.", -1),
    "RD, 2 bins": ("Share of target pixels within 2 bins of the truth.", -1),
    "MAE m": ("Mean error, without sign.", 1),
    "bias m": ("Mean error, with sign.", 1),
    "inlier RMSE m": ("Root mean square error of the answers within 3 bins.", 1),
    "Var of RD": ("Variance of the RD over repetitions: the paper's Var, most plausibly.", 1),
    "answered": ("Share of target pixels with an answer.", -1),
    "ms": ("Time to range one capture here, the median.", 1),
    "scene": ("What is looked at.", 1),
    "probability of the right bin": ("That the true bin beats every other, at best.", -1),
    "Cramér-Rao bound m": ("Least scatter of answers that are not grossly wrong.", 1),
}
"""Of each column a line of help, and 1 or -1: whether its lowest or highest value comes first."""
