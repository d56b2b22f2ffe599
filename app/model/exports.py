"""Files for download: plots, images, point clouds and tables as they are on screen.

Each function takes what is shown now, and returns a function that writes the file on a thread.
Numbers come from arrays and from `app.units.Quantity`, never from text.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from app.model.budget import fits
from app.model.colors import cloud_of, map_of, shown, shown_image
from app.model.download_text import NO_INTERVALS, NO_POINTS, NO_POINTS_INSIDE, NOTHING_DRAWN
from app.model.large import Grid
from app.model.script import script_of
from app.model.state import FIT, UNITS, State, Viewing
from app.model.store import Answer
from app.model.text import Fact
from app.theme import WRONG_COLOR
from app.units import Quantity, ShownGate, scale
from core.cost import predicted_interval_time
from core.geometry import WHOLE, Box, pixel_angle_of
from core.inference import range_intervals
from core.io import (
    P_VALUE,
    WRITERS,
    ColorScale,
    Picture,
    Plane,
    Product,
    decimals_of,
    guessed_angle,
    write_columns,
    write_points,
)
from core.report import write_report
from core.studies import Table, as_csv, without_nan

Array = NDArray[Any]
Floats = NDArray[np.float64]

Write = Callable[[BinaryIO], None]
"""Writes a file; runs on a thread."""


# Plots


@dataclass(frozen=True, eq=False)
class Curve:
    """A curve or marks of a plot, as the values that the plot was made from.

    Parameters
    ----------
    layer : str
        Layer of the plot that draws it.
    name : str
    x : array_like, shape (n,)
        Positions on the horizontal axis; along a gate, in bins.
    y : array_like, shape (n,), optional
        Omitted for marks, which are positions only.
    unit : str
        Unit or quantity of `y`; may be empty or equal to the name.
    """

    layer: str
    name: str
    x: ArrayLike
    y: ArrayLike | None = None
    unit: str = ""

    @property
    def heading(self) -> str:
        """Name and unit."""
        return self.name if self.unit in ("", self.name) else f"{self.name} ({self.unit})"

    def within(self, low: float, high: float) -> tuple[Floats, Floats]:
        """Return x and y, (n,) each, between two positions; the y of a mark is 1."""
        x = np.atleast_1d(np.asarray(self.x, float))
        y = np.ones(x.size) if self.y is None else np.asarray(self.y, float)
        inside = (x >= low) & (x <= high)
        return x[inside], y[inside]


def band(
    layer: str, name: str, x: ArrayLike, low: ArrayLike, high: ArrayLike, unit: str
) -> list[Curve]:
    """Return the limits (n,) of a curve as two curves."""
    limits = (("lowest", low), ("highest", high))
    return [Curve(layer, f"{name}, {end}", x, y, unit) for end, y in limits]


def plot_file(curves: Sequence[Curve], along: ShownGate | str, x_range: Any) -> Write:
    """Return curves as CSV, as far as they are in view.

    The first column is the horizontal axis. Curves over the same positions share rows; others have
    rows of their own, NaN in all other columns.

    Parameters
    ----------
    curves : sequence of Curve
    along : ShownGate or str
        Label of the horizontal axis, or for curves over bins their gate: the first columns are then
        bins of the whole gate, nanoseconds and metres.
    x_range : bokeh.models.Range1d
        The horizontal axis as it is zoomed.

    Raises
    ------
    ValueError
        If no curve is in view.
    """
    groups: dict[bytes, tuple[Floats, dict[str, Floats]]] = {}
    view = _view(x_range)
    for curve in curves:
        x, y = curve.within(*view)
        groups.setdefault(x.tobytes(), (x, {}))[1][curve.heading] = y
    if not any(x.size for x, _ in groups.values()):
        raise ValueError(NOTHING_DRAWN)
    columns = _axis(np.concatenate([x for x, _ in groups.values()]), along)
    for name in dict.fromkeys(curve.heading for curve in curves):
        columns[name] = np.concatenate(
            [values.get(name, np.full(x.size, np.nan)) for x, values in groups.values()]
        )
    return partial(write_columns, columns)


def _axis(x: Floats, along: ShownGate | str) -> dict[str, Floats]:
    """Return the columns of the horizontal axis."""
    if isinstance(along, str):
        return {along: x}
    scales = (scale(unit, along) for unit in UNITS)
    return {each.title: each.origin + each.step * x for each in scales}


def _view(axis_range: Any) -> tuple[float, float]:
    """Return the visible ends of an axis; infinite until the browser has reported them."""
    ends = [axis_range.start, axis_range.end]
    if any(map(math.isnan, ends)):
        return -math.inf, math.inf
    return min(ends), max(ends)


# Images

ARRAYS = ("npz", "tif")
"""Formats that hold the arrays of an estimate."""


def image_files(
    answer: Answer,
    kind: str,
    viewing: Viewing,
    figure: Any,
    look: ColorScale | None = None,
    title: str = "",
) -> dict[str, Write]:
    """Return an image (row, col) as shown, with the estimate that it belongs to.

    Arrays and pages include the 68 and 95 % intervals of the ranges, a table those of an estimate.
    Pictures are those that `core.save_image` makes of the pixels in view, in the light mode.

    Parameters
    ----------
    answer : Answer
    kind : str
        As for `app.model.colors.map_of`.
    viewing : Viewing
        Estimates below its confidence are left out.
    figure : bokeh.plotting.figure
        Plot of the image; pictures and a CSV file hold the pixels in view.
    look : ColorScale, optional
        Colours, by default those of the image.
    title : str
        Title of a picture, by default that of its colours.
    """
    values, own = map_of(answer, kind, viewing)
    look = look or own
    name = {"Estimate": "range_m", FIT: P_VALUE}.get(kind, kind.lower())
    unit = {"m": "m", "m/s": "m s-1"}.get(look.unit, "1")
    plane = Plane(values, unit, look.legend)
    product = _product(answer, viewing.least_confidence, shown={name: plane})
    rows, cols = in_view(figure, answer.grid, values.shape)
    picture = Picture(
        values[rows, cols],
        look,
        title,
        product.lines,
        viewing.least_confidence if kind in ("Estimate", "Error") else None,
        first=answer.grid.place(rows.start, cols.start),
        step=answer.grid.step,
    )
    prepare = partial(_with_intervals, answer, product)
    listed = prepare if kind == "Estimate" else lambda: product
    return {
        "csv": image_file(values, look, figure, answer.grid, listed),
        **_written_by(prepare, ARRAYS),
        **{suffix: partial(picture.write, suffix=suffix) for suffix in ("png", "svg")},
    }


def _with_intervals(answer: Answer, product: Product) -> Product:
    """Add the intervals of the ranges, or the remark that they would take too long."""
    n_pixels = int(product.image.valid.sum())
    is_moving = product.image.velocity is not None
    if fits(predicted_interval_time(n_pixels, answer.capture.echo_bins, is_moving)):
        inner, outer = range_intervals(answer.capture, product.image, (0.68, 0.95))
        return replace(product, interval_68=inner, interval=outer)
    return replace(product, remark="; ".join(filter(None, (product.remark, NO_INTERVALS))))


def _written_by(prepare: Callable[[], Product], suffixes: Sequence[str]) -> dict[str, Write]:
    """Return the files that `core.io.writers` makes of a product, which is prepared on a thread."""

    def write(suffix: str, file: BinaryIO) -> None:
        WRITERS[f".{suffix}"](prepare(), file)

    return {suffix: partial(write, suffix) for suffix in suffixes}


def in_view(figure: Any, grid: Grid, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of an image that are at least partly in view of its plot."""
    found = []
    for ends, place in zip(
        (figure.y_range, figure.x_range), grid.place(*map(np.arange, shape)), strict=True
    ):
        seen = np.flatnonzero(_in_view(ends, place, grid.step / 2))
        if not seen.size:
            raise ValueError(NOTHING_DRAWN)
        found.append(slice(int(seen[0]), int(seen[-1]) + 1))
    rows, cols = found
    return rows, cols


def image_file(
    values: Array,
    look: ColorScale,
    figure: Any,
    grid: Grid,
    prepare: Callable[[], Product] | None = None,
) -> Write:
    """Return the pixels in view of an image (row, col), one line each, as CSV.

    Rows and columns are those of the file, as on the axes.

    Parameters
    ----------
    values, look, figure, grid
        Image, its colours, its plot, and the place of its pixels in the file.
    prepare : callable, optional
        Returns the estimate to which an image in metres belongs. It determines the decimals, and
        its intervals, if it has any, are added.
    """
    rows, cols = in_view(figure, grid, values.shape)

    def write(file: BinaryIO) -> None:
        place = grid.place(*(np.arange(each.start, each.stop) for each in (rows, cols)))
        row, col = np.meshgrid(*place, indexing="ij")
        columns, decimals = {"row": row, "col": col, look.legend: values[rows, cols]}, {}
        if prepare is not None and look.unit == "m":
            product = prepare()
            limits = {name: each[rows, cols] for name, each in product.interval_columns.items()}
            places = decimals_of(product.range_step_m[rows, cols])
            columns, decimals = columns | limits, dict.fromkeys((look.legend, *limits), places)
        write_columns(columns, file, decimals=decimals)

    return write


def _in_view(axis_range: Any, place: Array, half: float) -> NDArray[np.bool_]:
    """Return which rows or columns are at least partly in view."""
    low, high = _view(axis_range)
    return np.asarray((place + half > low) & (place - half < high))


def _product(answer: Answer, least_confidence: float, box: Box = WHOLE, **more: Any) -> Product:
    """Return the visible pixels of an estimate, for `core.io.writers`."""
    more.setdefault("pixel_angle_rad", answer.capture.acquisition.pixel_angle_rad)
    return Product(answer.capture, shown_image(answer, least_confidence, box), **more)


# Reports


def report_file(answer: Answer, state: State, title: str) -> Write:
    """Return the report on the capture, the estimate and the pixel on screen, as HTML.

    Parameters
    ----------
    answer : Answer
    state : State
        How it is shown.
    title : str
        Title of the report.
    """
    viewing = state.viewing
    chosen_deg = viewing.field_of_view_deg
    chosen_rad = None if chosen_deg is None else pixel_angle_of(chosen_deg, answer.capture.shape[1])
    return partial(
        write_report,
        answer.capture,
        answer.run.image,
        pixel=state.pixel,
        least_confidence=viewing.least_confidence,
        pixel_angle_rad=chosen_rad,  # `core` states whether its own is a guess
        box=state.box,
        colors=viewing,
        title=title,
        script=script_of(answer, state),
    )


# Clouds


def cloud_files(answer: Answer, kind: str, viewing: Viewing, box: Box = WHOLE) -> dict[str, Write]:
    """Return the points of `app.model.colors.cloud_of` in their colours on screen.

    Parameters
    ----------
    answer : Answer
    kind, viewing, box
        As for `cloud_of`. Where the field of view is a guess, the files say so.

    Raises
    ------
    ValueError
        If there are no points.
    """
    if not shown(answer, viewing.least_confidence).any():
        raise ValueError(NO_POINTS)
    if not shown(answer, viewing.least_confidence, box).any():
        raise ValueError(NO_POINTS_INSIDE)
    is_guessed = answer.is_width_guessed(viewing)
    remark = guessed_angle(answer.own_field_of_view_deg) if is_guessed else ""
    prepare = partial(_cloud, answer, kind, viewing, box, remark)

    def table(file: BinaryIO) -> None:
        write_points(prepare(), file)

    return {"csv": table, **_written_by(prepare, ("ply", "las", "laz"))}


def _cloud(answer: Answer, kind: str, viewing: Viewing, box: Box, remark: str) -> Product:
    """Return the pixels inside a box with their intervals and an image of their colours."""
    cloud, rgb, wrong, _ = cloud_of(answer, kind, viewing, box)
    rgb = rgb.copy()
    if wrong is not None:
        rgb[wrong] = tuple(bytes.fromhex(WRONG_COLOR[1:]))
    if answer.run.image.returns is None:
        of_points, rgb = rgb, np.zeros((*answer.capture.shape, 3), np.uint8)
        rgb[shown(answer, viewing.least_confidence, box)] = of_points
    angle_rad = float(cloud.field_data["pixel_angle_rad"][0])
    more = {"pixel_angle_rad": angle_rad, "rgb": rgb, "remark": remark}
    return _with_intervals(answer, _product(answer, viewing.least_confidence, box, **more))


# Tables


def table_file(item: Table) -> Write:
    """Return a table with every digit of its numbers, as CSV."""
    return _csv(item.columns, item.rows)


def shown_table_file(columns: Sequence[Sequence[Any]], rows: Sequence[Mapping[str, Any]]) -> Write:
    """Return the columns and rows of an `app.widgets.controls.Table` as CSV.

    A cell's smaller line and a row's note get columns of their own; the unit that the numbers of a
    column share moves into its name.
    """
    (first, *_), *others = columns
    heads, body = [first], [[row["name"]] for row in rows]
    for n, (title, *_) in enumerate(others):
        cells = [row["cells"][n] if row.get("cells") else ("", None, "") for row in rows]
        texts, values, below = zip(*cells, strict=True)
        unit = next((each.unit for each in texts if isinstance(each, Quantity)), "")
        heads.append(f"{title} ({unit})" if unit and unit not in title else title)
        for line, text, value in zip(body, texts, values, strict=True):
            is_number = isinstance(value, int | float) and not isinstance(text, Quantity)
            line.append(value if is_number else _value(text))
        if any(below):
            heads.append(f"{title}, more")
            for line, more in zip(body, below, strict=True):
                line.append(more)
    notes = [row.get("message") or row.get("note") or "" for row in rows]
    return _csv([*heads, "note"], [[*line, note] for line, note in zip(body, notes, strict=True)])


def facts_file(facts: Sequence[Fact]) -> Write:
    """Return named values as CSV; interval, unit and note of a number have columns of their own."""
    rows = []
    for name, text, help in facts:
        more: Sequence[Any] = [""] * 4
        if isinstance(text, Quantity):
            ends = (text.rounded(end) for end in (text.low, text.high))
            more = [*ends, text.unit, text.note]
        rows.append([name, _value(text), *more, help])
    return _csv(("quantity", "value", "low", "high", "unit", "more", "meaning"), rows)


def _value(text: str) -> Any:
    """Return the number of a text that keeps one, as exact as shown; a dash is an empty cell."""
    return text.rounded(text.value) if isinstance(text, Quantity) else "" if text == "–" else text


def _csv(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> Write:
    if not rows:
        raise ValueError(NOTHING_DRAWN)

    def write(file: BinaryIO) -> None:
        file.write(as_csv(columns, without_nan(rows)).encode())

    return write
