"""Viewers of the Inspect page: the picture to navigate by, and plots along the gate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import SelectionGeometry
from bokeh.models import (
    BasicTicker,
    BoxSelectTool,
    BoxZoomTool,
    ColumnDataSource,
    LassoSelectTool,
    Range1d,
    WheelZoomTool,
)
from numpy.typing import NDArray

from app.pages.shared.outputs import layers_of
from app.plots import elements as plots
from app.plots import inspect as inspector_plots
from app.plots.gate import GateAxes, GateReadOut
from app.theme import Palette
from app.widgets.figures import Layers, cover, paint_frame, pane_of, round_up
from app.widgets.image_view import ImageView
from core import Acquisition

Array = NDArray[Any]
Corners = tuple[tuple[float, float], ...]
"""Of a polygon, as (row, col)."""

ENOUGH_CORNERS = 60
"""Of a region that was drawn by hand: enough for its shape, and short enough for an address."""


class Navigator(ImageView):
    """The picture to navigate by, with a region outlined and pins framed.

    Parameters
    ----------
    tapped : callable
        Called with the row and column of a tapped pixel.
    selected : callable
        Called with the corners of a region that was drawn.

    Attributes
    ----------
    drags : dict of str to bokeh.models.Tool
        What dragging on the picture can do.
    """

    def __init__(
        self, tapped: Callable[[int, int], None], selected: Callable[[Corners], None]
    ) -> None:
        super().__init__(tapped)
        drawing = self.figure
        # Nothing is selected in the picture itself: what was drawn is outlined by a layer.
        by_hand = {
            "Rectangle": BoxSelectTool(renderers=[]),
            "Lasso": LassoSelectTool(renderers=[], continuous=False),
        }
        wheel = WheelZoomTool()
        drawing.add_tools(*by_hand.values(), wheel)
        drawing.toolbar.active_scroll = wheel
        (zoom,) = (tool for tool in drawing.toolbar.tools if isinstance(tool, BoxZoomTool))
        self.drags = {"Zoom": zoom, **by_hand}
        for name, color, width in (("shadow", "#000000", 4), ("line", "#ffd000", 2)):
            drawing.patches(
                "xs",
                "ys",
                source=inspector_plots.empty("xs", "ys"),
                fill_alpha=0,
                line_color=color,
                line_width=width,
                name=f"region {name}",
            )
        drawing.quad(
            "left",
            "right",
            "top",
            "bottom",
            source=inspector_plots.empty("left", "right", "top", "bottom", "color"),
            fill_alpha=0,
            line_color="color",
            line_width=2.5,
            name="pins",
        )
        own = {each.name: each for each in drawing.renderers if each.name}
        self._region = [own["region shadow"].data_source, own["region line"].data_source]
        self._pins = own["pins"].data_source

        def select(event: SelectionGeometry) -> None:
            if event.final:
                drawn = corners_of(event.geometry)
                selected(tuple(_rounded(self._grid.index(*each)) for each in drawn))

        drawing.on_event(SelectionGeometry, select)

    def outline(self, region: Corners) -> None:
        """Draw a region's outline; none if it is empty."""
        places = [self._grid.place(*corner) for corner in region]
        cols, rows = [col for _, col in places], [row for row, _ in places]
        for source in self._region:
            source.data = {"xs": [cols] if region else [], "ys": [rows] if region else []}

    def pin(self, pins: Sequence[tuple[int, int]], colors: Sequence[str]) -> None:
        """Frame pixels, each in its colour."""
        frames = np.array(
            [plots.pixel_frame(*self._grid.place(*pin), self.half_frame) for pin in pins], float
        ).reshape(-1, 4)
        sides = dict(zip(("left", "bottom", "right", "top"), frames.T, strict=True))
        self._pins.data = {**sides, "color": list(colors[: len(pins)])}


def corners_of(geometry: Mapping[str, Any]) -> Corners:
    """Corners (row, col) of what was drawn by one of Bokeh's selection tools."""
    if geometry["type"] == "rect":
        (left, right), (top, bottom) = (
            sorted((geometry[f"{axis}0"], geometry[f"{axis}1"])) for axis in "xy"
        )
        drawn = [(top, left), (top, right), (bottom, right), (bottom, left)]
    else:
        drawn = list(zip(geometry["y"], geometry["x"], strict=True))
        drawn = drawn[:: -(-len(drawn) // ENOUGH_CORNERS)]
    return tuple((float(row), float(col)) for row, col in drawn)


def _rounded(corner: tuple[float, float]) -> tuple[float, float]:
    """As fine as an address needs it."""
    return round(corner[0], 2), round(corner[1], 2)


def rectangle(rows: tuple[int, int], cols: tuple[int, int]) -> Corners:
    """Corners of the region of whole pixels from one row to another, and from column to column."""
    (top, bottom), (left, right) = ((low - 0.5, high + 0.5) for low, high in (rows, cols))
    return (top, left), (top, right), (bottom, right), (bottom, left)


@dataclass(frozen=True)
class Curves:
    """What the plots of a pixel, or of a region's sum, show; all of shape (bin,)."""

    raw: Array
    expected: Array | None
    small: Array
    large: Array
    rate: Array
    rate_unit: str
    residual: Array
    enhanced: Array
    truth_bin: float
    answer_bin: float
    candidate_bins: Sequence[float]


COLORS = {
    "rate": "raw",
    "candidates": "text",
    "ranks": "text",
    "window": "residual",
    "t_n": "answer",
    "suggested": "residual",
    "line": "small",
    "points": "small",
    "interval": "small",
}
"""The palette's names of layers that have others."""


class Marked(Layers):
    """A figure of named renderers that takes on the colours of the mode."""

    def __init__(self, drawing: Any) -> None:
        super().__init__(drawing, layers_of(drawing).layers)

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode."""
        paint_frame(self.figure, colors)
        for layer, handles in self.layers.items():
            glyph, color = handles["glyph"], getattr(colors, COLORS.get(layer, layer), None)
            if color is None:  # it has a column of them
                continue
            for part in ("line_color", "fill_color", "text_color"):
                if hasattr(glyph, part):
                    setattr(glyph, part, color)


class GatePlot(Marked):
    """A plot over the gate whose curves stand in one source, of the first layer.

    Parameters
    ----------
    drawing : bokeh.plotting.figure
        Of `app.plots.inspect`.
    read_out : mapping of str to str
        Column of each value that is read out under the pointer, by its name.
    has_top : bool
        Whether it has a second axis along the gate.
    """

    def __init__(
        self, drawing: Any, read_out: Mapping[str, str] | None = None, has_top: bool = False
    ) -> None:
        super().__init__(drawing)
        self._axes = GateAxes(drawing, has_top)
        self._read_out = None
        if read_out:
            first = next(iter(self.layers.values()))
            source, renderer = first["source"], first["glyph_renderer"]
            rows = [(name, source, column) for name, column in read_out.items()]
            self._read_out = GateReadOut(drawing, renderer, rows)
        drawing.yaxis.ticker = BasicTicker(desired_num_ticks=4)

    def follow(self, unit: str, acquisition: Acquisition) -> None:
        """Take on another unit or gate."""
        self._axes.follow(unit, acquisition)
        if self._read_out is not None:
            self._read_out.follow(acquisition)

    def show_curves(self, **curves: Array) -> None:
        """Draw other curves (bin,) in the first layer's source."""
        first = next(iter(self.layers))
        bins = plots.centres(next(iter(curves.values())).size)
        if len(self.source(first).data["bin"]) != bins.size:
            every = {"bin": bins, **curves}
            self.source(first).data = {n: np.asarray(x, np.float32) for n, x in every.items()}
        else:
            self.write(first, **curves)

    def frame(self, *curves: Array, axis: str = "") -> None:
        """Fit the vertical axis to what it shows."""
        top = round_up(1.15 * max(float(np.nanmax(curve, initial=0.0)) for curve in curves)) or 1.0
        vertical = self.figure.extra_y_ranges[axis] if axis else self.figure.y_range
        if vertical.end != top:
            vertical.update(end=top, reset_end=top)


class PixelPlots:
    """Counts, rate and stages of a pixel or a region, linked along the gate."""

    def __init__(self) -> None:
        nowhere, upright = plots.marker_line(np.nan, 1.0)
        self._marks = {
            "truth": ColumnDataSource({"x": nowhere, "y": upright}),
            "answer": ColumnDataSource({"x": nowhere, "y": upright}),
            "candidates": inspector_plots.empty("x", "y", "rank"),
        }
        self._bins = Range1d(0, 1)
        drawn = (self._bins, self._marks)
        counts = {"Counts": "raw", "Small scale": "small", "Large scale": "large"}
        stages = {"Residual": "residual", "Enhanced": "enhanced"}
        self.counts = GatePlot(inspector_plots.counts(*drawn), counts, has_top=True)
        self.rate = GatePlot(inspector_plots.rate(*drawn), {"Rate": "rate"})
        self.stages = GatePlot(inspector_plots.stages(*drawn), stages)

    @property
    def panes(self) -> list[pn.pane.Bokeh]:
        """The plots, from top to bottom."""
        return [pane_of(plot.figure) for plot in self._plots]

    @property
    def _plots(self) -> tuple[GatePlot, GatePlot, GatePlot]:
        return self.counts, self.rate, self.stages

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode."""
        for plot in self._plots:
            plot.paint(colors)

    def update(self, shown: Curves, unit: str, acquisition: Acquisition) -> None:
        """Show a pixel or a region, positions in a unit."""
        n_bins = acquisition.n_bins
        cover(self._bins, n_bins)
        expected = np.full(n_bins, np.nan) if shown.expected is None else shown.expected
        for plot in self._plots:
            plot.follow(unit, acquisition)
        self.counts.show_curves(
            raw=shown.raw, expected=expected, small=shown.small, large=shown.large
        )
        self.counts.show("expected", shown.expected is not None)
        self.counts.frame(shown.raw, shown.large, expected)
        self.rate.show_curves(rate=shown.rate)
        self.rate.frame(shown.rate)
        self.rate.figure.yaxis[0].axis_label = shown.rate_unit.capitalize()
        self.rate.figure.title.text = inspector_plots.RATE_TITLES[shown.rate_unit]
        self.stages.show_curves(residual=shown.residual, enhanced=shown.enhanced)
        self.stages.frame(shown.residual)
        self.stages.frame(shown.enhanced, axis="enhanced")
        for name, position in (("truth", shown.truth_bin), ("answer", shown.answer_bin)):
            self.counts.write(name, x=np.full(2, position))
            for plot in self._plots:
                plot.show(name, bool(np.isfinite(position)))
        places = np.asarray(shown.candidate_bins, np.float32)
        self._marks["candidates"].data = {
            "x": places,
            "y": np.full(places.size, inspector_plots.CANDIDATE_HEIGHT, np.float32),
            "rank": [str(n + 1) for n in range(places.size)],
        }
