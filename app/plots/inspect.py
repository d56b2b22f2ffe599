"""Figures of the Inspect page as pure functions: Bokeh figures with named renderers.

Figures over the gate have an extra vertical range ``marks`` from 0 to 1, in which vertical lines
extend from bottom to top whatever the data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bokeh.models import (
    ColumnDataSource,
    HoverTool,
    LinearAxis,
    NumeralTickFormatter,
    PrintfTickFormatter,
    Range1d,
)
from bokeh.plotting import figure

from app.plots.elements import ENHANCED_TITLE, SCORE_TITLE

MARKS = "marks"
RATE_TITLES = {
    "photons per pulse": "Rate, pile-up corrected (Coates)",
    "photons": "Rate as counted (no pile-up to correct)",
}
COUNTS_TITLES = {True: "Counts, and the two scales that follow them", False: "Counts"}
"""Titles with and without the scales."""
FIT_TITLE = "Counts, and those that the model expects"
EVIDENCE_TITLE = "Probability of the surface"
RESIDUAL_TITLE = "Residuals: counts minus expected ones"
FIT_COLUMNS = ("bin", "fit", "low", "high")
CANDIDATE_HEIGHT = 0.05
"""Height of the candidates' marks: near the bottom, where no legend hides them."""
RANK_GAP = 0.05
"""Distance, as a share of the gate, below which two ranks would overlap on a narrow screen."""
RANK_PX = 13
"""Height of a rank."""

PROFILE_TITLE = "Range along the line through the pinned pixels"
DISTANCE_LABEL = "Distance along the line (m)"
PROFILE_COLUMNS = (
    *("distance", "width", "range", "low", "high", "truth"),
    *("confidence", "row", "col", "text"),
)

NAMES = {
    "raw": "counts",
    "small": "small scale",
    "large": "large scale",
    "window": "suggested gate",
    "fit": "expected (fit)",
    "band": "95 % band",
    "alone": "the pixel alone",
    "neighbours": "its neighbours",
    "posterior": "both (posterior)",
    "deviation": "residual",
    "limits": "±2",
    "t_n": "T_n",
    "suggested": "suggested T_n",
    "interval": "95 % interval",
    "points": "within 3 bins",
    "present": "present number",
}
"""Names on screen of the layers that have another one."""


def empty(*columns: str) -> ColumnDataSource:
    """Return an empty source."""
    return ColumnDataSource({name: [] for name in columns})


def lifts(positions: Sequence[float], gap: float) -> list[float]:
    """Return the vertical offset in px of the rank of each candidate, best first.

    A rank is above those before it that are nearer than `gap`. Zooming in only separates them.
    """
    rows: list[int] = []
    for n, position in enumerate(positions):
        near = {
            row for row, other in zip(rows, positions, strict=False) if abs(other - position) < gap
        }
        rows.append(next(row for row in range(n + 1) if row not in near))
    return [-4.0 - RANK_PX * row for row in rows]


def counts(bins: Range1d, marks: Mapping[str, ColumnDataSource]) -> Any:
    """Plot the counts of each bin as bars, with both scales and the expected counts.

    ``expected`` are those of the true range and fluxes, ``fit`` those of the estimated ones.
    """
    drawing = _over_the_gate(COUNTS_TITLES[True], "Counts", bins)
    source, predicted = empty("bin", "raw", "expected", "small", "large"), empty(*FIT_COLUMNS)
    _bars(drawing, source, "raw")
    _line(drawing, source, "expected", 1.5, line_dash="dotted")
    _line(drawing, source, "small")
    _line(drawing, source, "large")
    band = {"x": "bin", "y1": "low", "y2": "high", "source": predicted}
    drawing.varea(**band, fill_alpha=0.3, name="band", legend_label=NAMES["band"])
    _line(drawing, predicted, "fit")
    return _marked(drawing, marks, with_ranks=True)


def rate(bins: Range1d, marks: Mapping[str, ColumnDataSource]) -> Any:
    """Plot the detection rate of each bin, corrected for pile-up."""
    drawing = _over_the_gate("", "", bins)
    source = empty("bin", "rate")
    _bars(drawing, source, "rate")
    return _marked(drawing, marks)


def stages(bins: Range1d, marks: Mapping[str, ColumnDataSource]) -> Any:
    """Plot the residual of the two scales, and the weighted residual on an axis of its own."""
    drawing = _over_the_gate(ENHANCED_TITLE, "Residual (counts)", bins)
    source = empty("bin", "residual", "enhanced")
    drawing.extra_y_ranges["enhanced"] = Range1d(0, 1)
    axis = LinearAxis(y_range_name="enhanced", axis_label="Counts × weight")
    drawing.add_layout(axis, "right")
    _line(drawing, source, "residual")
    _line(drawing, source, "enhanced", y_range_name="enhanced", line_dash=[6, 3])
    return _marked(drawing, marks)


def score(bins: Range1d, marks: Mapping[str, ColumnDataSource]) -> Any:
    """Plot the score of a method in each bin."""
    drawing = _over_the_gate(SCORE_TITLE, "Score", bins)
    _line(drawing, empty("bin", "score"), "score")
    return _marked(drawing, marks)


def evidence(bins: Range1d, marks: Mapping[str, ColumnDataSource]) -> Any:
    """Plot the probability of the surface from a pixel alone, from its neighbours, and both."""
    drawing = _over_the_gate(EVIDENCE_TITLE, "Probability per bin", bins)
    source = empty("bin", "alone", "neighbours", "posterior")
    _line(drawing, source, "alone")
    _line(drawing, source, "neighbours", line_dash=[6, 3])
    _line(drawing, source, "posterior")
    return _marked(drawing, marks)


def residuals(bins: Range1d, marks: Mapping[str, ColumnDataSource]) -> Any:
    """Plot the residuals of the counts from those that the model expects."""
    drawing = _over_the_gate(RESIDUAL_TITLE, "Standard deviations", bins)
    _bars(drawing, empty("bin", "deviation", *FIT_COLUMNS), "deviation")
    drawing.hspan(
        y=[-2.0, 2.0],
        line_width=1.2,
        line_dash="dashed",
        name="limits",
        legend_label=NAMES["limits"],
    )
    return _marked(drawing, marks)


def overlay(bins: Range1d, title: str, unit: str) -> Any:
    """Plot a line for each pin."""
    drawing = _over_the_gate(title, unit, bins)
    drawing.multi_line(
        "xs",
        "ys",
        line_color="color",
        legend_field="label",
        line_width=1.8,
        source=empty("xs", "ys", "color", "label"),
        name="lines",
    )
    return _with_legend(drawing)


def aggregate(bins: Range1d) -> Any:
    """Plot the summed counts of all pixels, the suggested gate, and T_n."""
    drawing = _over_the_gate("Counts of all pixels along the gate", "Counts", bins)
    drawing.yaxis.formatter = NumeralTickFormatter(format="0,0")  # also for millions
    _bars(drawing, empty("bin", "raw"), "raw")
    drawing.quad(
        "left",
        "right",
        source=empty("left", "right"),
        top=1.0,
        bottom=0.0,
        y_range_name=MARKS,
        fill_alpha=0.12,
        line_width=0,
        name="window",
        legend_label=NAMES["window"],
    )
    for name, dash in (("t_n", "solid"), ("suggested", "dashed")):
        _vertical(drawing, empty("x", "y"), name, line_dash=dash)
    return _with_legend(drawing)


def accuracy() -> Any:
    """Plot the share of right pixels against the number of pulses, with 95 % intervals."""
    drawing = _with_marks(
        x_axis_type="log",
        x_axis_label="Pulses",
        y_axis_label="Within 3 bins",
        x_range=Range1d(1, 1000),
        y_range=Range1d(0, 1.05),
        tools="",
    )
    source = empty("pulses", "value", "low", "high", "rmse_m")
    drawing.segment(
        "pulses",
        "low",
        "pulses",
        "high",
        source=source,
        line_width=5,
        line_alpha=0.4,
        name="interval",
        legend_label=NAMES["interval"],
    )
    drawing.line("pulses", "value", source=source, line_width=1.5, name="line")
    points = drawing.scatter(
        "pulses", "value", source=source, size=6, name="points", legend_label=NAMES["points"]
    )
    drawing.add_tools(
        HoverTool(
            renderers=[points],
            tooltips=[
                ("Pulses", "@pulses"),
                ("Within 3 bins", "@value{0.0000} [@low{0.0000}, @high{0.0000}]"),
                ("RMSE (m)", "@rmse_m{0.000}"),
            ],
        )
    )
    drawing.xaxis.formatter = PrintfTickFormatter(format="%.3g")
    _vertical(drawing, empty("x", "y"), "present")
    return _with_legend(drawing, "bottom_right")


def profile() -> Any:
    """Plot ranges against the distance along a line, with their 95 % intervals."""
    drawing = figure(
        title=PROFILE_TITLE,
        x_axis_label=DISTANCE_LABEL,
        y_axis_label="Range (m)",
        x_range=Range1d(0, 1),
        y_range=Range1d(0, 1),
        sizing_mode="stretch_both",
        min_height=200,
        tools="box_zoom,xwheel_zoom",
        active_scroll="xwheel_zoom",
        toolbar_location=None,
    )
    source = empty(*PROFILE_COLUMNS)
    # Each pixel has a bar of its own: nothing is drawn where there is no estimate.
    band = {"x": "distance", "bottom": "low", "top": "high", "width": "width"}
    drawing.vbar(
        **band,
        source=source,
        fill_alpha=0.3,
        line_alpha=0.3,
        name="interval",
        legend_label=NAMES["interval"],
    )
    across = {"x": "distance", "source": source}
    drawing.line(**across, y="range", line_width=1, line_alpha=0.5, name="line")
    dashed = {"line_width": 2, "line_dash": "4 2", "legend_label": "truth"}
    drawing.line(**across, y="truth", name="truth", **dashed)
    points = drawing.scatter(**across, y="range", size=4, name="points", legend_label="estimate")
    drawing.add_tools(
        HoverTool(
            renderers=[points],
            tooltips=[
                ("Row, column", "@row, @col"),
                ("Distance (m)", "@distance{0.000}"),
                ("Range (95 %)", "@text"),
                ("Confidence", "@confidence{0.000}"),
            ],
        )
    )
    return _with_legend(drawing)


def _over_the_gate(title: str, unit: str, bins: Range1d) -> Any:
    drawing = _with_marks(
        title=title,
        x_range=bins,
        y_range=Range1d(0, 1),
        y_axis_label=unit,
        tools="xbox_zoom,xwheel_zoom",
        active_scroll="xwheel_zoom",
    )
    drawing.min_border_top = drawing.min_border_bottom = 2
    return drawing


def _with_marks(**options: Any) -> Any:
    """Return a responsive figure with the range ``marks``."""
    drawing = figure(
        sizing_mode="stretch_both",
        min_height=80,  # Panel adds those of hidden plots to the height of the page
        toolbar_location=None,
        **options,
    )
    drawing.extra_y_ranges = {MARKS: Range1d(0, 1)}
    drawing.min_border_left, drawing.min_border_right = 52, 52
    return drawing


def _bars(drawing: Any, source: ColumnDataSource, column: str) -> None:
    label = NAMES.get(column, column)
    drawing.vbar(
        x="bin", top=column, width=1.0, source=source, line_width=0, name=column, legend_label=label
    )


def _line(
    drawing: Any, source: ColumnDataSource, column: str, width: float = 2, **style: Any
) -> None:
    label = NAMES.get(column, column)
    drawing.line(
        "bin", column, source=source, line_width=width, name=column, legend_label=label, **style
    )


def _vertical(
    drawing: Any,
    source: ColumnDataSource,
    name: str,
    width: float = 1.8,
    **style: Any,
) -> None:
    drawing.line(
        "x",
        "y",
        source=source,
        y_range_name=MARKS,
        line_width=width,
        name=name,
        legend_label=NAMES.get(name, name),
        **style,
    )


def _marked(drawing: Any, marks: Mapping[str, ColumnDataSource], with_ranks: bool = False) -> Any:
    """Add truth, estimate and candidates, from sources that figures share."""
    _vertical(drawing, marks["truth"], "truth", 2.5, line_dash="4 2")
    _vertical(drawing, marks["estimate"], "estimate", 1.5)
    places = {"source": marks["candidates"], "y_range_name": MARKS}
    drawing.scatter("x", "y", marker="triangle", size=8, **places, name="candidates")
    if with_ranks:
        # Above their marks; at their side they would overlap the next one.
        above = {"y_offset": "lift", "text_align": "center", "text_baseline": "bottom"}
        # Legible on bars and curves; `PixelPlots.paint` sets the colour.
        plate = {"background_fill_alpha": 0.8, "padding": (0, 2), "border_radius": 2}
        style = {"text_font_size": "11px", "name": "ranks"}
        drawing.text("x", "y", "rank", **places, **above, **plate, **style)
    return _with_legend(drawing)


def _with_legend(drawing: Any, location: str = "top_right") -> Any:
    drawing.legend.update(
        orientation="horizontal",
        location=location,
        click_policy="hide",
        background_fill_alpha=0.8,
    )
    return drawing
