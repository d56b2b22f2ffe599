"""The command that says how much model a scene or a capture requires."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from core.acquisition import Pulse
from core.cli.options import (
    LIGHT_NAMES,
    add_light,
    add_reading,
    flux,
    reading,
    require_none,
    show,
    show_progress,
    whole_from_to,
)
from core.cli.results import add_results, show_tables
from core.estimators import ESTIMATORS
from core.io.readers import read_capture
from core.scene import scenes
from core.studies.ablation import plain
from core.studies.ablation import study as requires
from core.studies.ablation.criterion import Requirement
from core.studies.outputs import Table
from core.studies.timing import machine

_SEEDS = 16


def add(commands: Any) -> None:
    """Add this command to a parser's."""
    command = commands.add_parser(
        "requires", help="which parts and corrections a scene or a capture needs, and which not"
    )
    seen = command.add_mutually_exclusive_group()
    seen.add_argument("--capture", type=Path, help="a file that `info` can read")
    seen.add_argument("--scene", choices=scenes, default="car", help="built in (car)")
    add_light(command)
    command.add_argument("--method", choices=ESTIMATORS, default="likelihood", help="(likelihood)")
    command.add_argument(
        "--seeds", type=whole_from_to(2, 1000), help=f"captures of a scene ({_SEEDS})"
    )
    command.add_argument("--folder", type=Path, help="for a page and its tables")
    command.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    add_results(command)
    add_reading(command)
    command.set_defaults(work=_requires)


def _requires(chosen: argparse.Namespace) -> None:
    title, rows, others = _of_scene(chosen) if chosen.capture is None else _of_capture(chosen)
    print(file=sys.stderr)
    tables = [requires.table(rows, title), *others]
    if chosen.json:
        show({row.part: asdict(row) for row in rows}, as_json=True)
    else:
        show_tables(tables, chosen)
    if chosen.folder is not None:
        from core.studies.report import write  # noqa: PLC0415 - draws, as nothing else here

        page = write([*tables, machine()], chosen.folder, title, (requires.RULE,))
        print(page, file=sys.stderr)


def _of_scene(chosen: argparse.Namespace) -> tuple[str, Sequence[Requirement], list[Table]]:
    told = reading(chosen)
    n_pulses = told.pop("n_pulses")
    require_none(told, sorted(told), "a scene is not read from a file")
    scene, light, pulse = scenes[chosen.scene](), flux(chosen), Pulse()
    acquisition = replace(scene.acquisition, n_pulses=n_pulses or scene.acquisition.n_pulses)
    first, count = chosen.seed or 0, chosen.seeds or _SEEDS
    rows = requires.requirements(
        scene,
        light,
        acquisition=acquisition,
        pulse=pulse,
        method=chosen.method,
        seeds=range(first, first + count),
        progress=show_progress,
    )
    title = (
        f"What {chosen.scene} requires at SBR {light.sbr:g}, {light.signal:g} signal photons and "
        f"{acquisition.n_pulses} pulses, ranged by {chosen.method}"
    )
    return title, rows, [plain.table(scene, acquisition, light, pulse)]


def _of_capture(chosen: argparse.Namespace) -> tuple[str, Sequence[Requirement], list[Table]]:
    require_none(vars(chosen), (*LIGHT_NAMES, "seeds"), "a capture is lit and drawn already")
    capture = read_capture(chosen.capture, **reading(chosen))
    print(capture.source, file=sys.stderr)  # with the guesses, before anything rests on them
    rows = requires.requirements(capture, method=chosen.method, progress=show_progress)
    return f"What {chosen.capture.name} requires, ranged by {chosen.method}", rows, []
