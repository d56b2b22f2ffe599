"""What the files hold that are downloaded: of plots, images, clouds and tables, as shown.

Each function takes what is shown now and returns what writes it later, on a worker.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, BinaryIO

import numpy as np
from bokeh.models import Axis, GlyphRenderer
from numpy.typing import NDArray

from app.model.colors import Look, cloud_of, map_of, shown
from app.model.download_text import NO_POINTS, NOTHING_DRAWN
from app.model.large import Grid
from app.model.state import UNITS, Viewing
from app.model.store import Answer
from app.model.text import Fact
from app.theme import WRONG_COLOR
from app.units import AXIS_TITLES, scale
from core import Acquisition
from core.io import WRITERS, Plane, Product, write_columns
from core.studies import Table, as_csv

Array = NDArray[Any]

Write = Callable[[BinaryIO], None]
"""Writes a file, on a worker."""


# Plots


def plot_file(figure: Any, acquisition: Acquisition | None = None) -> Write:
    """The curves of a Bokeh figure, as CSV; see `drawn`."""
    return partial(write_columns, drawn(figure, acquisition))


def drawn(figure: Any, acquisition: Acquisition | None = None) -> dict[str, Array]:
    """The curves of a Bokeh figure as columns, as far as they are in view.

    The first column is the horizontal axis. Curves over the same places share their lines; those
    over other places follow in lines of their own, NaN in all other columns. A mark, such as an
    upright line, is a 1 at its place. What the legend has hidden is left out.

    Parameters
    ----------
    figure : bokeh.plotting.figure
    acquisition : Acquisition, optional
        Of a figure over bins: its first columns are bins, nanoseconds and metres.

    Raises
    ------
    ValueError
        If no curve is drawn.
    """
    groups: dict[bytes, tuple[Array, dict[str, Array]]] = {}
    low, high = _view(figure.x_range)
    for name, x, y in _curves(figure):
        inside = (x >= low) & (x <= high)
        _, curves = groups.setdefault(x[inside].tobytes(), (x[inside], {}))
        curves[name] = y[inside]
    if not any(x.size for x, _ in groups.values()):
        raise ValueError(NOTHING_DRAWN)
    places = np.concatenate([x for x, _ in groups.values()])
    if acquisition is None:
        columns = {_label(figure.below): places}
    else:
        along = {unit: scale(unit, acquisition) for unit in UNITS}
        columns = {
            AXIS_TITLES[unit]: each.origin + each.step * places.astype(float)
            for unit, each in along.items()
        }
    for name in dict.fromkeys(name for _, curves in groups.values() for name in curves):
        pieces = [
            curves.get(name, np.full(x.size, np.nan, np.float32)) for x, curves in groups.values()
        ]
        columns[name] = np.concatenate(pieces)
    return columns


def _curves(figure: Any) -> Iterator[tuple[str, Array, Array]]:
    """Name with unit, x and y of all that a figure draws and names."""
    labels = {
        renderer.id: item.label
        for legend in figure.legend
        for item in legend.items
        for renderer in item.renderers
    }
    for renderer in figure.renderers:
        if not isinstance(renderer, GlyphRenderer) or not renderer.visible:
            continue
        glyph, kind = renderer.glyph, type(renderer.glyph).__name__
        columns = renderer.data_source.data
        label = labels.get(renderer.id)
        unit = _unit(_label([*figure.left, *figure.right], renderer.y_range_name))
        if kind == "MultiLine":
            names = columns[getattr(label, "field", "title")]
            lines = zip(names, columns["xs"], columns["ys"], strict=True)
            found = [(name, np.asarray(x), np.asarray(y)) for name, x, y in lines]
        else:
            # Beside the legend stand bands and points; other lines only join what has a name.
            name = renderer.name if kind in ("VArea", "Scatter") else ""
            data = {name: np.asarray(x) for name, x in columns.items()}
            found = _shape(kind, getattr(label, "value", name), glyph, data)
        for name, x, y in found:
            is_upright = kind == "Line" and x.size == 2 and x[0] == x[1]
            if name and (is_upright or not unit):  # its height says nothing
                yield name, np.unique(x), np.ones(np.unique(x).size, np.float32)
            elif name:
                yield name if name == unit else f"{name} ({unit})", x, y


def _shape(
    kind: str, name: str, glyph: Any, data: Mapping[str, Array]
) -> list[tuple[str, Array, Array]]:
    """Name, x and y of what a glyph draws."""
    if kind == "Quad" and glyph.top in data:
        return [(name, (data["left"] + data["right"]) / 2, data[glyph.top])]
    if kind == "Quad":
        return [(name, np.concatenate([data["left"], data["right"]]), np.empty(0))]
    if kind in ("VArea", "Segment"):
        x = data[glyph.x if kind == "VArea" else glyph.x0]
        ends = (glyph.y1, glyph.y2) if kind == "VArea" else (glyph.y0, glyph.y1)
        low, high = (data[column] for column in ends)
        return [(f"{name}, lowest", x, low), (f"{name}, highest", x, high)]
    if kind in ("VBar", "Line", "Step", "Scatter"):
        return [(name, data[glyph.x], data[glyph.top if kind == "VBar" else glyph.y])]
    return []


def _label(axes: Sequence[Any], range_name: str = "default") -> str:
    """Label of the first axis of a vertical range; empty where there is none."""
    own = (each for each in axes if isinstance(each, Axis) and each.y_range_name == range_name)
    return next((each.axis_label or "" for each in own), "")


def _unit(label: str) -> str:
    """What an axis counts: what its label has in brackets, or else the label."""
    in_brackets = re.search(r"\((.*)\)$", label)
    return in_brackets[1] if in_brackets else label[:1].lower() + label[1:]


def _view(of: Any) -> tuple[float, float]:
    """Ends of an axis as it is zoomed; everything where the browser has not told yet."""
    ends = [of.start, of.end]
    if any(map(math.isnan, ends)):
        return -math.inf, math.inf
    return min(ends), max(ends)


# Images


def image_files(
    answer: Answer, kind: str, least_confidence: float, figure: Any
) -> dict[str, Write]:
    """An image (row, col) as shown, and the answer behind it.

    Parameters
    ----------
    answer : Answer
    kind : str
        What is shown of it, as `app.model.colors.map_of` takes it.
    least_confidence : float
        Answers below are left out.
    figure : bokeh.plotting.figure
        Where it is drawn; a CSV file holds the pixels in view.
    """
    values, look = map_of(answer, kind, least_confidence)
    name = "range_m" if kind == "Estimate" else kind.lower()
    plane = Plane(values, look.unit if look.unit == "m" else "1", look.legend)
    product = _product(answer, least_confidence, shown={name: plane})
    files = {suffix: partial(WRITERS[f".{suffix}"], product) for suffix in ("npz", "tif")}
    return {"csv": image_file(values, look, figure, answer.grid), **files}


def image_file(values: Array, look: Look, figure: Any, grid: Grid) -> Write:
    """The pixels in view of an image (row, col), one line each, as CSV.

    Rows and columns are those of the file, as on the axes; `grid` tells them.
    """
    places = grid.place(*map(np.arange, values.shape))
    in_view = [
        _in_view(ends, place, grid.step / 2)
        for ends, place in zip((figure.y_range, figure.x_range), places, strict=True)
    ]

    def write(file: BinaryIO) -> None:
        seen = (place[each] for place, each in zip(places, in_view, strict=True))
        row, col = np.meshgrid(*seen, indexing="ij")
        write_columns({"row": row, "col": col, look.legend: values[np.ix_(*in_view)]}, file)

    return write


def _in_view(of: Any, place: Array, half: float) -> NDArray[np.bool_]:
    """Which of an image's rows or columns are at least partly in view."""
    low, high = _view(of)
    return np.asarray((place + half > low) & (place - half < high))


def _product(answer: Answer, least_confidence: float, **more: Any) -> Product:
    """What is shown of an answer, as `core.io.writers` takes it."""
    visible, image = shown(answer, least_confidence), answer.run.image
    range_m = np.where(visible, image.range_m, np.nan)
    more.setdefault("pixel_angle_rad", answer.capture.acquisition.pixel_angle_rad)
    return Product(answer.capture, replace(image, range_m=range_m, valid=visible), **more)


# Clouds


def cloud_files(answer: Answer, kind: str, viewing: Viewing) -> dict[str, Write]:
    """The points of `app.model.colors.cloud_of`, with the colours that they have on screen.

    Raises
    ------
    ValueError
        If there are none.
    """
    if not shown(answer, viewing.least_confidence).any():
        raise ValueError(NO_POINTS)
    prepare = partial(_cloud, answer, kind, viewing)

    def table(file: BinaryIO) -> None:
        product = prepare()
        points = product.points()
        xyz_m = dict(zip(("x_m", "y_m", "z_m"), points.xyz_m.T, strict=True))
        write_columns(xyz_m | product.point_columns(points), file)

    return {
        "ply": lambda file: WRITERS[".ply"](prepare(), file),
        "las": lambda file: WRITERS[".las"](prepare(), file),
        "csv": table,
    }


def _cloud(answer: Answer, kind: str, viewing: Viewing) -> Product:
    """The answers on show, and in the image of their colours those of the points on screen."""
    cloud, rgb, wrong = cloud_of(answer, kind, viewing)
    rgb = rgb.copy()
    if wrong is not None:
        rgb[wrong] = tuple(bytes.fromhex(WRONG_COLOR[1:]))
    image = np.zeros((*answer.capture.shape, 3), np.uint8)
    image[shown(answer, viewing.least_confidence)] = rgb
    angle_rad = float(cloud.field_data["pixel_angle_rad"][0])
    return _product(answer, viewing.least_confidence, pixel_angle_rad=angle_rad, rgb=image)


# Tables


def table_file(item: Table) -> Write:
    """A table with every digit of its numbers, as CSV."""
    return _text(item.columns, item.rows)


def shown_table_file(columns: Sequence[Sequence[Any]], rows: Sequence[Mapping[str, Any]]) -> Write:
    """Columns and rows of an `app.widgets.controls.Table` as they stand there, as CSV.

    A cell's smaller line and a row's note get columns of their own; a percent sign that a whole
    column carries moves into its name.
    """
    (first, *_), *others = columns
    heads, body = [first], [[row["name"]] for row in rows]
    for place, (title, *_) in enumerate(others):
        cells = [row["cells"][place] if row.get("cells") else ("", None, "") for row in rows]
        texts = ["" if cell[0] == "–" else cell[0].replace(",", "") for cell in cells]
        in_percent = all(text.endswith(" %") for text in texts if text) and any(texts)
        heads.append(f"{title} (%)" if in_percent else title)
        for line, text in zip(body, texts, strict=True):
            line.append(text.removesuffix(" %"))
        if any(cell[2] for cell in cells):
            heads.append(f"{title}, more")
            for line, cell in zip(body, cells, strict=True):
                line.append(cell[2])
    notes = [row.get("message") or row.get("note") or "" for row in rows]
    return _text([*heads, "note"], [[*line, note] for line, note in zip(body, notes, strict=True)])


_A_NUMBER = r"([+-]?[\d,.]+(?:e[+-]\d+)?|∞)"
_A_FACT = re.compile(
    rf"{_A_NUMBER}(?: \[{_A_NUMBER}, {_A_NUMBER}\])?(?: (%|[^\W\d]+))?(?: \((.+)\))?"
)


def facts_file(facts: Sequence[Fact]) -> Write:
    """Named values as CSV; what else stands beside a number has columns of its own."""
    rows = []
    for name, text, help in facts:
        parts = _A_FACT.fullmatch(text)
        told = parts.groups("") if parts else ("" if text == "–" else text, *[""] * 4)
        plain = [each.replace("∞", "inf").replace(",", "") for each in told] if parts else told
        rows.append([name, *plain, help])
    return _text(("quantity", "value", "low", "high", "unit", "more", "meaning"), rows)


def _text(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> Write:
    if not rows:
        raise ValueError(NOTHING_DRAWN)
    plain = [
        ["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row]
        for row in rows
    ]

    def write(file: BinaryIO) -> None:
        file.write(as_csv(columns, plain).encode())

    return write
