"""Plots of a report as SVG that is part of the page.

Text and axes take the colour of the page's text; other colours are legible on light and dark paper.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats
from core.io.writers.colors import ColorScale
from core.io.writers.picture import drawing, save_figure

_INK = "#010203"  # replaced by the colour of the page's text
_STYLE: dict[Any, Any] = {
    "font.size": 10.0,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    **dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), _INK
    ),
}
_WIDTH_IN = 5.2
_MOST_DRAWN_BINS = 1024  # as lines; more are drawn as pixels, which bounds the size of the file
_COLORS = {
    "counts": "#8d949c",
    "small scale": "#2b8cd6",
    "large scale": "#d55e00",
    "residual": "#2b8cd6",
    "enhanced": "#d55e00",
    "score": "#2b8cd6",
}
ESTIMATE, TRUTH, SUGGESTED = "#e8206a", "#009e73", "#2b8cd6"


class Mark(NamedTuple):
    """Span of ranges in metres, or a line where both ends are equal."""

    low_m: float
    high_m: float
    color: str


def image_svg(
    values: NDArray[Any], scale: ColorScale, step: int, pixel: tuple[int, int], title: str
) -> str:
    """Return an image (row, col) with its colour bar and a mark at the pixel.

    Every `step`-th row and column is drawn.
    """
    rows, cols = values.shape
    colors = ListedColormap(scale.colors).with_extremes(
        bad="none", under=scale.outside, over=scale.outside
    )
    with _style(title):
        height_in = float(np.clip(0.8 * _WIDTH_IN * rows / cols, 1.6, 8.0))
        figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
        axes = figure.add_subplot()
        shown = axes.imshow(
            values[::step, ::step],
            vmin=scale.low,
            vmax=scale.high,
            cmap=colors,
            interpolation="none",
            extent=(-0.5, cols - 0.5, rows - 0.5, -0.5),
        )
        row, col = pixel
        axes.plot(col, row, marker="s", markersize=7, markerfacecolor="none", color=ESTIMATE)
        axes.set(xlabel="Column (px)", ylabel="Row (px)")
        axes.locator_params(integer=True, min_n_ticks=1)
        extend = "neither" if scale.outside is None else "both"
        figure.colorbar(shown, ax=axes, label=scale.legend, extend=extend)
        return _svg(figure)


def gate_svg(
    acquisition: Acquisition,
    curves: Mapping[str, Floats],
    marks: Mapping[str, Mark],
    unit: str,
    title: str,
    view_bins: tuple[float, float] | None = None,
) -> str:
    """Return curves (bin,) over the ranges of the gate, or of a part of it."""
    ends_m = acquisition.bin_to_range_m(view_bins or (0, acquisition.n_bins))
    edges_m = acquisition.bin_to_range_m(np.arange(acquisition.n_bins + 1))
    raster = acquisition.n_bins > _MOST_DRAWN_BINS
    with _style(title):
        figure = Figure(figsize=(_WIDTH_IN, 3.1), layout="constrained")
        axes = figure.add_subplot()
        for name, curve in curves.items():
            axes.stairs(
                np.where(np.isfinite(curve), curve, np.nan),
                edges_m,
                label=name,
                color=_COLORS[name],
                fill=name == "counts",
                rasterized=raster,
            )
        for name, mark in marks.items():
            _draw_mark(axes, name, mark)
        axes.set(xlabel="Range (m)", ylabel=unit, xlim=tuple(ends_m))
        to_bins = acquisition.range_m_to_bin
        axes.secondary_xaxis("top", (to_bins, acquisition.bin_to_range_m)).set_xlabel("Bin")
        axes.grid(color=_INK, alpha=0.15)
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize="small")
        return _svg(figure)


def _draw_mark(axes: Axes, name: str, mark: Mark) -> None:
    if not np.isfinite(mark.low_m):
        return
    if mark.low_m == mark.high_m:
        axes.axvline(mark.low_m, color=mark.color, linestyle="--", linewidth=1.2, label=name)
    else:
        axes.axvspan(mark.low_m, mark.high_m, color=mark.color, alpha=0.2, lw=0, label=name)


def _style(title: str) -> AbstractContextManager[None]:
    """Draw a plot of the report.

    The title enters the identifiers within the plot, which must differ on a page.
    """
    return drawing({**_STYLE, "svg.hashsalt": title})


def _svg(figure: Figure) -> str:
    """Return a figure as an element of the page."""
    buffer = io.BytesIO()
    save_figure(figure, buffer, "svg", 200)
    drawn = buffer.getvalue().decode()
    drawn = drawn[drawn.index("<svg") :].replace(_INK, "currentColor")
    # A style would hold for the whole page, and names of groups are those of every plot.
    drawn = re.sub(r"<(metadata|style).*?</\1>", "", drawn, flags=re.DOTALL)
    return re.sub(r'<g id="[^"]*"', "<g", drawn)
