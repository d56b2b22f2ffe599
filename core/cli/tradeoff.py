"""The command that measures speed against accuracy and recommends configurations."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from core.acquisition import Flux
from core.capture import Capture
from core.checks import require
from core.cli.options import (
    add_capture,
    add_processes,
    reading,
    require_none,
    show_progress,
    whole_from_to,
)
from core.cli.results import add_results, publish
from core.io.readers import read_capture
from core.io.readers.options import add_read_options
from core.scene import scenes
from core.studies.statistics import MIN_REPEATS
from core.studies.tradeoff import page
from core.studies.tradeoff import plan as plans
from core.studies.tradeoff.measure import candidates, studied, study, variations
from core.studies.tradeoff.pareto import including_flux_time
from core.studies.tradeoff.surrogate import Simulation, surrogate_of, window

SCENES, SBRS = ("car", "uniform"), (0.04, 0.06, 0.2)
SHORT_SCENES, SHORT_SBRS = ("car",), (0.06,)
NOT_VARIED = (
    "Pulses, exposure and gate are varied for first photons of a known number of pulses only."
)
PRINTED = ("recommendations", "fronts", "required_pulses")


def add(commands: Any) -> None:
    """Add this command to a parser."""
    command = commands.add_parser(
        "tradeoff", help="measure speed against accuracy of every method; recommend configurations"
    )
    subject = command.add_mutually_exclusive_group()
    add_capture(subject)
    subject.add_argument(
        "--scene", nargs="+", choices=scenes, help=f"to simulate ({' '.join(SCENES)})"
    )
    sbrs = " ".join(map(str, SBRS))
    command.add_argument("--sbr", type=float, nargs="+", help=f"signal over background ({sbrs})")
    command.add_argument("--ppp", type=float, help=f"signal photons per pulse ({Flux().signal})")
    command.add_argument(
        "--within",
        type=float,
        nargs="+",
        default=page.TIMES_MS,
        metavar="MS",
        help="recommend the most accurate within these milliseconds per image",
    )
    command.add_argument(
        "--reach",
        type=float,
        nargs="+",
        default=page.DEGREES,
        metavar="RD",
        help="recommend the fastest with these restoration degrees",
    )
    command.add_argument(
        "--tolerance", type=int, choices=(1, 2, 3), default=3, help="of the RD, in bins (3)"
    )
    command.add_argument(
        "--with-light",
        "--with-flux",
        dest="with_flux",
        action="store_true",
        help="include the time to estimate the flux model, as for new images",
    )
    command.add_argument("--seeds", type=whole_from_to(2, 1000), help="(8; 3 with --short)")
    command.add_argument(
        "--repeats", type=whole_from_to(MIN_REPEATS, 1000), help="rounds of timing (9; 6)"
    )
    command.add_argument("--short", action="store_true", help="one scene, one SBR: a minute")
    add_processes(command)
    add_results(command, folder="tradeoff")
    add_read_options(command)
    command.set_defaults(work=_tradeoff)


def _tradeoff(chosen: argparse.Namespace) -> None:
    for milliseconds in chosen.within:
        require("within", milliseconds, milliseconds > 0, "milliseconds above 0")
    for rd in chosen.reach:
        require("reach", rd, 0 < rd <= 1, "a share of the targets, above 0 and up to 1")
    chosen.folder.mkdir(parents=True, exist_ok=True)  # fail before the work
    plan, simulations = _of_capture(chosen) if chosen.capture else _of_scenes(chosen)
    seeds = range(chosen.seeds or (3 if chosen.short else 8))
    points = study(
        plan,
        seeds=seeds,
        repeats=chosen.repeats or (MIN_REPEATS if chosen.short else 9),
        processes=chosen.processes,
        progress=_bar("images ranged"),
    )
    sweeps = page.acquisition_sweeps(
        simulations, seeds[: max(2, len(seeds) // 2)], chosen.processes, _bar("captures ranged")
    )
    introduction = [
        f"{len(points)} configurations and conditions, {len(seeds)} seeds shared by all.",
        *dict.fromkeys(f"{each.source}: {each.note}." for each in points if each.note),
    ]
    if not simulations:
        introduction.append(NOT_VARIED)
    if chosen.with_flux:
        points = including_flux_time(points)
        introduction.append("Times include the estimation of the flux model.")
    items = page.items(points, sweeps, chosen.within, chosen.reach, chosen.tolerance)
    page.write_settings(points, chosen.folder)
    publish(items, chosen, "Speed against accuracy", introduction, PRINTED)


def _of_scenes(chosen: argparse.Namespace) -> tuple[plans.Plan, list[Simulation]]:
    """Return what is measured on built-in scenes, and the simulations whose acquisition varies."""
    options = reading(chosen)
    options.pop("n_pulses")
    require_none(options, sorted(options), "it is an option for reading a --capture")
    signal = Flux().signal if chosen.ppp is None else chosen.ppp
    names = chosen.scene or (SHORT_SCENES if chosen.short else SCENES)
    sbrs = chosen.sbr or (SHORT_SBRS if chosen.short else SBRS)
    simulations = [
        plans.simulated(name, sbr, signal, chosen.n_pulses) for name in names for sbr in sbrs
    ]
    plan: plans.Plan = []
    for each in simulations:
        plan += (
            [(each, plans.all_candidates(each))] if chosen.short else plans.plan_over_pulses(each)
        )
    if not chosen.short:
        plan += plans.threaded(sbrs[-1], signal)
    return plan, simulations


def _of_capture(chosen: argparse.Namespace) -> tuple[plans.Plan, list[Simulation]]:
    """Return what is measured on a file, and its surrogate."""
    require_none(vars(chosen), ("sbr", "ppp"), "a capture has its own flux")
    capture = read_capture(chosen.capture, **reading(chosen))
    print(capture.source, file=sys.stderr)  # with assumptions, before anything depends on them
    source = studied(replace(capture, source=chosen.capture.name))
    if isinstance(source, Capture):
        targets = window(np.asarray(source.truth_range_m), source.pulse, source.acquisition)
        simulation = surrogate_of(source, source.source)
    else:
        targets, simulation = source.window, source
    plan: plans.Plan = [(source, candidates() + variations(targets))]
    return plan, [simulation] if simulation.holds_first_photons else []


def _bar(what: str) -> Callable[[int, int], None]:
    def progress(done: int, of: int) -> None:
        show_progress(done, of, what)
        if done == of:
            print(file=sys.stderr)

    return progress
