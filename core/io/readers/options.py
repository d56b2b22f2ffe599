"""Options for reading a file: one field each, from which all interfaces follow.

`core.read_capture`, its documentation, the options of the command line, the form in the app, links
and scripts are made from the fields of `ReadOptions` and their `Option`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from types import MappingProxyType
from typing import Any, get_args

import numpy as np

from core.acquisition import LONGEST_S, MOST_BINS, MOST_PULSES, SHORTEST_BIN_S, Pulse, require_time
from core.capture import Detection
from core.checks import require, require_type, require_whole
from core.io.readers.quantities import (
    EXAMPLE,
    EXAMPLE_OF_ANGLE,
    angle_as_typed,
    parsed_angle,
    parsed_time,
    time_as_typed,
)

MOST_PULSE_GROUPS = 1000
"""Largest number of groups of pulses; each has a cube of its own."""

Check = Callable[[str, Any], None]
"""Called with the name of a field and its value; raises ``ValueError``."""


@dataclass(frozen=True)
class Kind:
    """Type of an option: how its values are parsed, written and checked."""

    annotation: str
    """Type in the documentation."""
    parse: Callable[[str], Any]
    """From text; raises ``ValueError``."""
    accepts: str
    check: Check
    write: Callable[[Any], str] = str
    """As text from which `parse` returns the same value."""
    metavars: tuple[str, ...] = ()
    """Names of the parts of a value that takes several arguments of the command line."""
    choices: tuple[str, ...] = ()
    """All texts that are accepted, where they are few."""


@dataclass(frozen=True)
class Option:
    """Presentation of a field of `ReadOptions`."""

    label: str
    """Label in a form."""
    flag: str
    """Option of the command line, without the dashes."""
    kind: Kind
    help: str
    """Description, as a sentence."""


def _option(label: str, flag: str, kind: Kind, help: str) -> Any:
    return field(default=None, metadata={"option": Option(label, flag, kind, help)})


def _is_whole(value: Any) -> bool:
    return isinstance(value, int | np.integer)


def _time(least_s: float) -> Kind:
    def check(name: str, value: Any) -> None:
        require_time(name, value, least_s)

    return Kind("float", parsed_time, EXAMPLE, check, time_as_typed)


def _count(most: int) -> Kind:
    def check(name: str, value: Any) -> None:
        require_whole(name, value, most)

    return Kind("int", int, "a whole number", check)


def _required(accepts: str, is_valid: Callable[[Any], bool]) -> Check:
    return lambda name, value: require(name, value, is_valid(value), accepts)


def _required_number(accepts: str, is_valid: Callable[[Any], bool]) -> Check:
    def check(name: str, value: Any) -> None:
        require_type(name, value, Real, accepts)
        require(name, value, is_valid(value), accepts)

    return check


def _parsed_shape(text: str) -> tuple[int, int]:
    rows, cols = re.split(r"[\s,x×]+", text.strip())
    return int(rows), int(cols)


def _is_shape(value: Any) -> bool:
    is_pair = isinstance(value, tuple) and len(value) == 2
    return is_pair and all(_is_whole(size) and size >= 1 for size in value)


def _parsed_records(text: str) -> int | tuple[int, int]:
    first, dash, last = text.partition("-")
    return (int(first), int(last)) if dash else int(first)


def _records_as_typed(records: int | tuple[int, int]) -> str:
    return "-".join(map(str, records)) if isinstance(records, tuple) else str(records)


def _are_records(value: Any) -> bool:
    span = value if isinstance(value, tuple) else (value, value)
    return len(span) == 2 and all(map(_is_whole, span)) and 0 <= span[0] <= span[1]


_DETECTIONS = get_args(Detection)
_NAMES = Kind("str", str, "names", _required("text", lambda value: isinstance(value, str)))
_ANGLE = Kind(
    "float",
    parsed_angle,
    EXAMPLE_OF_ANGLE,
    _required_number("an angle between 0 and 1 radian", lambda value: 0 < value < 1),
    angle_as_typed,
)
_WHOLE = Kind("int", int, "a whole number", _required("a whole number", _is_whole))
_DETECTION = Kind(
    "str",
    str,
    "first or all",
    _required(" or ".join(map(repr, _DETECTIONS)), lambda value: value in _DETECTIONS),
    choices=_DETECTIONS,
)
_SHAPE = Kind(
    "tuple of int",
    _parsed_shape,
    "rows and columns such as 64 x 64",
    _required("rows and columns, each at least 1", _is_shape),
    lambda shape: " x ".join(map(str, shape)),
    ("ROWS", "COLS"),
)
_RECORDS = Kind(
    "int or tuple of int",
    _parsed_records,
    "a record such as 0, or the first and the last one such as 3-7",
    _required("a record from 0, or the first and the last one", _are_records),
    _records_as_typed,
)
_RATE = Kind(
    "float",
    float,
    "pulses per second such as 20e3",
    _required_number("pulses per second, positive", lambda value: 0 < value < np.inf),
    lambda rate_hz: repr(float(rate_hz)),
)
_PULSE = Kind(
    "Pulse",
    lambda text: Pulse.gaussian(parsed_time(text)),
    EXAMPLE,
    _required("a Pulse", lambda value: isinstance(value, Pulse)),
    lambda pulse: time_as_typed(pulse.tau_s),
)


@dataclass(frozen=True)
class ReadOptions:
    """User overrides for a file; None takes the value from the file, or guesses it.

    Raises
    ------
    ValueError
        If a field is out of its range.
    """

    time_unit_s: float | None = _option(
        "Time unit",
        "time-unit",
        _time(SHORTEST_BIN_S),
        "Unit of the arrival times, such as 8ps; only for a file that holds such.",
    )
    bin_width_s: float | None = _option(
        "Bin width", "bin-width", _time(SHORTEST_BIN_S), "Width of a bin, such as 64ps."
    )
    gate_delay_s: float | None = _option(
        "Gate opens after",
        "gate-delay",
        _time(-LONGEST_S),
        "Time from the pulse to the first bin, such as 280ns; earlier photons are dropped.",
    )
    n_bins: int | None = _option(
        "Bins",
        "bins",
        _count(MOST_BINS),
        "Bins in the gate; later photons are dropped. A cube must have just as many.",
    )
    n_pulses: int | None = _option(
        "Pulses sent", "pulses", _count(MOST_PULSES), "Pulses sent for each pixel; never guessed."
    )
    variable: str | None = _option(
        "Variable", "variable", _NAMES, "Name of the array, where the file holds several."
    )
    pulse: Pulse | None = _option(
        "Echo's standard deviation",
        "pulse-sigma",
        _PULSE,
        "Standard deviation of an echo, such as 150ps; one that is given is that of a Gaussian.",
    )
    pixel_angle_rad: float | None = _option(
        "Pixel angle", "pixel-angle", _ANGLE, "Angle between neighbouring pixels, such as 20urad."
    )
    detection: Detection | None = _option(
        "Photons of a pulse",
        "detection",
        _DETECTION,
        "Photons of a pulse that are recorded, first or all; guessed to be first photons where the "
        "number of pulses is known and no pixel has more photons.",
    )
    axes: str | None = _option(
        "Axes (such as bin row col)",
        "axes",
        _NAMES,
        "Names of the file's axes in its own order, such as 'bin row col', for raw frames 'pulse "
        "col row', for lists of photons 'col row'.",
    )
    shape: tuple[int, int] | None = _option(
        "Rows x columns",
        "shape",
        _SHAPE,
        "Rows and columns of a file that lists its pixels one after the other.",
    )
    stop_s: float | None = _option(
        "Common stop after",
        "stop",
        _time(-LONGEST_S),
        "For common-stop instruments: times count backwards from this time after the pulse, often "
        "the laser's period.",
    )
    no_trigger: int | None = _option(
        "Frames: no trigger is",
        "no-trigger",
        _WHOLE,
        "Value in raw frames (pulse, row, col) of trigger bins that marks no trigger; declares the "
        "array of a .npy or .npz file as such frames.",
    )
    first_detections: int | None = _option(
        "First detections only",
        "first-detections",
        _count(MOST_PULSES),
        "Number of detections to keep of each pixel, in the order of the file; only for a file "
        "that lists photons.",
    )
    records: int | tuple[int, int] | None = _option(
        "Records",
        "records",
        _RECORDS,
        "Records of a sequence in time that are added up, counted from 0: one such as 0, or a span "
        "such as 3-7. A frame of raw frames or of a scan is a record, and so is each file of a "
        "sequence such as 'run_*.npz'.",
    )
    pulse_groups: int | None = _option(
        "Groups of pulses",
        "pulse-groups",
        _count(MOST_PULSE_GROUPS),
        "Number of groups in which the order of the pulses is kept, such as 40, for surfaces that "
        "move; only for raw frames, and for a sequence of files, each of which is in one group.",
    )
    pulse_rate_hz: float | None = _option(
        "Pulse rate (Hz)",
        "pulse-rate",
        _RATE,
        "Pulses per second, such as 20e3, from which velocities in metres per second follow; only "
        "with groups of pulses.",
    )

    def __post_init__(self) -> None:
        for name, option in reading_options().items():
            if (value := getattr(self, name)) is not None:
                option.kind.check(name, value)

    @classmethod
    def from_text(cls, typed: Mapping[str, str]) -> ReadOptions:
        """Return the request for typed fields; an empty one leaves the value to the reader.

        Raises
        ------
        ValueError
            If a text cannot be parsed, or a value is out of its range: names the field, the text
            and what would be accepted.
        """
        values: dict[str, Any] = {}
        for name, text in typed.items():
            kind = reading_options()[name].kind
            try:
                values[name] = kind.parse(text.strip()) if text.strip() else None
            except ValueError:
                require(name, text, False, f"{kind.accepts}, or nothing to let the reader guess")
        return cls(**values)

    def completed_by(self, others: ReadOptions) -> ReadOptions:
        """Return these options, and those of `others` where they are None."""
        own = {name: value for name, value in vars(self).items() if value is not None}
        return replace(others, **own)

    def as_text(self, name: str) -> str:
        """Return a field as it would be typed."""
        value = getattr(self, name)
        return "" if value is None else reading_options()[name].kind.write(value)

    def order(self, canonical: tuple[str, ...]) -> tuple[int, ...] | None:
        """Return the position in the file of each axis, for `numpy.transpose`.

        Parameters
        ----------
        canonical : tuple of str
            Names of the axes in the order of the result, such as ``("row", "col", "bin")``.

        Returns
        -------
        tuple of int or None
            None where `axes` is not specified.

        Raises
        ------
        ValueError
            If `axes` names others, or not each of them once.
        """
        if self.axes is None:
            return None
        named = re.split(r"[\s,]+", self.axes.strip())
        fits = sorted(named) == sorted(canonical)
        require("axes", self.axes, fits, f"{' '.join(canonical)!r} in the order of the file")
        return tuple(named.index(name) for name in canonical)

    def refuse(self, names: Iterable[str], why: str) -> None:
        """Raise ``ValueError`` if a field is specified that does not apply to the file."""
        for name in names:
            require(name, getattr(self, name), getattr(self, name) is None, f"None: {why}")


IN_ORDER = ("pulse_groups", "pulse_rate_hz")
"""Options of `ReadOptions` for files that keep the order of the pulses."""


class AmbiguousError(ValueError):
    """A file that can be read in several ways, of which the user must choose one.

    Parameters
    ----------
    message : str
    question : str
        Question for the user, with ``{file}`` in place of the file's name.
    choices : mapping of str to mapping
        Options as text of each way, by its title, the most likely first.
    """

    def __init__(
        self, message: str, question: str, choices: Mapping[str, Mapping[str, str]]
    ) -> None:
        super().__init__(message)
        self.question, self.choices = question, choices


def _which_variable(variables: Sequence[str], listed: str) -> AmbiguousError:
    """Return the error that asks for one of several arrays, the most likely first."""
    names = " or ".join((", ".join(variables[:-1]), variables[-1]))
    number = "Two" if len(variables) == 2 else len(variables)
    return AmbiguousError(
        f"variable = None is not accepted: give {names}, each of which could be the capture; "
        f"the file has {listed}.",
        f"{number} arrays of {{file}} could be the capture. Which?",
        {name: {"variable": name} for name in variables},
    )


TRUTH_HINT = "a map of true ranges is no capture: add it to one as its truth"
"""End of a message about a file that may hold the truth of a capture."""


def choose_variable(
    requested: str | None,
    names: Container[str],
    fitting: Mapping[str, bool],
    accepted: str,
    listed: str,
) -> str:
    """Return the requested name, else that of the only array that fits.

    Parameters
    ----------
    requested : str or None
    names : container of str
        Those that may be requested.
    fitting : mapping of str to bool
        Names of the arrays that fit, and whether they hold whole numbers. Photons are counted in
        such; fractions may be rates.
    accepted, listed : str
        What an array must be, and the arrays of the file, for messages.

    Raises
    ------
    AmbiguousError
        If several fit.
    ValueError
        If the requested one is unknown, or none fits.
    """
    what = f"the name of {accepted}; the file has {listed}"
    if requested is not None:
        require("variable", requested, requested in names, what)
        return requested
    if len(fitting) > 1:
        raise _which_variable(sorted(fitting, key=lambda name: not fitting[name]), listed)
    require("variable", None, len(fitting) == 1, f"as variable {what}; {TRUTH_HINT}")
    return next(iter(fitting))


def reading_options() -> dict[str, Option]:
    """Return the option of each field of `ReadOptions`."""
    return {each.name: each.metadata["option"] for each in fields(ReadOptions)}


def add_read_options(parser: Any) -> None:
    """Add an option for each field of `ReadOptions` to a parser of `argparse`."""
    group = parser.add_argument_group("reading the file; what is not given is guessed")
    for name, option in reading_options().items():
        parts = option.kind.metavars
        # One string for each option: `read_options_from` parses them as a form does.
        several = {"nargs": len(parts), "metavar": parts} if parts else {}
        given = {"choices": option.kind.choices or None, "help": option.help}
        group.add_argument(f"--{option.flag}", dest=name, **given, **several)


def read_options_from(chosen: Any) -> ReadOptions:
    """Return the options that `argparse` has parsed.

    Raises
    ------
    ValueError
        If a text cannot be parsed, or a value is out of its range.
    """
    given = {name: getattr(chosen, name) or "" for name in reading_options()}
    return ReadOptions.from_text(
        {name: each if isinstance(each, str) else " ".join(each) for name, each in given.items()}
    )


def with_flags(message: str, *others: str) -> str:
    """Return a message with the options of the command line instead of the arguments' names.

    One that was not given is called missing: nobody has written its value, None.

    Parameters
    ----------
    message : str
    others : str
        Names of arguments that are no fields of `ReadOptions`.
    """
    flags = {name: option.flag for name, option in reading_options().items()}
    flags |= {name: name.replace("_", "-") for name in others}
    found = _renamed(message, {name: f"--{flag}" for name, flag in flags.items()})
    found = re.sub(r"(--[\w-]+) = None is not accepted", r"\1 is missing", found)
    return found.replace("give None: ", "leave it out: ")


def with_labels(message: str, others: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return a message with the labels of a form instead of the arguments' names.

    `others` are labels of arguments that are no fields of `ReadOptions`, by their names.
    """
    labels = {name: option.label for name, option in reading_options().items()} | {**others}
    found = _renamed(message, {name: f"“{label}”" for name, label in labels.items()})
    found = found.replace("” = None is not accepted", "” is empty")
    return found.replace("give None: ", "leave it empty: ")


def _renamed(message: str, names: Mapping[str, str]) -> str:
    """Replace the names of arguments, but not those of arrays that a file has.

    One that is a common word is replaced only where a value follows.
    """
    said, mark, listed = message.partition("the file has ")
    for name, other in names.items():
        end = r"\b" if "_" in name else r"(?= = )"
        said = re.sub(rf"\b{name}{end}", other, said)
    return said + mark + listed
