"""Rendered figures with data that are updated in place; their colours, panes and axes."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import bokeh.models
import holoviews as hv
import numpy as np
import panel as pn
from bokeh.core.serialization import Deserializer, Serialized, Serializer
from bokeh.events import DoubleTap
from bokeh.models import ColorBar, CustomJS, Range1d
from bokeh.util.serialization import make_id
from numpy.typing import ArrayLike

from app.model.exports import Curve, Write, plot_file
from app.theme import LARGE, LARGE_STYLES, RAISED, STYLES, WRAPPED, Palette
from app.units import ShownGate


class Layers:
    """A figure whose layers receive new values.

    Parameters
    ----------
    figure : bokeh.plotting.figure
    layers : mapping
        "source", "glyph" and "glyph_renderer" of each layer.
    """

    def __init__(self, figure: Any, layers: Mapping[str, Mapping[str, Any]]) -> None:
        self.figure = figure
        self.layers = layers
        self._along: ShownGate | str = ""
        self._curves: Sequence[Curve] = ()
        reset = CustomJS(args={"figure": self.figure}, code="figure.reset.emit()")
        self.figure.js_on_event(DoubleTap, reset)

    def source(self, layer: str) -> Any:
        """Return the data source of a layer."""
        return self.layers[layer]["source"]

    def color(self, layer: str, color: str) -> None:
        """Set the colour of a layer."""
        glyph = self.layers[layer]["glyph"]
        glyph.line_color = color
        if hasattr(glyph, "fill_color"):
            glyph.fill_color = color

    def write(self, layer: str, **columns: ArrayLike) -> None:
        """Replace columns of a layer; only changed ones are sent, as float32."""
        data = self.source(layer).data
        new = {name: np.asarray(values, np.float32) for name, values in columns.items()}
        new = {n: v for n, v in new.items() if not np.array_equal(data[n], v, equal_nan=True)}
        if new:
            data.update(new)

    def keep(self, along: ShownGate | str, curves: Sequence[Curve]) -> None:
        """Keep what the layers show for a download; `along` is the gate or the axis label."""
        self._along, self._curves = along, curves

    def csv(self) -> Write:
        """Return the kept curves as CSV; those that are hidden or out of view are left out."""
        visible = [
            each for each in self._curves if self.layers[each.layer]["glyph_renderer"].visible
        ]
        return plot_file(visible, self._along, self.figure.x_range)

    def show(self, layer: str, visible: bool) -> None:
        """Show or hide a layer and its line in the legend."""
        renderer = self.layers[layer]["glyph_renderer"]
        if renderer.visible == visible:
            return
        renderer.visible = visible
        for legend in self.figure.legend:
            for item in legend.items:
                if renderer in item.renderers:
                    item.visible = visible


HANDLES = ("source", "glyph", "glyph_renderer", "color_mapper")
"""Models of a layer that are changed later, by the names that HoloViews gives them."""


@cache
def _rendered(declare: Callable[[], hv.Overlay]) -> tuple[Serialized[Any], list[dict[str, str]]]:
    """Render an overlay; return its figure, serialized, and the ids of `HANDLES` of each layer."""
    rendered = hv.renderer("bokeh").get_plot(declare())
    layers = [
        {name: each.handles[name].id for name in HANDLES if name in each.handles}
        for each in rendered.subplots.values()
    ]
    return Serializer().serialize(rendered.state), layers


def _renamed(content: Any, ids: Mapping[str, str]) -> Any:
    """Return serialized models with other ids."""
    if isinstance(content, dict):
        return {
            key: ids[value] if key == "id" else _renamed(value, ids)
            for key, value in content.items()
        }
    return [_renamed(each, ids) for each in content] if isinstance(content, list) else content


class Plot(Layers):
    """A copy of a HoloViews overlay, which each process renders once.

    HoloViews takes three times as long as copying its figure.

    Parameters
    ----------
    declare : callable
        Function of a module that returns the overlay.
    layers : sequence of str
        Name of each element of the overlay, which is also that of its colour in `Palette`.
    """

    def __init__(self, declare: Callable[[], hv.Overlay], layers: Sequence[str]) -> None:
        rendered, handles = _rendered(declare)
        ids: defaultdict[str, str] = defaultdict(make_id)
        copied = Serialized(_renamed(rendered.content, ids), rendered.buffers)
        figure = Deserializer().deserialize(copied)
        models = {each.id: each for each in figure.references()}
        found = [{name: models[ids[key]] for name, key in each.items()} for each in handles]
        super().__init__(figure, dict(zip(layers, found, strict=True)))

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        paint_frame(self.figure, colors)
        for layer in self.layers:
            self.color(layer, getattr(colors, layer))


def paint_frame(figure: Any, colors: Palette) -> None:
    """Apply colours to everything around the data."""
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
    """Return the colour bars below a figure or at its right side."""
    return [each for each in (*figure.below, *figure.right) if isinstance(each, ColorBar)]


def pane_of(figure: Any) -> pn.pane.Bokeh:
    """Return a pane that the figure fills."""
    for renderer in figure.renderers:
        # Nothing can be selected in a plot: these glyphs would only be sent and built.
        renderer.update(selection_glyph=None, nonselection_glyph=None, muted_glyph=None)
    _style(figure, STYLES)
    for legend in figure.legend:
        if legend in figure.center:
            legend.stylesheets = [WRAPPED]
        elif legend not in figure.right:
            # It reaches beyond the left end of the frame, beside which there is more room.
            legend.update(stylesheets=[WRAPPED, RAISED], location="top_right")
    return pn.pane.Bokeh(figure, sizing_mode="stretch_both", margin=0)


def enlarge(figure: Any) -> None:
    """Make the text, lines and markers of a figure legible across a room."""
    _style(figure, LARGE_STYLES)
    for renderer in figure.renderers:
        glyph = renderer.glyph
        if getattr(glyph, "line_width", 0):
            glyph.line_width = LARGE * glyph.line_width
            glyph.line_dash = [round(LARGE * each) for each in glyph.line_dash]
        if hasattr(glyph, "size"):
            glyph.size = LARGE * glyph.size


def _style(figure: Any, styles: Mapping[str, Mapping[str, object]]) -> None:
    """Apply the styles of each kind of model to a figure and its parts."""
    axes = (each for axis in figure.axis for each in (axis, axis.formatter))
    for model in (figure, figure.title, *axes, *figure.legend, *color_bars(figure)):
        for kind, sizes in styles.items():
            if isinstance(model, getattr(bokeh.models, kind)):
                model.update(**sizes)


def around(border_px: Mapping[str, int]) -> tuple[int, int]:
    """Return the room beside the frame of a figure, and above and below it, in px."""
    return border_px["left"] + border_px["right"], border_px["top"] + border_px["bottom"]


def proportioned(aspect: float, across_px: int, down_px: int) -> str:
    """Return the style of a figure whose frame has the proportions of its image.

    It is as large as its container allows.

    Parameters
    ----------
    aspect : float
        Width of the image divided by its height.
    across_px, down_px : int
        Room beside the frame, and above and below it.
    """
    width = f"(100cqh - {down_px}px) * {aspect:.5g} + {across_px}px"
    height = f"(100cqw - {across_px}px) / {aspect:.5g} + {down_px}px"
    return f""":host {{ flex: none !important; width: min(100cqw, {width}) !important;
      height: min(100cqh, {height}) !important; }}"""


def cover(bins: Range1d, n_bins: int) -> bool:
    """Fit an axis to a gate of another length; return whether it was another."""
    if n_bins == bins.reset_end:
        return False
    bins.update(start=0, end=n_bins, reset_start=0, reset_end=n_bins)
    return True


def fit(figure: Any, low: float, high: float) -> None:
    """Set the ends of the vertical axis, and those that a reset restores."""
    vertical = figure.y_range
    if (low, high) != (vertical.start, vertical.end):
        vertical.update(start=low, end=high, reset_start=low, reset_end=high)


def round_up(value: float) -> float:
    """Round up to a few steps per decade, so that an axis seldom changes."""
    if value <= 0.0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(
        step * power
        for step in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 12)
        if step * power >= value
    )
