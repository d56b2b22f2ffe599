"""The command that computes signal and background from laser, optics and sunlight."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

from core.cli.options import add_settings, probability, settings_given, show, whole_from_to
from core.cli.results import add_results, publish
from core.photon_budget import TARGET_RD, PhotonBudget, reaching, steps
from core.scene import scenes
from core.studies.budget import needed_table, steps_table


def add(commands: Any) -> None:
    """Add this command to a parser."""
    command = commands.add_parser(
        "budget",
        help="compute signal and background from laser, optics and sunlight",
        description="Compute the photons per pulse that a lidar detects of a scene, step by step, "
        "and the pulse energy, aperture and filter that reach a restoration degree.",
    )
    command.add_argument("--scene", choices=scenes, default="car", help="built in (car)")
    command.add_argument(
        "--pulses", type=whole_from_to(1, 2**32 - 1), help="per pixel (as the scene has)"
    )
    command.add_argument(
        "--rd",
        type=probability,
        default=TARGET_RD,
        help=f"restoration degree within 3 bins to reach ({TARGET_RD:g})",
    )
    add_settings(command, PhotonBudget, "photon budget")
    command.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    add_results(command)
    command.set_defaults(work=_budget)


def _budget(chosen: argparse.Namespace) -> None:
    budget, scene = settings_given(chosen, PhotonBudget), scenes[chosen.scene]()
    if chosen.pulses is not None:
        acquisition = replace(scene.acquisition, n_pulses=chosen.pulses)
        scene = replace(scene, acquisition=acquisition)
    needed = reaching(budget, scene, chosen.rd)
    if chosen.json:
        facts: dict[str, Any] = {step.symbol: step.value for step in steps(budget, scene)}
        facts["needed"] = {each.name: (each.low, each.high) for each in needed}
        show(facts, as_json=True)
    tables = (steps_table(budget, scene, chosen.scene), needed_table(needed, chosen.rd))
    publish(tables, chosen, quiet=chosen.json)
