"""What the part of Trade-off says that judges parts of a model."""

from __future__ import annotations

import math
from collections.abc import Collection

from core.metrics import Interval
from core.studies.ablation import NOTE, TITLES, Requirement

__all__ = ["COLUMNS", "EXPLANATION", "NOTE", "REPETITIONS_HELP", "TITLE", "row", "subject"]

TITLE = "Parts and corrections: whether the model needs them."

EXPLANATION = """
No more model than the scene requires: each part of the scene, and each correction of the
likelihood, is left out, and what that moves is held against what the pulses can tell. A button
switches one off, or on again, in all pages.
"""

REPETITIONS_HELP = "Captures of the scene with and without each part; a file is judged as it is."

COLUMNS = (
    ("Part or correction", "What the model may hold, and why it must, or need not.", 1),
    ("Verdict", "Whether the model needs it.", 1),
    ("Moves", "Total variation of the trigger probabilities, mean over the pixels.", -1),
    ("Told from", "Total variation that the pulses of one pixel tell.", -1),
    ("Pixels", "Share of the pixels in which the pulses tell it.", -1),
    ("RD", "Share of targets within 3 bins, with it less without; 95 % interval.", -1),
    ("RMSE (m)", "With it less without; 95 % interval.", 1),
    ("Time", "With it over without; 95 % interval.", -1),
)


def subject(title: str, absent: Collection[str]) -> str:
    """What is judged, and what is switched off."""
    names = ", ".join(TITLES[name] for name in TITLES if name in absent)
    return f"{title}." + (f" Switched off in all pages: {names}." if names else "")


def row(name: str, found: Requirement | None, can_switch: bool, is_off: bool) -> dict[str, object]:
    """A row of the table."""
    title = TITLES[name]
    told: dict[str, object] = {
        "key": name,
        "action": ("Switch on" if is_off else "Switch off") if can_switch else "",
        "name": f"{title[0].upper()}{title[1:]}",
        "note": "off" if is_off else "",
    }
    if found is None:
        return told | {"message": "Not judged yet: Compute."}
    worst = "" if math.isnan(found.worst) else f"worst {found.worst:.2g}"
    return told | {
        "note": f"{told['note']}; {found.why}".removeprefix("; "),
        "cells": [
            [found.verdict, found.verdict, ""],
            [_number(found.total_variation), *_sortable(found.total_variation), worst],
            [_number(found.resolvable), *_sortable(found.resolvable), ""],
            [_percent(found.told_share), *_sortable(found.told_share), ""],
            _change(found.rd_change, "+.4f"),
            _change(found.rmse_change_m, "+.3f"),
            _change(found.time_ratio, ".2f"),
        ],
    }


def _sortable(value: float) -> tuple[float | None]:
    return (None if math.isnan(value) else value,)


def _number(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.2g}"


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100 * share:.0f} %"


def _change(found: Interval, form: str) -> list[object]:
    if math.isnan(found.value):
        return ["–", None, ""]
    below = f"{format(found.low, form)} to {format(found.high, form)}"
    return [format(found.value, form), found.value, below]
