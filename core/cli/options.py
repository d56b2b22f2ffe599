"""What several commands take and show alike."""

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

from core.acquisition import Flux, Pulse
from core.checks import require
from core.io.readers.wording import UNITS_S

_MOST_WITHOUT_UNIT_S = 1e-3


def seconds(text: str) -> float:
    """A time such as ``64ps``, ``4.43 us`` or, in seconds and below a millisecond, ``1e-9``."""
    parts = re.fullmatch(r"([-+.\deE]+) *([a-zµ]*)", text.strip())
    try:
        number, unit = parts.groups() if parts else ("", "")
        time_s = float(number) * UNITS_S[unit or "s"]
        # A forgotten unit would make nanoseconds of light years.
        if not unit and abs(time_s) > _MOST_WITHOUT_UNIT_S:
            raise ValueError
    except (KeyError, ValueError):
        known = ", ".join(UNITS_S)
        raise argparse.ArgumentTypeError(
            f"{text!r} is not accepted: give a time such as 64ps or 1e-9; units are {known}."
        ) from None
    return time_s


def whole_from_to(least: int, most: int) -> Callable[[str], int]:
    """A whole number within bounds."""

    def whole(text: str) -> int:
        if not (text.isdigit() and least <= int(text) <= most):
            raise argparse.ArgumentTypeError(f"{text} is not accepted: give {least} to {most}.")
        return int(text)

    return whole


READING: dict[str, dict[str, Any]] = {
    "time-unit": {"type": seconds, "dest": "time_unit_s", "help": "of arrival times, such as 8ps"},
    "bin-width": {"type": seconds, "dest": "bin_width_s", "help": "such as 64ps"},
    "gate-delay": {
        "type": seconds,
        "dest": "gate_delay_s",
        "help": "from the pulse to the first bin, such as 280ns or, before it, =-5ns",
    },
    "bins": {"type": int, "dest": "n_bins", "help": "in the gate"},
    "pulses": {"type": int, "dest": "n_pulses", "help": "sent for each pixel"},
    "variable": {"help": "name of the array, where the file holds several"},
    "pulse-sigma": {
        "type": seconds,
        "dest": "pulse",
        "help": "standard deviation of an echo, taken for a Gaussian",
    },
    "pixel-angle": {
        "type": float,
        "dest": "pixel_angle_rad",
        "help": "between neighbouring pixels, in radians",
    },
    "detection": {"choices": ("first", "all"), "help": "photons of a pulse that are recorded"},
    "axes": {"help": "the file's order, such as 'bin row col'"},
    "shape": {
        "type": int,
        "nargs": 2,
        "metavar": ("ROWS", "COLS"),
        "help": "of a file that lists its pixels",
    },
    "stop": {
        "type": seconds,
        "dest": "stop_s",
        "help": "common stop: times count backwards from this time after the pulse",
    },
    "no-trigger": {"type": int, "help": "raw frames: what stands where nothing fired"},
    "first-detections": {"type": int, "help": "keep so many of each pixel"},
}
"""How a file is to be read, as `core.read_capture` takes it; guessed where not told."""


READING_NAMES = [kind.get("dest", name.replace("-", "_")) for name, kind in READING.items()]
"""Names of these arguments, in the same order."""


def add_reading(command: Any) -> None:
    """Add the options that tell how a file is to be read."""
    group = command.add_argument_group("how to read the file; what is not told is guessed")
    for name, kind in READING.items():
        group.add_argument(f"--{name}", **kind)


def add_processes(command: Any) -> None:
    """Add the option that tells how many processes share the work."""
    cores = os.cpu_count() or 1
    command.add_argument(
        "--processes", type=whole_from_to(1, 256), default=cores, help=f"({cores})"
    )


def reading(chosen: argparse.Namespace) -> dict[str, Any]:
    """The arguments of `core.read_capture`."""
    told = {name: getattr(chosen, name) for name in READING_NAMES}
    if told["pulse"] is not None:
        told["pulse"] = Pulse.gaussian(told["pulse"])
    if told["shape"] is not None:
        told["shape"] = tuple(told["shape"])
    return told


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
    """A message of `core` in the words of the command line."""
    for name, argument in zip(READING, READING_NAMES, strict=True):
        if "_" in argument:
            message = re.sub(rf"\b{argument}\b", f"--{name}", message)
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
