"""Plots as pure functions: arrays in, HoloViews elements out.

They are declared once. When values change, `app.views` writes the changed columns to the rendered
plots: building a plot again would take ten times as long as drawing it.
"""

from __future__ import annotations

from typing import Any

import holoviews as hv
import numpy as np
from numpy.typing import NDArray

from app.theme import RANGE_COLORS, Palette

Array = NDArray[Any]

hv.extension("bokeh")
# Copying each plot out of a WebGL canvas takes longer than drawing its few lines on a plain one.
hv.renderer("bokeh").webgl = False

BIN = hv.Dimension("bin", label="Bin")

# The layers of each plot, by the palette's names for them, in the order in which they are drawn.
HISTOGRAM_LAYERS = ("raw", "expected", "small", "large", "truth", "answer")
RESIDUAL_LAYERS = ("raw", "residual", "truth", "answer")
ENHANCED_LAYERS = ("weight", "enhanced", "truth", "answer")


def marker_line(position_bin: float, height: float) -> tuple[Array, Array]:
    """Coordinates of an upright line from 0 to `height`; of nothing at NaN."""
    return np.full(2, position_bin), np.array([0.0, height])


def edges(n_bins: int) -> Array:
    """Edges of the bins as a histogram draws them: bin k is centred on k + 1/2."""
    return np.arange(n_bins + 1, dtype=float)


def centres(n_bins: int) -> Array:
    """Centres of the bins."""
    return np.arange(n_bins) + 0.5


def histogram(
    counts: Array, expected: Array, small: Array, large: Array, colors: Palette
) -> hv.Overlay:
    """Raw counts with the model's expectation and both scales over them.

    Parameters
    ----------
    counts, expected, small, large : ndarray, shape (bin,)
        In counts; NaN where there is nothing to draw.
    """
    n_bins = counts.size
    unit = hv.Dimension("counts", label="Counts")
    bars = hv.Histogram((edges(n_bins), counts), kdims=BIN, vdims=unit, label="raw histogram")
    layers = [
        bars.opts(color=colors.raw, line_width=0),
        _curve(centres(n_bins), expected, unit, "expected").opts(
            color=colors.expected, line_dash="dotted", line_width=1.5
        ),
        _curve(centres(n_bins), small, unit, "small scale").opts(color=colors.small, line_width=2),
        _curve(centres(n_bins), large, unit, "large scale").opts(color=colors.large, line_width=2),
        *_markers(unit, colors),
    ]
    return _panel(layers, "Histogram of the pixel, and the two scales that follow it")


def residual(values: Array, difference: Array, colors: Palette) -> hv.Overlay:
    """Positive difference of the scales; the raw first difference on demand, shape (bin,) each."""
    n_bins = values.size
    unit = hv.Dimension("residual", label="Counts")
    layers = [
        _curve(centres(n_bins), difference, unit, "first difference of the raw histogram").opts(
            color=colors.raw, line_width=1.2
        ),
        _curve(centres(n_bins), values, unit, "residual").opts(color=colors.residual, line_width=2),
        *_markers(unit, colors),
    ]
    return _panel(layers, "Residual: large scale minus small scale, where positive")


def enhanced(values: Array, weight: Array, colors: Palette) -> hv.Overlay:
    """Residual times weight, with the weight scaled to the plot, shape (bin,) each."""
    n_bins = values.size
    unit = hv.Dimension("enhanced", label="Counts × weight")
    layers = [
        _curve(centres(n_bins), weight, unit, "weight (scaled to fit)").opts(
            color=colors.weight, line_dash="dashed", line_width=1.2
        ),
        _curve(centres(n_bins), values, unit, "enhanced").opts(color=colors.enhanced, line_width=2),
        *_markers(unit, colors),
    ]
    return _panel(layers, "Enhanced: residual × weight; its largest value is the echo")


def _curve(x: Array, y: Array, unit: hv.Dimension, label: str) -> hv.Curve:
    return hv.Curve((x, y), kdims=BIN, vdims=unit, label=label)


def _markers(unit: hv.Dimension, colors: Palette) -> list[hv.Curve]:
    nowhere = marker_line(np.nan, 1.0)
    return [
        _curve(*nowhere, unit, "truth").opts(color=colors.truth, line_width=2.5, line_dash="4 2"),
        _curve(*nowhere, unit, "answer").opts(color=colors.answer, line_width=1.5),
    ]


def _panel(layers: list[Any], title: str) -> hv.Overlay:
    return hv.Overlay(layers).opts(
        hv.opts.Overlay(
            title=title,
            responsive=True,
            min_height=120,
            toolbar=None,
            default_tools=["xbox_zoom"],
            show_legend=True,
            legend_position="top_right",
            legend_cols=6,
            legend_opts={"click_policy": "hide", "background_fill_alpha": 0.8},
        )
    )


def range_image(image: Array, low: float, high: float) -> hv.Overlay:
    """An image (row, col) with row 0 at the top, and a frame for the pixel on show.

    Parameters
    ----------
    image : ndarray, shape (row, col)
        NaN is left blank.
    low, high : float
        Values at the ends of the colour scale.
    """
    rows, cols = image.shape
    value = hv.Dimension("value", label="Range (m)", range=(low, high))
    picture = hv.Image(
        (np.arange(cols), np.arange(rows), image),
        kdims=[hv.Dimension("col", label="Column"), hv.Dimension("row", label="Row")],
        vdims=value,
    ).opts(
        cmap=RANGE_COLORS,
        colorbar=True,
        colorbar_opts={"width": 10, "padding": 4, "title_standoff": 6},
        clipping_colors={"NaN": (0, 0, 0, 0)},
    )
    frames = [
        hv.Rectangles([pixel_frame(0, 0)]).opts(
            fill_alpha=0, line_color=color, line_width=width, apply_ranges=False
        )
        for color, width in (("#000000", 4), ("#ffffff", 1.6))
    ]
    return hv.Overlay([picture, *frames]).opts(
        hv.opts.Overlay(
            title="Range image",
            responsive=True,
            min_height=200,
            toolbar=None,
            default_tools=["box_zoom", "tap"],
            show_legend=False,
        )
    )


def pixel_frame(row: int, col: int) -> tuple[float, float, float, float]:
    """Left, bottom, right and top of a frame around a pixel that leaves the pixel itself free."""
    return col - 1.5, row - 1.5, col + 1.5, row + 1.5
