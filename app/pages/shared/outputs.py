"""Cards that show the outputs of a study: curves, pictures and tables."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np
import panel as pn
import panel_material_ui as pmui
from bokeh.events import Tap
from bokeh.models import Range1d

from app.model.download_text import NOTHING_DRAWN
from app.model.exports import Curve, band, image_file, table_file
from app.model.large import Grid
from app.model.methods import METHOD_TITLES, PARAMETER_SYMBOLS
from app.model.text import NOT_COMPUTED, number
from app.pages.paper.text import (
    COLUMN_HELP,
    OUTSIDE_NOTE,
    PLACE_HELP,
    RECONSTRUCTION,
    TITLES_OF_PRESETS,
)
from app.pages.session import Session
from app.pages.shared.downloads import PLOT, TABLE, Shown, Subject, downloadable, shown_with
from app.plots import elements as plots
from app.theme import LIGHT, RANGE_COLORS, Palette
from app.widgets.cards import card
from app.widgets.controls import Knob, Sentence, Table
from app.widgets.figures import (
    Layers,
    around,
    enlarge,
    paint_frame,
    pane_of,
    proportioned,
    round_up,
)
from app.widgets.image_view import CONTAINER, JOINED_BORDER_PX
from app.widgets.method_picture import ScaleBar
from core.io import ColorScale
from core.metrics import Interval
from core.parameters import Number
from core.studies import outputs as items
from core.typesetting import typeset

Item = TypeVar("Item")

# Panel uses a figure's default width, 600 px, as the minimum width of its containers.
FREE = ":host { min-width: 0 !important; }"
GRID = """
:host { display: grid !important; gap: 8px; width: 100%; min-width: 0 !important;
  grid-template-columns: repeat(auto-fit, minmax(230px, 1fr)); }
.scroll-button { display: none !important; }
"""
PICTURE_HEIGHT = 300
BORDER_PX = {**JOINED_BORDER_PX, "top": 26}
"""Room around a picture of a gallery, with its title."""

FILLED = ":host { display: flex !important; flex-direction: column; height: 100% !important; }"
FILLING = ":host { flex: 1 1 0 !important; min-height: 0; grid-template-rows: 100%; }"
FULL = ":host { height: 100% !important; min-height: 0 !important; }"
LARGE_BORDER_PX = {"left": 4, "right": 4, "top": 40, "bottom": 4}
LARGE_SCALE_PX = 88
"""Room and style where pictures fill their container."""

FORMATS = {"SBR": "g", "ms": ".1f"}
"""Formats of columns whose numbers need no four decimals."""


class CurveCard:
    """Curves with a note below them; further curves of the same names only replace values.

    Parameters
    ----------
    across : Range1d, optional
        A horizontal axis shared by several plots.
    waiting : str
        Text to show before the first curves.
    """

    def __init__(self, across: Range1d | None = None, waiting: str = "") -> None:
        self._across = across
        self._note = Sentence(text=waiting, sizing_mode="stretch_width", margin=(2, 10, 6, 10))
        self._plot: Layers | None = None
        self._item: items.Plot | None = None
        self._is_cleared = False
        self._colors = LIGHT
        self.card = card(self._note)

    @property
    def figure(self) -> Any:
        """The figure; None before the first curves."""
        return self._plot and self._plot.figure

    @property
    def figures(self) -> list[Any]:
        """The figure, once there are curves."""
        return [] if self._plot is None else [self._plot.figure]

    def offer(self, session: Session, subject: Callable[[], Subject]) -> None:
        """Add a download button, shown with the first curves."""

        def show() -> Shown:
            item = _required(None if self._is_cleared else self._item)
            plot = _required(self._plot)
            return Shown(subject(), item.key, {"csv": plot.csv()})

        downloadable(self.card, session, "curves", show, PLOT)[-1].visible = self._plot is not None

    def show(self, item: items.Plot) -> None:
        """Show curves in place of the last ones."""
        if self._plot is None or self._item is None or _names(item) != _names(self._item):
            self._plot = self._built(item)
        self._item, self._is_cleared = item, False
        self._plot.keep(item.x_label, curves_of(item))
        figure = self._plot.figure
        low, high = (
            round_up(1.1 * max(float(np.nanmax(sign * curve, initial=0.0)) for curve in curves))
            for sign, curves in ((-1, item.curves.values()), (1, item.curves.values()))
        )
        if (-low, high) != (figure.y_range.start, figure.y_range.end):
            figure.y_range.update(start=-low, end=high, reset_start=-low, reset_end=high)
        for name, values in item.curves.items():
            self._plot.write(name, **{"x": item.x, "top" if name == plots.BARS else "y": values})
            self._plot.show(name, True)
        for name, (below, above) in item.bands.items():
            self._plot.write(f"{name} band", x=item.x, y1=below, y2=above)
            self._plot.show(f"{name} band", True)
        for name, place in item.marks.items():
            x, y = plots.marker_line(place, high, -low)
            self._plot.write(name, x=x, y=y)
            self._plot.show(name, math.isfinite(place))
        figure.title.text, self._note.text = item.title, item.note

    def clear(self, why: str) -> None:
        """Hide the curves, which are outdated, and state why below the empty axes."""
        self._is_cleared, self._note.text = True, why
        if self._plot is not None:
            for name in self._plot.layers:
                self._plot.show(name, False)

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        self._colors = colors
        if self._plot is None or self._item is None:
            return
        paint_frame(self._plot.figure, colors)
        for name, (color, dash) in plots.curve_styles(self._item, colors).items():
            glyph = self._plot.layers[name]["glyph"]
            if name == plots.BARS:
                glyph.update(fill_color=color, line_color=color)
            else:
                glyph.update(line_color=color, line_dash=dash)
            if name in self._item.bands:
                self._plot.layers[f"{name} band"]["glyph"].fill_color = color

    def _built(self, item: items.Plot) -> Layers:
        drawing = plots.curves(item, self._colors)
        if self._across is not None:
            drawing.x_range = self._across
        drawing.y_range = Range1d(0, 1)
        drawing.min_border_left = 68
        paint_frame(drawing, self._colors)
        pane = pane_of(drawing)
        if self._plot is None:
            self.card.insert(0, pane)
            self.card[-1].visible = True
        else:
            self.card[0] = pane
        return layers_of(drawing)


def _names(item: items.Plot) -> list[str]:
    """Return the names of a plot's layers."""
    return [*item.curves, *item.marks]


def curves_of(item: items.Plot) -> list[Curve]:
    """Return bands, curves and marks of a study's plot, for a download."""
    bands = [
        limit
        for name, limits in item.bands.items()
        for limit in band(f"{name} band", spelled(name), item.x, *limits, item.y_label)
    ]
    curves = [
        Curve(name, spelled(name), item.x, values, item.y_label)
        for name, values in item.curves.items()
    ]
    return bands + curves + [Curve(name, spelled(name), at) for name, at in item.marks.items()]


class TableCard:
    """A table with its title above and its note below."""

    def __init__(self, waiting: str = NOT_COMPUTED) -> None:
        self._title = pmui.Typography(waiting, variant="subtitle2", margin=(6, 8))
        self._table = Table(sizing_mode="stretch_width", margin=0)
        self._note = Sentence(sizing_mode="stretch_width", margin=(6, 8, 12, 8))
        self._item: items.Table | None = None
        self.layout = pn.Column(
            self._title, self._table, self._note, sizing_mode="stretch_width", margin=0
        )

    def offer(self, session: Session, subject: Callable[[], Subject]) -> None:
        """Add a download button, shown with the table."""

        def show() -> Shown:
            item = _required(self._item)
            return Shown(subject(), item.key, {"csv": table_file(item)})

        shown_with(downloadable(self.layout, session, "table", show, TABLE), self._table, "columns")

    def show(self, item: items.Table) -> None:
        """Show a table in place of the last one."""
        self._item = item
        columns, rows = table_of(item)
        self._table.param.update(title=item.title, columns=columns, rows=rows)
        self._title.object, self._note.text = f"**{item.title}**", item.note


class Gallery:
    """Pictures on one colour scale; a tap, or row and column, compare one pixel in all of them.

    Parameters
    ----------
    is_large : bool
        Whether they fill their container, without axes, under titles legible across a room.
    """

    def __init__(self, is_large: bool = False) -> None:
        self._is_large = is_large
        self._border_px = LARGE_BORDER_PX if is_large else BORDER_PX
        self._drawn: list[Layers] = []
        self._item: items.Pictures | None = None
        self._colors = LIGHT
        self._framed: Callable[[Any, str], Any] = lambda pane, _: pane
        styles = [GRID, FILLING] if is_large else [GRID]
        self._grid = pn.Column(stylesheets=styles, sizing_mode="stretch_width", margin=0)
        self.place = [
            Knob.of(Number(symbol, 0, 63, whole=True), 32, PLACE_HELP)
            for symbol in ("Row", "Column")
        ]
        for knob in self.place:
            knob.param.watch(lambda _: self._mark(), "value")
        self._scale = ScaleBar()
        self._scale.figure.visible = False
        size = {"fontSize": "var(--type-size)"} if is_large else None
        self._title = pmui.Typography("", variant="subtitle2", sx=size, margin=(6, 0))
        self._note = Sentence(text=NOT_COMPUTED, sizing_mode="stretch_width", margin=(4, 0))
        self.layout = pn.Column(
            self._title,
            self._grid,
            self._scale.pane,
            self._note,
            stylesheets=[FREE, FILLED] if is_large else [FREE],
            sizing_mode="stretch_width",
            margin=0,
        )
        if is_large:
            self._framed = lambda pane, _: self._held(pane)
            self._scale.figure.height = LARGE_SCALE_PX
            enlarge(self._scale.figure)

    def offer(self, session: Session, subject: Callable[[], Subject]) -> None:
        """Add a download button to each picture."""
        self._framed = partial(self._with_button, session, subject)

    def _with_button(
        self, session: Session, subject: Callable[[], Subject], pane: Any, name: str
    ) -> pn.Column:
        def show() -> Shown:
            item = _required(self._item)
            look = _look(item)
            files = {"csv": image_file(item.images[name], look, pane.object, Grid())}
            return Shown(subject(), f"{item.key} {name}", files, scale=look)

        return downloadable(self._held(pane), session, spelled(name), show, PLOT)

    def _held(self, pane: Any) -> pn.Column:
        return pn.Column(
            pane,
            stylesheets=[CONTAINER, FREE, *([FULL] if self._is_large else [])],
            sizing_mode="stretch_width",
            height=None if self._is_large else PICTURE_HEIGHT,
            margin=0,
        )

    @property
    def figures(self) -> list[Any]:
        """The figures, in the order of the pictures."""
        return [each.figure for each in self._drawn]

    def show(self, item: items.Pictures) -> None:
        """Show pictures of one size in place of the last ones."""
        before, self._item = self._item, None  # no mark before all pictures are drawn
        shape = next(iter(item.images.values())).shape
        for knob, size in zip(self.place, shape, strict=True):
            knob.param.update(high=size - 1, initial=size // 2, value=min(knob.value, size - 1))
        if before is None or _frame(before) != _frame(item):
            self._build(item)
        for drawn, image in zip(self._drawn, item.images.values(), strict=True):
            drawn.source("picture").data["image"] = [image.astype(np.float32)]
        self._item = item
        self._mark()
        self._scale.update(_look(item))
        self._scale.figure.visible, self._note.text = True, f"{item.note} {OUTSIDE_NOTE}"
        self._title.object = f"**{item.title}**"

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        self._colors = colors
        self._scale.paint(colors)
        for drawing in self.figures:
            paint_frame(drawing, colors)

    def _build(self, item: items.Pictures) -> None:
        self._drawn = [layers_of(drawing) for drawing in plots.pictures(item)]
        panes = [pane_of(drawing) for drawing in self.figures]
        rows, cols = next(iter(item.images.values())).shape
        for drawing in self.figures:
            drawing.update(**{f"min_border_{side}": px for side, px in self._border_px.items()})
            drawing.stylesheets = [proportioned(cols / rows, *around(self._border_px))]
            drawing.axis.visible = not self._is_large
            paint_frame(drawing, self._colors)
            drawing.on_event(Tap, self._tapped)
        self._grid.objects = [
            self._framed(pane, name) for pane, name in zip(panes, item.images, strict=True)
        ]

    def _tapped(self, event: Tap) -> None:
        for knob, at in zip(self.place, (event.y, event.x), strict=True):
            knob.value = min(max(math.floor(at + 0.5), 0), knob.high)

    def _mark(self) -> None:
        """Frame the pixel in all pictures, and write its range into their titles."""
        if self._item is None:
            return
        row, col = (int(knob.value) for knob in self.place)
        sides = dict(
            zip(("left", "bottom", "right", "top"), plots.pixel_frame(row, col), strict=True)
        )
        for drawn, (name, image) in zip(self._drawn, self._item.images.items(), strict=True):
            range_m = float(image[row, col])
            text = "no target" if math.isnan(range_m) else number(range_m, "m")
            for layer in ("shadow", "frame"):
                drawn.write(layer, **{side: [at] for side, at in sides.items()})
            title = spelled(name)
            drawn.figure.title.text = title if self._is_large else f"{title}: {text}"


def _required(item: Item | None) -> Item:
    if item is None:
        raise ValueError(NOTHING_DRAWN)
    return item


def layers_of(drawing: Any) -> Layers:
    """Return the named renderers of a Bokeh figure as layers."""
    found = {
        each.name: {"source": each.data_source, "glyph": each.glyph, "glyph_renderer": each}
        for each in drawing.renderers
    }
    return Layers(drawing, found)


def _look(item: items.Pictures) -> ColorScale:
    """Return the colour scale of all pictures."""
    return ColorScale(item.label, "", item.low, item.high, RANGE_COLORS)


def _frame(item: items.Pictures) -> tuple[Any, ...]:
    """Return what requires new figures when it changes."""
    return item.low, item.high, [image.shape for image in item.images.values()]


def spelled(name: str) -> str:
    """Return a key as text, with spaces."""
    return name.replace("_", " ")


def table_of(item: items.Table) -> tuple[list[Any], list[dict[str, Any]]]:
    """Return columns and rows for `app.widgets.controls.Table`.

    The limits of an interval become a smaller line below its value, "kind" one below the name, and
    a difference from a printed value is also classified. Empty columns are left out.
    """
    names = item.columns
    shown = [
        place
        for place, name in enumerate(names)
        if name != "kind" and any(row[place] != "" for row in item.rows)
    ]
    if "method" in names:  # it names the row, in whichever column
        shown.sort(key=lambda place: names[place] != "method")
    first, *others = shown
    columns = [[names[place], *COLUMN_HELP.get(names[place], ("", 1))] for place in shown]
    rows = [
        {
            "name": _name(row[first]),
            "note": RECONSTRUCTION if "reconstruction" in row else "",
            "cells": [_cell(names, row, place) for place in others],
        }
        for row in item.rows
    ]
    return columns, rows


def _cell(names: tuple[str, ...], row: tuple[Any, ...], place: int) -> list[Any]:
    """Return text, value to sort by, and the smaller second line."""
    value = row[place]
    if names[place] == "parameter":
        method = row[names.index("method")]
        return [PARAMETER_SYMBOLS[method, value], value, ""]
    if isinstance(value, str):
        return [_name(value), value or None, ""]
    if names[place] in FORMATS:
        return [format(value, FORMATS[names[place]]), value, ""]
    below = ""
    if names[place] == "difference":
        found, printed = row[place - 2 : place]
        larger_is_better = names[place - 2].startswith("RD")
        is_chance = found.low <= printed <= found.high
        is_better = (value > 0) == larger_is_better
        below = "within chance" if is_chance else "better" if is_better else "worse"
        return [typeset(f"{value:+.4f}"), value, below]
    if isinstance(value, Interval):
        below = f"{typeset(items.as_text(value.low))} to {typeset(items.as_text(value.high))}"
        value = value.value
    known = not math.isnan(value)
    return [typeset(items.as_text(value)) if known else "–", value if known else None, below]


def _name(text: Any) -> str:
    return (METHOD_TITLES | TITLES_OF_PRESETS).get(text, spelled(str(text)))
