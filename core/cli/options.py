"""Options and output shared by commands."""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from core.acquisition import Flux
from core.checks import require
from core.estimators import FALSE_ALARM, JUDGES
from core.geometry import Box
from core.inference import FALSE_RETURN, MOST_RETURNS
from core.io import read_options_from
from core.io.readers.quantities import EXAMPLE_OF_ANGLE, parsed_angle
from core.io.writers import RangeColors
from core.parameters import Choice, Number, spec_of


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


def probability(text: str) -> float:
    """Parse a probability for an option."""
    try:
        if 0 <= (value := float(text)) <= 1:
            return value
    except ValueError:
        pass
    raise argparse.ArgumentTypeError(f"{text} is not accepted: give 0 to 1.")


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


def add_pixel(command: Any, help: str) -> None:
    """Add the option for one pixel."""
    command.add_argument("--pixel", type=int, nargs=2, metavar=("ROW", "COL"), help=help)


def add_false_alarm(command: Any) -> None:
    """Add the option for the accepted rate of false alarms."""
    command.add_argument(
        "--false-alarm",
        type=float,
        help="accepted share of echo-free pixels with an estimate, "
        f"{FALSE_ALARM.least:g} to {FALSE_ALARM.most:g}; by default all pixels have one; the "
        "methods kde and chi exceed it next to surfaces, since they add neighbouring pixels; "
        "without effect on the methods unmixing and image_posterior, which have "
        "--false-acceptance and --pixels instead",
    )


def add_returns(command: Any) -> None:
    """Add the options for several returns of a pixel."""
    command.add_argument(
        "--returns",
        type=whole_from_to(1, MOST_RETURNS),
        default=1,
        help="surfaces of a pixel to look for (1); point clouds hold all of them, and LAS their "
        f"numbers; at most {MOST_RETURNS}",
    )
    command.add_argument(
        "--false-return",
        type=float,
        help="with --returns: accepted share of pixels with one surface that get a second "
        f"({FALSE_RETURN:g})",
    )


def add_judge(command: Any) -> None:
    """Add the option for what determines the confidence."""
    command.add_argument(
        "--judged-by",
        choices=JUDGES,
        default=JUDGES[0],
        help="confidence from the counts of the pixel alone, or from those of its neighbours, too "
        f"({JUDGES[0]})",
    )


def refuse_judging(judged_by: str) -> None:
    """Raise ``ValueError`` if the image is to judge a capture that is ranged in tiles."""
    accepted = "'pixel' for a capture that is ranged in tiles"
    require("judged_by", judged_by, judged_by == JUDGES[0], accepted)


def add_filters(command: Any) -> None:
    """Add the options for the accepted rate of false alarms and the confidence of what is saved."""
    add_false_alarm(command)
    command.add_argument(
        "--least-confidence",
        type=probability,
        help="leave estimates of less confidence out of the files, as the app does below 0.9; they "
        "still count in the figures; by default all are written",
    )


def add_crop(command: Any) -> None:
    """Add the options for the box to which a point cloud is cropped."""
    group = command.add_argument_group("crop of the point cloud, as in the app")
    group.add_argument(
        "--crop",
        type=_limit,
        nargs=2,
        metavar=("FROM", "TO"),
        default=(None, None),
        help="shortest and longest range in metres; - for no limit",
    )
    group.add_argument(
        "--crop-pixels",
        type=_corners,
        metavar="'ROW,COL ROW,COL ...'",
        default=(),
        help="corners of a polygon that holds the pixels, as files state them",
    )


def crop_given(chosen: argparse.Namespace) -> Box:
    """Return the box that the options of `add_crop` give."""
    return Box(chosen.crop_pixels, *chosen.crop)


def _limit(text: str) -> float | None:
    """Parse the limit of a range; None for -."""
    if text == "-":
        return None
    with suppress(ValueError):
        if math.isfinite(value := float(text)):
            return value
    raise argparse.ArgumentTypeError(f"{text} is not accepted: give metres, or - for no limit.")


def _corners(text: str) -> tuple[tuple[float, float], ...]:
    """Parse the corners of a polygon."""
    with suppress(ValueError):
        pairs = (each.split(",") for each in text.split())
        corners = tuple((float(row), float(col)) for row, col in pairs)
        if len(corners) >= 3 and np.isfinite(corners).all():
            return corners
    message = f"{text} is not accepted: give 3 or more row,col separated by spaces."
    raise argparse.ArgumentTypeError(message)


def add_colors(command: Any) -> None:
    """Add the options for the colours of pictures."""
    group = command.add_argument_group("colours of ranges in pictures, as in the app")
    for each in fields(RangeColors):
        spec, help = spec_of(each), f"{each.metadata['help']}".replace("%", "%%")
        name = each.name.removesuffix("_m").replace("_", "-")
        kind: dict[str, Any] = {"type": float, "metavar": "METRES"}
        if isinstance(spec, Choice):
            kind = {"choices": spec.options, "default": each.default}
        group.add_argument(f"--{name}", dest=each.name, help=help, **kind)


def colors_given(chosen: argparse.Namespace) -> RangeColors:
    """Return the colours that the options of `add_colors` give."""
    return RangeColors(**{each.name: getattr(chosen, each.name) for each in fields(RangeColors)})


def add_settings(command: Any, kind: type[Any], title: str = "settings of the method") -> None:
    """Add an option for each setting of a method, or of something else that the title names."""
    group = command.add_argument_group(title)
    for each in fields(kind):
        spec = spec_of(each)
        parse = (int if spec.whole else float) if isinstance(spec, Number) else str
        group.add_argument(
            f"--{each.name.replace('_', '-')}",
            dest=f"setting_{each.name}",
            type=parse,
            default=each.default,
            metavar=each.name.upper(),
            help=f"{each.metadata['help']} ({each.default})".replace("%", "%%"),
        )


def settings_given(chosen: argparse.Namespace, kind: type[Any]) -> Any:
    """Return the settings that the options of `add_settings` give."""
    return kind(**{each.name: getattr(chosen, f"setting_{each.name}") for each in fields(kind)})


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


_LEAST = 1e-15
MOST_LISTED = 10
"""Items of a list that are printed as lines."""


def show(facts: Mapping[str, Any], as_json: bool) -> None:
    """Print facts, one per line or as one JSON object, where NaN and infinity are null."""
    if as_json:
        print(json.dumps(_plain(facts)))
        return
    width = max(map(len, facts))
    for name, value in facts.items():
        for n, line in enumerate(_lines(value)):
            print(f"{name if n == 0 else '':<{width}}  {line}")


def _lines(value: Any) -> list[str]:
    """Return a value as text, a list as one line for each item."""
    if isinstance(value, list):
        lines = [line for each in value[:MOST_LISTED] for line in _lines(each)]
        n_more = len(value) - MOST_LISTED
        return [*lines, f"and {n_more} more: --json has all"] if n_more > 0 else lines
    if isinstance(value, Mapping):
        return [", ".join(f"{name} {each}" for name, each in value.items())]
    if not isinstance(value, float | np.floating):
        return [str(value)]
    # Of the quantities in SI units none is so small: a probability in the tails of a model.
    return [f"< {_LEAST:g}" if 0 < value < _LEAST else f"{value:.6g}"]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
