"""Thin viewers: a rendered plot, and how new values get into it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import bokeh.models
import holoviews as hv
import numpy as np
import panel as pn
from bokeh.events import DoubleTap, Tap
from bokeh.models import (
    BasicTicker,
    BoxZoomTool,
    ColorBar,
    CustomJS,
    DataRange1d,
    Range1d,
)
from numpy.typing import ArrayLike, NDArray

from app.model.colors import Look
from app.model.large import Grid
from app.model.store import Pixel
from app.plots import elements as plots
from app.plots.gate import GateAxes, GateReadOut
from app.theme import LIGHT, STYLES, Palette
from core import Acquisition

Array = NDArray[Any]


class Layers:
    """A figure that stays; new values go into the sources of its layers.

    Parameters
    ----------
    figure : bokeh.plotting.figure
    layers : mapping
        Of each layer the "source", the "glyph" and the "glyph_renderer".
    """

    def __init__(self, figure: Any, layers: Mapping[str, Mapping[str, Any]]) -> None:
        self.figure = figure
        self.layers = layers
        reset = CustomJS(args={"figure": self.figure}, code="figure.reset.emit()")
        self.figure.js_on_event(DoubleTap, reset)

    def source(self, layer: str) -> Any:
        """The data source of a layer."""
        return self.layers[layer]["source"]

    def write(self, layer: str, **columns: ArrayLike) -> None:
        """Replace columns of a layer; only what changed travels, as float32."""
        data = self.source(layer).data
        new = {name: np.asarray(values, np.float32) for name, values in columns.items()}
        new = {n: v for n, v in new.items() if not np.array_equal(data[n], v, equal_nan=True)}
        if new:
            data.update(new)

    def show(self, layer: str, visible: bool) -> None:
        """Draw a layer, and its line in the legend, or leave them out."""
        renderer = self.layers[layer]["glyph_renderer"]
        if renderer.visible == visible:
            return
        renderer.visible = visible
        for legend in self.figure.legend:
            for item in legend.items:
                if renderer in item.renderers:
                    item.visible = visible


class Plot(Layers):
    """A HoloViews overlay, rendered once.

    Parameters
    ----------
    overlay : hv.Overlay
    layers : sequence of str
        A palette's name for each element of the overlay, in their order.
    """

    def __init__(self, overlay: hv.Overlay, layers: Sequence[str]) -> None:
        rendered = hv.renderer("bokeh").get_plot(overlay)
        handles = [each.handles for each in rendered.subplots.values()]
        super().__init__(rendered.state, dict(zip(layers, handles, strict=True)))

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode."""
        paint_frame(self.figure, colors)
        for layer, handles in self.layers.items():
            glyph, color = handles["glyph"], getattr(colors, layer)
            glyph.line_color = color
            if hasattr(glyph, "fill_color"):
                glyph.fill_color = color


def paint_frame(figure: Any, colors: Palette) -> None:
    """Colours of all that surrounds the data."""
    figure.title.text_color = colors.text
    for axis in figure.axis:
        axis.axis_label_text_color = axis.major_label_text_color = colors.muted
        axis.axis_line_color = axis.major_tick_line_color = colors.muted
    figure.grid.grid_line_color = colors.grid
    for legend in figure.legend:
        legend.label_text_color = colors.text
        legend.background_fill_color = legend.inactive_fill_color = colors.paper
    for bar in color_bars(figure):
        bar.title_text_color = bar.major_label_text_color = colors.muted


def color_bars(figure: Any) -> list[ColorBar]:
    """Of a figure, below it or at its right side."""
    return [each for each in (*figure.below, *figure.right) if isinstance(each, ColorBar)]


class SignalPlots:
    """The pixel's three plots, linked along the gate."""

    def __init__(self) -> None:
        one = np.zeros(1)
        self.histogram = Plot(plots.histogram(one, one, one, one, LIGHT), plots.HISTOGRAM_LAYERS)
        self.residual = Plot(plots.residual(one, one, LIGHT), plots.RESIDUAL_LAYERS)
        self.enhanced = Plot(plots.enhanced(one, one, LIGHT), plots.ENHANCED_LAYERS)
        self._bins = Range1d(0, 1)
        for plot in self._plots:
            figure = plot.figure
            figure.x_range, figure.y_range = self._bins, Range1d(0, 1)
            figure.min_border_left, figure.min_border_right = 46, 14
            figure.min_border_top = figure.min_border_bottom = 4
            figure.yaxis.ticker = BasicTicker(desired_num_ticks=4)
        # The second axis once: the plots stand above each other.
        self._axes = [GateAxes(plot.figure, plot is self.histogram) for plot in self._plots]
        raw = ("Counts", self.histogram.source("raw"), "top")
        small, large = (
            (f"{name} scale".capitalize(), self.histogram.source(name), "counts")
            for name in ("small", "large")
        )
        rest = (
            ("Residual", self.residual.source("residual"), "residual"),
            ("Enhanced", self.enhanced.source("enhanced"), "enhanced"),
        )
        self._read_outs = [
            GateReadOut(plot.figure, plot.layers[layer]["glyph_renderer"], rows)
            for plot, layer, rows in (
                (self.histogram, "raw", (raw, small, large)),
                (self.residual, "residual", rest),
                (self.enhanced, "enhanced", rest),
            )
        ]

    @property
    def panes(self) -> list[pn.pane.Bokeh]:
        """The three plots, from top to bottom."""
        return [pane_of(plot.figure) for plot in self._plots]

    @property
    def _plots(self) -> tuple[Plot, Plot, Plot]:
        return self.histogram, self.residual, self.enhanced

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode."""
        for plot in self._plots:
            plot.paint(colors)

    def update(
        self, pixel: Pixel, acquisition: Acquisition, with_difference: bool, unit: str = "bins"
    ) -> None:
        """Show a pixel, positions in a unit."""
        for axes in self._axes:
            axes.follow(unit, acquisition)
        for read_out in self._read_outs:
            read_out.follow(acquisition)
        if cover(self._bins, acquisition.n_bins):
            self._lay_out(acquisition.n_bins)
        signals, nothing = pixel.signals, np.full(acquisition.n_bins, np.nan)
        expected = nothing if pixel.expected is None else pixel.expected
        self.histogram.write("raw", top=signals.raw)
        self.histogram.write("expected", counts=expected)
        self.histogram.write("small", counts=signals.small)
        self.histogram.write("large", counts=signals.large)
        self.histogram.show("expected", pixel.expected is not None)
        self._frame(self.histogram, pixel, 0.0, signals.raw, signals.large, expected)

        difference = pixel.difference if with_difference else nothing
        self.residual.write("residual", residual=signals.residual)
        self.residual.write("raw", residual=difference)
        self.residual.show("raw", with_difference)
        low = float(np.nanmin(difference)) if with_difference else 0.0
        self._frame(self.residual, pixel, low, signals.residual, difference)

        top = float(signals.enhanced.max()) or 1.0
        weight = signals.weight * (0.8 * top / (signals.weight.max() or 1.0))
        self.enhanced.write("enhanced", enhanced=signals.enhanced)
        self.enhanced.write("weight", enhanced=weight)
        self._frame(self.enhanced, pixel, 0.0, signals.enhanced, weight)

    def _lay_out(self, n_bins: int) -> None:
        """Lay out the plots for another number of bins."""
        edges, centres = plots.edges(n_bins), plots.centres(n_bins)
        empty = np.zeros(n_bins)
        bars = {"left": edges[:-1], "right": edges[1:], "top": empty, "bottom": empty}
        self.histogram.source("raw").data = bars
        for plot, column, layers in (
            (self.histogram, "counts", ("expected", "small", "large")),
            (self.residual, "residual", ("raw", "residual")),
            (self.enhanced, "enhanced", ("weight", "enhanced")),
        ):
            for layer in layers:
                plot.source(layer).data = {"bin": centres, column: empty}

    @staticmethod
    def _frame(plot: Plot, pixel: Pixel, low: float, *curves: Array) -> None:
        """Fit the vertical axis, and draw truth and answer from bottom to top."""
        highest = max(float(np.nanmax(curve, initial=0.0)) for curve in curves)
        vertical = plot.figure.y_range
        end, start = round_up(highest * 1.15), -round_up(-low * 1.05)
        if (start, end) != (vertical.start, vertical.end):
            vertical.update(start=start, end=end, reset_start=start, reset_end=end)
        (column,) = (name for name in plot.source("truth").data if name != "bin")
        for layer, position in (("truth", pixel.truth_bin), ("answer", pixel.answer_bin)):
            x, y = plots.marker_line(position, end)
            plot.write(layer, **{"bin": x, column: y})
            plot.show(layer, bool(np.isfinite(position)))


def pane_of(figure: Any) -> pn.pane.Bokeh:
    """A place that the figure fills."""
    for renderer in figure.renderers:
        # How a line would look if it were chosen, or others were: nothing is chosen in a plot.
        renderer.update(selection_glyph=None, nonselection_glyph=None, muted_glyph=None)
    for model in (figure, figure.title, *figure.axis, *figure.legend, *color_bars(figure)):
        for kind, sizes in STYLES.items():
            if isinstance(model, getattr(bokeh.models, kind)):
                model.update(**sizes)
    return pn.pane.Bokeh(figure, sizing_mode="stretch_both", margin=0)


def cover(bins: Range1d, n_bins: int) -> bool:
    """Let an axis show a whole gate, whatever it was zoomed to; whether that was another gate."""
    if n_bins == bins.reset_end:
        return False
    bins.update(start=0, end=n_bins, reset_start=0, reset_end=n_bins)
    return True


def round_up(value: float) -> float:
    """The next of 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8 times a power of ten: an axis that rests."""
    if value <= 0.0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(
        step * power
        for step in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 12)
        if step * power >= value
    )


class ImageView:
    """The image to navigate by; a tap chooses a pixel.

    Parameters
    ----------
    tapped : callable
        Called with the row and column of a tapped pixel.
    """

    def __init__(self, tapped: Callable[[int, int], None]) -> None:
        self._plot = Plot(
            plots.range_image(np.zeros((2, 2)), 0.0, 1.0), ("picture", "shadow", "frame")
        )
        self._shape, self._grid = (0, 0), Grid()
        self._look: Look | None = None
        self.figure = self._plot.figure
        self.pane = pane_of(self.figure)
        self.figure.match_aspect = True
        self.figure.x_range = DataRange1d(range_padding=0, renderers=[])
        self.figure.y_range = DataRange1d(range_padding=0, flipped=True, renderers=[])
        picture = self._plot.layers["picture"]
        for ranges in (self.figure.x_range, self.figure.y_range):
            ranges.renderers = [picture["glyph_renderer"]]
        for layer in ("shadow", "frame"):  # which move more often than the picture below changes
            self._plot.layers[layer]["glyph_renderer"].level = "overlay"
        self._mapper = picture["color_mapper"]
        (self._bar,) = color_bars(self.figure)
        (zoom,) = self.figure.select(BoxZoomTool)
        zoom.match_aspect = True
        # HoloViews adds others, of which Bokeh takes the first.
        self.figure.toolbar.active_drag = zoom

        def tap(event: Tap) -> None:
            row, col = self._grid.pixel(event.y, event.x)
            if 0 <= row < self._shape[0] and 0 <= col < self._shape[1]:
                tapped(row, col)

        self.figure.on_event(Tap, tap)
        reset = CustomJS(args={"figure": self.figure}, code="figure.reset.emit()")
        self.figure.js_on_change("tags", reset)

    def join(self, first: ImageView) -> None:
        """Become one of several side by side, with one view, and one scale that stands by them."""
        self._bar.visible = False
        self.figure.xaxis.axis_label = self.figure.yaxis.axis_label = None
        if first is self:
            return
        for name in ("x_range", "y_range"):
            shared = getattr(first.figure, name)
            shared.renderers = [*shared.renderers, *getattr(self.figure, name).renderers]
            setattr(self.figure, name, shared)

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode."""
        paint_frame(self.figure, colors)

    def fit(self, rows: int, cols: int, grid: Grid) -> None:
        """Make room for an image of other pixels; for one of the same, the zoom stays."""
        if ((rows, cols), grid) != (self._shape, self._grid):
            self.enter(rows, cols, grid)

    def enter(self, rows: int, cols: int, grid: Grid) -> None:
        """Make room for another image, blank so far."""
        self._shape, self._grid = (rows, cols), grid
        blank = [np.full((rows, cols), np.nan, np.float32)]
        left, above, *_ = plots.pixel_frame(*grid.place(0, 0), grid.step / 2)
        size = {"dw": [cols * grid.step], "dh": [rows * grid.step]}
        self._plot.source("picture").data = {"image": blank, "x": [left], "y": [above], **size}
        self.figure.tags = [*grid.first, grid.step, rows, cols]  # which ends a zoom

    def update(self, image: Array, look: Look) -> None:
        """Show an image (row, col); NaN is left blank."""
        self._plot.source("picture").data["image"] = [np.asarray(image, np.float32)]
        if look == self._look:
            return  # Bokeh would look at every single colour again
        self._look = look
        self._mapper.update(
            low=look.low,
            high=look.high,
            palette=look.colors,
            low_color=look.outside,
            high_color=look.outside,
        )
        self._bar.title = look.unit
        self.figure.title.text = look.title

    @property
    def half_frame(self) -> float:
        """Half the side of a frame, in pixels of the file: it is seen in a large image, too."""
        return max(1.5, 0.014 * max(self._shape)) * self._grid.step

    def mark(self, row: int, col: int) -> None:
        """Frame a pixel."""
        left, bottom, right, top = plots.pixel_frame(*self._grid.place(row, col), self.half_frame)
        for layer in ("shadow", "frame"):
            self._plot.write(layer, left=[left], bottom=[bottom], right=[right], top=[top])
