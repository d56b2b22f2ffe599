"""Results of a study as data: plots, scatter plots, images and tables, and their text forms."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np

from core.acquisition import Floats
from core.metrics import Interval


@dataclass(frozen=True, eq=False)
class Plot:
    """Curves over one axis; `x` and each curve have the same length.

    `marks` are named positions on the axis. `bands` holds the lower and upper limit of a curve.
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
    """Groups of points with intervals on two logarithmic axes, and a line through some of them.

    Each coordinate has the shape (3, n): value, low, high. `line` holds x, y and a label of each of
    its points, (n,) each.
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
    """Images (row, col) on one colour scale; NaN is blank."""

    key: str
    title: str
    label: str
    images: Mapping[str, Floats]
    low: float
    high: float
    note: str = ""


@dataclass(frozen=True)
class Table:
    """Rows of numbers, intervals and text; `formats` holds format specifications of columns."""

    key: str
    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    note: str = ""
    formats: Mapping[str, str] = field(default_factory=dict)


Item = Plot | Scatter | Pictures | Table


def table(
    key: str,
    title: str,
    records: Iterable[Any],
    columns: Mapping[str, Callable[[Any], Any]],
    note: str = "",
    formats: Mapping[str, str] | None = None,
) -> Table:
    """Return a table with one row per record; each column is a function of the record."""
    rows = tuple(tuple(cell(record) for cell in columns.values()) for record in records)
    return Table(key, title, tuple(columns), rows, note, formats or {})


def as_text(value: Any, form: str = "") -> str:
    """Format a number, by default with four decimals, or an interval as ``value [low, high]``."""
    if isinstance(value, Interval):
        text, low, high = (as_text(each, form) for each in astuple(value))
        return text if math.isnan(value.value) else f"{text} [{low}, {high}]"
    if not isinstance(value, float):  # which includes numpy's
        return str(value)
    if math.isnan(value):
        return "–"
    if form:
        return format(value, form)
    return f"{value:.4f}" if 1e-3 <= abs(value) < 1e4 or value == 0 else f"{value:.3g}"


def as_csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a table as CSV with every digit; an interval takes three columns."""
    rows = list(rows)
    wide = {i for row in rows for i, value in enumerate(row) if isinstance(value, Interval)}
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(
        f"{name}{end}"
        for i, name in enumerate(columns)
        for end in (("", ", low", ", high") if i in wide else ("",))
    )
    for row in rows:
        writer.writerow(
            cell for i, value in enumerate(row) for cell in (_ends(value) if i in wide else [value])
        )
    return text.getvalue()


def without_nan(rows: Iterable[Sequence[Any]]) -> list[list[Any]]:
    """Return the rows of a table for `as_csv` with empty cells in place of NaN."""
    return [
        [None if isinstance(cell, float) and math.isnan(cell) else cell for cell in row]
        for row in rows
    ]


def _ends(value: Any) -> Sequence[Any]:
    return astuple(value) if isinstance(value, Interval) else (value, "", "")


def as_markdown(
    columns: Sequence[str],
    rows: Iterable[Sequence[Any]],
    formats: Mapping[str, str] | None = None,
) -> str:
    """Return a table as Markdown, with rounded numbers."""
    forms = [(formats or {}).get(name, "") for name in columns]
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(map(as_text, row, forms)) + " |" for row in rows]
    return "\n".join(lines)


def columns_and_rows(item: Item) -> tuple[Sequence[str], Iterator[Sequence[Any]]]:
    """Return the numbers of an item as a table."""
    if isinstance(item, Table):
        return item.columns, iter(item.rows)
    if isinstance(item, Plot):
        curves = dict(item.curves)
        for name, (low, high) in item.bands.items():
            curves |= {f"{name}, low": low, f"{name}, high": high}
        return (item.x_label, *curves), zip(item.x, *curves.values(), strict=True)
    if isinstance(item, Scatter):
        points = (
            (name, Interval(*at_x), Interval(*at_y))
            for name, (x, y) in item.groups.items()
            for at_x, at_y in zip(x.T, y.T, strict=True)
        )
        return ("group", item.x_label, item.y_label), points
    pixels = (
        (name, row, col, value)
        for name, image in item.images.items()
        for (row, col), value in np.ndenumerate(image)
    )
    return ("image", "row", "col", item.label), pixels
