"""Colours of the light and the dark mode, and styles of all plots."""

from __future__ import annotations

from dataclasses import dataclass

import colorcet

from core.io import RangeColors, colors_of

FONT = "Roboto, system-ui, sans-serif"

RANGE_COLORS = colors_of(RangeColors().color_map)
ERROR_COLORS: list[str] = colorcet.palette["diverging_bwr_20_95_c54"]
COUNT_COLORS: list[str] = colorcet.palette["fire"][30:-20]
WRONG_COLOR = "#e8206a"


@dataclass(frozen=True)
class Palette:
    """Colours of one mode; those of the signals are safe for colour blindness (Okabe and Ito)."""

    text: str
    muted: str
    grid: str
    paper: str
    raw: str
    expected: str
    small: str
    large: str
    residual: str
    enhanced: str
    weight: str
    truth: str
    estimate: str
    methods: tuple[str, ...]
    """Colours of lines, none of them that of the truth; `line_style` adds dashes."""


LIGHT = Palette(
    text="#1c2430",
    muted="#5a6675",
    grid="#e3e8ee",
    paper="#ffffff",
    raw="#b9c3cf",
    expected="#1c2430",
    small="#0072b2",
    large="#d55e00",
    residual="#009e73",
    enhanced="#8e4585",
    weight="#7a8696",
    truth="#009e73",
    estimate="#c2185b",
    methods=("#0072b2", "#d55e00", "#8e4585", "#a67c00", "#1c2430", "#3f9fd8"),
)
DARK = Palette(
    text="#e8edf3",
    muted="#a3afbd",
    grid="#2c3642",
    paper="#161c24",
    raw="#4d5a69",
    expected="#e8edf3",
    small="#56b4e9",
    large="#ff9e4a",
    residual="#2fd6a5",
    enhanced="#e39bd0",
    weight="#8996a6",
    truth="#2fd6a5",
    estimate="#ff6fa3",
    methods=("#56b4e9", "#ff9e4a", "#e39bd0", "#e3c34a", "#e8edf3", "#7f8cff"),
)


def palette(dark: bool) -> Palette:
    """Return the colours of a mode."""
    return DARK if dark else LIGHT


DASHES: tuple[list[int], ...] = ([], [6, 3], [2, 2])


def line_style(place: int, colors: Palette) -> tuple[str, list[int]]:
    """Return colour and dashes of the n-th line, counted from 0."""
    n_dash, n_color = divmod(place, len(colors.methods))
    return colors.methods[n_color], DASHES[n_dash % len(DASHES)]


WRAPPED = """
:host(:not(.bk-vertical)) { width: max-content; max-width: calc(100% - 4px); }
:host(:not(.bk-vertical)) .bk-grid {
  display: flex; flex-wrap: wrap; justify-content: flex-end; width: auto; row-gap: 0;
}
"""
"""Style of a horizontal legend: rows no wider than the plot."""

RAISED = """
:host(:not(.bk-vertical)) { padding-bottom: 7px !important; max-width: calc(100% + 40px); }
"""
"""Further style of a legend above or below a plot, which else touches an axis or the border.

Its width is relative to the frame, beside which there is room for the labels of an axis.
"""

STYLES: dict[str, dict[str, object]] = {
    # Transparent, so that the card's colour changes with the mode.
    "Plot": {
        "background_fill_color": None,
        "border_fill_color": None,
        "outline_line_color": None,
    },
    "Grid": {},  # listed, so that the page's theme does not change its colour
    "Title": {"text_font_size": "12px", "text_font": FONT, "standoff": 2},
    "Axis": {
        "axis_label_text_font": FONT,
        "axis_label_text_font_size": "11px",
        "axis_label_text_font_style": "normal",
        "axis_label_standoff": 1,
        "major_label_text_font": FONT,
        "major_label_text_font_size": "11px",
        "major_tick_out": 3,
        "minor_tick_line_color": None,
    },
    "BasicTickFormatter": {"power_limit_high": 9},  # counts of millions without an exponent
    "Legend": {
        "label_text_font": FONT,
        "label_text_font_size": "11px",
        "label_standoff": 4,
        "label_height": 13,
        "glyph_height": 13,
        "glyph_width": 16,
        "border_line_color": None,
        "margin": 2,
        "padding": 1,
        "spacing": 7,
    },
    "ColorBar": {
        "background_fill_color": None,
        "title_text_font": FONT,
        "title_text_font_size": "11px",
        "title_text_font_style": "normal",
        "major_label_text_font": FONT,
        "major_label_text_font_size": "11px",
    },
}
"""Styles of all plots by Bokeh's model; `paint_frame` sets the colours of a mode."""

LARGE_STYLES: dict[str, dict[str, object]] = {
    "Title": {"text_font_size": "26px"},
    "Axis": {
        "axis_label_text_font_size": "24px",
        "axis_label_standoff": 6,
        "major_label_text_font_size": "24px",
        "major_tick_out": 8,
        "major_tick_line_width": 2,
    },
    "Legend": {
        "label_text_font_size": "24px",
        "label_height": 28,
        "glyph_height": 24,
        "glyph_width": 40,
        "spacing": 10,
        "label_standoff": 8,
    },
    "ColorBar": {"title_text_font_size": "24px", "major_label_text_font_size": "24px"},
}
"""Sizes of plots in presenter mode, in place of those in `STYLES`."""

LARGE = 2
"""Width of lines and size of markers in presenter mode, over those elsewhere."""
