"""Text of the Explore page: figures of the image, numbers of a pixel, and explanations."""

from __future__ import annotations

import math

from app.model.store import Answer, Pixel
from app.model.text import Fact, milliseconds, number, share
from app.units import scale

IMAGE_HELP = "What the image shows"

CLOUD_HELP = "What the cloud is coloured by"

EXPLANATION = """
**What is seen.** Each pixel sends pulses and keeps only the *first* photon of each. In daylight
most pulses are spent on background before the echo arrives: the histogram piles up at the front.
Two tracking differentiators follow it: the *small scale* follows the slow decay, the *large scale*
the sudden echo. Their positive difference, the *residual*, times a *weight*, has its largest value
about two bins behind the echo; that lag is known from the model and taken out.

**What moves a range.** Of l and h only (m·h)²·l counts: they are one knob. m, n, T_n, the weight,
the start and σ each move ranges. α, with the weight as printed (cubic), multiplies every bin alike
and can move nothing; with the *exponential* weight it can. Every weight is a guess of
where targets are: as printed that they are far, as recommended (exponential, α 0.15) hardly any.

**Recommended** was searched on random depths over the gate and other seeds than the reported ones;
**as printed** is the paper's text taken literally.
"""


def figure_strip(answer: Answer) -> list[Fact]:
    """Name, value and help of each figure; those that need a truth only where there is one."""
    figures = answer.run.figures
    strip = []
    if figures:
        strip = [
            (
                "RMSE",
                number(figures["rmse_m"], "m"),
                "Root mean square error over target pixels with an answer.",
            ),
            ("Within 1 bin", share(figures["rd_1_bin"]), "Share of target pixels: RD(1 bin)."),
            (
                "Within 3 bins",
                share(figures["rd_3_bins"]),
                "Share of target pixels: RD(3 bins), as the paper most plausibly means it.",
            ),
        ]
        if figures["coverage"] < 1:
            help = "Share of target pixels with an answer; the RMSE is over these."
            strip.append(("Answered", share(figures["coverage"]), help))
    made = "Simulated in" if answer.request.source.is_scene else "Read in"
    strip += [
        (made, milliseconds(answer.capture_s), "Time to make the capture and find its light."),
        ("Estimated in", milliseconds(answer.run.estimate_s), "Time to range every pixel."),
    ]
    return strip


def pixel_numbers(answer: Answer, pixel: Pixel, unit: str = "bins") -> list[Fact]:
    """Name, value and help of each number of a pixel; positions along the gate in a unit."""
    tracking, sigma = answer.request.tracking, float(pixel.signals.sigma)
    n_pulses = answer.capture.gated_pulses
    r_small = tracking.l * sigma
    row, col = answer.grid.place(pixel.row, pixel.col)
    entries = [
        ("Pixel", f"row {row}, col {col}", "Arrow keys on the image move it."),
        ("Estimate", number(pixel.range_m, "m"), "Range of the surface, lag removed."),
    ]
    if unit != "m":
        place = scale(unit, answer.capture.acquisition).place(pixel.answer_bin)
        entries.append(("Position", place, "Where the estimate stands along the gate."))
    if answer.capture.truth_range_m is not None:
        truth = "no target" if math.isnan(pixel.truth_m) else number(pixel.truth_m, "m")
        error_m = pixel.range_m - pixel.truth_m
        entries += [
            ("Truth", truth, "Where the surface is."),
            ("Error", number(error_m, "m", sign=True), "Estimate minus truth."),
        ]
    entries += [
        (
            "Confidence",
            share(pixel.confidence),
            "Probability that there is a surface within 3 bins of the estimate.",
        ),
        ("σ", number(sigma, "counts"), "Standard deviation of the histogram."),
        ("r small", number(r_small, ""), "l·σ, bound of the small scale's acceleration."),
        ("r large", number(tracking.n * r_small, ""), "n·l·σ, that of the large scale."),
        ("Detections", f"{pixel.counts:,}", "Counts in this pixel's histogram."),
    ]
    if n_pulses is not None:
        fired = share(pixel.counts / n_pulses)
        entries.append(("Pulses that fired", fired, "Share of pulses with a detection."))
    return entries


def cloud_caption(answer: Answer, n_shown: int, n_wrong: int | None) -> str:
    """A line under the cloud."""
    total = answer.capture.shape[0] * answer.capture.shape[1]
    line = f"{n_shown:,} of {total:,} answers shown"
    return line if n_wrong is None else f"{line}, {n_wrong:,} of them wrong (crosses)"
