"""The three plots of a pixel: histogram, residual and enhanced signal."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BasicTicker, Range1d
from numpy.typing import NDArray

from app.model.store import Pixel
from app.plots import elements as plots
from app.plots.gate_axes import GateAxes, GateReadOut
from app.theme import LIGHT, Palette
from app.widgets.figures import Plot, cover, round_up
from core import Acquisition

Array = NDArray[Any]


class SignalPlots:
    """The pixel's three plots, linked along the gate."""

    def __init__(self) -> None:
        one = np.zeros(1)
        self.histogram = Plot(plots.histogram(one, one, one, one, LIGHT), plots.HISTOGRAM_LAYERS)
        self.residual = Plot(plots.residual(one, one, LIGHT), plots.RESIDUAL_LAYERS)
        self.enhanced = Plot(plots.enhanced(one, one, LIGHT), plots.ENHANCED_LAYERS)
        self._bins = Range1d(0, 1)
        for plot in self.plots:
            figure = plot.figure
            figure.x_range, figure.y_range = self._bins, Range1d(0, 1)
            figure.min_border_left, figure.min_border_right = 46, 14
            figure.min_border_top = figure.min_border_bottom = 4
            figure.yaxis.ticker = BasicTicker(desired_num_ticks=4)
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
            )
        ]

    @property
    def plots(self) -> tuple[Plot, Plot, Plot]:
        """The three plots, from top to bottom."""
        return self.histogram, self.residual, self.enhanced

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        for plot in self.plots:
            plot.paint(colors)

    def update(
        self, pixel: Pixel, acquisition: Acquisition, with_difference: bool, unit: str = "bins"
    ) -> None:
        """Show a pixel, with axes in a unit."""
        for axes in self._axes:
            axes.follow(unit, acquisition)
        for read_out in self._read_outs:
            read_out.follow(acquisition)
        if cover(self._bins, acquisition.n_bins):
            self._lay_out(acquisition.n_bins)
        signals, nothing = pixel.signals, np.full(acquisition.n_bins, np.nan)
        expected = nothing if pixel.expected is None else pixel.expected
        lines = {"expected": expected, "small": signals.small, "large": signals.large}
        self.histogram.write("raw", top=signals.raw)
        for layer, counts in lines.items():
            self.histogram.write(layer, counts=counts)
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
        self._keep(pixel, acquisition, lines, difference)

    def _keep(
        self, pixel: Pixel, acquisition: Acquisition, lines: dict[str, Array], difference: Array
    ) -> None:
        """Keep values (bin,) for downloads, the weight as it is; on screen it is scaled."""
        signals, curves, names = pixel.signals, plots.bin_curves, plots.RESIDUAL_NAMES
        histogram = curves(plots.HISTOGRAM_NAMES, "counts", raw=signals.raw, **lines)
        residual = curves(names, "counts", raw=difference, residual=signals.residual)
        weight = curves({}, "", weight=signals.weight)
        enhanced = curves({}, "counts × weight", enhanced=signals.enhanced)
        marks = plots.marks({}, truth=pixel.truth_bin, estimate=pixel.answer_bin)
        for plot, own in zip(self.plots, (histogram, residual, weight + enhanced), strict=True):
            plot.keep(acquisition, own + marks)

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
        ):
            for layer in layers:
                plot.source(layer).data = {"bin": centres, column: empty}

    @staticmethod
    def _frame(plot: Plot, pixel: Pixel, low: float, *curves: Array) -> None:
        """Fit the vertical axis, and draw the lines of truth and estimate."""
        highest = max(float(np.nanmax(curve, initial=0.0)) for curve in curves)
        vertical = plot.figure.y_range
        end, start = round_up(highest * 1.15), -round_up(-low * 1.05)
        if (start, end) != (vertical.start, vertical.end):
            vertical.update(start=start, end=end, reset_start=start, reset_end=end)
        (column,) = (name for name in plot.source("truth").data if name != "bin")
        for layer, position in (("truth", pixel.truth_bin), ("estimate", pixel.answer_bin)):
            x, y = plots.marker_line(position, end)
            plot.write(layer, **{"bin": x, column: y})
            plot.show(layer, bool(np.isfinite(position)))
