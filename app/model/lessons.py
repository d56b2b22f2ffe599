"""Lessons: Markdown files with front matter (TOML between lines of +++), read and checked.

A file names views and checks of `core.studies.lessons`; nothing in it is evaluated. The text below
the front matter introduces the lesson; the text below a line of three dashes explains the result,
and that below a second one, which slides leave out, says where to go on.
"""

from __future__ import annotations

import math
import re
import tomllib
from argparse import ArgumentParser
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from core.checks import require
from core.parameters import Choice, spec_of
from core.studies import outputs
from core.studies.lessons import CHECKS, PLOTS, VIEWS, Bench, arguments_of, require_signal
from core.studies.pulses import Pulses

Item = outputs.Plot | outputs.Pictures | Pulses
"""Content of a view."""

FENCE, RULE = "+++", "\n---\n"
BUILT_IN = Path(str(resources.files("app"))) / "lessons"
PREDICTED = "your prediction"

SPECS = {each.name: spec_of(each) for each in fields(Bench)}
"""Specification of each field that a lesson can set or control."""

SHAPES = {"flat": (1.0, 1.0), "rising": (0.2, 1.8), "falling": (1.8, 0.2)}
"""Predicted curves: their first and last value, over the mean of what is predicted."""


@dataclass(frozen=True)
class Prediction:
    """Prediction made before the result is shown: a shape, or a number on an axis."""

    question: str
    view: str
    """View on which the prediction stays drawn."""
    axis: str = ""
    """``"x"`` or ``"y"`` for a number; empty for one of `SHAPES`."""
    low: float = 0.0
    high: float = 1.0
    unit: str = ""

    def parsed(self, text: str) -> str | float | None:
        """Return a committed prediction; None for an empty text.

        Raises
        ------
        ValueError
            If it is neither empty nor possible.
        """
        if not text:
            return None
        if not self.axis:
            require("prediction", text, text in SHAPES, " or ".join(SHAPES))
            return text
        value = number_of(text, "prediction")
        possible = self.low <= value <= self.high
        require("prediction", text, possible, f"a number from {self.low:g} to {self.high:g}")
        return value

    def drawn(self, plot: outputs.Plot, committed: str | float) -> outputs.Plot:
        """Return a plot with the prediction."""
        if isinstance(committed, str):
            first, last = SHAPES[committed]
            mean = float(np.nanmean(next(iter(plot.curves.values()))))
            curve = mean * np.linspace(first, last, plot.x.size)
        elif self.axis == "x":
            return replace(plot, marks={**plot.marks, PREDICTED: committed})
        else:
            curve = np.full(plot.x.size, committed)
        return replace(plot, curves={**plot.curves, PREDICTED: curve})


@dataclass(frozen=True)
class Hint:
    """Typical wrong answer, computed, and the remark on it."""

    function: str
    arguments: Mapping[str, float]
    text: str


@dataclass(frozen=True)
class Check:
    """A question whose answer `core` computes."""

    question: str
    function: str
    arguments: Mapping[str, float]
    tolerance: float
    """Largest accepted error."""
    bench: Bench
    view: str
    """View from which the answer can be read, in that state."""
    hints: tuple[Hint, ...] = ()

    @property
    def answer(self) -> float:
        """The right answer."""
        return CHECKS[self.function](self.bench, **self.arguments)

    def verdict(self, given: float) -> tuple[bool, str]:
        """Return whether an answer is right, and a sentence about it."""
        right = self.answer
        if abs(given - right) <= self.tolerance:
            return True, f"Right: {right:.3g}."
        for hint in self.hints:
            wrong = CHECKS[hint.function](self.bench, **hint.arguments)
            if abs(given - wrong) <= self.tolerance:
                return False, hint.text
        return False, f"Not yet: the answer is {'larger' if right > given else 'smaller'}."


@dataclass(frozen=True)
class Lesson:
    """One lesson."""

    key: str
    """Name of its file, without the suffix: its name in links."""
    title: str
    bench: Bench
    """Its state; all but `control` is fixed."""
    control: str
    """The field of `bench` that the learner moves."""
    ends: tuple[float, float] | None
    """Ends of that control; None for those of the field, or for a choice."""
    before: tuple[str, ...]
    """Views that are shown before the prediction."""
    after: tuple[str, ...]
    """Views that are shown after it."""
    prediction: Prediction
    check: Check
    introduction: str
    explanation: str
    further: str
    """Where to go on."""

    def moved(self, text: str) -> Bench:
        """Return the state after the control was moved; an empty text stands for not moved.

        Raises
        ------
        ValueError
            If the field does not accept it.
        """
        if not text:
            return self.bench
        spec = SPECS[self.control]
        value: Any = text if isinstance(spec, Choice) else number_of(text, self.control)
        if getattr(spec, "whole", False):
            value = round(value)
        bench = replace(self.bench, **{self.control: value})
        for name in self.after:
            require_signal(name, bench)
        return bench

    def seen(self, name: str, bench: Bench, committed: str | float | None) -> Item:
        """Return a view, with the prediction if it belongs there."""
        if committed is not None and name == self.prediction.view:
            return self.prediction.drawn(PLOTS[name](bench), committed)
        return VIEWS[name](bench)


def number_of(text: str, name: str) -> float:
    """Return a number that a learner typed as `name`, with a decimal point or comma.

    Raises
    ------
    ValueError
        If it is not a finite number.
    """
    typed = text.strip()
    try:
        value = float(typed.replace(",", ".").removesuffix("%"))
    except ValueError:
        value = math.nan
    require(name, text[:40], math.isfinite(value), "a number")
    return value / 100 if typed.endswith("%") else value


# -- Files -----------------------------------------------------------------------------------------


def add_lessons_option(parser: ArgumentParser) -> None:
    """Add the option for the folders of `read_lessons`."""
    parser.add_argument(
        "--lessons",
        action="append",
        default=[],
        type=Path,
        metavar="FOLDER",
        help="add the lessons (*.md) of a folder; may be repeated",
    )


def read_lessons(folders: Sequence[Path] = ()) -> dict[str, Lesson]:
    """Return the built-in lessons and those of folders by key.

    They are in the order of the numbers with which the names of their files begin.

    Raises
    ------
    ValueError
        If a folder does not exist or has no lessons, a lesson is not valid, or two have the same
        file name or title.
    """
    found: dict[str, Lesson] = {}
    for folder in (BUILT_IN, *folders):
        files = sorted(folder.glob("*.md"), key=_place)
        require("--lessons", str(folder), bool(files), "a folder with lessons (*.md)")
        for each in files:
            lesson = read_lesson(each)
            titles = [other.title for other in found.values()]
            unique = "one that no other lesson has"
            require("--lessons: file name", str(each), lesson.key not in found, unique)
            require(f"{each.name}: title", lesson.title, lesson.title not in titles, unique)
            found[lesson.key] = lesson
    return found


def number_of_lesson(key: str) -> int | None:
    """Return the number at the beginning of a lesson's key; None if it has none."""
    number = re.match(r"\d+", key)
    return int(number.group()) if number else None


def _place(path: Path) -> tuple[float, str]:
    """Return the sort key of a file: its number, or infinity without one, then its name."""
    number = number_of_lesson(path.stem)
    return (math.inf if number is None else number), path.name


@cache
def built_in_lessons() -> Mapping[str, Lesson]:
    """Return the built-in lessons."""
    return read_lessons()


def read_lesson(path: Path) -> Lesson:
    """Return the lesson of a file.

    Raises
    ------
    ValueError
        If it is not valid: the message names the file and the entry.
    """
    try:
        return lesson_of(path.stem, path.read_text("utf-8-sig"))  # editors may write a BOM
    except (ValueError, OSError) as error:
        raise ValueError(f"{path.name}: {error}") from error


_ENTRIES = ("title", "before", "after", "state", "control", "prediction", "check")
_CHECK_ENTRIES = ("question", "view", "function", "arguments", "tolerance", "state", "hints")


def lesson_of(key: str, text: str) -> Lesson:
    """Return the lesson that a text holds; raises as `read_lesson`, without the file's name."""
    start, front, body = _split(text)
    require("beginning", start[:20], not start.strip(), f"a line of {FENCE}")
    given = _Table("front matter", tomllib.loads(front), _ENTRIES)
    bench = Bench(**given.table("state", SPECS).values)
    moved = given.table("control", ("name", "from", "to"))
    control = moved.text("name")
    require("control.name", control, control in SPECS, " or ".join(map(repr, SPECS)))
    before, after = (_views(given.texts(name), bench) for name in ("before", "after"))
    prediction = _prediction(
        given.table("prediction", [each.name for each in fields(Prediction)]), after
    )
    check = _check(given.table("check", _CHECK_ENTRIES), bench, after, prediction.view)
    introduction, explanation, further = (*body.split(RULE, 2), "", "")[:3]
    return Lesson(
        key,
        given.text("title"),
        bench,
        control,
        _ends(moved, control),
        before,
        after,
        prediction,
        check,
        introduction.strip(),
        explanation.strip(),
        further.strip(),
    )


def _split(text: str) -> tuple[str, str, str]:
    parts = text.split(f"{FENCE}\n", 2)
    require("front matter", text[:20], len(parts) == 3, f"text between two lines of {FENCE}")
    return parts[0], parts[1], parts[2]


def _views(names: Sequence[str], bench: Bench) -> tuple[str, ...]:
    for name in names:
        require("view", name, name in VIEWS, " or ".join(map(repr, VIEWS)))
        require_signal(name, bench)
    return tuple(names)


def _ends(given: _Table, control: str) -> tuple[float, float] | None:
    if not {"from", "to"} & given.values.keys():
        return None
    spec = SPECS[control]
    if isinstance(spec, Choice):
        raise ValueError(f"control: leave out from and to, since {control!r} is not a number.")
    low, high = given.number("from"), given.number("to")
    accepted = spec.low <= low < high <= spec.high and spec.takes(low) and spec.takes(high)
    noun = "integers" if spec.whole else "numbers"
    what = f"increasing {noun} from {spec.low:g} to {spec.high:g}"
    require("control: from, to", (low, high), accepted, what)
    return low, high


def _prediction(given: _Table, after: Sequence[str]) -> Prediction:
    found = Prediction(
        given.text("question"),
        given.text("view"),
        given.text("axis", ""),
        given.number("low", 0.0),
        given.number("high", 1.0),
        given.text("unit", ""),
    )
    plots = [name for name in after if name in PLOTS]
    require("prediction.view", found.view, found.view in plots, f"a plot of after, {plots}")
    require("prediction.axis", found.axis, found.axis in ("", "x", "y"), "'x', 'y' or nothing")
    ends = found.low, found.high
    require("prediction: low, high", ends, found.low < found.high, "increasing numbers")
    return found


def _check(given: _Table, bench: Bench, after: Sequence[str], view: str) -> Check:
    """Return the check; `view` is that of the prediction, from which most answers can be read."""
    at = replace(bench, **given.table("state", SPECS, {}).values)
    view = given.text("view", view)
    require("check.view", view, view in after, f"a view of after, {[*after]}")
    require_signal(view, at)
    tolerance = given.number("tolerance")
    require("check.tolerance", tolerance, tolerance > 0, "a number above 0")
    hints = [
        Hint(*_function(each, at), each.text("text"))
        for each in given.tables("hints", ("function", "arguments", "text"))
    ]
    return Check(given.text("question"), *_function(given, at), tolerance, at, view, tuple(hints))


def _function(given: _Table, bench: Bench) -> tuple[str, Mapping[str, float]]:
    """Return the name of a check and its arguments, all of which are required."""
    name = given.text("function")
    expected = arguments_of(name)
    require_signal(name, bench)
    arguments = given.table("arguments", expected, {})
    return name, {each: arguments.number(each) for each in expected}


_KINDS: dict[type, str] = {str: "text", dict: "a table", list: "a list", float: "a finite number"}


@dataclass(frozen=True)
class _Table:
    """A table of the front matter, whose entries are checked as they are read."""

    name: str
    values: dict[str, Any]
    known: Collection[str]
    """Names that its entries may have."""

    def __post_init__(self) -> None:
        require(self.name, self.values, isinstance(self.values, dict), _KINDS[dict])
        what = " or ".join(map(repr, self.known)) or "none"
        for name in self.values:
            require(f"entry of {self.name}", name, name in self.known, what)

    def _get(self, name: str, kind: type, default: Any = None) -> Any:
        value = self.values.get(name, default)
        if value is None:
            raise ValueError(f"{self.name}: {name} is missing")
        if kind is float:
            accepted = type(value) in (int, float) and math.isfinite(value)
        else:
            accepted = isinstance(value, kind)
        require(f"{self.name}: {name}", value, accepted, _KINDS[kind])
        return value

    def text(self, name: str, default: str | None = None) -> str:
        return str(self._get(name, str, default))

    def number(self, name: str, default: float | None = None) -> float:
        value: float = self._get(name, float, default)
        return value

    def texts(self, name: str) -> list[str]:
        return list(map(str, self._get(name, list)))

    def table(
        self, name: str, known: Collection[str], default: dict[str, Any] | None = None
    ) -> _Table:
        return _Table(name, self._get(name, dict, default), known)

    def tables(self, name: str, known: Collection[str]) -> list[_Table]:
        return [_Table(name, each, known) for each in self._get(name, list, [])]
