"""Plots that compare methods: scores along the gate of a pixel, and reliability."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from bokeh.models import BasicTicker, LegendItem, Range1d
from numpy.typing import NDArray

from app.model.exports import Curve
from app.model.methods import METHOD_TITLES
from app.plots import elements as plots
from app.plots.gate_axes import GateAxes
from app.theme import Palette
from app.units import ShownGate
from app.widgets.figures import Plot, cover, fit, paint_frame, pane_of

Array = NDArray[Any]


Style = tuple[str, list[int]]
"""Colour and dashes of a method's line."""

LOWEST_SCORE = -1.0
"""Lower scores are cut; the scale runs from a curve's median, 0, to its maximum, 1."""


class Lines:
    """The lines of a plot, one for each method, in one layer, which is faster than a layer each."""

    def __init__(self, plot: Plot) -> None:
        self.source = plot.source("lines")
        self.source.data = {name: [] for name in ("xs", "ys", "color", "dash", "title")}
        color, dash = {"field": "color"}, {"field": "dash"}
        plot.layers["lines"]["glyph"].update(line_color=color, line_dash=dash)

    def update(self, lines: Mapping[str, tuple[Array, Array]], styles: Mapping[str, Style]) -> None:
        """Replace the lines, by method."""
        self.source.data = {
            "xs": [x.astype(np.float32) for x, _ in lines.values()],
            "ys": [y.astype(np.float32) for _, y in lines.values()],
            "title": [METHOD_TITLES[method] for method in lines],
            "color": [styles[method][0] for method in lines],
            "dash": [styles[method][1] or "solid" for method in lines],
        }


def curves_of(lines: Mapping[str, tuple[Array, Array]], unit: str) -> list[Curve]:
    """Return the lines of a plot, by method, for a download."""
    return [Curve("lines", METHOD_TITLES[method], *line, unit) for method, line in lines.items()]


class CurvePlot:
    """Score of each bin of one pixel, by method.

    Attributes
    ----------
    plot : Plot
    pane : pn.pane.Bokeh
    """

    def __init__(self) -> None:
        self.plot = Plot(plots.score_curves, ("lines", "truth", "estimates"))
        self._lines = Lines(self.plot)
        self._estimates = self.plot.source("estimates")
        self._estimates.data = {"bin": [], "score": [], "color": []}
        self.plot.layers["estimates"]["glyph"].fill_color = {"field": "color"}
        drawing = self.plot.figure
        drawing.x_range, drawing.y_range = Range1d(0, 1), Range1d(0, 1)
        drawing.min_border_left, drawing.min_border_right = 46, 14
        self._axes = GateAxes(drawing)
        renderer = self.plot.layers["lines"]["glyph_renderer"]
        drawing.legend[0].items.insert(
            0, LegendItem(label={"field": "title"}, renderers=[renderer])
        )
        self.pane = pane_of(drawing)

    def update(
        self,
        curves: Mapping[str, Array],
        estimates: Mapping[str, float],
        truth_bin: float,
        gate: ShownGate,
        styles: Mapping[str, Style],
        unit: str,
    ) -> None:
        """Show a pixel: curves (bin,), estimates in bins and styles of lines, by method."""
        plot = self.plot
        cover(plot.figure.x_range, gate.n_bins)
        self._axes.follow(unit, gate)
        centres = plots.centres(gate.n_bins)
        lines = {method: (centres, curve) for method, curve in curves.items()}
        self._lines.update(lines, styles)
        lowest = min((float(curve.min()) for curve in curves.values()), default=0.0)
        low = 1.05 * max(lowest, LOWEST_SCORE) - 0.02
        # One above the other, so that equal estimates remain visible.
        height = {method: 1.06 + 0.07 * place for place, method in enumerate(estimates)}
        top = 1.1 + 0.07 * len(estimates)
        fit(plot.figure, low, top)
        estimated = [method for method, at in estimates.items() if np.isfinite(at)]
        self._estimates.data = {
            "bin": np.array([estimates[method] for method in estimated], np.float32),
            "score": np.array([height[method] for method in estimated], np.float32),
            "color": [styles[method][0] for method in estimated],
        }
        x, y = plots.marker_line(truth_bin, top)
        plot.write("truth", bin=x, score=y)
        plot.show("truth", bool(np.isfinite(truth_bin)))
        marks = [
            Curve("estimates", f"{METHOD_TITLES[each]}, {plots.ESTIMATES_NAME}", estimates[each])
            for each in estimated
        ]
        truth = Curve("truth", "truth", truth_bin)
        plot.keep(gate, [*curves_of(lines, "score, scaled"), truth, *marks])

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme; those of the lines come with `update`."""
        paint_frame(self.plot.figure, colors)
        self.plot.layers["truth"]["glyph"].line_color = colors.truth


class ReliabilityPlot:
    """Share of right estimates against their confidence, by method.

    Attributes
    ----------
    plot : Plot
    pane : pn.pane.Bokeh
    """

    def __init__(self) -> None:
        self.plot = Plot(plots.reliability, ("honest", "lines", "dots"))
        self._lines = Lines(self.plot)
        self._dots = self.plot.source("dots")
        self._dots.data = {"confidence": [], "right": [], "color": []}
        self.plot.layers["dots"]["glyph"].fill_color = {"field": "color"}
        drawing = self.plot.figure
        drawing.x_range, drawing.y_range = Range1d(0, 1.02), Range1d(0, 1.04)
        drawing.xaxis.ticker = drawing.yaxis.ticker = BasicTicker(desired_num_ticks=5)
        self.pane = pane_of(drawing)

    def update(self, lines: Mapping[str, tuple[Array, Array]], styles: Mapping[str, Style]) -> None:
        """Show confidence and share of right estimates, by method."""
        self._lines.update(lines, styles)
        self.plot.keep("Confidence", curves_of(lines, "share right within 3 bins"))
        confidence, right = ([each[axis] for each in lines.values()] for axis in (0, 1))
        colors = [[styles[method][0]] * each[0].size for method, each in lines.items()]
        self._dots.data = {
            "confidence": np.concatenate([*confidence, np.empty(0)]),
            "right": np.concatenate([*right, np.empty(0)]),
            "color": [color for several in colors for color in several],
        }

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme; those of the lines come with `update`."""
        paint_frame(self.plot.figure, colors)
        self.plot.layers["honest"]["glyph"].line_color = colors.muted
