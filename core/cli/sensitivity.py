"""The command that measures for which settings and scenes each method can be trusted."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from core.cli.options import show_progress
from core.cli.results import add_results, show_tables
from core.studies.outputs import Table


class UnconfirmedZone(ArithmeticError):
    """A zone that sliders mark as doubtful is not doubtful when measured."""


def add(commands: Any) -> None:
    """Add the command to a parser's."""
    command = commands.add_parser("stability", help="for which settings each method can be trusted")
    command.add_argument(
        "--folder", type=Path, default=Path("stability"), help="output folder (stability)"
    )
    add_results(command)
    command.set_defaults(work=_stability)


def _stability(chosen: argparse.Namespace) -> None:
    from core.studies.sensitivity import page as stability  # noqa: PLC0415 - draws, as few commands do

    items, unconfirmed = stability.study(show_progress)
    page = stability.write_page(items, chosen.folder)
    print(file=sys.stderr)
    show_tables((item for item in items if isinstance(item, Table)), chosen)
    print(page)
    print("Properties at the extremes are tests: pytest core/tests/test_extremes.py")
    if unconfirmed:
        raise UnconfirmedZone("\n".join(unconfirmed))
