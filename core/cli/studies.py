"""Commands that repeat a study: the paper, its tables, every method beside the limit."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from core.cli.options import add_processes, show_progress, whole_from_to
from core.cli.results import add_results, show_tables
from core.io.readers import read_capture
from core.studies.methods import calibration, field, uniform
from core.studies.outputs import Table, as_markdown
from core.studies.paper import figures as paper
from core.studies.paper import recommend
from core.studies.paper.printed import TABLE_2
from core.studies.trials import Condition, Method, Results, trials
from core.tracking import PRESETS

MOST_SEEDS = recommend.SEEDS.start  # from there on they are the search's own


def add(commands: Any) -> None:
    """Add these commands to a parser's."""
    for each in (_add_paper, _add_table2, _add_uniform, _add_calibration, _add_field, _add_large):
        each(commands)
    _add_speed(commands)
    search = commands.add_parser("recommend", help="the search that found the recommended preset")
    search.set_defaults(work=_recommend)


def _add_paper(commands: Any) -> None:
    command = commands.add_parser("paper", help="every figure and table of the paper, and a page")
    command.add_argument("--repetitions", type=whole_from_to(2, MOST_SEEDS), default=MOST_SEEDS)
    command.add_argument("--folder", type=Path, default=Path("paper"), help="written to (paper)")
    command.add_argument("--field", type=Path, help="a measured capture to compare methods on")
    add_processes(command)
    add_results(command)
    command.set_defaults(work=_paper)


def _paper(chosen: argparse.Namespace) -> None:
    from core.studies.paper import page  # noqa: PLC0415 - draws, which nothing else here needs

    chosen.folder.mkdir(parents=True, exist_ok=True)
    measured = read_capture(chosen.field) if chosen.field else None
    results = trials(
        paper.plan(),
        range(chosen.repetitions),
        store=chosen.folder / "trials.jsonl",
        processes=chosen.processes,
        progress=show_progress,
    )
    print(file=sys.stderr)
    show_tables([paper.table_2(results), paper.table_3(results)], chosen)
    print("Figures ...", file=sys.stderr)
    print(page.write_page(results, chosen.folder, chosen.repetitions, measured))


def _add_table2(commands: Any) -> None:
    command = commands.add_parser("table2", help="the car under six SBRs, beside the paper's")
    command.add_argument("--seeds", type=whole_from_to(2, MOST_SEEDS), default=20)
    command.add_argument("--preset", choices=PRESETS, default="recommended")
    add_processes(command)
    add_results(command)
    command.set_defaults(work=_table2)


def _table2(chosen: argparse.Namespace) -> None:
    settings = PRESETS[chosen.preset]
    print(f"Preset {chosen.preset}, seeds 0 to {chosen.seeds - 1}: {settings}\n")
    method = Method(chosen.preset, "tracking", settings)
    results = _tried({Condition("car", sbr): [method] for sbr in TABLE_2}, chosen)
    show_tables([paper.table_2(results, (method,))], chosen)


def _add_uniform(commands: Any) -> None:
    command = commands.add_parser("uniform", help="every method on depths uniform over the gate")
    command.add_argument("--seeds", type=whole_from_to(2, MOST_SEEDS), default=24)
    add_processes(command)
    add_results(command)
    command.set_defaults(work=_uniform)


def _uniform(chosen: argparse.Namespace) -> None:
    show_tables([uniform.table(_tried(uniform.PLAN, chosen))], chosen)


def _add_calibration(commands: Any) -> None:
    command = commands.add_parser("calibration", help="is a confidence of 0.9 right 9 times in 10?")
    command.add_argument("--seeds", type=whole_from_to(1, MOST_SEEDS), default=5)
    add_results(command)
    command.set_defaults(work=_calibration)


def _calibration(chosen: argparse.Namespace) -> None:
    show_tables([calibration.table(calibration.reports(range(chosen.seeds)))], chosen)


def _add_field(commands: Any) -> None:
    command = commands.add_parser(
        "field", help="published captures with a truth: how near each method comes to it"
    )
    command.add_argument("captures", type=Path, help="the folder that holds them")
    add_results(command)
    command.set_defaults(work=_field)


def _field(chosen: argparse.Namespace) -> None:
    show_tables(field.tables(chosen.captures, lambda what: print(what, file=sys.stderr)), chosen)


def _add_large(commands: Any) -> None:
    command = commands.add_parser(
        "large", help="a generated capture of 8 GB, ranged on a small cluster with bounded memory"
    )
    command.add_argument("--folder", type=Path, default=Path("large"), help="written to (large)")
    command.add_argument("--rows", type=whole_from_to(64, 2**14), default=2048, help="(2048)")
    command.add_argument("--bins", type=whole_from_to(16, 2**14), default=1024, help="(1024)")
    command.add_argument("--chunk", type=whole_from_to(16, 2**12), default=128, help="(128)")
    command.add_argument("--workers", type=whole_from_to(1, 64), default=2, help="(2)")
    command.add_argument(
        "--memory", type=float, default=2.0, help="of all workers together, in GB (2)"
    )
    add_results(command)
    command.set_defaults(work=_large)


def _large(chosen: argparse.Namespace) -> None:
    from core.studies.performance import large  # noqa: PLC0415 - a cluster, which nothing else here needs

    path = chosen.folder / f"building_{chosen.rows}_{chosen.bins}_{chosen.chunk}.zarr"
    if not path.exists():
        chosen.folder.mkdir(parents=True, exist_ok=True)
        print(f"Simulating {path} ...", file=sys.stderr)
        large.generate(path, chosen.rows, chosen.bins, chosen.chunk)
    disk = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    counts = chosen.rows**2 * chosen.bins * 2
    print(f"{path}: {counts / 1e9:.2f} GB of counts, {disk / 1e9:.2f} GB on disk\n")
    found = []
    memory_bytes = int(chosen.memory * 1e9)
    for each in large.study(path, chosen.workers, memory_bytes, show_progress):
        found.append(each)
        print(f"\r{each.title}: {each.seconds:.1f} s" + " " * 40, file=sys.stderr)
    show_tables([large.table(found)], chosen)
    if not all(each.same for each in found):
        raise ValueError("same answer = NO is not accepted: see the table.")


def _add_speed(commands: Any) -> None:
    command = commands.add_parser(
        "speed", help="how fast tracking is: beside plain code, as captures grow, from a cold start"
    )
    command.add_argument("--folder", type=Path, default=Path("speed"), help="written to (speed)")
    command.add_argument(
        "--rounds", type=whole_from_to(6, 1000), default=21, help="of each measurement (21)"
    )
    add_results(command)
    command.set_defaults(work=_speed)


def _speed(chosen: argparse.Namespace) -> None:
    from core.studies import report  # noqa: PLC0415 - draws, as no other study does
    from core.studies.performance import speed  # noqa: PLC0415

    found = speed.study(speed.Extent(rounds=chosen.rounds), show_progress)
    page = report.write(found.items, chosen.folder, "Speed", speed.INTRODUCTION)
    print(file=sys.stderr)
    show_tables((item for item in found.items if isinstance(item, Table)), chosen)
    print(page)
    if found.regressions:
        sys.exit("\n".join(found.regressions))


def _recommend(chosen: argparse.Namespace) -> None:
    found = []
    for candidate in recommend.candidates():
        found.append(candidate)
        print(f"\r{len(found)} settings tried", end="", file=sys.stderr, flush=True)
    found.sort(key=lambda candidate: (candidate.passes, candidate.margin), reverse=True)
    rows = [(c.margin, *c.rd.values(), "yes" if c.passes else "no", c.settings) for c in found[:12]]
    reached = (f"RD at SBR {sbr:g}" for sbr in uniform.SBRS)
    print("\n\n" + as_markdown(("smallest margin", *reached, "passes Table 2", "settings"), rows))


def _tried(plan: Any, chosen: argparse.Namespace) -> Results:
    found = trials(plan, range(chosen.seeds), processes=chosen.processes, progress=show_progress)
    print(file=sys.stderr)
    return found
