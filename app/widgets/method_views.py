"""Viewers of several methods at once: one picture each, their common scale, curves, reliability."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import BasicTicker, ColorBar, LegendItem, LinearColorMapper, Range1d
from bokeh.plotting import figure
from numpy.typing import NDArray

from app.model.colors import Look
from app.model.store import Answer
from app.plots import elements as plots
from app.plots.gate import GateAxes
from app.theme import LIGHT, WRONG_COLOR, Palette
from app.widgets.cloud import PointCloud
from app.widgets.controls import Sentence
from app.widgets.views import ImageView, Plot, paint_frame, pane_of
from core import ESTIMATORS, Acquisition

Array = NDArray[Any]

TITLES = {method: estimator.title for method, estimator in ESTIMATORS.items()}

Style = tuple[str, list[int]]
"""Colour and dashes of a method's line."""

PICTURE = """
:host { display: flex !important; flex-direction: column; min-width: 0; overflow: hidden;
  height: 100% !important;
  border: 1px solid var(--mui-palette-divider, #d5dbe2); border-radius: 8px;
  background: var(--mui-palette-background-paper, #fff); transition: opacity 0.2s 0.25s; }
"""

# Titles of one line and of three: the pictures below them stand at one height.
TITLE = ":host { flex: 1 !important } .note { font-weight: 600 }"
CAPTION = ".note { white-space: nowrap; overflow: hidden; text-overflow: ellipsis }"

LOWEST_SCORE = -1.0
"""Of the scale that runs from a curve's median, 0, to its maximum, 1: what lies lower is cut."""


class Picture:
    """One method's image, or its cloud, with a line on the pixel below it.

    Parameters
    ----------
    tapped : callable
        Called with the row and column of a tapped pixel of the image.
    picked : callable
        Called with the flat index of a tapped point of the cloud.
    """

    def __init__(
        self, tapped: Callable[[int, int], None], picked: Callable[[int], None], height: int
    ) -> None:
        self.image = ImageView(tapped)
        self.cloud: PointCloud | None = None
        # On the right there is room for a download button.
        self.title = Sentence(
            stylesheets=[TITLE], sizing_mode="stretch_width", margin=(4, 30, 0, 8)
        )
        self.caption = Sentence(
            stylesheets=[CAPTION], sizing_mode="stretch_width", margin=(0, 8, 4, 8)
        )
        self._picked = picked
        self._stage = pn.Column(self.image.pane, sizing_mode="stretch_width", margin=0)
        self.card = pn.Column(
            self.title,
            self._stage,
            self.caption,
            stylesheets=[PICTURE],
            sizing_mode="stretch_width",
            margin=0,
        )
        self.resize(height)

    def draw_image(self, values: Array, look: Look) -> None:
        """Show an image (row, col) on the common scale, in place of the cloud."""
        self.image.pane.visible = True
        if self.cloud is not None:
            self.cloud.visible = False
        self.image.update(values, replace(look, title=""))

    def resize(self, height: int) -> None:
        """Make picture and cloud this high."""
        self._stage.height = height

    def dim(self, is_outdated: bool) -> None:
        """Draw what is still to be replaced faintly."""
        self.card.styles = {"opacity": "0.35" if is_outdated else "1"}

    def show_cloud(self, dark: bool) -> PointCloud:
        """Put the cloud in place of the image; it is made when it is first asked for."""
        if self.cloud is None:
            self.cloud = PointCloud(
                wrong_color=WRONG_COLOR, link="methods", dark=dark, sizing_mode="stretch_both"
            )
            self.cloud.param.watch(lambda event: self._picked(event.new), "selected")
            self._stage.append(self.cloud)
        self.image.pane.visible, self.cloud.visible = False, True
        return self.cloud


class ScaleBar:
    """The one colour scale of several pictures."""

    def __init__(self) -> None:
        # A colour bar needs a figure to stand in; nothing is drawn in this one.
        self.figure = figure(
            height=52,
            sizing_mode="stretch_width",
            toolbar_location=None,
            x_range=Range1d(0, 1),
            y_range=Range1d(0, 1),
        )
        self.figure.scatter([], [])
        self.figure.axis.visible = self.figure.grid.visible = False
        self.figure.min_border_left = self.figure.min_border_right = 16
        self._mapper = LinearColorMapper(palette=["#000000"], low=0.0, high=1.0)
        self._bar = ColorBar(
            color_mapper=self._mapper, height=9, padding=0, title_standoff=3, label_standoff=3
        )
        self.figure.add_layout(self._bar, "below")
        self.pane = pane_of(self.figure)
        self.pane.sizing_mode = "stretch_width"

    def update(self, look: Look) -> None:
        """Show another scale."""
        self._mapper.update(low=look.low, high=look.high, palette=look.colors)
        self._bar.title = look.legend

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode."""
        paint_frame(self.figure, colors)


class Lines:
    """The lines of a plot, one for each method, in one layer: a layer each would take longer."""

    def __init__(self, plot: Plot) -> None:
        self.source = plot.source("lines")
        self.source.data = {name: [] for name in ("xs", "ys", "color", "dash", "title")}
        color, dash = {"field": "color"}, {"field": "dash"}
        plot.layers["lines"]["glyph"].update(line_color=color, line_dash=dash)

    def update(self, lines: Mapping[str, tuple[Array, Array]], styles: Mapping[str, Style]) -> None:
        """Draw other lines, by method."""
        self.source.data = {
            "xs": [x.astype(np.float32) for x, _ in lines.values()],
            "ys": [y.astype(np.float32) for _, y in lines.values()],
            "title": [TITLES[method] for method in lines],
            "color": [styles[method][0] for method in lines],
            "dash": [styles[method][1] or "solid" for method in lines],
        }


class CurvePlot:
    """Each picked method's score of each bin of one pixel."""

    def __init__(self) -> None:
        self._plot = Plot(plots.score_curves(LIGHT), ("lines", "truth", "answers"))
        self._lines = Lines(self._plot)
        self._answers = self._plot.source("answers")
        self._answers.data = {"bin": [], "score": [], "color": []}
        self._plot.layers["answers"]["glyph"].fill_color = {"field": "color"}
        drawing = self._plot.figure
        drawing.x_range, drawing.y_range = Range1d(0, 1), Range1d(0, 1)
        drawing.min_border_left, drawing.min_border_right = 46, 14
        self._axes = GateAxes(drawing)
        renderer = self._plot.layers["lines"]["glyph_renderer"]
        drawing.legend[0].items.insert(
            0, LegendItem(label={"field": "title"}, renderers=[renderer])
        )
        self.pane = pane_of(drawing)
        drawing.legend.spacing = 1  # room for all methods there are

    def update(
        self,
        curves: Mapping[str, Array],
        answers: Mapping[str, float],
        truth_bin: float,
        acquisition: Acquisition,
        styles: Mapping[str, Style],
        unit: str,
    ) -> None:
        """Show a pixel: curves (bin,), answers in bins and lines' styles, by method."""
        plot, bins = self._plot, self._plot.figure.x_range
        if bins.end != acquisition.n_bins:
            bins.update(end=acquisition.n_bins, reset_end=acquisition.n_bins)
        self._axes.follow(unit, acquisition)
        centres = plots.centres(acquisition.n_bins)
        self._lines.update({method: (centres, curve) for method, curve in curves.items()}, styles)
        lowest = min((float(curve.min()) for curve in curves.values()), default=0.0)
        low = 1.05 * max(lowest, LOWEST_SCORE) - 0.02
        # One above the other, so that equal answers can be told apart.
        height = {method: 1.06 + 0.07 * place for place, method in enumerate(answers)}
        top = 1.1 + 0.07 * len(answers)
        vertical = plot.figure.y_range
        if (low, top) != (vertical.start, vertical.end):
            vertical.update(start=low, end=top, reset_start=low, reset_end=top)
        answered = [method for method, at in answers.items() if np.isfinite(at)]
        self._answers.data = {
            "bin": np.array([answers[method] for method in answered], np.float32),
            "score": np.array([height[method] for method in answered], np.float32),
            "color": [styles[method][0] for method in answered],
        }
        x, y = plots.marker_line(truth_bin, top)
        plot.write("truth", bin=x, score=y)
        plot.show("truth", bool(np.isfinite(truth_bin)))

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode; those of the lines come with `update`."""
        paint_frame(self._plot.figure, colors)
        self._plot.layers["truth"]["glyph"].line_color = colors.truth


class ReliabilityPlot:
    """How often each picked method is right, against how sure it is."""

    def __init__(self) -> None:
        self._plot = Plot(plots.reliability(LIGHT), ("honest", "lines", "dots"))
        self._lines = Lines(self._plot)
        self._dots = self._plot.source("dots")
        self._dots.data = {"told": [], "right": [], "color": []}
        self._plot.layers["dots"]["glyph"].fill_color = {"field": "color"}
        drawing = self._plot.figure
        drawing.x_range, drawing.y_range = Range1d(0, 1.02), Range1d(0, 1.04)
        drawing.xaxis.ticker = drawing.yaxis.ticker = BasicTicker(desired_num_ticks=5)
        self.pane = pane_of(drawing)

    def update(self, lines: Mapping[str, tuple[Array, Array]], styles: Mapping[str, Style]) -> None:
        """Show confidence told and share right, by method."""
        self._lines.update(lines, styles)
        told, right = ([each[axis] for each in lines.values()] for axis in (0, 1))
        colors = [[styles[method][0]] * each[0].size for method, each in lines.items()]
        self._dots.data = {
            "told": np.concatenate([*told, np.empty(0)]),
            "right": np.concatenate([*right, np.empty(0)]),
            "color": [color for several in colors for color in several],
        }

    def paint(self, colors: Palette) -> None:
        """Take on the colours of the mode; those of the lines come with `update`."""
        paint_frame(self._plot.figure, colors)
        self._plot.layers["honest"]["glyph"].line_color = colors.muted


def title_of(method: str) -> str:
    """A method's name; of a reconstruction, marked as such."""
    return TITLES[method] + (" (reconstruction)" if ESTIMATORS[method].reconstructed else "")


def answer_bin(answer: Answer, row: int, col: int) -> float:
    """Where a method puts a pixel's echo; NaN where it does not answer."""
    return float(answer.run.image.bin[row, col])
