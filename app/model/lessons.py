"""Lessons: Markdown files with front matter (TOML between lines of +++), read and checked.

A file names views and checks of `core.studies.lessons`; nothing in it is evaluated. Below its front
matter stands what is read before the prediction, and, below a line of three dashes, after it.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from core.checks import require
from core.parameters import Choice, spec_of
from core.studies import outputs
from core.studies.lessons import CHECKS, VIEWS, Bench, arguments_of

FENCE, RULE = "+++", "\n---\n"
BUILT_IN = Path(str(resources.files("app"))) / "lessons"
PREDICTED = "your prediction"

SHAPES = {"flat": (1.0, 1.0), "rising": (0.2, 1.8), "falling": (1.8, 0.2)}
"""Predicted curves: their first and last value, over the mean of what is predicted."""


@dataclass(frozen=True)
class Prediction:
    """What the learner commits to before anything is shown: a shape, or a number on an axis."""

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
        value = number_of(text)
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
    """A typical wrong answer, computed, and what to say about it."""

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

    def moved(self, text: str) -> Bench:
        """Return the state after the control was moved; an empty text stands for not moved.

        Raises
        ------
        ValueError
            If the field does not accept it.
        """
        if not text:
            return self.bench
        (field,) = (each for each in fields(self.bench) if each.name == self.control)
        spec = spec_of(field)
        value: Any = text if isinstance(spec, Choice) else number_of(text)
        if getattr(spec, "whole", False):
            value = round(value)
        return replace(self.bench, **{self.control: value})

    def seen(self, name: str, bench: Bench, committed: str | float | None) -> Any:
        """Return a view, with the prediction if it belongs there."""
        view = VIEWS[name](bench)
        if committed is not None and name == self.prediction.view:
            assert isinstance(view, outputs.Plot)
            return self.prediction.drawn(view, committed)
        return view


def number_of(text: str) -> float:
    """Return a number that a learner typed, with a decimal point or comma.

    Raises
    ------
    ValueError
        If it is not a finite number.
    """
    try:
        value = float(text.replace(",", ".").removesuffix("%"))
    except ValueError:
        value = math.nan
    require("answer", text[:40], math.isfinite(value), "a number")
    return value / 100 if text.strip().endswith("%") else value


# -- Files -----------------------------------------------------------------------------------------


def read_lessons(folders: Sequence[Path] = ()) -> dict[str, Lesson]:
    """Return the built-in lessons and those of folders by key, in the order of their file names.

    Raises
    ------
    ValueError
        If a folder does not exist or has no lessons, or a lesson is not valid.
    """
    found: dict[str, Lesson] = {}
    for folder in (BUILT_IN, *folders):
        files = sorted(folder.glob("*.md"))
        require("--lessons", str(folder), bool(files), "a folder with lessons (*.md)")
        found |= {each.stem: read_lesson(each) for each in files}
    return found


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
        return lesson_of(path.stem, path.read_text("utf-8"))
    except (ValueError, TypeError, KeyError, OSError) as error:
        reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"{path.name}: {reason}") from error


def lesson_of(key: str, text: str) -> Lesson:
    """Return the lesson that a text holds; raises as `read_lesson`, without the file's name."""
    start, front, body = _split(text)
    require("beginning", start[:20], not start.strip(), f"a line of {FENCE}")
    given = _Table("front matter", tomllib.loads(front))
    bench = Bench(**given.table("state").values)
    moved = given.table("control")
    control = moved.text("name")
    known = [each.name for each in fields(bench)]
    require("control.name", control, control in known, " or ".join(map(repr, known)))
    views = {name: _views(given.texts(name)) for name in ("before", "after")}
    introduction, _, explanation = body.partition(RULE)
    ends = moved.values.get("from"), moved.values.get("to")
    return Lesson(
        key,
        given.text("title"),
        bench,
        control,
        None if None in ends else (float(ends[0]), float(ends[1])),  # type: ignore[arg-type]
        views["before"],
        views["after"],
        _prediction(given.table("prediction"), views["after"]),
        _check(given.table("check"), bench),
        introduction.strip(),
        explanation.strip(),
    )


def _split(text: str) -> tuple[str, str, str]:
    parts = text.split(f"{FENCE}\n", 2)
    require("front matter", text[:20], len(parts) == 3, f"text between two lines of {FENCE}")
    return parts[0], parts[1], parts[2]


def _views(names: Sequence[str]) -> tuple[str, ...]:
    for name in names:
        require("view", name, name in VIEWS, " or ".join(map(repr, VIEWS)))
    return tuple(names)


def _prediction(given: _Table, after: Sequence[str]) -> Prediction:
    found = Prediction(**given.values)
    require("prediction.view", found.view, found.view in after, f"one of after, {list(after)}")
    require("prediction.axis", found.axis, found.axis in ("", "x", "y"), "'x', 'y' or nothing")
    return found


def _check(given: _Table, bench: Bench) -> Check:
    at = replace(bench, **given.table("state", {}).values)
    hints = [
        Hint(each.text("function"), _arguments(each), each.text("text"))
        for each in given.tables("hints")
    ]
    return Check(
        given.text("question"),
        given.text("function"),
        _arguments(given),
        float(given.values["tolerance"]),
        at,
        tuple(hints),
    )


def _arguments(given: _Table) -> Mapping[str, float]:
    """Return the arguments of a named function, which must be all of its own."""
    expected = arguments_of(given.text("function"))
    values = given.table("arguments", {}).values
    require("arguments", list(values), set(values) == set(expected), f"{expected}")
    return {name: float(value) for name, value in values.items()}


_KINDS: dict[type, str] = {str: "text", dict: "a table", list: "a list"}


@dataclass(frozen=True)
class _Table:
    """A table of the front matter, whose entries are checked as they are read."""

    name: str
    values: dict[str, Any]

    def _get(self, name: str, kind: type, default: Any = None) -> Any:
        value = self.values.get(name, default)
        if value is None:
            raise ValueError(f"{self.name}: {name} is missing")
        require(f"{self.name}: {name}", value, isinstance(value, kind), _KINDS[kind])
        return value

    def text(self, name: str) -> str:
        return str(self._get(name, str))

    def texts(self, name: str) -> list[str]:
        return list(map(str, self._get(name, list)))

    def table(self, name: str, default: dict[str, Any] | None = None) -> _Table:
        return _Table(name, self._get(name, dict, default))

    def tables(self, name: str) -> list[_Table]:
        return [_Table(name, each) for each in self._get(name, list, [])]
