"""Pictures of an image: PNG and SVG, the same bytes each time for the same image.

Values beyond the colours are grey, pixels without one white. The description within the file holds
the acquisition, method, settings (JSON), version and source, one line ``name: value`` each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from core.io.writers.colors import MOST_ELONGATED, ColorScale, range_scale
from core.io.writers.product import Product, plain
from core.labels import software

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_INVALID = "#ffffff"
_DOTS_PER_INCH = 200
_WIDTH_INCHES = 6.4  # 1280 pixels

DRAWING = Lock()
"""Held while a figure is drawn and saved."""


@contextmanager
def drawing(settings: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Draw and save a figure with settings of Matplotlib, in one thread at a time.

    The settings are those of the process. By default, the text of an SVG stays text, and its
    identifiers are the same each time.
    """
    import matplotlib  # noqa: PLC0415 - slow to import

    chosen: dict[Any, Any] = {"svg.hashsalt": "firstphoton", "svg.fonttype": "none"}
    with DRAWING, matplotlib.rc_context(chosen | dict(settings or {})):
        yield


def save_figure(
    figure: Figure,
    file: BinaryIO,
    suffix: str,
    dpi: int,
    creator: str | None = None,
    description: str | None = None,
) -> None:
    """Save a figure as ``"png"`` or ``"svg"``, without a date: the same bytes for the same data."""
    known: dict[str, Any] = {"Description": description}
    known |= {"Date": None, "Creator": creator} if suffix == "svg" else {"Software": creator}
    figure.savefig(file, format=suffix, dpi=dpi, metadata=known)


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with its colours and texts.

    Parameters
    ----------
    values : ndarray, shape (row, col)
        NaN where there is none.
    scale : ColorScale
    title : str
        By default that of the scale.
    lines : sequence of str
        Description within the file.
    least_confidence : float, optional
        Confidence below which values are left out.
    first : tuple of int
        Row and column of the first pixel, in those of the file.
    step : int
        Rows and columns of the file from one pixel to the next.
    """

    values: NDArray[Any]
    scale: ColorScale
    title: str = ""
    lines: Sequence[str] = ()
    least_confidence: float | None = None
    first: tuple[int, int] = (0, 0)
    step: int = 1

    @classmethod
    def of(cls, product: Product) -> Picture:
        """Return the picture of a range image."""
        image = product.image
        scale = range_scale(product.capture, image, product.colors)
        least = None if image.made_by is None else image.made_by.least_confidence
        return cls(image.range_m, scale, plain(product.title), product.lines, least)

    @property
    def legend(self) -> str:
        """Meaning of white and grey, with the number of pixels of each."""
        least, n_white = self.least_confidence, int(np.isnan(self.values).sum())
        what = f"no value, or confidence below {least:g}" if least else "no value"
        legend = f"white: {what} ({n_white:,} of {self.values.size:,} pixels)"
        if self.scale.outside is None:
            return legend
        return f"{legend} · grey: beyond the colours ({self.scale.n_outside(self.values):,})"

    def write(self, file: BinaryIO, suffix: str) -> None:
        """Write the picture as ``"png"`` or ``"svg"``; the text of an SVG stays text."""
        described = "\n".join(self.lines)
        with drawing():
            save_figure(self._drawn(), file, suffix, _DOTS_PER_INCH, software(), described)

    def _drawn(self) -> Figure:
        from matplotlib.colors import ListedColormap  # noqa: PLC0415
        from matplotlib.figure import Figure  # noqa: PLC0415

        (rows, cols), scale = self.values.shape, self.scale
        colors = ListedColormap(scale.colors).with_extremes(
            bad=_INVALID, under=scale.outside, over=scale.outside
        )
        proportions = float(np.clip(rows / cols, 1 / MOST_ELONGATED, MOST_ELONGATED))
        height = float(np.clip(5.2 * proportions, 1.6, 10.0))
        figure = Figure(figsize=(_WIDTH_INCHES, height), layout="compressed")
        axes = figure.add_subplot()
        above, left = (at - self.step / 2 for at in self.first)
        shown = axes.imshow(
            self.values,
            vmin=scale.low,
            vmax=scale.high,
            cmap=colors,
            interpolation="none",
            aspect=proportions * cols / rows,
            extent=(left, left + cols * self.step, above + rows * self.step, above),
        )
        axes.set_title(self.title or scale.title, parse_math=False, wrap=True)
        axes.set(xlabel="Column (px)", ylabel="Row (px)")
        ends = "neither" if scale.outside is None else "both"
        figure.colorbar(shown, ax=axes, label=scale.legend, extend=ends)
        figure.supxlabel(self.legend, fontsize="small")
        return figure


def write_png(product: Product, file: BinaryIO) -> None:
    """Write PNG."""
    Picture.of(product).write(file, "png")


def write_svg(product: Product, file: BinaryIO) -> None:
    """Write SVG."""
    Picture.of(product).write(file, "svg")
