"""Conversion of range images to points in space.

Coordinates are right-handed, in metres, with the sensor at the origin: x to the right of the
image, y away from the sensor along the optical axis, z up. Distances are thus positive and the
cloud stands upright in programs that take z as up.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from core.acquisition import Floats
from core.checks import require

__all__ = [
    "Points",
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
