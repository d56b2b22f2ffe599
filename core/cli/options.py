"""Options and output that commands share."""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from core.acquisition import Flux
from core.checks import require
from core.io import ReadOptions, reading_options


def whole_from_to(least: int, most: int) -> Callable[[str], int]:
    """A whole number within bounds."""

    def whole(text: str) -> int:
        if not (text.isdigit() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text} is not accepted: give {least} to {most}.")
        return int(text)

    return whole


def add_reading(command: Any) -> None:
    """Add the options for reading a file, one for each field of `core.io.ReadOptions`."""
    group = command.add_argument_group("how to read the file; what is not specified is guessed")
    for name, option in reading_options().items():
        parts = option.kind.words
        # One string for each option: `reading` parses them as the app's form does.
        several = {"nargs": len(parts), "metavar": parts} if parts else {}
        group.add_argument(f"--{option.flag}", dest=name, help=option.help, **several)


def add_processes(command: Any) -> None:
    """Add the option that tells how many processes share the work."""
    cores = os.cpu_count() or 1
    command.add_argument(
        "--processes", type=whole_from_to(1, 256), default=cores, help=f"({cores})"
    )


def reading(chosen: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `core.read_capture`."""
    given = {name: getattr(chosen, name) or "" for name in reading_options()}
    joined = {
        name: each if isinstance(each, str) else " ".join(each) for name, each in given.items()
    }
    return vars(ReadOptions.from_text(joined))


LIGHT_NAMES = ("sbr", "ppp", "seed")


def add_light(command: Any) -> None:
    """Add the options that tell how a scene is lit."""
    group = command.add_argument_group("how a scene is lit")
    usual = Flux()
    group.add_argument("--sbr", type=float, help=f"signal over background ({usual.sbr})")
    group.add_argument("--ppp", type=float, help=f"signal photons per pulse ({usual.signal})")
    group.add_argument("--seed", type=int, help="of the simulation (0)")


def flux(chosen: argparse.Namespace) -> Flux:
    """The light that these options tell."""
    usual = Flux()
    return Flux(
        usual.signal if chosen.ppp is None else chosen.ppp,
        usual.sbr if chosen.sbr is None else chosen.sbr,
    )


def require_none(told: Mapping[str, Any], names: Sequence[str], why: str) -> None:
    """Refuse what makes no sense beside other options."""
    for name in names:
        require(name, told[name], told[name] is None, f"None: {why}")


def as_options(message: str) -> str:
    """Return a message of `core` with the names of the command line's options."""
    for name, option in reading_options().items():
        if "_" in name:
            message = re.sub(rf"\b{name}\b", f"--{option.flag}", message)
    return message


def show_progress(done: int, of: int, what: str = "pieces") -> None:
    """A bar on standard error."""
    bar = "#" * (40 * done // max(of, 1))
    print(f"\r[{bar:<40}] {done} of {of} {what}", end="", file=sys.stderr, flush=True)


def show(facts: Mapping[str, Any], as_json: bool) -> None:
    """Print facts, one a line or as one JSON object; what is no number there is null."""
    if as_json:
        print(json.dumps(_plain(facts)))
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        text = f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
        print(f"{name:<{width}}  {text}")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
