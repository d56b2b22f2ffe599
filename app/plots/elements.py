"""Plots as pure functions: arrays in, HoloViews elements or Bokeh figures out.

They are declared once. When values change, `app.widgets.figures` writes the changed columns to the
rendered plots: building a plot again would take ten times as long as drawing it.
"""

from __future__ import annotations

from typing import Any

import holoviews as hv
import numpy as np
from bokeh.models import (
    ColumnDataSource,
    DataRange1d,
    HoverTool,
    Legend,
    LegendItem,
    LinearColorMapper,
    Span,
)
from bokeh.plotting import figure
from numpy.typing import NDArray

from app.theme import OUTSIDE_COLOR, RANGE_COLORS, Palette, method_style
from core.studies import outputs as items
from core.studies.paper import figures as paper

Array = NDArray[Any]

hv.extension("bokeh")
# Copying each plot out of a WebGL canvas takes longer than drawing its few lines on a plain one.
hv.renderer("bokeh").webgl = False

BIN = hv.Dimension("bin", label="Bin")

# The layers of each plot, by the palette's names for them, in the order in which they are drawn.
HISTOGRAM_LAYERS = ("raw", "expected", "small", "large", "truth", "answer")
RESIDUAL_LAYERS = ("raw", "residual", "truth", "answer")
ENHANCED_LAYERS = ("weight", "enhanced", "truth", "answer")


def marker_line(position_bin: float, top: float, bottom: float = 0.0) -> tuple[Array, Array]:
    """Coordinates of an upright line; of nothing at NaN."""
    return np.full(2, position_bin), np.array([bottom, top])


def edges(n_bins: int) -> Array:
    """Edges of the bins as a histogram draws them: bin k is centred on k + 1/2."""
    return np.arange(n_bins + 1, dtype=float)


def centres(n_bins: int) -> Array:
    """Centres of the bins."""
    return np.arange(n_bins) + 0.5


def histogram(
    counts: Array, expected: Array, small: Array, large: Array, colors: Palette
) -> hv.Overlay:
    """Raw counts with the model's expectation and both scales over them.

    Parameters
    ----------
    counts, expected, small, large : ndarray, shape (bin,)
        In counts; NaN where there is nothing to draw.
    """
    n_bins = counts.size
    unit = hv.Dimension("counts", label="Counts")
    bars = hv.Histogram((edges(n_bins), counts), kdims=BIN, vdims=unit, label="raw histogram")
    layers = [
        bars.opts(color=colors.raw, line_width=0),
        _curve(centres(n_bins), expected, unit, "expected").opts(
            color=colors.expected, line_dash="dotted", line_width=1.5
        ),
        _curve(centres(n_bins), small, unit, "small scale").opts(color=colors.small, line_width=2),
        _curve(centres(n_bins), large, unit, "large scale").opts(color=colors.large, line_width=2),
        *_markers(unit, colors),
    ]
    return _panel(layers, "Histogram of the pixel, and the two scales that follow it")


def residual(values: Array, difference: Array, colors: Palette) -> hv.Overlay:
    """Positive difference of the scales; the raw first difference on demand, shape (bin,) each."""
    n_bins = values.size
    unit = hv.Dimension("residual", label="Counts")
    layers = [
        _curve(centres(n_bins), difference, unit, "first difference of the raw histogram").opts(
            color=colors.raw, line_width=1.2
        ),
        _curve(centres(n_bins), values, unit, "residual").opts(color=colors.residual, line_width=2),
        *_markers(unit, colors),
    ]
    return _panel(layers, "Residual: large scale minus small scale, where positive")


def enhanced(values: Array, weight: Array, colors: Palette) -> hv.Overlay:
    """Residual times weight, with the weight scaled to the plot, shape (bin,) each."""
    n_bins = values.size
    unit = hv.Dimension("enhanced", label="Counts × weight")
    layers = [
        _curve(centres(n_bins), weight, unit, "weight (scaled to fit)").opts(
            color=colors.weight, line_dash="dashed", line_width=1.2
        ),
        _curve(centres(n_bins), values, unit, "enhanced").opts(color=colors.enhanced, line_width=2),
        *_markers(unit, colors),
    ]
    return _panel(layers, "Enhanced: residual × weight; its largest value is the echo")


def _curve(x: Array, y: Array, unit: hv.Dimension, label: str) -> hv.Curve:
    return hv.Curve((x, y), kdims=BIN, vdims=unit, label=label)


def _markers(unit: hv.Dimension, colors: Palette) -> list[hv.Curve]:
    nowhere = marker_line(np.nan, 1.0)
    return [
        _curve(*nowhere, unit, "truth").opts(color=colors.truth, line_width=2.5, line_dash="4 2"),
        _curve(*nowhere, unit, "answer").opts(color=colors.answer, line_width=1.5),
    ]


def _panel(layers: list[Any], title: str) -> hv.Overlay:
    return hv.Overlay(layers).opts(
        hv.opts.Overlay(
            title=title,
            responsive=True,
            min_height=120,
            toolbar=None,
            default_tools=["xbox_zoom"],
            show_legend=True,
            legend_position="top_right",
            legend_cols=6,
            legend_opts={"click_policy": "hide", "background_fill_alpha": 0.8},
        )
    )


def range_image(image: Array, low: float, high: float) -> hv.Overlay:
    """An image (row, col) with row 0 at the top, and a frame for the pixel on show.

    Parameters
    ----------
    image : ndarray, shape (row, col)
        NaN is left blank.
    low, high : float
        Values at the ends of the colour scale.
    """
    rows, cols = image.shape
    value = hv.Dimension("value", label="Range (m)", range=(low, high))
    picture = hv.Image(
        (np.arange(cols), np.arange(rows), image),
        kdims=[hv.Dimension("col", label="Column"), hv.Dimension("row", label="Row")],
        vdims=value,
    ).opts(
        cmap=RANGE_COLORS,
        colorbar=True,
        colorbar_opts={"width": 10, "padding": 4, "title_standoff": 6},
        clipping_colors={"NaN": (0, 0, 0, 0)},
    )
    frames = [
        hv.Rectangles([pixel_frame(0, 0)]).opts(
            fill_alpha=0, line_color=color, line_width=width, apply_ranges=False
        )
        for color, width in (("#000000", 4), ("#ffffff", 1.6))
    ]
    return hv.Overlay([picture, *frames]).opts(
        hv.opts.Overlay(
            title="Range image",
            responsive=True,
            min_height=200,
            toolbar=None,
            default_tools=["box_zoom", "tap"],
            show_legend=False,
        )
    )


def pixel_frame(row: float, col: float, half: float = 1.5) -> tuple[float, float, float, float]:
    """Left, bottom, right and top of a frame around a pixel that leaves the pixel itself free."""
    return col - half, row - half, col + half, row + half


def score_curves(colors: Palette) -> hv.Overlay:
    """Scores of each bin, a line for each method, with the truth and the methods' answers."""
    unit = hv.Dimension("score", label="Score, scaled")
    nothing = np.full(1, np.nan)
    layers = [
        hv.Path([np.full((1, 2), np.nan)], [BIN, unit]).opts(line_width=1.8),
        _curve(*marker_line(np.nan, 1.0), unit, "truth").opts(
            color=colors.truth, line_width=2.5, line_dash="4 2"
        ),
        hv.Scatter((nothing, nothing), BIN, unit, label="answer, own lag removed").opts(
            marker="inverted_triangle", size=9, line_width=0
        ),
    ]
    return _panel(layers, "Score of each bin: 0 is a curve's median, 1 its maximum").opts(
        hv.opts.Overlay(legend_position="right", legend_cols=1)
    )


def reliability(colors: Palette) -> hv.Overlay:
    """Share right against confidence told, a line for each method, and the diagonal."""
    told = hv.Dimension("told", label="Confidence told")
    right = hv.Dimension("right", label="Share right within 3 bins")
    ends, nothing = np.array([0.0, 1.0]), np.full(1, np.nan)
    layers = [
        hv.Curve((ends, ends), told, right, label="honest").opts(
            color=colors.muted, line_width=1, line_dash="dashed"
        ),
        hv.Path([np.full((1, 2), np.nan)], [told, right]).opts(line_width=1.8),
        hv.Scatter((nothing, nothing), told, right).opts(size=6, line_width=0),
    ]
    return _panel(layers, "Reliability: on the dashed line confidence is honest").opts(
        hv.opts.Overlay(show_legend=False)
    )


# Curves of the studies that have a colour of their own, by the palette's names, and their dashes.
STUDY_COLORS: dict[str, tuple[str, list[int]]] = {
    "histogram": ("raw", []),
    "small scale": ("small", []),
    "large scale": ("large", []),
    "residual": ("residual", []),
    "largest residual, no noise": ("residual", []),
    "largest of noise alone, median": ("muted", [6, 3]),
    "largest of noise alone, 95 %": ("text", [6, 3]),
    "limit: probability of the right bin": ("text", [2, 4]),
    "echo's onset": ("truth", [4, 2]),
    "truth": ("truth", [4, 2]),
    "answer, lag included": ("answer", []),
    "the echo above": ("answer", []),
}
METHOD_PLACES = {method.name: place for place, method in enumerate(paper.COMPARED)}
BARS = "histogram"
"""The curve that is drawn as bars."""


def curves(item: items.Plot, colors: Palette) -> Any:
    """A Bokeh figure of a study's curves, and upright lines at its marks, as named renderers.

    The band of a curve has the curve's name and "band". Without HoloViews, which would take five
    times as long: these are built while someone waits.
    """
    drawing = figure(
        title=item.title,
        x_axis_type="log" if item.x_is_log else "linear",
        x_axis_label=item.x_label,
        y_axis_label=item.y_label,
        sizing_mode="stretch_both",
        min_height=120,
        tools="xbox_zoom",
        toolbar_location=None,
    )
    lines = {name: (item.x, values) for name, values in item.curves.items()}
    lines |= {name: marker_line(place, 1.0) for name, place in item.marks.items()}
    entries = []
    styles = curve_styles(item, colors)
    for name, (low, high) in item.bands.items():
        color, _ = styles[name]
        band = {"x": item.x, "y1": low, "y2": high}
        drawing.varea(**band, fill_color=color, fill_alpha=0.2, name=f"{name} band")
    for name, (color, dash) in styles.items():
        x, y = lines[name]
        if name == BARS:
            renderer = drawing.vbar(x=x, top=y, width=1.0, color=color, line_width=0, name=name)
        else:
            renderer = drawing.line(x, y, color=color, line_dash=dash, line_width=2, name=name)
        entries.append(LegendItem(label=name.replace("_", " "), renderers=[renderer]))
    many = len(entries) > 6
    # Room for the legend, the same for all: plots above each other stay aligned.
    drawing.min_border_right = 196 if many else 14
    legend = Legend(
        items=entries,
        orientation="vertical" if many else "horizontal",
        ncols=3 if 4 < len(entries) <= 6 else "auto",
        click_policy="hide",
        background_fill_alpha=0.0,
    )
    drawing.add_layout(legend, "right" if many else "above")
    return drawing


def curve_styles(item: items.Plot, colors: Palette) -> dict[str, tuple[str, list[int]]]:
    """Colour and dashes of each curve and mark; of a method by its place among all methods."""
    styles = {}
    for place, name in enumerate((*item.curves, *item.marks)):
        if name in STUDY_COLORS:
            of_palette, dash = STUDY_COLORS[name]
            styles[name] = (getattr(colors, of_palette), dash)
        else:
            styles[name] = method_style(METHOD_PLACES.get(name, place), colors)
    return styles


def pictures(item: items.Pictures) -> list[Any]:
    """A Bokeh figure for each image (row, col), row 0 at the top; they share colours and view.

    Each has the renderers "picture", and "shadow" and "frame" around a pixel.
    """
    mapper = LinearColorMapper(
        palette=RANGE_COLORS,
        low=item.low,
        high=item.high,
        low_color=OUTSIDE_COLOR,
        high_color=OUTSIDE_COLOR,
        nan_color="rgba(0, 0, 0, 0)",
    )
    across, down = DataRange1d(range_padding=0), DataRange1d(range_padding=0, flipped=True)
    drawings, shown = [], []
    for name, image in item.images.items():
        rows, cols = image.shape
        drawing = figure(
            title=name,
            x_range=across,
            y_range=down,
            match_aspect=True,
            tools="box_zoom,tap",
            toolbar_location=None,
        )
        place = {"x": -0.5, "y": -0.5, "dw": cols, "dh": rows}
        shown.append(drawing.image([image], **place, color_mapper=mapper, name="picture"))
        left, bottom, right, top = ([side] for side in pixel_frame(0, 0))
        for layer, color, width in (("shadow", "#000000", 4), ("frame", "#ffffff", 1.6)):
            drawing.quad(
                *(left, right, top, bottom),
                fill_alpha=0,
                line_color=color,
                line_width=width,
                name=layer,
            )
        drawings.append(drawing)
    for ranges in (across, down):  # frames do not widen the view
        ranges.renderers = shown
    return drawings


MARKERS = ("circle", "square", "triangle")
"""Of methods that share a colour."""


def tradeoff(colors: Palette) -> Any:
    """A Bokeh figure of missed targets against time, as named renderers.

    ``points`` are measured ways to range, ``times`` and ``degrees`` their whiskers, ``front`` the
    line of those that none beats, ``chosen`` a ring around what is recommended.
    """
    drawing = figure(
        x_axis_type="log",
        y_axis_type="log",
        x_axis_label="Time for an image (ms)",
        y_axis_label="Not within 3 bins (share of the target pixels)",
        title="Further left is faster, further down is right more often",
        sizing_mode="stretch_both",
        min_height=240,
        tools="box_zoom,tap",
        toolbar_location=None,
    )
    for name, dimension in _ASKED.items():
        drawing.add_layout(Span(name=name, dimension=dimension, line_dash=[6, 3]))
    drawing.step("x", "y", source=_empty("x", "y"), mode="after", line_width=2, name="front")
    for name in ("times", "degrees"):
        source = _empty("x0", "y0", "x1", "y1", "color")
        ends = {"x0": "x0", "y0": "y0", "x1": "x1", "y1": "y1"}
        drawing.segment(**ends, line_color="color", source=source, name=name)
    drawing.scatter(
        "x", "y", source=_empty("x", "y"), size=19, fill_alpha=0, line_width=2.5, name="chosen"
    )
    points = drawing.scatter(
        "x",
        "y",
        source=_empty("x", "y", "color", "marker", "method", "way", "told"),
        size=9,
        color="color",
        marker="marker",
        legend_field="method",
        name="points",
    )
    points.nonselection_glyph = points.selection_glyph = None
    drawing.add_tools(
        HoverTool(
            renderers=[points], tooltips=[("", "@way"), ("", "@told")], point_policy="snap_to_data"
        )
    )
    legend = drawing.legend[0]
    legend.update(background_fill_alpha=0.0, orientation="horizontal", ncols=3)
    drawing.add_layout(legend, "below")  # beside the plot it would leave a phone none
    paint_tradeoff(drawing, colors)
    return drawing


_ASKED = {"asked time": "height", "asked degree": "width"}
"""Lines at what was asked for, and along what they run."""


def show_asked(drawing: Any, milliseconds: float, degree: float) -> None:
    """Draw what was asked of the ways to range; a degree of 1 lies below any axis."""
    missed = 1 - degree or None
    for name, place in zip(_ASKED, (milliseconds, missed), strict=True):
        drawing.select_one({"name": name}).location = place


def paint_tradeoff(drawing: Any, colors: Palette) -> None:
    """Colours of the lines between the points, which have their own."""
    for name, color in (("front", colors.text), ("chosen", colors.answer)):
        drawing.select_one({"name": name}).glyph.line_color = color
    for name in _ASKED:
        drawing.select_one({"name": name}).line_color = colors.muted


def _empty(*columns: str) -> ColumnDataSource:
    return ColumnDataSource({column: [] for column in columns})
