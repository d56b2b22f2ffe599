"""The point cloud of a report: coordinates and colours that `cloud.js` draws."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.geometry import points_m
from core.io.writers.colors import ColorScale

_STEPS = 2**15 - 1  # of a coordinate, on either side of the centre
_RADIUS_SHARE = 0.9  # of the points, that the first view holds: a few wrong ones lie far away


@dataclass(frozen=True)
class Cloud:
    """Points of a range image as the attributes of a canvas.

    Parameters
    ----------
    n_points : int
    size_m : tuple of float
        Width, depth and height between the outermost points.
    xyz, rgb : str
        Coordinates as int16 and colours as uint8, shape (point, 3), in Base64.
    unit : float
        One step of a coordinate, in radii of the first view.
    spacing : float
        Distance of neighbouring points, likewise.
    """

    n_points: int
    size_m: tuple[float, float, float]
    xyz: str
    rgb: str
    unit: float
    spacing: float


def cloud_of(range_m: Floats, scale: ColorScale, pixel_angle_rad: float, step: int) -> Cloud | None:
    """Return the points of every `step`-th row and column; None if there are none.

    Parameters
    ----------
    range_m : ndarray, shape (row, col)
        NaN where there is no point.
    scale : ColorScale
        Colours of the ranges.
    pixel_angle_rad : float
        Angle between the lines of sight of neighbouring pixels.
    step : int
    """
    thinned = np.full(range_m.shape, np.nan)
    thinned[::step, ::step] = range_m[::step, ::step]
    points = points_m(thinned, pixel_angle_rad)
    if not points.row.size:
        return None
    found_m = thinned[points.row, points.col]
    centred_m = points.xyz_m - np.median(points.xyz_m, axis=0)
    spacing_m = step * pixel_angle_rad * float(np.median(found_m))
    distance_m = np.linalg.norm(centred_m, axis=1)
    radius_m = max(float(np.quantile(distance_m, _RADIUS_SHARE)), spacing_m)
    unit = max(float(np.abs(centred_m).max()) / radius_m, 1.0) / _STEPS
    steps = np.round(centred_m / (radius_m * unit)).astype("<i2")
    rgb = scale.rgb(found_m)
    width_m, depth_m, height_m = np.ptp(points.xyz_m, axis=0).tolist()
    size_m = width_m, depth_m, height_m
    return Cloud(len(steps), size_m, _base64(steps), _base64(rgb), unit, spacing_m / radius_m)


def _base64(values: NDArray[np.generic]) -> str:
    return b64encode(np.ascontiguousarray(values).tobytes()).decode()
