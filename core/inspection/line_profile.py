"""Ranges along a line through a range image, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.checks import require
from core.estimators import RangeImage
from core.geometry import sight_lines
from core.inference import range_interval


@dataclass(frozen=True, eq=False)
class LineProfile:
    """Ranges of the pixels on a line; every array has shape (pixel,), in the order of the line."""

    row: NDArray[np.intp]
    col: NDArray[np.intp]
    distance_m: Floats
    """Distance from the first pixel along the line, across the line of sight, at the depth
    `depth_m`; NaN if no pixel has an estimate."""
    range_m: Floats
    """NaN without an estimate."""
    low_m: Floats
    """Lower limit of the 95 % interval of `range_m` (`core.range_interval`)."""
    high_m: Floats
    """Its upper limit."""
    confidence: Floats
    truth_m: Floats | None
    """True ranges, if they are known."""
    depth_m: float
    """Median distance of the surfaces from the sensor along the optical axis."""


def line_profile(
    capture: Capture,
    image: RangeImage,
    points: Sequence[tuple[int, int]],
    pixel_angle_rad: float | None = None,
) -> LineProfile:
    """Return the ranges of the pixels on a line through the image.

    Between two points the pixels nearest to the straight line are taken, one for each row or each
    column, whichever are more. Lengths along the line hold for the median depth of its surfaces:
    they follow from the angle between pixels, and do not depend on the ranges of single pixels.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        Estimate of the capture. Pixels without an estimate, such as those that
        `RangeImage.confident` removes, have no range.
    points : sequence of (row, col)
        Two or more pixels, not all the same, which the line joins in this order.
    pixel_angle_rad : float, optional
        Angle between the lines of sight of neighbouring pixels, in radians; the capture's own where
        None.

    Raises
    ------
    ValueError
        If there are fewer points, one lies outside the image, or the angle is unknown or not
        between 0 and π/2.
    """
    pixels, steps = _pixels_along(_corners(points, capture.shape))
    row, col = pixels.T
    angle_rad = capture.acquisition.pixel_angle_rad if pixel_angle_rad is None else pixel_angle_rad
    if angle_rad is None:
        raise ValueError(
            "pixel_angle_rad = None is not accepted: give the angle between neighbouring pixels in "
            "radians, which the capture does not state."
        )
    range_m = image.range_m[row, col]
    depths_m = (range_m * sight_lines(capture.shape, angle_rad)[row, col, 1])[np.isfinite(range_m)]
    depth_m = float(np.median(depths_m)) if depths_m.size else np.nan
    on_line = np.zeros(capture.shape, bool)
    on_line[row, col] = True
    interval = range_interval(capture, replace(image, valid=image.valid & on_line))
    return LineProfile(
        row,
        col,
        steps * np.tan(angle_rad) * depth_m,
        range_m,
        interval.low_m[row, col],
        interval.high_m[row, col],
        image.confidence[row, col],
        None if capture.truth_range_m is None else capture.truth_range_m[row, col],
        depth_m,
    )


def _corners(points: Sequence[tuple[int, int]], shape: tuple[int, int]) -> NDArray[np.intp]:
    """Return the points of a line, shape (point, 2)."""
    corners = np.asarray(points)
    usable = corners.ndim == 2 and corners.shape[1] == 2 and len(corners) >= 2
    usable = usable and np.issubdtype(corners.dtype, np.integer)
    usable = usable and bool((corners >= 0).all() and (corners < shape).all())
    usable = usable and bool((corners != corners[0]).any())
    rows, cols = shape
    require("points", points, usable, f"2 or more different (row, col) below ({rows}, {cols})")
    return corners


def _pixels_along(corners: NDArray[np.intp]) -> tuple[NDArray[np.intp], Floats]:
    """Return the pixels on a line (pixel, 2), and their distances along it in pixels (pixel,)."""
    pixels, steps, length = [corners[:1]], [np.zeros(1)], 0.0
    for start, end in pairwise(corners):
        share = np.linspace(0, 1, int(np.abs(end - start).max()) + 1)[1:]
        pixels.append(np.rint(start + share[:, np.newaxis] * (end - start)).astype(np.intp))
        steps.append(length + share * np.hypot(*(end - start)))
        length += float(np.hypot(*(end - start)))
    return np.concatenate(pixels), np.concatenate(steps)
