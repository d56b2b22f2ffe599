"""The command that judges which parts of the model a scene or a capture needs."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict, replace
from typing import Any

from core.acquisition import Pulse
from core.cli.options import (
    FLUX_OPTIONS,
    add_capture,
    add_flux,
    add_processes,
    flux_of,
    reading,
    require_none,
    show,
    show_progress,
    whole_from_to,
)
from core.cli.results import CheckFailed, add_results, publish
from core.estimators import ESTIMATORS
from core.io.readers import read_capture
from core.io.readers.options import add_read_options
from core.photon_budget import with_falloff
from core.scene import scenes
from core.studies.ablation import plain, power
from core.studies.ablation.criterion import Requirement
from core.studies.ablation.study import RULE, RULE_OF_CAPTURES, requirements, requirements_table
from core.studies.outputs import Item
from core.studies.timing import machine

_SEEDS = 16


def add(commands: Any) -> None:
    """Add this command to a parser."""
    command = commands.add_parser(
        "requires", help="judge which parts and corrections a scene or a capture needs"
    )
    subject = command.add_mutually_exclusive_group()
    add_capture(subject)
    subject.add_argument("--scene", choices=scenes, default="car", help="built in (car)")
    subject.add_argument(
        "--power",
        type=whole_from_to(2, 10_000),
        metavar="CAPTURES",
        help="measure how often verdicts on captures are right, with as many simulated for each "
        "size of each part",
    )
    add_flux(command)
    command.add_argument(
        "--falloff",
        action="store_true",
        default=None,
        help="also judge the 1/R² falloff of a scene's signal, relative to its median range",
    )
    command.add_argument("--method", choices=ESTIMATORS, default="likelihood", help="(likelihood)")
    command.add_argument(
        "--seeds", type=whole_from_to(2, 1000), help=f"simulated captures of a scene ({_SEEDS})"
    )
    add_processes(command)
    command.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    add_results(command, folder="")
    add_read_options(command)
    command.set_defaults(work=_requires)


def _requires(chosen: argparse.Namespace) -> None:
    if chosen.power is not None:
        _measure_power(chosen)
        return
    judge = _judge_scene if chosen.capture is None else _judge_capture
    title, rows, tables = judge(chosen)
    print(file=sys.stderr)
    if chosen.json:
        show({row.part: asdict(row) for row in rows}, as_json=True)
    items: list[Item] = [requirements_table(rows, title), *tables, machine()]
    printed = ("requirements", *(each.key for each in tables))
    rule = RULE if chosen.capture is None else RULE_OF_CAPTURES
    publish(items, chosen, title, (rule,), printed, quiet=chosen.json)


def _measure_power(chosen: argparse.Namespace) -> None:
    given = (*FLUX_OPTIONS, "falloff", "seeds", "json")
    require_none({**vars(chosen), "json": chosen.json or None}, given, "power has its own captures")
    found = list(power.outcomes(power.CASES, chosen.power, chosen.processes, show_progress))
    print(file=sys.stderr)
    publish([power.power_table(found)], chosen)
    if failed := [f"{each.case.part}: see the table." for each in found if not each.holds]:
        raise CheckFailed("\n".join(failed))


_Judged = tuple[str, tuple[Requirement, ...], list[Item]]


def _judge_scene(chosen: argparse.Namespace) -> _Judged:
    options = reading(chosen)
    n_pulses = options.pop("n_pulses")
    require_none(options, sorted(options), "a scene is not read from a file")
    scene, flux, pulse = scenes[chosen.scene](), flux_of(chosen), Pulse()
    if chosen.falloff:
        scene = with_falloff(scene)
    acquisition = replace(scene.acquisition, n_pulses=n_pulses or scene.acquisition.n_pulses)
    first, count = chosen.seed or 0, chosen.seeds or _SEEDS
    rows = requirements(
        scene,
        flux,
        acquisition=acquisition,
        pulse=pulse,
        method=chosen.method,
        seeds=range(first, first + count),
        progress=show_progress,
    )
    title = (
        f"Requirements of {chosen.scene} at SBR {flux.sbr:g}, {flux.signal:g} signal photons and "
        f"{acquisition.n_pulses} pulses, ranged by {chosen.method}"
    )
    return title, rows, [plain.table(scene, acquisition, flux, pulse)]


def _judge_capture(chosen: argparse.Namespace) -> _Judged:
    require_none(vars(chosen), (*FLUX_OPTIONS, "seeds"), "a capture has its own flux")
    require_none(vars(chosen), ("falloff",), "a capture has its own signal")
    capture = read_capture(chosen.capture, **reading(chosen))
    print(capture.source, file=sys.stderr)  # with assumptions, before anything depends on them
    rows = requirements(capture, method=chosen.method, progress=show_progress)
    return f"Requirements of {chosen.capture.name}, ranged by {chosen.method}", rows, []
