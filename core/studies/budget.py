"""Tables of a photon budget: its steps, and what reaches a restoration degree."""

from __future__ import annotations

from collections.abc import Sequence

from core.photon_budget import PhotonBudget, Reach, flux_extents, steps
from core.scene import Scene
from core.studies.outputs import Table, table

__all__ = ["NEEDED_NOTE", "background_note", "needed_table", "steps_table"]

NEEDED_NOTE = (
    "One setting at a time, the others unchanged. RD within 3 bins of the likelihood with known "
    "fluxes, as the single-pixel limit predicts it for pixels of the scene with their own signal."
)


def steps_table(budget: PhotonBudget, scene: Scene, name: str) -> Table:
    """Return one row per step of the photon budget of a scene that `name` names."""
    (low, high), background = flux_extents(budget, scene)
    return table(
        "budget",
        f"Photon budget of {name}",
        steps(budget, scene),
        {
            "step": lambda step: step.name,
            "symbol": lambda step: step.symbol,
            "equation": lambda step: step.equation,
            "value": lambda step: step.value,
            "unit": lambda step: step.unit,
        },
        "What is given is a setting; h and c are Planck's constant and the speed of light. Signal "
        "and background are those of a surface at the range R with the reflectivity ρ. Nearer "
        f"and brighter pixels get more signal: {low:.3g} to {high:.3g} per pulse. "
        f"{background_note(*background)}",
        {"value": ".4g"},
    )


def background_note(low: float, high: float) -> str:
    """Return a sentence on the background of the pixels, from its extent per pulse."""
    least, most = f"{low:.3g}", f"{high:.3g}"
    if least == most:
        return f"The background is {least} in all pixels."
    return f"The background is {least} to {most}: bright surfaces reflect more sunlight."


def needed_table(found: Sequence[Reach], target_rd: float) -> Table:
    """Return one row per setting, with the values that reach a restoration degree."""
    return table(
        "needed",
        f"What reaches a restoration degree of {target_rd:g}",
        found,
        {
            "setting": lambda reach: reach.spec.symbol,
            "now": lambda reach: reach.now,
            "from": lambda reach: reach.low,
            "to": lambda reach: reach.high,
            "unit": lambda reach: reach.spec.unit,
            "largest RD": lambda reach: reach.best_rd,
            "with": lambda reach: reach.best,
        },
        f"{NEEDED_NOTE} Values between the ends of the slider; a dash: none of them suffices.",
        dict.fromkeys(("now", "from", "to", "with"), ".3g"),
    )
