"""Texts of the Paper page."""

from __future__ import annotations

SECTIONS_HELP = "Figures and tables of the paper, computed on this server."

NO_SIDEBAR = "This page has its own controls; the other pages' controls are hidden."

RECONSTRUCTION = "reconstructed from its abstract"

TITLES_OF_PRESETS = {
    "tracking": "Tracking differentiator, recommended",
    "tracking, literal": "Tracking differentiator, literal",
}

JUMP = """
Background fires most pulses before the echo arrives: the probability that a bin triggers falls from
bin to bin (Figure 1). The echo is a jump in it, which the first difference shows (Figure 2).
"""
SCALES = """
Top: histogram of a pixel as in Figure 4. The large scale follows a jump, the small scale the trend:
with the literal preset it starts at zero, and meets the background only late in the gate. Bottom,
not in the paper: the height of the residual against the echo's bin. Where it falls to the level of
noise alone, the echo is lost.
"""
PILE_UP = """
A target is moved from bin 20 to the end of the gate. Top: the trigger frequency at its peak (Figure
5a), which falls, and fits of it (Figure 6). The paper takes the fall for exponential, and concludes
that the weight should grow exponentially, but prints a cubic weight. Bottom: noise in the bins
before the target (Figure 5b).
"""
WEIGHTS = """
Not in the paper. The enhanced signal is the residual times a weight; the estimate is its maximum.
The weight trades late echoes against early noise, and is therefore an assumption about range.
"""
TABLE_2 = """
The paper's method on the car at six SBRs, with the recommended preset and with its literal
equations. Below: the likelihood, and the oracle, which knows the true fluxes.
"""
TABLE_3 = """
All methods on the car at the chosen SBR. The paper prints this table for 0.06 only; for its five
other SBRs it prints its own method alone, in Table 2.
"""
IMAGES = """
Estimated range images. Tap an image, or choose a row and a column, to compare a pixel in all of
them.
"""
NOT_REPORTED = """
What each method estimates without an echo, how its accuracy depends on the echo's bin, the limit
of a single pixel, and statements of the paper that its own tables contradict.
"""
READING_TRIALS = (
    "Below each number: its 95 % interval. Difference: computed here minus printed, marked as "
    "better, worse, or within chance. All methods use the same captures, one per repetition. "
    "Methods reconstructed from abstracts may differ from the paper's."
)
OUTSIDE_NOTE = (
    "Grey: estimates beyond the ends of the colour scale. The titles end with the range of the "
    "framed pixel; tap another."
)
PLACE_HELP = "Pixel whose range is shown above each image; a tap on an image also selects it."
NEEDS_TWO = "The table appears after the second repetition: an interval needs two."

COLUMN_HELP: dict[str, tuple[str, int]] = {
    "SBR": ("Signal-to-background ratio.", -1),
    "method": ("Name of the method in this app.", 1),
    "RD, 3 bins": ("Share of target pixels within 3 bins of the truth: the paper's RD.", -1),
    "RMSE m": ("Root mean square error over target pixels with an estimate.", 1),
    "printed RD": ("Value printed in the paper.", -1),
    "printed RMSE m": ("Value printed in the paper.", 1),
    "difference": ("Computed here minus printed.", -1),
    "RD, 1 bin": ("Share of target pixels within 1 bin of the truth.", -1),
    "RD, 2 bins": ("Share of target pixels within 2 bins of the truth.", -1),
    "MAE m": ("Mean absolute error.", 1),
    "bias m": ("Mean error.", 1),
    "inlier RMSE m": ("Root mean square error of the estimates within 3 bins.", 1),
    "Var of RD": ("Variance of the RD over repetitions, probably the paper's Var.", 1),
    "answered": ("Share of target pixels with an estimate.", -1),
    "ms": ("Median time to estimate one capture on this server.", 1),
    "scene": ("The scene.", 1),
    "probability of the right bin": (
        "Approximate probability that the likeliest delay, with known fluxes and uniform depths, "
        "is that of the echo. It does not bound other rules or priors.",
        -1,
    ),
    "approximated to": ("Largest error of the probability found in simulations.", 1),
    "Cramér-Rao bound m": ("Smallest standard deviation of unbiased estimates.", 1),
}
"""Help and sort order of each column: 1 or -1, lowest or highest value first."""
