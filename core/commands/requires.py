"""The command that says how much model a scene or a capture requires."""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from core.acquisition import Pulse
from core.capture import Capture
from core.checks import require
from core.commands.options import (
    LIGHT_NAMES,
    READING_NAMES,
    add_light,
    add_reading,
    flux,
    reading,
    require_none,
    show,
    show_progress,
    whole_from_to,
)
from core.estimators import ESTIMATORS
from core.experiments import plain, requires
from core.experiments.items import Table, as_markdown
from core.experiments.requirement import Requirement
from core.experiments.timing import machine
from core.readers import read_capture
from core.scene import scenes

_SEEDS = 16


def add(commands: Any) -> None:
    """Add this command to a parser's."""
    command = commands.add_parser(
        "requires", help="which parts and corrections a scene or a capture needs, and which not"
    )
    seen = command.add_mutually_exclusive_group()
    seen.add_argument("file", type=Path, nargs="?", help="a capture that `info` can read")
    seen.add_argument("--capture", type=Path, help="the same")
    seen.add_argument("--scene", choices=scenes, default="car", help="built in (car)")
    add_light(command)
    command.add_argument("--method", choices=ESTIMATORS, default="likelihood", help="(likelihood)")
    command.add_argument(
        "--seeds", type=whole_from_to(2, 1000), help=f"captures of a scene ({_SEEDS})"
    )
    command.add_argument("--out", type=Path, help="a folder for the page and its tables")
    command.add_argument("--json", action="store_true", help="one JSON object instead of a table")
    add_reading(command)
    command.set_defaults(work=_requires)


def _requires(chosen: argparse.Namespace) -> None:
    path = chosen.file or chosen.capture
    if path is None:
        title, rows, absent = _of_scene(chosen)
        tables = [requires.table(rows, title), absent]
    else:
        title, rows = _of_capture(path, chosen)
        tables = [requires.table(rows, title)]
    print(file=sys.stderr)
    if chosen.json:
        show({row.part: vars(row) for row in rows}, True)
    else:
        for each in tables:
            print(f"{each.title}\n\n{as_markdown(each.columns, each.rows)}\n")
    if chosen.out is not None:
        from core.experiments.report import write  # noqa: PLC0415 - draws, as nothing else here

        introduction = (requires.RULE, requires.NOTE)
        print(write([*tables, machine()], chosen.out, title, introduction), file=sys.stderr)
