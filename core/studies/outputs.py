"""What a study shows: curves, pictures and tables, as data."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from core.acquisition import Floats


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves over one axis; `marks` are places on it, `x` and each curve have the same length.

    A curve of which `bands` knows the lowest and the highest is drawn with what lies between.
    """

    key: str
    title: str
    x_label: str
    y_label: str
    x: Floats
    curves: Mapping[str, Floats]
    marks: Mapping[str, float] = field(default_factory=dict)
    note: str = ""
    bands: Mapping[str, tuple[Floats, Floats]] = field(default_factory=dict)
    x_is_log: bool = False


@dataclass(frozen=True, eq=False)
class Scatter:
    """Groups of places on two logarithmic axes, with intervals, some joined by a line.

    Each coordinate has the shape (3, n): value, lowest, highest. `line` names some of the places:
    (n,) each of x, y and text.
    """

    key: str
    title: str
    x_label: str
    y_label: str
    groups: Mapping[str, tuple[Floats, Floats]]
    line: tuple[Floats, Floats, Sequence[str]]
    line_label: str
    note: str = ""


@dataclass(frozen=True, eq=False)
class Pictures:
    """Images (row, col) on one colour scale, NaN where there is nothing."""

    key: str
    title: str
    label: str
    images: Mapping[str, Floats]
    low: float
    high: float
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of numbers and words."""

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    note: str = ""


Item = Plot | Scatter | Pictures | Table


def as_text(value: Any) -> str:
    """A number with four digits that count; a word as it is."""
    if isinstance(value, float):  # numpy's are, too
        return f"{value:.4f}" if 1e-3 <= abs(value) < 1e4 or value == 0 else f"{value:.3g}"
    return str(value)


def as_csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as other software reads it, every digit of its numbers."""
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()


def as_markdown(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A table as a person reads it in a terminal."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(as_text(value) for value in row) + " |" for row in rows]
    return "\n".join(lines)
