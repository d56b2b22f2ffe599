"""The command that holds laws at every extreme, and measures where to trust each method."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from core.cli.options import show_progress
from core.studies.outputs import Table, as_markdown


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
    command.set_defaults(work=_stability)


def _stability(chosen: argparse.Namespace) -> None:
    from core.studies.sensitivity import page as stability  # noqa: PLC0415 - every estimator, for one command

    items, broken = stability.study(show_progress)
    page = stability.write_page(items, chosen.folder)
    for item in items:
        if isinstance(item, Table):
            print(f"\n{item.title}\n\n{as_markdown(item.columns, item.rows)}")
    print(f"\n{page}")
    if broken:
        raise BrokenLaw("\n".join(broken))
