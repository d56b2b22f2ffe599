"""The command that measures speed against accuracy, and answers what to choose."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from core.acquisition import Flux
from core.capture import Capture
from core.checks import require
from core.cli.options import (
    add_processes,
    add_reading,
    reading,
    require_none,
    show_progress,
    whole_from_to,
)
from core.cli.results import add_results, show_tables
from core.io.readers import read_capture
from core.scene import scenes
from core.studies.outputs import Table
from core.studies.timing import FEWEST_REPEATS
from core.studies.tradeoff import page
from core.studies.tradeoff import plan as plans
from core.studies.tradeoff.measure import candidates, studied, study, variations
from core.studies.tradeoff.pareto import with_light
from core.studies.tradeoff.surrogate import Simulation, like, window

SCENES, SBRS = ("car", "uniform"), (0.04, 0.06, 0.2)
SHORT_SCENES, SHORT_SBRS = ("car",), (0.06,)
SAID = ("answers", "fronts", "needed")
"""Tables that are printed, too."""


def add(commands: Any) -> None:
    """Add this command to a parser's."""
    command = commands.add_parser(
        "tradeoff", help="what accuracy costs: every method measured, and which to choose"
    )
    seen = command.add_mutually_exclusive_group()
    seen.add_argument("--capture", type=Path, help="a file that `info` can read")
    seen.add_argument(
        "--scene", nargs="+", choices=scenes, help=f"to simulate ({' '.join(SCENES)})"
    )
    told = " ".join(map(str, SBRS))
    command.add_argument("--sbr", type=float, nargs="+", help=f"signal over background ({told})")
    command.add_argument("--ppp", type=float, help=f"signal photons per pulse ({Flux().signal})")
    command.add_argument(
        "--within",
        type=float,
        nargs="+",
        default=page.WITHIN_MS,
        metavar="MS",
        help="asks for the best accuracy within these milliseconds an image",
    )
    command.add_argument(
        "--reach",
        type=float,
        nargs="+",
        default=page.REACHED,
        metavar="RD",
        help="asks for the cheapest that restores this share of the targets",
    )
    command.add_argument(
        "--tolerance", type=int, choices=(1, 2, 3), default=3, help="bins within which it does (3)"
    )
    command.add_argument(
        "--with-light",
        action="store_true",
        help="count the finding of the light in: each image is a new one",
    )
    command.add_argument("--seeds", type=whole_from_to(2, 1000), help="(8; 3 with --short)")
    command.add_argument("--repeats", type=whole_from_to(FEWEST_REPEATS, 1000), help="of timing")
    command.add_argument("--short", action="store_true", help="one scene, one SBR: a minute")
    command.add_argument(
        "--folder", type=Path, default=Path("tradeoff"), help="written to (tradeoff)"
    )
    add_processes(command)
    add_results(command)
    add_reading(command)
    command.set_defaults(work=_tradeoff)


def _tradeoff(chosen: argparse.Namespace) -> None:
    from core.studies import report  # noqa: PLC0415 - draws, which nothing else here needs

    for milliseconds in chosen.within:
        require("within", milliseconds, milliseconds > 0, "milliseconds above 0")
    for rd in chosen.reach:
        require("reach", rd, 0 < rd <= 1, "a share of the targets, above 0 and up to 1")
    chosen.folder.mkdir(parents=True, exist_ok=True)  # before the work, not behind it
    plan, simulations = _of_capture(chosen) if chosen.capture else _of_scenes(chosen)
    seeds = range(chosen.seeds or (3 if chosen.short else 8))
    points = study(
        plan,
        seeds=seeds,
        repeats=chosen.repeats or (FEWEST_REPEATS if chosen.short else 9),
        processes=chosen.processes,
        progress=_on_bar("images ranged"),
    )
    found = page.acquired(
        simulations, seeds[: max(2, len(seeds) // 2)], chosen.processes, _on_bar("captures ranged")
    )
    if chosen.with_light:
        points = with_light(points)
    items = page.items(points, found, chosen.within, chosen.reach, chosen.tolerance)
    show_tables((each for each in items if isinstance(each, Table) and each.key in SAID), chosen)
    introduction = [
        f"{len(points)} ways and conditions, {len(seeds)} seeds, the same for all ways.",
        *dict.fromkeys(f"{each.source}: {each.note}." for each in points if each.note),
    ]
    if chosen.with_light:
        introduction.append("Times include finding the light: each image is a new one.")
    page.write_settings(points, chosen.folder)
    print(report.write(items, chosen.folder, "Speed against accuracy", introduction))


def _of_scenes(chosen: argparse.Namespace) -> tuple[plans.Plan, list[Simulation]]:
    """What is studied of built-in scenes, and what is acquired of them."""
    told = reading(chosen)
    told.pop("n_pulses")
    require_none(told, sorted(told), "it tells how to read a --capture")
    signal = Flux().signal if chosen.ppp is None else chosen.ppp
    names = chosen.scene or (SHORT_SCENES if chosen.short else SCENES)
    sbrs = chosen.sbr or (SHORT_SBRS if chosen.short else SBRS)
    simulations = [
        plans.simulated(name, sbr, signal, chosen.n_pulses) for name in names for sbr in sbrs
    ]
    plan: plans.Plan = []
    for each in simulations:
        plan += [(each, plans.around(each))] if chosen.short else plans.over_pulses(each)
    if not chosen.short:
        plan += plans.threaded(sbrs[-1], signal)
    return plan, simulations


def _of_capture(chosen: argparse.Namespace) -> tuple[plans.Plan, list[Simulation]]:
    """What is studied of a file, and what is acquired of a simulation like it."""
    require_none(vars(chosen), ("sbr", "ppp"), "a capture has its own light")
    capture = read_capture(chosen.capture, **reading(chosen))
    print(capture.source, file=sys.stderr)  # with the guesses, before anything rests on them
    source = studied(replace(capture, source=chosen.capture.name))
    if isinstance(source, Capture):
        truth_m = np.asarray(source.truth_range_m)
        around = window(truth_m, source.pulse, source.acquisition)
        simulation = like(source, source.source)
    else:
        around, simulation = source.window, source
    plan: plans.Plan = [(source, candidates() + variations(window=around))]
    return plan, [simulation] if capture.gated_pulses else []


def _on_bar(what: str) -> Callable[[int, int], None]:
    def told(done: int, of: int) -> None:
        show_progress(done, of, what)
        if done == of:
            print(file=sys.stderr)

    return told
