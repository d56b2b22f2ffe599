"""An image in which a tap selects a pixel."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from bokeh.events import Tap
from bokeh.models import BasicTicker, BoxZoomTool, CustomJS, DataRange1d
from numpy.typing import NDArray

from app.model.large import Grid
from app.plots import elements as plots
from app.theme import Palette
from app.widgets.figures import Plot, around, color_bars, paint_frame, pane_of, proportioned
from core.io import MOST_ELONGATED, ColorScale

Array = NDArray[Any]

BORDER_PX = {"left": 52, "right": 66, "top": 26, "bottom": 40}
"""Room for axes, title and colour bar; the title leaves room for a download button."""

JOINED_BORDER_PX = {"left": 36, "right": 12, "top": 6, "bottom": 24}
"""Room around one of several images, without labels and colour bar."""

LARGE_PIXELS = 20
"""Most pixels along the longer side of a picture that are large on screen."""

CONTAINER = ":host { container-type: size; }"
"""Style of the part of a page that an image fills as far as its proportions allow."""


class ImageView:
    """An image in which a tap selects a pixel.

    The part of the page that holds it needs the style `CONTAINER`.

    Parameters
    ----------
    tapped : callable
        Called with the row and column of a tapped pixel.
    """

    def __init__(self, tapped: Callable[[int, int], None]) -> None:
        self._plot = Plot(plots.range_image, ("picture", "shadow", "frame"))
        self._shape, self._grid = (0, 0), Grid()
        self._look: ColorScale | None = None
        self.figure = self._plot.figure
        self.pane = pane_of(self.figure)
        self.figure.match_aspect = True
        self.figure.grid.visible = False
        for axis in self.figure.axis:
            axis.ticker = BasicTicker(min_interval=1)
        self._reserve(BORDER_PX)
        self.figure.x_range = DataRange1d(range_padding=0, renderers=[])
        self.figure.y_range = DataRange1d(range_padding=0, flipped=True, renderers=[])
        picture = self._plot.layers["picture"]
        for ranges in (self.figure.x_range, self.figure.y_range):
            ranges.renderers = [picture["glyph_renderer"]]
        for layer in ("shadow", "frame"):  # moving them does not redraw the image
            self._plot.layers[layer]["glyph_renderer"].level = "overlay"
        self._mapper = picture["color_mapper"]
        (self._bar,) = color_bars(self.figure)
        self._bar.ticker = BasicTicker()
        (zoom,) = self.figure.select(BoxZoomTool)
        zoom.match_aspect = True
        # Else Bokeh activates the first of the tools that HoloViews adds.
        self.figure.toolbar.active_drag = zoom

        self.figure.add_tools(plots.value_read_out(picture["glyph_renderer"]))

        def tap(event: Tap) -> None:
            row, col = self._grid.pixel(event.y, event.x)
            if 0 <= row < self._shape[0] and 0 <= col < self._shape[1]:
                tapped(row, col)

        self.figure.on_event(Tap, tap)
        reset = CustomJS(args={"figure": self.figure}, code="figure.reset.emit()")
        self.figure.js_on_change("tags", reset)

    def join(self, first: ImageView) -> None:
        """Share zoom with the first of several images, and their colour scale."""
        self._bar.visible = False
        self.figure.xaxis.axis_label = self.figure.yaxis.axis_label = None
        for axis in self.figure.axis:
            axis.ticker.desired_num_ticks = 4  # two images side by side fit on a phone
        self._reserve(JOINED_BORDER_PX)
        if first is self:
            return
        for name in ("x_range", "y_range"):
            shared = getattr(first.figure, name)
            shared.renderers = [*shared.renderers, *getattr(self.figure, name).renderers]
            setattr(self.figure, name, shared)

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        paint_frame(self.figure, colors)

    def fit(self, rows: int, cols: int, grid: Grid) -> None:
        """Prepare for an image; the zoom is kept if its pixels are the same as before."""
        if ((rows, cols), grid) != (self._shape, self._grid):
            self.enter(rows, cols, grid)

    def enter(self, rows: int, cols: int, grid: Grid) -> None:
        """Prepare for another image, which stays blank until `update`."""
        self._shape, self._grid = (rows, cols), grid
        blank = [np.full((rows, cols), np.nan, np.float32)]
        left, above, *_ = plots.pixel_frame(*grid.place(0, 0), grid.step / 2, grid.step / 2)
        width, height = cols * grid.step, rows * grid.step
        box = {"x": [left], "y": [above], "dw": [width], "dh": [height]}
        self._plot.source("picture").data = {"image": blank, **box}
        self.figure.tags = [*grid.first, grid.step, rows, cols]  # resets the zoom, see above
        self.figure.xaxis.bounds = (left, left + width)
        self.figure.yaxis.bounds = (above, above + height)
        self._keep_proportions()

    def _reserve(self, border_px: Mapping[str, int]) -> None:
        """Reserve room around the image."""
        self._border_px = border_px
        self.figure.update(**{f"min_border_{side}": px for side, px in border_px.items()})
        self._keep_proportions()

    def _keep_proportions(self) -> None:
        """Fit the frame to the image: a wider or higher one would show what is not there."""
        rows, cols = self._shape
        aspect = self._aspect
        self.figure.match_aspect = aspect == max(cols, 1) / max(rows, 1)
        self.figure.stylesheets = [proportioned(aspect, *around(self._border_px))]

    @property
    def _aspect(self) -> float:
        """Width of the picture divided by its height."""
        rows, cols = self._shape
        return min(max(max(cols, 1) / max(rows, 1), 1 / MOST_ELONGATED), MOST_ELONGATED)

    def update(self, image: Array, look: ColorScale) -> None:
        """Show an image (row, col); NaN is blank."""
        self._plot.source("picture").data["image"] = [np.asarray(image, np.float32)]
        if look == self._look:
            return  # Bokeh would compare every colour
        self._look = look
        self._mapper.update(
            low=look.low,
            high=look.high,
            palette=look.colors,
            low_color=look.outside,
            high_color=look.outside,
        )
        self._bar.title = look.unit
        self._bar.ticker.min_interval = 1 if look.whole else 0
        self._plot.source("picture").tags = [look.unit]  # for the pointer
        self.figure.title.text = look.title

    @property
    def half_frame(self) -> tuple[float, float]:
        """Half the height and width of a frame in pixels of the file, large enough to be visible.

        It is close around pixels that are large themselves.
        """
        rows, cols = self._shape
        longest = rows * max(1.0, self._aspect), cols * max(1.0, 1 / self._aspect)
        down, across = (0.5 if n <= LARGE_PIXELS else max(1.5, 0.014 * n) for n in longest)
        return down * self._grid.step, across * self._grid.step

    def frame(self, row: int, col: int) -> tuple[float, float, float, float]:
        """Return left, bottom, right and top of the frame of a pixel."""
        return plots.pixel_frame(*self._grid.place(row, col), *self.half_frame)

    def mark(self, row: int, col: int) -> None:
        """Frame a pixel."""
        left, bottom, right, top = self.frame(row, col)
        for layer in ("shadow", "frame"):
            self._plot.write(layer, left=[left], bottom=[bottom], right=[right], top=[top])
