"""Texts of the Explore page: figures of the image, numbers of a pixel, and explanations."""

from __future__ import annotations

from app.model.store import Answer, Pixel
from app.model.text import Fact, estimate_facts, milliseconds, number, share
from app.units import count, scale
from core.geometry import WHOLE, Box

IMAGE_HELP = "Quantity shown in the image"

CLOUD_HELP = "Quantity that colours the point cloud"

ECHO_FREE = "Estimates without an echo"

EXPLANATION = """
**What you see.** For each pixel, pulses are sent, and only the *first* photon after each is
recorded. In daylight, background fires most pulses before the echo arrives: the histogram piles up
at the front of the gate. Two tracking differentiators follow it: the *large scale* a sudden echo,
the *small scale* the trend. Their positive difference, the *residual*, times a *weight*, has its
maximum some three bins after the echo's onset; this lag is known from the model and subtracted.

**What misleads.** With *start* zero (the literal preset) the small scale begins far below the
histogram, and meets it only late in the gate. Until then there is a residual without any echo, and
estimates of noise gather where the two meet: an echo there is found by luck, too. *Estimates
without an echo*, below the histogram, shows where. Paper compares
[all methods](?page=Paper&reported=What+the+paper+does+not+report).

**What changes the estimate.** l and h act only through (m·h)²·l counts, so they are one parameter.
m, n, T_n, the weight, the start and σ each change estimates. With the printed weight (cubic), α
scales all bins alike and changes nothing; with the *exponential* weight it does. Every weight
assumes where targets are: the printed one that they are far, the recommended one (exponential,
α 0.15) hardly anything.

**Recommended** settings were optimized on random depths over the gate, with other seeds than the
reported ones. **Literal** takes the paper's equations as they are, with an l chosen here, since it
prints none.
"""


def figure_strip(answer: Answer) -> list[Fact]:
    """Return name, value and help of each figure; those that need the truth only if it is known."""
    figures = answer.run.figures
    strip: list[Fact] = []
    if figures:
        within_3 = "Share of target pixels within 3 bins of the truth, probably the paper's RD."
        strip = [
            (
                "RMSE",
                number(figures["rmse_m"], "m"),
                "Root mean square error over target pixels with an estimate.",
            ),
            (
                "Within 1 bin",
                share(figures["rd_1_bin"]),
                "Share of target pixels within 1 bin of the truth.",
            ),
            ("Within 3 bins", share(figures["rd_3_bins"]), within_3),
        ]
        if figures["coverage"] < 1:
            help = "Share of target pixels with an estimate; the RMSE is over these."
            strip.append(("Coverage", share(figures["coverage"]), help))
    made = "Simulated in" if answer.request.source.is_scene else "Read in"
    return [
        *strip,
        (made, milliseconds(answer.capture_s), "Time to obtain the capture and its fluxes."),
        ("Estimated in", milliseconds(answer.run.estimate_s), "Time to estimate all pixels."),
    ]


def pixel_numbers(answer: Answer, pixel: Pixel, unit: str = "bins") -> list[Fact]:
    """Return name, value and help of each number of a pixel, positions in a unit."""
    n_pulses = answer.capture.gated_pulses
    row, col = answer.grid.place(pixel.row, pixel.col)
    has_truth = answer.capture.truth_range_m is not None
    numbers = [
        *estimate_facts(pixel, scale(unit, answer.gate), has_truth),
        ("Pixel", f"row {row}, col {col}", "Arrow keys on the image move it."),
        *_accelerations(answer, pixel),
        ("Detections", count(pixel.counts), "Counts in this pixel's histogram."),
    ]
    if n_pulses is not None:
        fired = share(pixel.counts / n_pulses)
        numbers.append(("Pulses that fired", fired, "Share of pulses with a detection."))
    return numbers


def _accelerations(answer: Answer, pixel: Pixel) -> list[Fact]:
    """Return the limits of the tracking differentiator's scales; none for other methods."""
    if pixel.signals is None:
        return []
    tracking, sigma = answer.settings, float(pixel.signals.sigma)
    r_small = tracking.l * sigma
    return [
        ("σ", number(sigma, "counts"), "Standard deviation of the histogram."),
        ("r small", number(r_small, ""), "l·σ: limit of the small scale's acceleration."),
        ("r large", number(tracking.n * r_small, ""), "n·l·σ: limit for the large scale."),
    ]


def cloud_caption(
    answer: Answer,
    n_shown: int,
    n_wrong: int | None,
    box: Box = WHOLE,
    is_width_guessed: bool = False,
) -> str:
    """Return the line under the cloud."""
    image, where = answer.run.image, "" if box == WHOLE else " in the box"
    total, noun = int(image.valid.sum()), "estimates"
    if image.returns is not None:
        total, noun = len(image.returns), "returns"
    line = f"{n_shown:,} of {total:,} {noun} shown{where}"
    if n_wrong is not None:
        line += f", {n_wrong:,} of them wrong (crosses)"
    return line + ("; width is a guess" if is_width_guessed else "")
