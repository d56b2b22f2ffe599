"""Texts of the Trade-off page: explanations, help, sentences and table rows."""

from __future__ import annotations

from collections.abc import Sequence

from app.model.methods import METHOD_TITLES
from app.model.text import cell, interval_cell
from core.metrics import Interval
from core.parameters import Number
from core.studies.tradeoff import Candidate, Point, Recommendation

SECTIONS_HELP = (
    "Speed and accuracy: computing time and accuracy of each method. Acquisition: pulses, flux and "
    "gate that a restoration degree requires. Ablation: parts of the model that the data require. "
    "Sensitivity: accuracy as a function of each setting."
)

# Speed and accuracy

EXPLANATION = """
Each point is a configuration for this scene or capture: a method, with or without merged bins.
Further left is faster, further down is more accurate. Whiskers: 95 % intervals. Dashed: the goal.
The line joins the Pareto front, the configurations that no other one beats in both.
Tap a point, or press its button in the table, to open it.
"""

NOT_MEASURED = (
    "All methods are measured on this server, which takes some seconds. In the sidebar, Cancel "
    "stops it and Compute starts it again."
)

TITLE = "Speed and accuracy"

TIME_HELP = "Time limit for an image. The most accurate configuration within it is named above."
RD_HELP = (
    "Required share of target pixels within 3 bins of the truth. The fastest configuration that "
    "reaches it is named above."
)
REPEATS_HELP = "How often each method is timed, alternating with the others."
MERGES_HELP = "Use the capture's own bins only, or also merge 2 and 4 of them."
FLUX_HELP = (
    "The fluxes are estimated once per capture. Included: time for a new image. Excluded: time "
    "after a change of a setting."
)

OUTDATED = "The capture has changed since: press Compute to repeat it."

COLUMNS = (
    ("Configuration", "Method, and how much of the capture it uses.", 1),
    ("Within 3 bins", "Share of the target pixels, with its 95 % interval.", -1),
    ("Within 1 bin", "Share of the target pixels, with its 95 % interval.", -1),
    ("RMSE (m)", "Root mean square error, with its 95 % interval.", 1),
    ("Time (ms)", "Per image: median of the rounds, with its 95 % interval.", 1),
    ("Flux (ms)", "Time to estimate the fluxes, once per capture.", 1),
    ("Per bin (ns)", "Time per pixel and bin of the whole image.", 1),
    ("Memory (MB)", "Largest size of all arrays at once, without the capture.", 1),
)


def name_of(candidate: Candidate) -> str:
    """Return the name of a configuration."""
    title = METHOD_TITLES[candidate.method.estimator]
    returns = "" if candidate.returns == 1 else f"{candidate.returns} returns"
    reduction = str(candidate.reduction).removeprefix("whole")
    return ", ".join(filter(None, (title, returns, reduction)))


def rows(points: Sequence[Point], pareto: Sequence[Point]) -> list[dict[str, object]]:
    """Return the table's rows: first the Pareto front, fastest first."""
    others = [point for point in points if point not in pareto]
    ordered = [*pareto, *sorted(others, key=lambda point: -point.rd().value)]
    return [_row(point, points.index(point), point in pareto) for point in ordered]


def _row(point: Point, key: int, is_pareto: bool) -> dict[str, object]:
    note = "Pareto front" if is_pareto else _knowledge(point.candidate)
    return {
        "key": key,
        "action": "Open",
        "name": name_of(point.candidate),
        "note": note,
        "cells": [
            interval_cell(_percent(point.rd(3)), "{:.2f} %"),
            interval_cell(_percent(point.rd(1)), "{:.2f} %"),
            interval_cell(point.rmse_m, "{:.3g}"),
            interval_cell(point.milliseconds, "{:.3g}"),
            cell(point.flux_ms.value, "{:.3g}"),
            cell(point.ns_per_pixel_bin, "{:.3g}"),
            cell(point.peak_bytes / 1e6, "{:.3g}"),
        ],
    }


def _knowledge(candidate: Candidate) -> str:
    """Return what a configuration knows that no instrument knows; empty if nothing."""
    if candidate.knows_truth:
        return "knows the true ranges: reference only"
    return "knows the true fluxes: reference only" if candidate.knows_flux else ""


def _percent(found: Interval) -> Interval:
    return Interval(100 * found.value, 100 * found.low, 100 * found.high)


def tip(point: Point) -> str:
    """Return the second line of a point's tip."""
    ms, rd = point.milliseconds, point.rd()
    return (
        f"{ms.value:.3g} ms ({ms.low:.3g} to {ms.high:.3g}), {100 * rd.value:.2f} % within 3 bins "
        f"({100 * rd.low:.2f} to {100 * rd.high:.2f})"
    )


def subject(point: Point, repetitions: int, rounds: int, is_present: bool) -> str:
    """Return what was measured, how often, and whether the other pages still show it."""
    rows, cols, bins = point.shape
    sbr = "" if point.sbr is None else f", SBR {point.sbr:.3g}"
    pulses = "" if point.n_pulses is None else f", {point.n_pulses:,} pulses"
    note = f" ({point.note})" if point.note else ""
    outdated = "" if is_present else f" {OUTDATED}"
    often = f"{repetitions} repetitions, {rounds} timing rounds"
    return f"{point.source}{note}, {rows} × {cols} × {bins}{sbr}{pulses}; {often}.{outdated}"


def advice(
    milliseconds: float, rd: float, best: Recommendation | None, cheapest: Recommendation | None
) -> tuple[str, str]:
    """Return the most accurate configuration in time, and the fastest accurate one."""
    return (
        _recommended(f"Most accurate within {milliseconds:.3g} ms", best, "is fast enough"),
        _recommended(f"Fastest with {100 * rd:.3g} % within 3 bins", cheapest, "reaches the goal"),
    )


def _recommended(goal: str, found: Recommendation | None, keeps: str) -> str:
    if found is None:
        return f"{goal}: no configuration."
    point = found.point
    rd, ms = point.rd(), point.milliseconds
    sentence = (
        f"{goal}: {name_of(point.candidate)}, {100 * rd.value:.1f} % within 3 bins in "
        f"{ms.value:.3g} ms. In bootstrap samples of captures and times, it is selected again in "
        f"{100 * found.is_best:.0f} % and {keeps} in {100 * found.keeps:.0f} %."
    )
    if found.runners_up:
        names = "; ".join(
            f"{name_of(other.candidate)} ({100 * share:.0f} %)" for other, share in found.runners_up
        )
        sentence += f" Selected instead: {names}."
    return sentence


# Acquisition

ACQUISITION = """
Number of pulses, flux and length of the gate that reach a restoration degree: from theory, for
the likeliest delay with known fluxes; and from simulation, for the likelihood with known and with
estimated fluxes. Fluxes are known where pixels see one echo over uniform background. Below each
plot: the error of the theory, and what it assumes.
"""
NOT_SIMULATED = (
    "25 acquisitions of this scene are simulated, which takes up to half a minute. The sidebar "
    "shows the progress; Cancel stops it, Compute starts it again."
)
FAILED = "The study could not be completed. Press Compute to run it again."
FIRST_PHOTONS_ONLY = (
    "This study varies pulses and flux of first-photon data. This capture holds all photons, or "
    "its number of pulses is not known: choose a scene or another capture."
)


def simulated(name: str, repetitions: int, note: str) -> str:
    """Return what was simulated, and how often."""
    about = f" ({note})" if note else ""
    return f"{name}{about}: {repetitions} repetitions of each acquisition."


# Sensitivity

SENSITIVITY = """
Each setting of a method is swept with all others at their defaults, for depths uniform over the
gate, at the lowest SBR at which the method finds nine of ten pixels. A value is safe where it loses
at most a tenth of the pixels against the best value. Vertical lines mark the zones that sliders
show as doubtful.
"""
METHOD_HELP = "Method whose settings are swept; methods without numeric settings are not listed."
SENSITIVITY_TABLE = "Ranges in which settings are safe, degrade and fail"


def not_swept(spec: Number) -> str:
    """Return the placeholder of a plot."""
    return f"{spec.symbol} has not been swept yet."
