"""Plots as pure functions that return HoloViews elements, without values, or Bokeh figures.

Each plot is built once. When values change, `app.widgets.figures` writes the changed columns to it:
building a plot again would take ten times as long as drawing it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import holoviews as hv
import numpy as np
from bokeh.models import (
    ColumnDataSource,
    CustomJSHover,
    DataRange1d,
    HoverTool,
    Legend,
    LegendItem,
    LinearColorMapper,
    Range1d,
    Span,
)
from bokeh.plotting import figure
from numpy.typing import ArrayLike, NDArray

from app.model.exports import Curve
from app.model.methods import METHOD_PLACES
from app.model.store import Pixel
from app.theme import LIGHT, RANGE_COLORS, Palette, line_style
from app.units import Scale
from core.io import OUTSIDE_COLOR
from core.studies import outputs as items
from core.studies.paper import figures as paper
from core.studies.pulses import Pulses

Array = NDArray[Any]

hv.extension("bokeh")
# Copying each plot from a WebGL canvas takes longer than drawing its few lines on a plain one.
hv.renderer("bokeh").webgl = False

BIN = hv.Dimension("bin", label="Bin")
NOTHING = np.zeros(1)
"""Placeholder for values that are written later."""

# Layers of each plot, by their colours' names in the palette, in drawing order.
HISTOGRAM_LAYERS = ("raw", "expected", "small", "large", "truth", "estimate")
RESIDUAL_LAYERS = ("raw", "residual", "truth", "estimate")
ENHANCED_LAYERS = ("weight", "enhanced", "truth", "estimate")
SCORE_LAYERS = ("enhanced", "truth", "estimate")

# Names on screen of the layers that have another one.
HISTOGRAM_NAMES = {"raw": "raw histogram", "small": "small scale", "large": "large scale"}
RESIDUAL_NAMES = {"raw": "first difference of the raw histogram"}
SCORE_NAMES = {"enhanced": "score"}
HISTOGRAM_TITLES = {
    True: "Histogram and both scales",
    False: "Histogram of the pixel",
}
"""Titles with and without the scales."""
ENHANCED_TITLE, SCORE_TITLE = "Enhanced", "Score"
ESTIMATES_NAME = "estimate, own lag removed"


MOST_LAG = 0.1
"""Share of the gate above which a distance from estimate to maximum is not a lag."""


def score_title(what: str, pixel: Pixel, along: Scale) -> str:
    """Return the title of a plot of a pixel's score: how its maximum relates to the estimate.

    The estimate of a method is this maximum minus the method's lag, unless the estimate was then
    replaced by another, as some methods do.
    """
    if pixel.has_target is False:
        return f"{what}: no target here, its maximum is noise"
    if pixel.at_rest:
        return f"{what} of a surface at rest"
    lag = pixel.peak_lag_bins
    if abs(lag) < 1:
        return f"{what}: its maximum is the estimate"
    if not 0 < lag < MOST_LAG * pixel.score.size:
        return what
    return f"{what}: estimate = maximum − lag ({along.length(lag)})"


def bin_curves(names: Mapping[str, str], unit: str, **values: Array) -> list[Curve]:
    """State curves (bin,) for a download, by layer; `names` are those that differ from it."""
    return [
        Curve(layer, names.get(layer, layer), centres(y.size), y, unit)
        for layer, y in values.items()
    ]


def marks(names: Mapping[str, str], **positions: ArrayLike) -> list[Curve]:
    """State marks for a download, by layer; `names` are those that differ from it."""
    return [Curve(layer, names.get(layer, layer), x) for layer, x in positions.items()]


def drawn(lines: Mapping[str, Array | None], n_bins: int) -> dict[str, Array]:
    """Return curves (bin,) with NaN, which is not drawn, for those that are not known."""
    return {
        layer: np.full(n_bins, np.nan) if counts is None else counts
        for layer, counts in lines.items()
    }


def marker_line(position_bin: float, top: float, bottom: float = 0.0) -> tuple[Array, Array]:
    """Return the coordinates of a vertical line; it is not drawn at NaN."""
    return np.full(2, position_bin), np.array([bottom, top])


def edges(n_bins: int) -> Array:
    """Return the edges of the bins: bin k is centred on k + 1/2."""
    return np.arange(n_bins + 1, dtype=float)


def centres(n_bins: int) -> Array:
    """Return the centres of the bins."""
    return np.arange(n_bins) + 0.5


def histogram() -> hv.Overlay:
    """Plot raw counts with the expected counts of the model and both scales."""
    unit = hv.Dimension("counts", label="Counts")
    names = HISTOGRAM_NAMES
    bars = hv.Histogram((edges(1), NOTHING), kdims=BIN, vdims=unit, label=names["raw"])
    layers = [
        bars.opts(color=LIGHT.raw, line_width=0),
        _signal(unit, "expected", LIGHT.expected, 1.5, "dotted"),
        _signal(unit, names["small"], LIGHT.small),
        _signal(unit, names["large"], LIGHT.large),
        *_markers(unit),
    ]
    return _panel(layers, HISTOGRAM_TITLES[True])


def residual() -> hv.Overlay:
    """Plot the positive difference of the scales, and the first difference of the histogram."""
    unit = hv.Dimension("residual", label="Counts")
    layers = [
        _signal(unit, RESIDUAL_NAMES["raw"], LIGHT.raw, 1.2),
        _signal(unit, "residual", LIGHT.residual),
        *_markers(unit),
    ]
    return _panel(layers, "Residual: large minus small scale")


def enhanced() -> hv.Overlay:
    """Plot the residual times its weight, and the weight scaled to the plot."""
    unit = hv.Dimension("enhanced", label="Counts × weight")
    layers = [
        _signal(unit, "weight (scaled to fit)", LIGHT.weight, 1.2, "dashed"),
        _signal(unit, "enhanced", LIGHT.enhanced),
        *_markers(unit),
    ]
    return _panel(layers, f"{ENHANCED_TITLE}: residual × weight")


def score() -> hv.Overlay:
    """Plot the score of a method in each bin."""
    unit = hv.Dimension("score", label="Score")
    layers = [_signal(unit, "score", LIGHT.enhanced), *_markers(unit)]
    return _panel(layers, SCORE_TITLE)


def score_ends(values: Array) -> tuple[float, float]:
    """Return the ends of a vertical axis for scores (bin,).

    Scores below the median are shown as far as those above it.
    """
    high, middle = float(values.max()), float(np.median(values))
    above = high - middle or 1.0
    low = max(float(values.min()), middle - above)
    return low - 0.05 * above, high + 0.15 * above


def _signal(
    unit: hv.Dimension, label: str, color: str, width: float = 2, dash: str = "solid"
) -> hv.Curve:
    """Draw values of the bins (bin,)."""
    return _curve(centres(1), NOTHING, unit, label, color, width, dash)


def _curve(
    x: Array, y: Array, unit: hv.Dimension, label: str, color: str, width: float, dash: str
) -> hv.Curve:
    curve = hv.Curve((x, y), kdims=BIN, vdims=unit, label=label)
    return curve.opts(color=color, line_width=width, line_dash=dash)


def _truth(unit: hv.Dimension) -> hv.Curve:
    return _curve(*marker_line(np.nan, 1.0), unit, "truth", LIGHT.truth, 2.5, "4 2")


def _markers(unit: hv.Dimension) -> list[hv.Curve]:
    line = marker_line(np.nan, 1.0)
    return [_truth(unit), _curve(*line, unit, "estimate", LIGHT.estimate, 1.5, "solid")]


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
            legend_opts={
                "click_policy": "hide",
                "background_fill_alpha": 0.8,
                "orientation": "horizontal",
            },
        )
    )


def range_image() -> hv.Overlay:
    """Plot an image with row 0 at the top, and a frame around the selected pixel."""
    value = hv.Dimension("value", label="Range (m)", range=(0.0, 1.0))
    picture = hv.Image(
        (np.arange(2), np.arange(2), np.zeros((2, 2))),
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


def pixel_frame(
    row: float, col: float, down: float = 1.5, across: float = 1.5
) -> tuple[float, float, float, float]:
    """Return left, bottom, right and top of a frame, by default one that does not cover its pixel.

    It extends as far `down` as up, and as far to the left as `across`.
    """
    return col - across, row - down, col + across, row + down


def score_curves() -> hv.Overlay:
    """Plot the scores of each bin, a line for each method, with the truth and the estimates."""
    unit = hv.Dimension("score", label="Score, scaled")
    nothing = np.full(1, np.nan)
    layers = [
        hv.Path([np.full((1, 2), np.nan)], [BIN, unit]).opts(line_width=1.8),
        _truth(unit),
        hv.Scatter((nothing, nothing), BIN, unit, label=ESTIMATES_NAME).opts(
            marker="inverted_triangle", size=9, line_width=0
        ),
    ]
    return _panel(layers, "Score of each bin (0: median, 1: maximum)").opts(
        hv.opts.Overlay(legend_position="bottom")  # on a phone there is no room at its side
    )


def reliability() -> hv.Overlay:
    """Plot the share of right pixels against the confidence, a line for each method."""
    stated = hv.Dimension("confidence", label="Confidence")
    right = hv.Dimension("right", label="Share right within 3 bins")
    ends, nothing = np.array([0.0, 1.0]), np.full(1, np.nan)
    layers = [
        hv.Curve((ends, ends), stated, right, label="calibrated").opts(
            color=LIGHT.muted, line_width=1, line_dash="dashed"
        ),
        hv.Path([np.full((1, 2), np.nan)], [stated, right]).opts(line_width=1.8),
        hv.Scatter((nothing, nothing), stated, right).opts(size=6, line_width=0),
    ]
    return _panel(layers, "Reliability diagram (dashed: perfectly calibrated)").opts(
        hv.opts.Overlay(show_legend=False)
    )


# Curves of the studies with a colour of their own, by its name in the palette, and their dashes.
STUDY_COLORS: dict[str, tuple[str, list[int]]] = {
    "histogram": ("raw", []),
    "small scale": ("small", []),
    "large scale": ("large", []),
    "residual": ("residual", []),
    "largest residual, no noise": ("residual", []),
    "largest of noise alone, median": ("muted", [6, 3]),
    "largest of noise alone, 95 %": ("text", [6, 3]),
    "limit: probability of the right bin": ("text", [2, 4]),
    "limit": ("text", [2, 4]),
    "theory, flux known": ("text", [2, 4]),
    "estimates, no echo": ("estimate", []),
    "even": ("muted", [6, 3]),
    "echoes found": ("truth", []),
    "photons that arrive": ("large", []),
    "expected": ("expected", [2, 2]),
    "your prediction": ("estimate", [8, 4]),
    "calibrated": ("muted", [6, 3]),
    **dict.fromkeys(("exposure", "pulses", "α", "least confidence"), ("muted", [4, 2])),
    "echo's onset": ("truth", [4, 2]),
    "truth": ("truth", [4, 2]),
    ESTIMATES_NAME: ("estimate", []),
    "the echo above": ("estimate", []),
}
CURVE_PLACES = {**METHOD_PLACES, paper.LITERAL.name: len(METHOD_PLACES)}
SIMULATED = ", simulated"
"""End of the names of curves that are a method's."""
BARS = "histogram"
"""The curve that is drawn as bars."""


def curves(item: items.Plot, colors: Palette) -> Any:
    """Plot a study's curves, and vertical lines at its marks, as named renderers.

    The band of a curve has the curve's name and "band". Built without HoloViews, which takes five
    times as long, since these plots are built while the page is shown.
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
    # The same room for all legends keeps plots below each other aligned; one above the plot leaves
    # room for a download button.
    drawing.min_border_right = 196 if many else 32
    legend = Legend(
        items=entries,
        orientation="vertical" if many else "horizontal",
        click_policy="hide",
        background_fill_alpha=0.0,
    )
    drawing.add_layout(legend, "right" if many else "above")
    return drawing


def curve_styles(item: items.Plot, colors: Palette) -> dict[str, tuple[str, list[int]]]:
    """Return colour and dashes of each curve and mark; a method has the same ones everywhere."""
    styles = {}
    for n, name in enumerate((*item.curves, *item.marks)):
        if name in STUDY_COLORS:
            color, dash = STUDY_COLORS[name]
            styles[name] = (getattr(colors, color), dash)
        else:
            method = name.removesuffix(SIMULATED)
            styles[name] = line_style(CURVE_PLACES.get(method, n), colors)
    return styles


# Column or value of the pixel under the pointer. Bokeh would write NaN without asking.
READ_OUT = """
if (format === "column") return String(Math.round(value));
const found = source.data.image[0][special_vars.image_index.flat_index];
if (!Number.isFinite(found)) return "none shown";
const [unit] = source.tags;
return `${Number(found.toPrecision(5))} ${unit}`.replace(/e[+]?(-?\\d+)/, " × 10^$1");
"""


def value_read_out(picture: Any, unit: str = "") -> HoverTool:
    """Return a tool that shows row, column and value of an image's pixel under the pointer.

    The unit remains in the tags of the image's source: Bokeh would walk through the whole page if
    arguments of the tool were replaced.
    """
    picture.data_source.tags = [unit]
    shown = CustomJSHover(args={"source": picture.data_source}, code=READ_OUT)
    tips = [("Row", "$y{0}"), ("Column", "$x{column}"), ("Value", "$x{value}")]
    return HoverTool(renderers=[picture], tooltips=tips, formatters={"$x": shown})


PULSE_LAYERS = {
    "histogram": ("raw", "first photons so far"),
    "expected": ("expected", "expected"),
    "first photon": ("large", "first photon of this pulse"),
    "later photons": ("muted", "its later photons, lost"),
}
"""Layers of `pulse_figure`: colour in the palette, and name in the legend."""


def pulse_figure(item: Pulses) -> Any:
    """Plot a histogram that the browser fills, below the photons of one pulse.

    Its renderers have the names of `PULSE_LAYERS`.
    """
    n_bins = item.probability.size
    drawing = figure(
        title=item.title,
        x_axis_label="Bin (1 ns)",
        y_axis_label="Counts",
        x_range=Range1d(0, n_bins),
        y_range=Range1d(0, 1),
        extra_y_ranges={"photons": Range1d(0, 1)},
        sizing_mode="stretch_both",
        min_height=120,
        tools="",
        toolbar_location=None,
    )
    places = {"source": _empty("x", "y"), "y_range_name": "photons", "size": 9, "line_width": 1.5}
    drawn = {
        "histogram": drawing.vbar("x", 1.0, "top", source=_empty("x", "top"), line_width=0),
        "expected": drawing.line("x", "y", source=_empty("x", "y"), line_width=2, line_dash=[2, 2]),
        "first photon": drawing.scatter("x", "y", **places),
        "later photons": drawing.scatter(
            "x", "y", **places | {"source": _empty("x", "y")}, fill_alpha=0
        ),
    }
    for name, renderer in drawn.items():
        renderer.name = name
    entries = [LegendItem(label=PULSE_LAYERS[name][1], renderers=[drawn[name]]) for name in drawn]
    drawing.add_layout(
        Legend(items=entries, orientation="horizontal", background_fill_alpha=0.0), "above"
    )
    drawing.min_border_right = 32
    drawing.yaxis.ticker.min_interval = 1
    return drawing


def pictures(item: items.Pictures) -> list[Any]:
    """Plot images (row, col), a figure each, row 0 at the top, with common colours and view.

    Each figure has the renderers "picture", and "shadow" and "frame" around a pixel.
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
        box = {"x": -0.5, "y": -0.5, "dw": cols, "dh": rows}
        shown.append(drawing.image([image], **box, color_mapper=mapper, name="picture"))
        drawing.add_tools(value_read_out(shown[-1], "m"))
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
    for ranges in (across, down):  # frames must not widen the view
        ranges.renderers = shown
    return drawings


MARKERS = ("circle", "square", "triangle")
"""Markers of methods that share a colour."""


def tradeoff(colors: Palette) -> Any:
    """Plot missed targets against time, as named renderers.

    ``points`` are measured configurations, ``times`` and ``degrees`` their error bars, ``front``
    the Pareto front, ``chosen`` a ring around the recommended configuration.
    """
    drawing = figure(
        x_axis_type="log",
        y_axis_type="log",
        x_axis_label="Time for an image (ms)",
        y_axis_label="Not within 3 bins (share of the target pixels)",
        title="Error rate against time per image",
        sizing_mode="stretch_both",
        min_height=240,
        tools="box_zoom,tap",
        toolbar_location=None,
    )
    for name, dimension in _GOALS.items():
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
        source=_empty("x", "y", "color", "marker", "method", "way", "tip"),
        size=9,
        color="color",
        marker="marker",
        legend_field="method",
        name="points",
    )
    points.nonselection_glyph = points.selection_glyph = None
    drawing.add_tools(
        HoverTool(
            renderers=[points], tooltips=[("", "@way"), ("", "@tip")], point_policy="snap_to_data"
        )
    )
    legend = drawing.legend[0]
    legend.update(background_fill_alpha=0.0, orientation="horizontal")
    drawing.add_layout(legend, "below")  # on a phone there is no room at its side
    paint_tradeoff(drawing, colors)
    return drawing


_GOALS = {"goal time": "height", "goal degree": "width"}
"""Lines at the required time and restoration degree, and their direction."""


def show_goals(drawing: Any, milliseconds: float, degree: float) -> None:
    """Draw the required time and restoration degree; a degree of 1 is off the log axis."""
    for name, location in zip(_GOALS, (milliseconds, 1 - degree or None), strict=True):
        drawing.select_one({"name": name}).location = location


def paint_tradeoff(drawing: Any, colors: Palette) -> None:
    """Set the colours of lines; the points have their own."""
    for name, color in (("front", colors.text), ("chosen", colors.estimate)):
        drawing.select_one({"name": name}).glyph.line_color = color
    for name in _GOALS:
        drawing.select_one({"name": name}).line_color = colors.muted


def _empty(*columns: str) -> ColumnDataSource:
    return ColumnDataSource({column: [] for column in columns})
