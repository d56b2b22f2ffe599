"""Texts of the ablation study."""

from __future__ import annotations

import math
from collections.abc import Collection

from app.model.text import Cell, cell, interval_cell, percent_cell
from app.pages.tradeoff.text import OUTDATED
from core.studies.ablation import COMPARISON_NOTE, KINDS_NOTE, TITLES, Requirement

__all__ = ["COLUMNS", "EXPLANATION", "NOTE", "TITLE", "row", "subject"]

TITLE = "Parts, corrections and extensions: whether they are needed."

EXPLANATION = """
Each part of the scene and each correction of the likelihood is left out in turn, and the change is
compared with what the pulses can resolve. A capture is tested for them on all its pixels together:
"not needed" means that an effect large enough to matter would have been seen. A button switches a
part off, or on again, on all pages.

The likelihood is also compared with its extensions: the evidence of neighbouring pixels (the image
posterior), the search for a second return of each pixel, and the search for a velocity. These are
choices of the estimator; a second surface and motion are parts of the scene.
"""

NOTE = f"{KINDS_NOTE} {COMPARISON_NOTE}"

COLUMNS = (
    ("Part, correction or extension", "What is judged, and why it is needed or not.", 1),
    ("Verdict", "Whether the model needs it.", 1),
    (
        "Change",
        "Total variation of the trigger probabilities, mean over the pixels; of a capture, the "
        "effect that the reason states.",
        -1,
    ),
    (
        "Resolvable",
        "Smallest total variation that the pulses of one pixel resolve; of a capture, the effect "
        "that would have been seen with a probability of 80 %.",
        -1,
    ),
    ("Pixels", "Share of pixels whose pulses resolve the change.", -1),
    ("RD", "Share of targets within 3 bins: with minus without; 95 % interval.", -1),
    ("RMSE (m)", "With minus without; 95 % interval.", 1),
    ("Time ratio", "With divided by without; 95 % interval.", -1),
)


def subject(
    title: str, sbr: float | None, repetitions: int, absent: Collection[str], is_present: bool
) -> str:
    """Return what is studied, how often if it was simulated, and what is switched off.

    The SBR is that of a scene. Unless it is present, the sentence says how to study the scene or
    capture on screen.
    """
    names = ", ".join(TITLES[name] for name in TITLES if name in absent)
    light = "" if sbr is None else f", SBR {sbr:.3g}"
    often = f", {repetitions} repetitions" if repetitions else ""
    switched = f"Switched off on all pages: {names}." if names else ""
    outdated = "" if is_present else OUTDATED
    return " ".join(filter(None, (f"{title}{light}{often}.", outdated, switched)))


def row(name: str, found: Requirement | None, can_switch: bool, is_off: bool) -> dict[str, object]:
    """Return a row of the table."""
    title = TITLES[name]
    made: dict[str, object] = {
        "key": name,
        "action": ("Switch on" if is_off else "Switch off") if can_switch else "",
        "name": f"{title[0].upper()}{title[1:]}",
        "note": "off" if is_off else "",
    }
    if found is None:
        return made | {"message": "Not studied yet."}
    return made | {
        "note": f"{made['note']}; {found.why}".removeprefix("; "),
        "cells": [
            (found.verdict, found.verdict, ""),
            *_sizes(found),
            percent_cell(found.detectable_share),
            interval_cell(found.rd_change, "{:+.4f}"),
            interval_cell(found.rmse_change_m, "{:+.3f}"),
            interval_cell(found.time_ratio, "{:.2f}"),
        ],
    }


def _sizes(found: Requirement) -> tuple[Cell, Cell]:
    """Return the cells of the change and of the smallest one that is seen."""
    if math.isfinite(found.p_value):
        none = math.isinf(found.smallest_effect)
        smallest = math.nan if none else found.smallest_effect
        return percent_cell(found.effect), percent_cell(smallest)
    worst = "" if math.isnan(found.worst) else f"at most {found.worst:.2g}"
    return cell(found.total_variation, "{:.2g}", worst), cell(found.resolvable, "{:.2g}")
