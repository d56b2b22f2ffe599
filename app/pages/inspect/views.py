"""Plots of the Inspect page: the map, and plots along the gate."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
from bokeh.events import SelectionGeometry
from bokeh.models import (
    BasicTicker,
    BoxSelectTool,
    BoxZoomTool,
    ColumnDataSource,
    FreehandDrawTool,
    LassoSelectTool,
    Range1d,
    WheelZoomTool,
)
from numpy.typing import NDArray

from app.model.exports import Curve, band
from app.model.state import MOST_PINS, NEIGHBOURS
from app.model.store import Pixel
from app.pages.inspect.results import Corners, Inspected
from app.pages.shared.outputs import layers_of
from app.plots import elements as plots
from app.plots import inspect as inspect_plots
from app.plots.gate_axes import GateAxes, GateReadOut
from app.plots.gate_cut import GateCut
from app.theme import LIGHT, Palette
from app.units import Scale, ShownGate, scale
from app.widgets.figures import Layers, fit, paint_frame, round_up
from app.widgets.image_view import ImageView
from core import ESTIMATORS
from core.inference import Predictive
from core.inspection import FaultyPixel

Array = NDArray[Any]
Pixels = tuple[tuple[int, int], ...]
"""Rows and columns of pixels."""

MAX_DRAWN_CORNERS = 60
"""Corners kept of a lasso: enough for its shape, few enough for a link."""


NO_STROKE: dict[str, list[list[float]]] = {"xs": [[]], "ys": [[]]}
"""Data of a line that has not been drawn; without the path, Bokeh's tool would fail where a drag
begins beside the image."""


class Navigator(ImageView):
    """The map, with the region outlined and the pins framed.

    Parameters
    ----------
    tapped : callable
        Called with the row and column of a tapped pixel.
    selected : callable
        Called with the corners of a drawn region.
    joined : callable
        Called with the pixels at the vertices of a drawn line.

    Attributes
    ----------
    drags : dict of str to bokeh.models.Tool
        What dragging on the map can do.
    """

    def __init__(
        self,
        tapped: Callable[[int, int], None],
        selected: Callable[[Corners], None],
        joined: Callable[[Pixels], None],
    ) -> None:
        super().__init__(tapped)
        figure = self.figure
        self.drawn = ColumnDataSource(NO_STROKE)
        stroke = figure.multi_line(
            "xs", "ys", source=self.drawn, line_color="#ffffff", line_width=2, name="stroke"
        )
        # The tools select nothing in the image itself: a layer outlines the region.
        by_hand = {
            "Rectangle": BoxSelectTool(renderers=[]),
            "Lasso": LassoSelectTool(renderers=[], continuous=False),
            "Line": FreehandDrawTool(renderers=[stroke], num_objects=1),
        }
        wheel = WheelZoomTool()
        figure.add_tools(*by_hand.values(), wheel)
        figure.toolbar.active_scroll = wheel
        (zoom,) = (tool for tool in figure.toolbar.tools if isinstance(tool, BoxZoomTool))
        self.drags = {"Zoom": zoom, **by_hand}
        self._region = inspect_plots.empty("xs", "ys")
        for name, color, width in (("shadow", "#000000", 4), ("line", "#ffd000", 2)):
            figure.patches(
                "xs",
                "ys",
                source=self._region,
                fill_alpha=0,
                line_color=color,
                line_width=width,
                name=f"region {name}",
            )
        self._pins = inspect_plots.empty("left", "right", "top", "bottom", "color")
        figure.quad(
            "left",
            "right",
            "top",
            "bottom",
            source=self._pins,
            fill_alpha=0,
            line_color="color",
            line_width=2.5,
            name="pins",
        )

        self._line = inspect_plots.empty("x", "y")
        for name, color, thickness in (("shadow", "#000000", 3.5), ("line", "#ffffff", 1.5)):
            figure.line(
                "x",
                "y",
                source=self._line,
                line_color=color,
                line_width=thickness,
                name=f"line {name}",
            )

        self._faulty = inspect_plots.empty("x", "y", "marker")
        for name, color, thickness in (("shadow", "#000000", 3.5), ("mark", "#ffffff", 1.5)):
            figure.scatter(
                "x",
                "y",
                marker="marker",
                source=self._faulty,
                size=7,
                fill_alpha=0,
                line_color=color,
                line_width=thickness,
                name=f"faulty {name}",
            )

        def select(event: SelectionGeometry) -> None:
            if event.final:
                corners = (self._grid.index(*each) for each in corners_of(event.geometry))
                selected(tuple((round(row, 2), round(col, 2)) for row, col in corners))

        figure.on_event(SelectionGeometry, select)

        def join(_attribute: str, _old: Any, new: Mapping[str, Any]) -> None:
            path = np.column_stack([np.asarray(new[axis][-1], float) for axis in ("ys", "xs")])
            if len(path):
                self.drawn.data = dict(NO_STROKE)  # a layer joins the pins
                joined(self._on_line(path))

        self.drawn.on_change("data", join)

    def _on_line(self, path: Array) -> Pixels:
        """Return the pixels, once each, at the vertices of a path (vertex, row and col)."""
        first, last = (0, 0), tuple(size - 1 for size in self._shape)
        inside = np.clip(path, *(np.array(self._grid.place(*at)) for at in (first, last)))
        pixels = [self._grid.pixel(*inside[at]) for at in vertices(inside, max(self.half_frame))]
        return tuple(dict.fromkeys(pixels))

    def mark_faulty(self, faulty: Sequence[FaultyPixel]) -> None:
        """Mark hot pixels by circles, dead ones by crosses."""
        places = [self._grid.place(each.row, each.col) for each in faulty]
        marks: dict[str, list[Any]] = {
            "y": [row for row, _ in places],
            "x": [col for _, col in places],
            "marker": ["circle" if each.health == "hot" else "x" for each in faulty],
        }
        if marks != self._faulty.data:
            self._faulty.data = marks

    def outline(self, region: Corners) -> None:
        """Outline a region; none if it is empty."""
        places = [self._grid.place(*corner) for corner in region]
        cols, rows = [col for _, col in places], [row for row, _ in places]
        self._region.data = {"xs": [cols] if region else [], "ys": [rows] if region else []}

    def pin(self, pins: Sequence[tuple[int, int]], colors: Sequence[str]) -> None:
        """Frame pixels, each in its colour."""
        frames = np.array([self.frame(*pin) for pin in pins], float).reshape(-1, 4)
        sides = dict(zip(("left", "bottom", "right", "top"), frames.T, strict=True))
        self._pins.data = {**sides, "color": list(colors[: len(pins)])}

    def join_pins(self, pins: Sequence[tuple[int, int]]) -> None:
        """Draw a line that joins pixels; none if they are fewer than two."""
        places = [self._grid.place(*pin) for pin in pins]
        self._line.data = {"x": [col for _, col in places], "y": [row for row, _ in places]}


def vertices(path: Array, tolerance: float) -> list[int]:
    """Return the indices of the ends of a path (point, 2), and of its strongest bends in between.

    They are at most `MOST_PINS`, and fewer if no point is farther than `tolerance` from the lines
    that join them.
    """
    kept = [0, len(path) - 1]
    while len(kept) < MOST_PINS:
        away = np.zeros(len(path))
        for first, last in pairwise(kept):
            (down, across), part = path[last] - path[first], slice(first, last + 1)
            (rows, cols), length = (path[part] - path[first]).T, np.hypot(down, across)
            away[part] = np.abs(rows * across - cols * down) / length if length else 0.0
        if away.max() <= tolerance:
            break
        kept = sorted([*kept, int(away.argmax())])
    return kept


def corners_of(geometry: Mapping[str, Any]) -> Corners:
    """Return the corners (row, col) of a selection drawn with one of Bokeh's tools."""
    if geometry["type"] == "rect":
        (left, right), (top, bottom) = (
            sorted((geometry[f"{axis}0"], geometry[f"{axis}1"])) for axis in "xy"
        )
        return (top, left), (top, right), (bottom, right), (bottom, left)
    drawn = list(zip(geometry["y"], geometry["x"], strict=True))
    kept = drawn[:: -(-len(drawn) // MAX_DRAWN_CORNERS)]
    return tuple((float(row), float(col)) for row, col in kept)


def rectangle(rows: tuple[int, int], cols: tuple[int, int]) -> Corners:
    """Return the corners of a rectangle of whole pixels, from first to last row and column."""
    (top, bottom), (left, right) = ((low - 0.5, high + 0.5) for low, high in (rows, cols))
    return (top, left), (top, right), (bottom, right), (bottom, left)


PALETTE_NAMES = {
    "rate": "raw",
    "candidates": "text",
    "ranks": "text",
    "score": "enhanced",
    "alone": "large",
    "neighbours": "small",
    "posterior": "enhanced",
    "window": "residual",
    "t_n": "estimate",
    "present": "estimate",
    "suggested": "residual",
    "line": "small",
    "points": "small",
    "interval": "small",
    "fit": "small",
    "band": "small",
    "deviation": "raw",
    "limits": "text",
}
"""Layers that the palette knows under another name."""


class NamedLayers(Layers):
    """A figure whose renderers are coloured by their names."""

    def __init__(self, figure: Any) -> None:
        super().__init__(figure, layers_of(figure).layers)

    def paint(self, colors: Palette) -> None:
        """Take on the colours of a mode."""
        paint_frame(self.figure, colors)
        for layer, handles in self.layers.items():
            glyph = handles["glyph"]
            color = getattr(colors, PALETTE_NAMES.get(layer, layer), None)
            if color is not None:  # else a column of the data holds the colours
                for part in ("line_color", "fill_color", "text_color"):
                    if hasattr(glyph, part):
                        setattr(glyph, part, color)

    def mark(self, layer: str, position: float) -> None:
        """Move an upright line."""
        x, y = plots.marker_line(position, 1.0)
        self.source(layer).data = {"x": x, "y": y}


class GatePlot(NamedLayers):
    """A plot over the gate; its curves are columns of the first layer's source.

    Parameters
    ----------
    figure : bokeh.plotting.figure
        From `app.plots.inspect`.
    read_out : mapping of str to str
        Columns to read out under the pointer, by their names on screen.
    has_top : bool
        Whether it has a second axis along the gate.
    """

    def __init__(
        self, figure: Any, read_out: Mapping[str, str] | None = None, has_top: bool = False
    ) -> None:
        super().__init__(figure)
        self._axes = GateAxes(figure, has_top)
        self._curve_layer = next(iter(self.layers))
        self._read_out = None
        if read_out:
            source = self.source(self._curve_layer)
            renderer = self.layers[self._curve_layer]["glyph_renderer"]
            rows = [(name, source, column) for name, column in read_out.items()]
            self._read_out = GateReadOut(figure, renderer, rows)
        figure.yaxis.ticker = BasicTicker(desired_num_ticks=4)

    def curve(self, name: str) -> Array:
        """Return a curve (bin,) as it is drawn, in 32 bits."""
        return np.asarray(self.source(self._curve_layer).data[name])

    def follow(self, unit: str, gate: ShownGate) -> None:
        """Change the unit or the gate of the axes."""
        self._axes.follow(unit, gate)
        if self._read_out is not None:
            self._read_out.follow(gate)

    def draw(self, gate: ShownGate, curves: Sequence[Curve]) -> None:
        """Draw curves (bin,), and keep them for a download; marks are only kept."""
        self.keep(gate, curves)
        columns = {each.layer: each.y for each in curves if each.y is not None}
        bins = plots.centres(gate.n_bins)
        if len(self.curve("bin")) != bins.size:
            columns["bin"] = bins
            self.source(self._curve_layer).data = {
                name: np.asarray(values, np.float32) for name, values in columns.items()
            }
        else:
            self.write(self._curve_layer, **columns)

    def frame(self, *curves: Array, axis: str = "") -> None:
        """Fit the vertical axis to these curves."""
        top = round_up(1.15 * max(float(np.nanmax(curve, initial=0.0)) for curve in curves)) or 1.0
        vertical = self.figure.extra_y_ranges[axis] if axis else self.figure.y_range
        if vertical.end != top:
            vertical.update(end=top, reset_end=top)


class PixelPlots:
    """Counts, and one plot below them, of a pixel or a region, linked along the gate.

    A plot is made when it is first shown: a page that opens would wait for hidden ones, too.

    Attributes
    ----------
    bins : Range1d
        The common axis along the gate.
    counts : GatePlot
    candidates : ColumnDataSource
        Marks of the candidates.
    cut : GateCut
        The ends of the gate on the counts, and the extent of all plots.
    """

    def __init__(self) -> None:
        nowhere, upright = plots.marker_line(np.nan, 1.0)
        self.candidates = inspect_plots.empty("x", "y", "rank", "lift")
        self._marks = {
            "truth": ColumnDataSource({"x": nowhere, "y": upright}),
            "estimate": ColumnDataSource({"x": nowhere, "y": upright}),
            "candidates": self.candidates,
        }
        self.bins = Range1d(0, 1)
        self._colors = LIGHT
        self._made: list[GatePlot] = []
        read_out = {"Counts": "raw", "Small scale": "small", "Large scale": "large"}
        self.counts = self._make(inspect_plots.counts, read_out, has_top=True)
        self.cut = GateCut(self.counts.figure, self.bins)

    @cached_property
    def rate(self) -> GatePlot:
        """The rate with pile-up corrected."""
        return self._make(inspect_plots.rate, {"Rate": "rate"})

    @cached_property
    def stages(self) -> GatePlot:
        """Residual and enhanced signal of the tracking differentiator."""
        return self._make(inspect_plots.stages, {"Residual": "residual", "Enhanced": "enhanced"})

    @cached_property
    def score(self) -> GatePlot:
        """The score of another method, in place of the stages."""
        return self._make(inspect_plots.score, {"Score": "score"})

    @cached_property
    def evidence(self) -> GatePlot:
        """The evidence of the neighbours and of the pixel.

        In place of the score of a method that uses neighbours.
        """
        read_out = {"Pixel alone": "alone", "Neighbours": "neighbours", "Both": "posterior"}
        return self._make(inspect_plots.evidence, read_out)

    @cached_property
    def residuals(self) -> GatePlot:
        """Residuals of the counts from those that the model expects."""
        read_out = {"Residual": "deviation", "Expected": "fit", "95 % from": "low", "to": "high"}
        return self._make(inspect_plots.residuals, read_out)

    def _make(
        self, figure: Callable[..., Any], read_out: Mapping[str, str], has_top: bool = False
    ) -> GatePlot:
        made = GatePlot(figure(self.bins, self._marks), read_out, has_top)
        made.paint(self._colors)
        self._made.append(made)
        return made

    def paint(self, colors: Palette) -> None:
        """Take on the colours of a mode."""
        self._colors = colors
        for plot in self._made:
            plot.paint(colors)
        self.counts.layers["ranks"]["glyph"].background_fill_color = colors.paper
        self.cut.paint(colors)

    def update(self, found: Inspected, unit: str, plot: str) -> str:
        """Show a pixel or a region, with positions in a unit.

        Parameters
        ----------
        found : Inspected
        unit : str
        plot : str
            What to show below the counts, of `app.model.state.PLOTS`. That of a fit stays empty
            until `draw_fit` draws the counts that the model expects.

        Returns
        -------
        below : str
            The attribute that holds the plot below the counts.
        """
        pixel, report, gate = found.pixel, found.report, found.answer.gate
        name = _below(found, plot)
        below: GatePlot = getattr(self, name)
        for each in (self.counts, below):
            each.follow(unit, gate)
        marks = _marks(found)
        self._draw_counts(pixel, gate, marks, with_fit=name == "residuals")
        draw: Callable[..., None] = getattr(self, f"_draw_{name}")
        draw(found, marks, scale(unit, gate))
        for mark, position in (("truth", pixel.truth_bin), ("estimate", pixel.answer_bin)):
            self.counts.write(mark, x=np.full(2, position))
            for each in (self.counts, below):
                each.show(mark, bool(np.isfinite(position)))
        candidates = [each.bin for each in report.candidates]
        extent = self.bins.reset_end - self.bins.reset_start
        self.candidates.data = {
            "x": np.array(candidates, np.float32),
            "y": np.full(len(candidates), inspect_plots.CANDIDATE_HEIGHT, np.float32),
            "rank": [str(n + 1) for n in range(len(candidates))],
            "lift": inspect_plots.lifts(candidates, inspect_plots.RANK_GAP * extent),
        }
        return name

    def _draw_rate(self, found: Inspected, marks: list[Curve], along: Scale) -> None:
        rate, unit = found.report.rate, found.report.rate_unit
        self.rate.draw(found.answer.gate, _curves(unit, rate=rate) + marks)
        self.rate.frame(rate)
        self.rate.figure.yaxis[0].axis_label = unit.capitalize()
        self.rate.figure.title.text = inspect_plots.RATE_TITLES[unit]

    def _draw_evidence(self, found: Inspected, marks: list[Curve], along: Scale) -> None:
        evidence = found.report.evidence
        assert evidence is not None
        self.evidence.draw(found.answer.gate, _curves("probability", **evidence._asdict()) + marks)
        self.evidence.frame(*evidence)

    def _draw_score(self, found: Inspected, marks: list[Curve], along: Scale) -> None:
        score = found.pixel.score
        self.score.figure.title.text = plots.score_title(plots.SCORE_TITLE, found.pixel, along)
        self.score.draw(found.answer.gate, _curves("", score=score) + marks)
        fit(self.score.figure, *plots.score_ends(score))

    def _draw_stages(self, found: Inspected, marks: list[Curve], along: Scale) -> None:
        signals = found.pixel.signals
        assert signals is not None
        title = plots.score_title(plots.ENHANCED_TITLE, found.pixel, along)
        self.stages.figure.title.text = title
        residual = _curves("counts", residual=signals.residual)
        enhanced = _curves("counts × weight", enhanced=signals.enhanced)
        self.stages.draw(found.answer.gate, residual + enhanced + marks)
        self.stages.frame(signals.residual)
        self.stages.frame(signals.enhanced, axis="enhanced")

    def _draw_residuals(self, found: Inspected, marks: list[Curve], along: Scale) -> None:
        self.residuals.keep(found.answer.gate, [])
        _empty(self.residuals.source("deviation"))

    def draw_fit(self, found: Inspected, predicted: Predictive) -> None:
        """Draw the counts that the model expects, and the residuals."""
        gate, marks = found.answer.gate, _marks(found)
        bins, low, high = plots.centres(gate.n_bins), predicted.low, predicted.high
        ends = band("band", inspect_plots.NAMES["band"], bins, low, high, "counts")
        fitted = _curves("counts", raw=predicted.counts, fit=predicted.expected)
        self.counts.keep(gate, [*fitted, *ends, *marks])
        self.residuals.keep(gate, [*_curves("", deviation=predicted.residual), *marks])
        self.counts.frame(predicted.counts, high)
        ends_at = max(round_up(1.1 * float(np.abs(predicted.residual).max())), 3.0)
        fit(self.residuals.figure, -ends_at, ends_at)
        drawn = {"bin": bins, "fit": predicted.expected, "low": low, "high": high}
        drawn = {name: np.asarray(values, np.float32) for name, values in drawn.items()}
        self.counts.source("fit").data = drawn
        deviation = predicted.residual.astype(np.float32)
        self.residuals.source("deviation").data = drawn | {"deviation": deviation}

    def _draw_counts(
        self, pixel: Pixel, gate: ShownGate, marks: list[Curve], with_fit: bool
    ) -> None:
        """Draw the counts, with those of the model and both scales where they are known."""
        known: dict[str, Any] = dict.fromkeys(pixel.lines) if with_fit else pixel.lines
        plot, lines = self.counts, plots.drawn(known, gate.n_bins)
        titles = inspect_plots.COUNTS_TITLES[pixel.signals is not None]
        plot.figure.title.text = inspect_plots.FIT_TITLE if with_fit else titles
        plot.draw(gate, _curves("counts", raw=pixel.histogram, **lines) + marks)
        for layer, counts in known.items():
            plot.show(layer, counts is not None)
        plot.frame(pixel.histogram, *lines.values())
        for layer in ("fit", "band"):
            plot.show(layer, with_fit)
        _empty(plot.source("fit"))


_curves = partial(plots.bin_curves, inspect_plots.NAMES)


def _empty(source: ColumnDataSource) -> None:
    source.data = {name: np.empty(0, np.float32) for name in source.data}


def _below(found: Inspected, plot: str) -> str:
    """Return the attribute of `PixelPlots` for one of `app.model.state.PLOTS`."""
    if plot in ("Rate", "Fit"):
        return "rate" if plot == "Rate" else "residuals"
    is_score = ESTIMATORS[found.report.method].evidence is not None
    if found.report.evidence is not None and (is_score or plot == NEIGHBOURS):
        return "evidence"
    return "score" if found.pixel.signals is None else "stages"


def _marks(found: Inspected) -> list[Curve]:
    """State truth, estimate and candidates for a download."""
    return plots.marks(
        inspect_plots.NAMES,
        truth=found.pixel.truth_bin,
        estimate=found.pixel.answer_bin,
        candidates=[each.bin for each in found.report.candidates],
    )
