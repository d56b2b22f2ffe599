"""The plots of a pixel: histogram, residual and enhanced signal, or the score of a method."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BasicTicker, Range1d
from numpy.typing import NDArray

from app.model.exports import Curve
from app.model.store import Pixel
from app.plots import elements as plots
from app.plots.gate_axes import GateAxes, GateReadOut
from app.plots.gate_cut import GateCut
from app.theme import Palette
from app.units import ShownGate, scale
from app.widgets.figures import Plot, fit, round_up
from core import Signals

Array = NDArray[Any]


LEFT_PX, BESIDE_PX = 46, 28
"""Room for the labels of the axis, and for the download button, which else covers the legend."""


class SignalPlots:
    """The pixel's plots, linked along the gate.

    Attributes
    ----------
    histogram : Plot
    residual, enhanced : Plot
        Stages of the tracking differentiator.
    score : Plot
        Score of another method, in place of these.
    cut : GateCut
        The ends of the gate on the histogram, and the extent of all plots.
    """

    def __init__(self) -> None:
        self.histogram = Plot(plots.histogram, plots.HISTOGRAM_LAYERS)
        self.residual = Plot(plots.residual, plots.RESIDUAL_LAYERS)
        self.enhanced = Plot(plots.enhanced, plots.ENHANCED_LAYERS)
        self.score = Plot(plots.score, plots.SCORE_LAYERS)
        self._bins = Range1d(0, 1)
        for plot in self.plots:
            figure = plot.figure
            figure.x_range, figure.y_range = self._bins, Range1d(0, 1)
            figure.min_border_left, figure.min_border_right = LEFT_PX, BESIDE_PX
            figure.min_border_top = figure.min_border_bottom = 4
            figure.yaxis.ticker = BasicTicker(desired_num_ticks=4)
        self.cut = GateCut(self.histogram.figure, self._bins)
        # The second axis appears once: the plots are stacked.
        self._axes = [GateAxes(plot.figure, plot is self.histogram) for plot in self.plots]
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
                (self.score, "enhanced", [("Score", self.score.source("enhanced"), "score")]),
            )
        ]

    @property
    def plots(self) -> tuple[Plot, ...]:
        """All plots, from top to bottom."""
        return self.histogram, self.residual, self.enhanced, self.score

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        for plot in self.plots:
            plot.paint(colors)
        self.cut.paint(colors)

    def update(
        self, pixel: Pixel, gate: ShownGate, with_difference: bool, unit: str = "bins"
    ) -> None:
        """Show a pixel, with axes in a unit."""
        for axes in self._axes:
            axes.follow(unit, gate)
        for read_out in self._read_outs:
            read_out.follow(gate)
        if self.histogram.source("raw").data["top"].size != gate.n_bins:
            self._lay_out(gate.n_bins)
        self._draw_histogram(pixel, gate)
        along = scale(unit, gate)
        if pixel.signals is None:
            self.score.figure.title.text = plots.score_title(plots.SCORE_TITLE, pixel, along)
            self._draw_score(pixel, gate)
        else:
            self.enhanced.figure.title.text = plots.score_title(plots.ENHANCED_TITLE, pixel, along)
            self._draw_stages(pixel, pixel.signals, gate, with_difference)

    def _draw_histogram(self, pixel: Pixel, gate: ShownGate) -> None:
        plot, lines = self.histogram, plots.drawn(pixel.lines, gate.n_bins)
        plot.figure.title.text = plots.HISTOGRAM_TITLES[pixel.signals is not None]
        plot.write("raw", top=pixel.histogram)
        for layer, counts in lines.items():
            plot.write(layer, counts=counts)
            plot.show(layer, pixel.lines[layer] is not None)
        self._frame(plot, pixel, 0.0, pixel.histogram, *lines.values())
        curves = plots.bin_curves(plots.HISTOGRAM_NAMES, "counts", raw=pixel.histogram, **lines)
        plot.keep(gate, curves + _marks(pixel))

    def _draw_score(self, pixel: Pixel, gate: ShownGate) -> None:
        plot, score = self.score, pixel.score
        plot.write("enhanced", score=score)
        low, high = plots.score_ends(score)
        fit(plot.figure, low, high)
        self._mark(plot, pixel, low, high)
        curves = plots.bin_curves(plots.SCORE_NAMES, "", enhanced=score)
        plot.keep(gate, curves + _marks(pixel))

    def _draw_stages(
        self, pixel: Pixel, signals: Signals, gate: ShownGate, with_difference: bool
    ) -> None:
        nothing = np.full(gate.n_bins, np.nan)
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

        curves, names = plots.bin_curves, plots.RESIDUAL_NAMES
        residual = curves(names, "counts", raw=difference, residual=signals.residual)
        enhanced = [
            *curves({}, "", weight=signals.weight),  # as it is; on screen it is scaled
            *curves({}, "counts × weight", enhanced=signals.enhanced),
        ]
        self.residual.keep(gate, residual + _marks(pixel))
        self.enhanced.keep(gate, enhanced + _marks(pixel))

    def _lay_out(self, n_bins: int) -> None:
        """Prepare the plots for another number of bins."""
        edges, centres = plots.edges(n_bins), plots.centres(n_bins)
        empty = np.zeros(n_bins)
        bars = {"left": edges[:-1], "right": edges[1:], "top": empty, "bottom": empty}
        self.histogram.source("raw").data = bars
        for plot, column, layers in (
            (self.histogram, "counts", ("expected", "small", "large")),
            (self.residual, "residual", ("raw", "residual")),
            (self.enhanced, "enhanced", ("weight", "enhanced")),
            (self.score, "score", ("enhanced",)),
        ):
            for layer in layers:
                plot.source(layer).data = {"bin": centres, column: empty}

    def _frame(self, plot: Plot, pixel: Pixel, low: float, *curves: Array) -> None:
        """Fit the vertical axis, and draw the lines of truth and estimate."""
        highest = max(float(np.nanmax(curve, initial=0.0)) for curve in curves)
        end = round_up(highest * 1.15) or 1.0
        fit(plot.figure, -round_up(-low * 1.05), end)
        self._mark(plot, pixel, 0.0, end)

    @staticmethod
    def _mark(plot: Plot, pixel: Pixel, low: float, high: float) -> None:
        """Draw the lines of truth and estimate."""
        (column,) = (name for name in plot.source("truth").data if name != "bin")
        for layer, position in (("truth", pixel.truth_bin), ("estimate", pixel.answer_bin)):
            x, y = plots.marker_line(position, high, low)
            plot.write(layer, **{"bin": x, column: y})
            plot.show(layer, bool(np.isfinite(position)))


def _marks(pixel: Pixel) -> list[Curve]:
    """State the lines of truth and estimate for a download."""
    return plots.marks({}, truth=pixel.truth_bin, estimate=pixel.answer_bin)
