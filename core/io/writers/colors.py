"""Colours of images: the choice of a user, and the scale that pages, clouds and pictures share."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.capture import CaptureInfo
from core.checks import require
from core.estimators import RangeImage
from core.inference import SMALL
from core.parameters import Choice, Number, Settings, parameter

Array = NDArray[Any]

COLOR_MAPS = {
    "bgyw": slice(None, -12),
    "viridis": slice(None),
    "plasma": slice(None),
    "inferno": slice(24, None),
}
"""Perceptually uniform colour maps of colorcet and Matplotlib, and the part of each that stays
visible on a white and on a black page."""

MOST_ELONGATED = 4
"""Longer side of an image's frame over the shorter one; pixels of longer images are not square."""

OUTSIDE_COLOR = "#8d949c"
"""Colour of ranges beyond the ends of the scale."""

_CONFIDENT = 0.9


@dataclass(frozen=True)
class RangeColors(Settings):
    """Colours of an image of ranges.

    Raises
    ------
    ValueError
        If a field is out of its bounds, or the limits are not in ascending order.
    """

    color_from_m: float | None = parameter(
        None,
        Number("Colours from", 0.0, 1e5, unit="m", least=-1e9, most=1e9, optional=True),
        "Lower end of the colours; nearer ranges are grey. By default it fits the estimates.",
    )
    color_to_m: float | None = parameter(
        None,
        Number("Colours to", 0.0, 1e5, unit="m", least=-1e9, most=1e9, optional=True),
        "Upper end of the colours; farther ranges are grey. By default it fits the estimates.",
    )
    color_map: str = parameter(
        "bgyw",
        Choice("Colour map", tuple(COLOR_MAPS)),
        "Colours of ranges, all perceptually uniform: bgyw (blue, green, yellow) of colorcet, and "
        "those of Matplotlib.",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.color_from_m, self.color_to_m
        if low is not None and high is not None:
            require("color_to_m", high, low < high, f"a number above color_from_m = {low:g}")


@dataclass(frozen=True)
class ColorScale:
    """A colour scale with its title; values beyond it are drawn in `outside`, if given."""

    title: str
    unit: str
    low: float
    high: float
    colors: list[str]
    outside: str | None = None
    whole: bool = False
    """Whether values are whole numbers."""

    @property
    def legend(self) -> str:
        """Title with the unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    def rgb(self, values: Array) -> NDArray[np.uint8]:
        """Return the colours of values (n,), as uint8 (n, 3)."""
        table = _table(tuple(self.colors))
        share = (values - self.low) / (self.high - self.low)
        index = np.clip(np.nan_to_num(share) * len(table), 0, len(table) - 1).astype(int)
        colors: NDArray[np.uint8] = table[index]
        if self.outside is not None:
            colors[(share < 0) | (share > 1)] = _rgb(self.outside)
        return colors

    def n_outside(self, values: Array) -> int:
        """Return how many values are drawn in `outside`."""
        beyond = (values < self.low) | (values > self.high)
        return 0 if self.outside is None else int(np.count_nonzero(beyond))


@cache
def _table(colors: tuple[str, ...]) -> NDArray[np.uint8]:
    return np.array([_rgb(color) for color in colors], np.uint8)


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


@cache
def colors_of(color_map: str) -> list[str]:
    """Return the colours of one of `COLOR_MAPS`, as #rrggbb."""
    import colorcet  # noqa: PLC0415 - slow to import

    if color_map in colorcet.palette:
        table = list(colorcet.palette[color_map])
    else:
        from matplotlib import colormaps, colors  # noqa: PLC0415 - slow to import

        table = [colors.to_hex(each) for each in colormaps[color_map](range(256))]
    return table[COLOR_MAPS[color_map]]


def range_scale(
    capture: CaptureInfo,
    image: RangeImage,
    chosen: RangeColors | None = None,
    title: str = "Estimated range",
) -> ColorScale:
    """Return the colour scale of a capture's ranges.

    A limit that is not chosen follows from the confident returns of an image that has several of a
    pixel, otherwise from the true ranges, if they are known, otherwise from the confident
    estimates, otherwise from all estimates, otherwise from the gate.

    Parameters
    ----------
    capture : CaptureInfo
    image : RangeImage
        The estimates that are shown.
    chosen : RangeColors, optional
    title : str
        Title of the scale.
    """
    chosen = chosen or RangeColors()
    bin_m = capture.acquisition.bin_length_m
    low, high = _automatic_limits_m(capture, image)
    if chosen.color_from_m is not None:
        low = float(chosen.color_from_m)
        high = max(high, low + bin_m)
    if chosen.color_to_m is not None:
        high = float(chosen.color_to_m)
        if chosen.color_from_m is None:
            low = min(low, high - bin_m)
    return ColorScale(title, "m", low, high, colors_of(chosen.color_map), OUTSIDE_COLOR)


def p_value_scale() -> ColorScale:
    """Return the colour scale of p-values of pixels: the smaller one is, the brighter."""
    return ColorScale("Goodness of fit: p-value", "", 0.0, SMALL, colors_of("inferno")[::-1])


def _automatic_limits_m(capture: CaptureInfo, image: RangeImage) -> tuple[float, float]:
    acquisition = capture.acquisition
    truth_m = getattr(capture, "truth_range_m", None)
    ends: Array
    returns = image.returns
    if returns is not None and (returns.confidence >= _CONFIDENT).any():
        # Surfaces before and behind that of the estimate, which a truth leaves out.
        ends = np.percentile(returns.range_m[returns.confidence >= _CONFIDENT], [1, 99])
    elif truth_m is not None and np.isfinite(truth_m).any():
        ends = np.array([np.nanmin(truth_m), np.nanmax(truth_m)])
    elif image.valid.any():
        sure = image.range_m[image.valid & (image.confidence >= _CONFIDENT)]
        ends = np.percentile(sure if sure.size else image.range_m[image.valid], [2, 98])
    else:
        ends = acquisition.bin_to_range_m([0, acquisition.n_bins])
    low, high = map(float, ends)
    return low - acquisition.bin_length_m, high + acquisition.bin_length_m
