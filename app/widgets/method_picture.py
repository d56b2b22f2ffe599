"""Image or point cloud of one method, and the colour scale of several methods."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import panel as pn
from bokeh.models import ColorBar, LinearColorMapper, Range1d
from bokeh.plotting import figure
from numpy.typing import NDArray

from app.model.large import Grid
from app.theme import WRONG_COLOR, Palette
from app.widgets.cloud import PointCloud
from app.widgets.controls import Sentence
from app.widgets.figures import paint_frame, pane_of
from app.widgets.image_view import CONTAINER, ImageView
from core.io import ColorScale

Array = NDArray[Any]


PICTURE = """
:host { display: flex !important; flex-direction: column; min-width: 0; overflow: hidden;
  height: 100% !important;
  border: 1px solid var(--mui-palette-divider, #d5dbe2); border-radius: 8px;
  background: var(--mui-palette-background-paper, #fff); }
"""
STAGE = CONTAINER + ":host { transition: opacity 0.2s 0.25s }"

# Titles of one to three lines: the pictures below them are aligned.
TITLE = ":host { flex: 1 !important } .note { font-weight: 600 }"
# Captions of one or two lines, likewise.
CAPTION = ".note { min-height: 2lh }"


class Picture:
    """One method's image or cloud, with a line about the pixel below it.

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
        # The margin leaves room for a download button.
        self.title = Sentence(
            stylesheets=[TITLE], sizing_mode="stretch_width", margin=(4, 30, 0, 8)
        )
        self.caption = Sentence(
            stylesheets=[CAPTION], sizing_mode="stretch_width", margin=(0, 8, 4, 8)
        )
        self._picked, self._is_blank = picked, True
        self._stage = pn.Column(
            self.image.pane, stylesheets=[STAGE], sizing_mode="stretch_width", margin=0
        )
        self.card = pn.Column(
            self.title,
            self._stage,
            self.caption,
            stylesheets=[PICTURE],
            sizing_mode="stretch_width",
            margin=0,
        )
        self.resize(height)

    def enter(self, rows: int, cols: int, grid: Grid) -> None:
        """Prepare for another capture; the picture is blank until it is drawn."""
        self._is_blank = True
        self.image.enter(rows, cols, grid)

    def draw_image(self, values: Array, look: ColorScale) -> None:
        """Show an image (row, col) in place of the cloud."""
        self._is_blank = False
        self.image.pane.visible = True
        if self.cloud is not None:
            self.cloud.visible = False
        self.image.update(values, replace(look, title=""))
        self.image.figure.name = f"{look.title}: {self.title.text}"

    def resize(self, height: int) -> None:
        """Set the height of image and cloud."""
        self._stage.height = height

    def dim(self, is_outdated: bool) -> None:
        """Draw an outdated picture faintly, and no axes around nothing."""
        outdated = "0" if self._is_blank else "0.35"
        self._stage.styles = {"opacity": outdated if is_outdated else "1"}

    def show_cloud(self, dark: bool) -> PointCloud:
        """Show the cloud in place of the image; it is made on demand."""
        self._is_blank = False
        if self.cloud is None:
            self.cloud = PointCloud(
                wrong_color=WRONG_COLOR, link="methods", dark=dark, sizing_mode="stretch_both"
            )
            self.cloud.param.watch(lambda event: self._picked(event.new), "selected")
            self._stage.append(self.cloud)
        self.image.pane.visible, self.cloud.visible = False, True
        return self.cloud


class ScaleBar:
    """The common colour scale of several pictures."""

    def __init__(self) -> None:
        # A colour bar needs a figure; this one is empty.
        self.figure = figure(
            name="Colour scale",
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

    def update(self, look: ColorScale) -> None:
        """Show another scale."""
        self._mapper.update(low=look.low, high=look.high, palette=look.colors)
        self._bar.title = look.legend

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        paint_frame(self.figure, colors)
