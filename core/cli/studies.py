"""Commands that repeat a study."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from core.cli.options import add_processes, show_progress, whole_from_to
from core.cli.results import CheckFailed, add_results, publish
from core.io.readers import read_capture
from core.studies.methods import (
    alarms,
    calibration,
    field,
    fit,
    judged,
    motion,
    neighbours,
    returns,
    tuned,
    tuning,
    uniform,
)
from core.studies.outputs import Table, as_markdown
from core.studies.paper import figures as paper
from core.studies.paper import page, recommend
from core.studies.paper.printed import TABLE_2
from core.studies.trials import Condition, Method, Results, trials
from core.tracking import PRESETS

_CALIBRATED = "confidence", "judged", "ranges", "fluxes", "alarms"
MAX_SEEDS = recommend.SEEDS.start  # from there on they are the search's


def add(commands: Any) -> None:
    """Add these commands to a parser."""
    command = _added(
        commands, "paper", "compute every figure and table of the paper", _paper, folder="paper"
    )
    _add_count(command, "--repetitions", 2, MAX_SEEDS, MAX_SEEDS)
    command.add_argument("--field", type=Path, help="a measured capture to compare methods on")
    add_processes(command)

    command = _added(commands, "table2", "compare the car at six SBRs with Table 2", _table2)
    _add_count(command, "--seeds", 2, MAX_SEEDS, 20)
    command.add_argument("--preset", choices=PRESETS, default="recommended", help="(recommended)")
    add_processes(command)

    command = _added(commands, "uniform", "range random and smooth depths over the gate", _uniform)
    _add_count(command, "--seeds", 2, MAX_SEEDS, 24)
    add_processes(command)

    command = _added(
        commands, "neighbours", "compare methods that use neighbouring pixels", _neighbours
    )
    _add_count(command, "--seeds", 2, MAX_SEEDS, 10)
    add_processes(command)

    command = _added(
        commands, "returns", "find two surfaces in a pixel, and count false ones", _returns
    )
    _add_count(command, "--seeds", 2, MAX_SEEDS, 10)
    add_processes(command)

    command = _added(commands, "motion", "range scenes that move during the pulses", _motion)
    _add_count(command, "--seeds", 2, MAX_SEEDS, 10)
    add_processes(command)

    command = _added(commands, "tuning", "search the settings of every method alike", _tuning)
    _add_count(command, "--seeds", 2, MAX_SEEDS, 8)

    command = _added(commands, "tuned", "table what settings chosen for each capture gain", _tuned)
    _add_count(command, "--seeds", 2, MAX_SEEDS, 10)
    add_processes(command)

    command = _added(
        commands, "calibration", "compare confidences and intervals with errors", _calibration
    )
    _add_count(command, "--seeds", 1, MAX_SEEDS, 2)
    _add_count(command, "--captures", 1, 1000, 8)
    command.add_argument(
        "--only",
        choices=_CALIBRATED,
        nargs="+",
        default=_CALIBRATED,
        help="measure these; --seeds holds for confidence, judged and ranges, --captures for each "
        "regime of the fluxes and each background of false alarms (all)",
    )
    add_processes(command)

    command = _added(
        commands, "fit", "compare confidences with errors where the model does not hold", _fit
    )
    _add_count(command, "--seeds", 1, MAX_SEEDS, 15)

    command = _added(commands, "field", "compare methods on published captures", _field)
    command.add_argument("captures", type=Path, help="the folder that holds them")

    command = _added(
        commands, "large", "range a generated capture of 8 GB on a small cluster", _large
    )
    command.add_argument("--folder", type=Path, default=Path("large"), help="of the file (large)")
    _add_count(command, "--rows", 64, 2**14, 2048)
    _add_count(command, "--bins", 16, 2**14, 1024)
    _add_count(command, "--chunk", 16, 2**12, 128)
    _add_count(command, "--workers", 1, 64, 2)
    command.add_argument("--memory", type=float, default=2.0, help="of all workers, in GB (2)")

    command = _added(
        commands,
        "speed",
        "measure the tracking kernels; fail if a speed-up is lost",
        _speed,
        folder="speed",
    )
    _add_count(command, "--rounds", 6, 1000, 21)

    _added(
        commands,
        "stability",
        "measure the range in which each setting can be trusted",
        _stability,
        folder="stability",
    )
    search = commands.add_parser("recommend", help="repeat the search for the recommended preset")
    search.set_defaults(work=_recommend)


def _added(commands: Any, name: str, help: str, work: Any, folder: str | None = None) -> Any:
    command = commands.add_parser(name, help=help, description=f"{help[0].upper()}{help[1:]}.")
    add_results(command, folder)
    command.set_defaults(work=work)
    return command


def _add_count(command: Any, name: str, least: int, most: int, default: int) -> None:
    help = f"{least} to {most} ({default})"
    command.add_argument(name, type=whole_from_to(least, most), default=default, help=help)


def _paper(chosen: argparse.Namespace) -> None:
    chosen.folder.mkdir(parents=True, exist_ok=True)
    measured = read_capture(chosen.field) if chosen.field else None
    store = chosen.folder / "trials.jsonl"
    results = _trials(paper.plan(), chosen.repetitions, chosen, store)
    title = f"The paper, reproduced ({chosen.repetitions} repetitions)"
    printed = ("table_2", "table_3", "flat_target")
    publish(page.items(results, measured), chosen, title, page.INTRODUCTION, printed)


def _table2(chosen: argparse.Namespace) -> None:
    settings = paper.in_whole_bins(chosen.preset)
    print(f"Preset {chosen.preset}, seeds 0 to {chosen.seeds - 1}: {settings}\n")
    method = Method(chosen.preset, "tracking", settings)
    plan = {Condition("car", sbr): [method] for sbr in TABLE_2}
    publish([paper.table_2(_trials(plan, chosen.seeds, chosen), (method,))], chosen)


def _uniform(chosen: argparse.Namespace) -> None:
    publish(uniform.tables(_trials(uniform.PLAN, chosen.seeds, chosen)), chosen)


def _neighbours(chosen: argparse.Namespace) -> None:
    publish(neighbours.tables(range(chosen.seeds), chosen.processes), chosen)


def _returns(chosen: argparse.Namespace) -> None:
    publish(returns.tables(range(chosen.seeds), chosen.processes), chosen)


def _motion(chosen: argparse.Namespace) -> None:
    publish(motion.tables(range(chosen.seeds), chosen.processes), chosen)


def _tuning(chosen: argparse.Namespace) -> None:
    found = tuning.tuning_table(range(chosen.seeds), progress=show_progress)
    print(file=sys.stderr)
    publish([found], chosen)


def _tuned(chosen: argparse.Namespace) -> None:
    publish([tuned.tuned_table(range(chosen.seeds), chosen.processes)], chosen)


def _calibration(chosen: argparse.Namespace) -> None:
    seeds, counted = range(chosen.seeds), list[alarms.Alarms]()
    tables: dict[str, Callable[[], Iterable[Table]]] = {
        "confidence": lambda: calibration.calibration_tables(seeds),
        "judged": lambda: [judged.judged_table(seeds, chosen.processes)],
        "ranges": lambda: [calibration.coverage_table(seeds, chosen.processes)],
        "fluxes": lambda: [calibration.flux_table(chosen.captures, chosen.processes)],
        "alarms": lambda: [alarms.alarms_table(counted)],
    }
    if "alarms" in chosen.only:
        counted = list(alarms.outcomes(chosen.captures, chosen.processes))
    publish((each for name in chosen.only for each in tables[name]()), chosen)
    if wrong := [f"{x.background}, {x.method}, {x.asked:g}" for x in counted if not x.holds]:
        raise CheckFailed(f"False alarms differ from those asked for: {'; '.join(wrong)}.")


def _fit(chosen: argparse.Namespace) -> None:
    found = list(fit.outcomes(range(chosen.seeds)))
    publish([fit.fit_table(found)], chosen)
    if failed := [f"{each.name}: see the table." for each in found if not each.holds]:
        raise CheckFailed("\n".join(failed))


def _field(chosen: argparse.Namespace) -> None:
    publish(field.tables(chosen.captures, lambda step: print(step, file=sys.stderr)), chosen)


def _large(chosen: argparse.Namespace) -> None:
    from core.studies.performance import large  # noqa: PLC0415 - loads Dask's cluster

    folder, chosen.folder = chosen.folder, None
    path = folder / f"building_{chosen.rows}_{chosen.bins}_{chosen.chunk}.zarr"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        print(f"Simulating {path} ...", file=sys.stderr)
        large.generate(path, chosen.rows, chosen.bins, chosen.chunk)
    disk = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    counts = chosen.rows**2 * chosen.bins * 2
    print(f"{path}: {counts / 1e9:.2f} GB of counts, {disk / 1e9:.2f} GB on disk\n")

    def passes() -> Iterator[large.Pass]:
        n_bytes = int(chosen.memory * 1e9)
        for each in large.study(path, chosen.workers, n_bytes, show_progress):
            print(f"\r{each.title}: {each.seconds:.1f} s" + " " * 40, file=sys.stderr)
            yield each

    found = list(passes())
    publish([large.passes_table(found)], chosen)
    if not all(each.same for each in found):
        raise CheckFailed("The estimates differ from those without Dask: see the table.")


def _speed(chosen: argparse.Namespace) -> None:
    from core.studies.performance import speed  # noqa: PLC0415 - compiles reference kernels

    tables, regressions = speed.study(speed.Extent(rounds=chosen.rounds), show_progress)
    print(file=sys.stderr)
    publish(tables, chosen, "Speed", speed.INTRODUCTION)
    if regressions:
        raise CheckFailed("\n".join(regressions))


def _stability(chosen: argparse.Namespace) -> None:
    from core.studies.sensitivity import page as stability  # noqa: PLC0415 - loads every estimator

    items, unconfirmed = stability.study(show_progress)
    print(file=sys.stderr)
    publish(items, chosen, stability.TITLE, stability.INTRODUCTION)
    if unconfirmed:
        raise CheckFailed("\n".join(unconfirmed))


def _recommend(chosen: argparse.Namespace) -> None:
    found = []
    for candidate in recommend.candidates():
        found.append(candidate)
        print(f"\r{len(found)} settings tried", end="", file=sys.stderr, flush=True)
    found.sort(key=lambda candidate: (candidate.passes, candidate.margin), reverse=True)
    rows = [(c.margin, *c.rd.values(), "yes" if c.passes else "no", c.settings) for c in found[:12]]
    reached = (f"RD at SBR {sbr:g}" for sbr in uniform.SBRS)
    print("\n\n" + as_markdown(("smallest margin", *reached, "passes Table 2", "settings"), rows))


def _trials(
    plan: Any, n_seeds: int, chosen: argparse.Namespace, store: Path | None = None
) -> Results:
    found = trials(
        plan,
        range(n_seeds),
        store=store,
        processes=chosen.processes,
        progress=show_progress,
    )
    print(file=sys.stderr)
    return found
