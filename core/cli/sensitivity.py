"""The command that holds laws at every extreme, and measures where to trust each method."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from core.cli.options import show_progress
from core.cli.results import add_results, show_tables
from core.studies.outputs import Table


class BrokenLaw(ArithmeticError):
    """A law that must hold everywhere does not."""


def add(commands: Any) -> None:
    """Add the command to a parser's."""
    command = commands.add_parser(
        "stability", help="laws at every extreme, and where each method is to be trusted"
    )
    command.add_argument(
        "--folder", type=Path, default=Path("stability"), help="written to (stability)"
    )
    add_results(command)
    command.set_defaults(work=_stability)


def _stability(chosen: argparse.Namespace) -> None:
    from core.studies.sensitivity import page as stability  # noqa: PLC0415 - every estimator, for one command

    items, broken = stability.study(show_progress)
    page = stability.write_page(items, chosen.folder)
    print(file=sys.stderr)
    show_tables((item for item in items if isinstance(item, Table)), chosen)
    print(page)
    if broken:
        raise BrokenLaw("\n".join(broken))
