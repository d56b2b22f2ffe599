"""What the page "Trade-off" says."""

from __future__ import annotations

from collections.abc import Sequence

from app.model.methods import METHOD_TITLES
from core.metrics import Interval
from core.studies.tradeoff import Candidate, Point, Recommendation

EXPLANATION = """
Each point is a way to range this scene, or this capture: a method, with some bins merged or not.
To the left is faster, lower is right more often; whiskers cover 95 %, dashes are what you ask for.
On the line are the ways that no other one beats: to be faster is to be wrong more often.
A tap on a point, or its button in the table, opens it.
"""

WAITING = "Compute measures every method here and now: some ten seconds for 64 × 64 pixels."

SECTIONS_HELP = (
    "What ranging costs and gives, what recording costs and gives, which parts of a model are "
    "needed, and within which range of each setting answers are to be trusted."
)

ACQUIRING = """
How many pulses, how much light, and how long a gate reach the restoration degree that is wanted:
by the limit's theory, for one who knows the light, and by simulation, for the likelihood that is
told the light and the one that estimates it. Bands cover 95 %.
"""
ACQUIRING_WAITS = "Compute simulates this scene, acquired in 25 ways: half a minute."

TITLE = "Speed against accuracy"

TIME_HELP = "What an image may take. The best that keeps to it is named above the plot."
RD_HELP = (
    "Share of the target pixels that must be within 3 bins. The fastest that reaches it is named."
)
REPETITIONS_HELP = (
    "Captures of the same scene with other noise, the same for all methods: more make the "
    "restoration degree surer."
)
REPEATS_HELP = "How often each method is timed, in turn with all others."
MERGES_HELP = "With the capture's own bins only, or with 2 and 4 merged as well."
LIGHT_HELP = (
    "The light that methods rest on is found once for each capture. Counted in, it is what an "
    "image costs that is new; left out, what a slider costs."
)

COLUMNS = (
    ("Way", "What ranges, and on how much of the capture.", 1),
    ("Within 3 bins", "Share of the target pixels, with its 95 % interval.", -1),
    ("Within 1 bin", "Share of the target pixels, with its 95 % interval.", -1),
    ("RMSE (m)", "Root mean square error, with its 95 % interval.", 1),
    ("ms", "For an image: the median of the rounds, with its 95 % interval.", 1),
    ("Light (ms)", "To find the light, once for each capture.", 1),
    ("ns", "For each pixel and bin of the whole image.", 1),
    ("Memory (MB)", "Most that arrays held at once, beyond the capture.", 1),
)


def name_of(candidate: Candidate) -> str:
    """A way to range, as one reads it."""
    title = METHOD_TITLES[candidate.method.estimator]
    reduction = str(candidate.reduction)
    return title if reduction == "whole" else f"{title}, {reduction}"


def rows(points: Sequence[Point], unbeaten: Sequence[Point]) -> list[dict[str, object]]:
    """The table's rows: first what no other way beats, the fastest first."""
    others = [point for point in points if point not in unbeaten]
    ordered = [*unbeaten, *sorted(others, key=lambda point: -point.rd().value)]
    return [_row(point, points.index(point), point in unbeaten) for point in ordered]


def _row(point: Point, key: int, is_unbeaten: bool) -> dict[str, object]:
    told = point.candidate.is_told_the_light
    note = "on the line" if is_unbeaten else "is told the light: a bound, no choice" if told else ""
    return {
        "key": key,
        "action": "Open",
        "name": name_of(point.candidate),
        "note": note,
        "cells": [
            _share(point.rd(3)),
            _share(point.rd(1)),
            _cell(point.rmse_m, "{:.3g}"),
            _cell(point.milliseconds, "{:.3g}"),
            [f"{point.light_ms.value:.3g}", point.light_ms.value, ""],
            [f"{point.ns_per_pixel_bin:.3g}", point.ns_per_pixel_bin, ""],
            [f"{point.peak_bytes / 1e6:.3g}", point.peak_bytes, ""],
        ],
    }


def _share(found: Interval) -> list[object]:
    percent = Interval(100 * found.value, 100 * found.low, 100 * found.high)
    return _cell(percent, "{:.2f} %")


def _cell(found: Interval, form: str) -> list[object]:
    number = form.removesuffix(" %")
    below = f"{number.format(found.low)} to {number.format(found.high)}"
    return [form.format(found.value), found.value, below]


def told(point: Point) -> str:
    """What a point's tip says below its name."""
    ms, rd = point.milliseconds, point.rd()
    return (
        f"{ms.value:.3g} ms ({ms.low:.3g} to {ms.high:.3g}), {100 * rd.value:.2f} % within 3 bins "
        f"({100 * rd.low:.2f} to {100 * rd.high:.2f})"
    )


def subject(point: Point, is_present: bool) -> str:
    """What was measured, and whether that is what the other pages show."""
    rows, cols, bins = point.shape
    light = "" if point.sbr is None else f", SBR {point.sbr:.3g}"
    pulses = "" if point.n_pulses is None else f", {point.n_pulses:,} pulses"
    note = f" ({point.note})" if point.note else ""
    outdated = "" if is_present else " The other pages show another capture by now: compute again."
    return f"{point.source}{note}, {rows} × {cols} × {bins}{light}{pulses}.{outdated}"


def advice(
    milliseconds: float, rd: float, best: Recommendation | None, cheapest: Recommendation | None
) -> tuple[str, str]:
    """The answers to both questions."""
    within, reaching = (
        f"Best within {milliseconds:.3g} ms",
        f"Cheapest that reaches {100 * rd:.3g} %",
    )
    return (
        _recommended(within, best, "keeps to the time"),
        _recommended(reaching, cheapest, "reaches it"),
    )


def _recommended(asked: str, found: Recommendation | None, keeps: str) -> str:
    """What to choose, and how sure that is."""
    if found is None:
        return f"{asked}: none of these ways."
    point = found.point
    rd, ms = point.rd(), point.milliseconds
    sentence = (
        f"{asked}: {name_of(point.candidate)}, right within 3 bins for {100 * rd.value:.1f} % in "
        f"{ms.value:.3g} ms. With captures and times drawn anew it is chosen again in "
        f"{100 * found.is_best:.0f} % of draws, and {keeps} in {100 * found.keeps:.0f} %."
    )
    if found.runners_up:
        names = "; ".join(
            f"{name_of(other.candidate)} ({100 * share:.0f} %)" for other, share in found.runners_up
        )
        sentence += f" Not told apart from it: {names}."
    return sentence
