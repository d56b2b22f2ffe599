"""The headless command line: ``python -m core <command> --help``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

from core.acquisition import Flux
from core.capture import Capture
from core.estimators import ESTIMATORS, FALSE_ALARM
from core.experiments import calibration, paper, recommend, uniform
from core.experiments.items import as_markdown, as_text
from core.experiments.printed import TABLE_2
from core.experiments.trials import Condition, Method, Results, trials
from core.parameters import Number, spec_of
from core.pipeline import run
from core.readers import read_capture
from core.scene import scenes
from core.simulate import simulate
from core.tracking import PRESETS

MOST_SEEDS = recommend.SEEDS.start  # from there on they are the search's own


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m core", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    for add in (_add_estimate, _add_paper, _add_table2, _add_uniform, _add_calibration):
        add(commands)
    search = commands.add_parser("recommend", help="the search that found the recommended preset")
    search.set_defaults(work=_recommend)
    chosen = parser.parse_args(arguments)
    try:
        chosen.work(chosen)
    except ValueError as error:
        parser.exit(2, f"{error}\n")
    except KeyboardInterrupt:
        parser.exit(130, "\nInterrupted.\n")
    return 0


def _add_estimate(commands: Any) -> None:
    command = commands.add_parser("estimate", help="range a scene or a capture by one method")
    methods = command.add_subparsers(dest="method", required=True)
    for name, estimator in ESTIMATORS.items():
        method = methods.add_parser(name, help=estimator.title, description=estimator.title)
        seen = method.add_mutually_exclusive_group()
        seen.add_argument("--capture", type=Path, help="a file that read_capture can read")
        seen.add_argument("--scene", choices=scenes, default="car", help="a scene to simulate")
        method.add_argument("--sbr", type=float, default=0.06, help="of the scene (0.06)")
        method.add_argument("--seed", type=int, default=0, help="of the simulation (0)")
        method.add_argument(
            "--false-alarm",
            type=float,
            help=f"share of pixels without an echo that may be answered, "
            f"{FALSE_ALARM.least:g} to {FALSE_ALARM.most:g}; all are where not given",
        )
        for each in fields(estimator.parameters):
            spec = spec_of(each)
            method.add_argument(
                f"--{each.name.replace('_', '-')}",
                dest=f"setting_{each.name}",
                type=_kind(spec),
                default=each.default,
                help=f"{each.metadata['help']} ({each.default})".replace("%", "%%"),
            )
        method.set_defaults(work=_estimate)


def _kind(spec: Any) -> Callable[[str], Any]:
    if not isinstance(spec, Number):
        return str
    return int if spec.whole else float


def _estimate(chosen: argparse.Namespace) -> None:
    capture = _capture(chosen)
    settings = ESTIMATORS[chosen.method].parameters(
        **{k.removeprefix("setting_"): v for k, v in vars(chosen).items() if "setting_" in k}
    )
    found = run(capture, chosen.method, settings, chosen.false_alarm)
    rows: list[tuple[str, Any]] = [
        ("source", capture.source),
        ("settings", str(settings)),
        ("pixels answered", int(found.image.valid.sum())),
        ("of them confident (0.9 and more)", int((found.image.confidence >= 0.9).sum())),
        *found.figures.items(),
        ("seconds for light and confidence", found.light_s),
        ("seconds for the method", found.estimate_s),
    ]
    print(as_markdown((ESTIMATORS[chosen.method].title, ""), rows))


def _capture(chosen: argparse.Namespace) -> Capture:
    if chosen.capture:
        return read_capture(chosen.capture)
    scene = scenes[chosen.scene]()
    return simulate(scene, scene.acquisition, Flux(sbr=chosen.sbr), seed=chosen.seed)


def _add_paper(commands: Any) -> None:
    command = commands.add_parser("paper", help="every figure and table of the paper, and a page")
    command.add_argument("--repetitions", type=_from_to(2, MOST_SEEDS), default=MOST_SEEDS)
    command.add_argument("--folder", type=Path, default=Path("paper"), help="written to (paper)")
    command.add_argument("--field", type=Path, help="a measured capture to compare methods on")
    _add_processes(command)
    command.set_defaults(work=_paper)


def _paper(chosen: argparse.Namespace) -> None:
    from core.experiments import page  # noqa: PLC0415 - draws, which nothing else here needs

    chosen.folder.mkdir(parents=True, exist_ok=True)
    field = read_capture(chosen.field) if chosen.field else None
    results = trials(
        paper.plan(),
        range(chosen.repetitions),
        store=chosen.folder / "trials.jsonl",
        processes=chosen.processes,
        progress=_show_progress,
    )
    print("\nFigures ...", file=sys.stderr)
    print(page.write_page(results, chosen.folder, chosen.repetitions, field))


def _add_table2(commands: Any) -> None:
    command = commands.add_parser("table2", help="the car under six SBRs, beside the paper's")
    command.add_argument("--seeds", type=_from_to(2, MOST_SEEDS), default=20)
    command.add_argument("--preset", choices=PRESETS, default="recommended")
    _add_processes(command)
    command.set_defaults(work=_table2)


def _table2(chosen: argparse.Namespace) -> None:
    settings = PRESETS[chosen.preset]
    print(f"Preset {chosen.preset}, seeds 0 to {chosen.seeds - 1}: {settings}\n")
    method = Method(chosen.preset, "tracking", settings)
    results = _tried({Condition("car", sbr): [method] for sbr in TABLE_2}, chosen)
    table = paper.table_2(results, (method,))
    print(as_markdown(table.columns, table.rows))


def _add_uniform(commands: Any) -> None:
    command = commands.add_parser("uniform", help="every method on depths uniform over the gate")
    command.add_argument("--seeds", type=_from_to(2, MOST_SEEDS), default=24)
    _add_processes(command)
    command.set_defaults(work=_uniform)


def _uniform(chosen: argparse.Namespace) -> None:
    table = uniform.table(_tried(uniform.PLAN, chosen))
    print(as_markdown(table.columns, table.rows))


def _add_calibration(commands: Any) -> None:
    command = commands.add_parser("calibration", help="is a confidence of 0.9 right 9 times in 10?")
    command.add_argument("--seeds", type=_from_to(1, MOST_SEEDS), default=5)
    command.set_defaults(work=_calibration)


def _calibration(chosen: argparse.Namespace) -> None:
    columns = ("scene", "SBR", "method", "calibration error", "confidence: share right (answers)")
    print(as_markdown(columns, ()))
    for report in calibration.reports(range(chosen.seeds)):
        told = ", ".join(
            f"{t.confidence:.2f}: {t.right.value:.2f} ({t.count})" for t in report.told
        )
        sbr = "all six" if report.sbr is None else f"{report.sbr:g}"
        row = (report.scene, sbr, report.method, as_text(report.error), told)
        print("| " + " | ".join(row) + " |", flush=True)


def _recommend(chosen: argparse.Namespace) -> None:
    found = []
    for candidate in recommend.candidates():
        found.append(candidate)
        print(f"\r{len(found)} settings tried", end="", file=sys.stderr, flush=True)
    found.sort(key=lambda candidate: (candidate.passes, candidate.margin), reverse=True)
    rows = [(c.margin, *c.rd.values(), "yes" if c.passes else "no", c.settings) for c in found[:12]]
    reached = (f"RD at SBR {sbr:g}" for sbr in uniform.SBRS)
    print("\n\n" + as_markdown(("smallest margin", *reached, "passes Table 2", "settings"), rows))


def _add_processes(command: Any) -> None:
    cores = os.cpu_count() or 1
    command.add_argument("--processes", type=_from_to(1, 256), default=cores, help=f"({cores})")


def _tried(plan: Any, chosen: argparse.Namespace) -> Results:
    found = trials(plan, range(chosen.seeds), processes=chosen.processes, progress=_show_progress)
    print(file=sys.stderr)
    return found


def _show_progress(done: int, of: int) -> None:
    bar = "#" * (40 * done // max(of, 1))
    print(f"\r[{bar:<40}] {done} of {of} pieces", end="", file=sys.stderr, flush=True)


def _from_to(least: int, most: int) -> Callable[[str], int]:
    def whole(text: str) -> int:
        if not (text.isdigit() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text} is not accepted: give {least} to {most}.")
        return int(text)

    return whole


if __name__ == "__main__":
    sys.exit(main())
