"""Conversion of range images to points in space.

Coordinates are right-handed, in metres, with the sensor at the origin: x to the right of the
image, y away from the sensor along the optical axis, z up. Distances are thus positive and the
cloud stands upright in programs that take z as up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Acquisition, Floats
from core.checks import require

__all__ = [
    "WHOLE",
    "Box",
    "Points",
    "distance_m",
    "guessed_field_of_view_deg",
    "pixel_angle_of",
    "pixels_in",
    "points_m",
    "sight_lines",
]


class Points(NamedTuple):
    """The pixels of a range image that have a range, row by row."""

    xyz_m: Floats
    """Coordinates in metres, shape (point, 3)."""
    row: NDArray[np.int32]
    """Row of each point's pixel, shape (point,)."""
    col: NDArray[np.int32]
    """Column of each point's pixel, shape (point,)."""


@dataclass(frozen=True)
class Box:
    """Part of a range image: the pixels in a polygon whose range lies between two limits.

    Parameters
    ----------
    polygon : tuple of (row, col)
        Corners, as for `pixels_in`; empty for all pixels.
    from_m, to_m : float, optional
        Shortest and longest range in metres; None for no limit.

    Raises
    ------
    ValueError
        If `to_m` is not above `from_m`.
    """

    polygon: tuple[tuple[float, float], ...] = ()
    from_m: float | None = None
    to_m: float | None = None

    def __post_init__(self) -> None:
        if self.from_m is not None and self.to_m is not None:
            is_above = self.from_m < self.to_m
            require("to_m", self.to_m, is_above, f"a number above from_m = {self.from_m:g}")

    def __str__(self) -> str:
        corners = " ".join(f"{row:g},{col:g}" for row, col in self.polygon)
        limits = {"from": self.from_m, "to": self.to_m}
        ranges = [f"{name} {limit:g} m" for name, limit in limits.items() if limit is not None]
        parts = [
            *([f"pixels in the polygon of corners row,col {corners}"] if corners else []),
            *([f"ranges {' '.join(ranges)}"] if ranges else []),
        ]
        return "; ".join(parts) or "everything"

    def contains(self, range_m: ArrayLike) -> NDArray[np.bool_]:
        """Return which pixels of a range image (row, col) are inside; none without a range."""
        ranges = np.asarray(range_m, float)
        inside: NDArray[np.bool_] = np.isfinite(ranges)
        if self.polygon:
            inside &= _mask(tuple(map(tuple, self.polygon)), ranges.shape)
        if self.from_m is not None:
            inside &= ranges >= self.from_m
        if self.to_m is not None:
            inside &= ranges <= self.to_m
        return inside


WHOLE = Box()
"""The box that holds everything."""


def sight_lines(shape: tuple[int, int], pixel_angle_rad: float) -> Floats:
    """Return the line of sight of each pixel of a pinhole camera with square pixels.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the image; row 0 is the top.
    pixel_angle_rad : float
        Angle between the lines of sight of neighbouring pixels at the centre of the image.

    Returns
    -------
    ndarray, shape (row, col, 3)
        Unit vectors; the centre of the image looks along y.

    Raises
    ------
    ValueError
        If the angle is not between 0 and π/2.
    """
    accepted = 0 < pixel_angle_rad < np.pi / 2
    require("pixel_angle_rad", pixel_angle_rad, accepted, "an angle between 0 and π/2 radians")
    rows, cols = shape
    step = np.tan(pixel_angle_rad)
    right = (np.arange(cols) - (cols - 1) / 2) * step
    up = ((rows - 1) / 2 - np.arange(rows)) * step
    lines = np.ones((rows, cols, 3))
    lines[..., 0] = right
    lines[..., 2] = up[:, np.newaxis]
    return np.asarray(lines / np.linalg.norm(lines, axis=-1, keepdims=True))


def points_m(range_m: ArrayLike, pixel_angle_rad: float) -> Points:
    """Return one point for each pixel of a range image that has a range.

    Parameters
    ----------
    range_m : array_like, shape (row, col)
        Range along each line of sight in metres; pixels that are not finite have no point.
    pixel_angle_rad : float
        Angle between the lines of sight of neighbouring pixels, in radians.

    Returns
    -------
    Points

    Raises
    ------
    ValueError
        If `range_m` is not an image, or the angle is not between 0 and π/2.
    """
    ranges = np.asarray(range_m, float)
    require("range_m", f"shape {ranges.shape}", ranges.ndim == 2, "an image (row, col)")
    row, col = np.nonzero(np.isfinite(ranges))
    lines = sight_lines(ranges.shape, pixel_angle_rad)
    xyz_m = ranges[row, col, np.newaxis] * lines[row, col]
    return Points(xyz_m, row.astype(np.int32), col.astype(np.int32))


def pixels_in(polygon: Sequence[tuple[float, float]], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Find the pixels whose centres lie in a polygon or on its edge, shape (row, col).

    Parameters
    ----------
    polygon : sequence of (row, col)
        Corners, at least 3, in pixels; the centre of the first pixel is (0, 0).
    shape : tuple of int
        Rows and columns of the image.

    Raises
    ------
    ValueError
        If there are fewer corners, or one is not finite.
    """
    from matplotlib.path import Path  # noqa: PLC0415 - slow to load

    corners = np.asarray(polygon, float)
    usable = corners.ndim == 2 and corners.shape[1] == 2 and len(corners) >= 3
    usable = usable and bool(np.isfinite(corners).all())
    require("polygon", f"{len(polygon)} corners", usable, "3 or more finite (row, col)")
    path, centres = Path(corners), np.indices(shape).reshape(2, -1).T
    # The sign of the margin that includes the edge depends on the orientation of the polygon.
    inside = [path.contains_points(centres, radius=margin) for margin in (-1e-9, 1e-9)]
    return np.asarray(np.logical_or(*inside).reshape(shape))


@lru_cache(maxsize=4)  # a slider of the limits changes only the ranges
def _mask(polygon: tuple[Any, ...], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return `pixels_in` as a read-only array."""
    inside = pixels_in(polygon, shape)
    inside.setflags(write=False)
    return inside


def distance_m(
    lines: ArrayLike, range_m: ArrayLike, half_width_m: ArrayLike
) -> tuple[float, float]:
    """Return the distance of two points, and half the width of its interval.

    The intervals of both ranges are propagated to first order, as independent errors.

    Parameters
    ----------
    lines : array_like, shape (2, 3)
        Lines of sight as unit vectors, as of `sight_lines`.
    range_m, half_width_m : array_like, shape (2,)
        Range of each point, and half the width of its interval, in metres.
    """
    towards, ranges = np.asarray(lines, float), np.asarray(range_m, float)
    between = ranges[1] * towards[1] - ranges[0] * towards[0]
    length_m = float(np.linalg.norm(between))
    # Change of the distance with each range; any change of one of two equal points is a distance.
    slopes = towards @ between / length_m if length_m else np.ones(2)
    return length_m, float(np.linalg.norm(slopes * np.asarray(half_width_m, float)))


def pixel_angle_of(field_of_view_deg: float, cols: int) -> float:
    """Return the angle in radians between neighbouring pixels at the centre of an image.

    Parameters
    ----------
    field_of_view_deg : float
        Horizontal angle that all columns span, in degrees.
    cols : int
        Columns of the image.
    """
    return float(np.arctan(2 * np.tan(np.radians(field_of_view_deg) / 2) / cols))


def guessed_field_of_view_deg(
    range_m: Floats, confidence: Floats, acquisition: Acquisition
) -> float:
    """Guess a horizontal field of view in degrees that makes a scene about as wide as it is deep.

    For a capture whose angle between pixels is not known; three digits, 0.001 to 120 degrees.

    Parameters
    ----------
    range_m, confidence : ndarray, shape (row, col)
        Estimates; the depth is that of the middle 90 % of those of confidence 0.9 or more.
    acquisition : Acquisition
        Its first bin is the depth if there are none.
    """
    sure = range_m[confidence >= 0.9]
    sure = sure if sure.size else acquisition.bin_to_range_m([0.0, 1.0])
    low, high = np.percentile(sure, [5, 95])
    width_deg = np.clip(np.degrees((high - low) / max(high, 1e-3)), 0.001, 120.0)
    return float(f"{width_deg:.3g}")
