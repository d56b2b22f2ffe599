"""Options and output shared by commands."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from core.acquisition import Flux
from core.checks import require
from core.io import read_options_from
from core.io.readers.quantities import EXAMPLE_OF_ANGLE, parsed_angle


def whole_from_to(least: int, most: int) -> Callable[[str], int]:
    """Return a parser of whole numbers within bounds."""

    def whole(text: str) -> int:
        if not (text.isdigit() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text} is not accepted: give {least} to {most}.")
        return int(text)

    return whole


def angle(text: str) -> float:
    """Parse an angle for an option."""
    try:
        return parsed_angle(text)
    except ValueError:
        message = f"{text} is not accepted: give {EXAMPLE_OF_ANGLE}."
        raise argparse.ArgumentTypeError(message) from None


class _Once(argparse.Action):
    """Refuse an option that is given twice, of which only the last value would count."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        if (before := getattr(namespace, self.dest)) is not None:
            parser.error(f"{option_string} is given twice, {before} and {values}: give one.")
        setattr(namespace, self.dest, values)


def add_capture(command: Any) -> None:
    """Add the option for a file to read."""
    help = "a file that `info` can read"
    command.add_argument("--capture", type=Path, action=_Once, help=help)


def add_processes(command: Any) -> None:
    """Add the option for the number of processes, by default one per core."""
    cores = os.cpu_count() or 1
    help = f"that share the work ({cores})"
    command.add_argument("--processes", type=whole_from_to(1, 256), default=cores, help=help)


def reading(chosen: argparse.Namespace) -> dict[str, Any]:
    """Return the arguments of `core.read_capture`."""
    return vars(read_options_from(chosen))


FLUX_OPTIONS = ("sbr", "ppp", "seed")


def add_flux(command: Any) -> None:
    """Add the options for the flux of a simulated scene."""
    group = command.add_argument_group("simulation of a scene")
    default = Flux()
    group.add_argument("--sbr", type=float, help=f"signal over background ({default.sbr})")
    group.add_argument("--ppp", type=float, help=f"signal photons per pulse ({default.signal})")
    group.add_argument("--seed", type=int, help="of the random numbers (0)")


def flux_of(chosen: argparse.Namespace) -> Flux:
    """Return the flux that these options give."""
    given = {"signal": chosen.ppp, "sbr": chosen.sbr}
    return Flux(**{name: value for name, value in given.items() if value is not None})


def require_none(options: Mapping[str, Any], names: Sequence[str], reason: str) -> None:
    """Refuse options that contradict others."""
    for name in names:
        require(name, options[name], options[name] is None, f"None: {reason}")


def show_progress(done: int, of: int, what: str = "pieces") -> None:
    """Draw a progress bar on standard error."""
    bar = "#" * (40 * done // max(of, 1))
    print(f"\r[{bar:<40}] {done} of {of} {what}", end="", file=sys.stderr, flush=True)


def show(facts: Mapping[str, Any], as_json: bool) -> None:
    """Print facts, one per line or as one JSON object, where NaN and infinity are null."""
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
