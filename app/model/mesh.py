"""Range images as PyVista meshes, in the coordinates of `core.geometry`."""

from __future__ import annotations

import numpy as np
import pyvista as pv
from numpy.typing import ArrayLike, NDArray

from core.geometry import points_m, sight_lines
from core.inference import Returns
from core.inspection import CONFIDENT

Floats = NDArray[np.float64]


def point_cloud(range_m: ArrayLike, pixel_angle_rad: float, **images: ArrayLike) -> pv.PolyData:
    """Turn a range image into a cloud of one vertex per pixel that has a range.

    Parameters
    ----------
    range_m : array_like, shape (row, col)
        Range along each line of sight in metres; pixels that are not finite are left out.
    pixel_angle_rad : float
        Angle between the lines of sight of neighbouring pixels, in radians.
    **images : array_like, shape (row, col) or (row, col, component)
        Further images of the same size, kept as point data under their names.

    Returns
    -------
    pyvista.PolyData
        Point data ``range_m``, ``row``, ``col`` and the images; field data ``image_shape`` and
        ``pixel_angle_rad``.

    Raises
    ------
    ValueError
        If ``range_m`` is not an image, another image differs in size, or the angle is not between
        0 and π/2.
    """
    ranges = np.asarray(range_m, float)
    xyz_m, row, col = points_m(ranges, pixel_angle_rad)
    cloud = pv.PolyData(xyz_m)
    cloud["range_m"] = ranges[row, col]
    cloud["row"] = row
    cloud["col"] = col
    for name, image in images.items():
        values = np.asarray(image)
        if values.shape[:2] != ranges.shape:
            raise ValueError(
                f"{name} has shape {values.shape}: give {ranges.shape}, that of range_m."
            )
        cloud[name] = values[row, col]
    cloud.field_data["image_shape"] = np.array(ranges.shape, np.int32)
    cloud.field_data["pixel_angle_rad"] = np.array([pixel_angle_rad])
    return cloud


def returns_cloud(returns: Returns, shape: tuple[int, int], pixel_angle_rad: float) -> pv.PolyData:
    """Turn the returns of an image of a shape (row, col) into a cloud, in their order.

    With the data of `point_cloud`, and the confidence of each return.
    """
    lines = sight_lines(shape, pixel_angle_rad)[returns.row, returns.col]
    cloud = pv.PolyData(returns.range_m[:, np.newaxis] * lines)
    for name in ("range_m", "row", "col", "confidence"):
        cloud[name] = getattr(returns, name)
    cloud.field_data["image_shape"] = np.array(shape, np.int32)
    cloud.field_data["pixel_angle_rad"] = np.array([pixel_angle_rad])
    return cloud


def pixel_index(cloud: pv.PolyData) -> NDArray[np.int32]:
    """Return the index of each point's pixel in the flattened image, ``row * n_cols + col``."""
    n_cols = cloud.field_data["image_shape"][1]
    return np.asarray(cloud["row"] * n_cols + cloud["col"], np.int32)


def spacing_m(cloud: pv.PolyData) -> float:
    """Return the distance of neighbouring points at the median range; 0 without points."""
    if cloud.n_points == 0:
        return 0.0
    return float(np.median(cloud["range_m"]) * cloud.field_data["pixel_angle_rad"][0])


def view_bounds(cloud: pv.PolyData, keep: ArrayLike | None = None) -> list[float]:
    """Return a box around the target that leaves out points scattered through the gate.

    It holds nearly all points to keep. Without any, since false detections are spread evenly over
    the gate, a slice of range belongs to the target where it holds clearly more points than the
    median slice. If most points lie outside such slices, the target fills the gate, and nearly all
    ranges are included.

    Parameters
    ----------
    cloud : pyvista.PolyData
        From `point_cloud`.
    keep : array_like of bool, shape (point,), optional
        Points to keep, such as those known to be right; by default those whose point data
        ``confidence`` is high.

    Returns
    -------
    list of float
        xmin, xmax, ymin, ymax, zmin, zmax in metres; empty for a cloud without points.
    """
    if cloud.n_points == 0:
        return []
    points, ranges = np.asarray(cloud.points), np.asarray(cloud["range_m"])
    if keep is None and "confidence" in cloud.point_data:
        keep = cloud["confidence"] >= CONFIDENT
    if keep is not None and np.any(keep):
        kept = np.asarray(keep, bool)
        points, ranges = points[kept], ranges[kept]
        low = np.percentile(ranges, 1, method="lower")
        high = np.percentile(ranges, 99, method="higher")
    else:
        low, high = _target_ranges(ranges)
    inside = points[(ranges >= low) & (ranges <= high)]
    margin = spacing_m(cloud)
    box = np.column_stack([inside.min(axis=0) - margin, inside.max(axis=0) + margin])
    return [float(value) for value in box.ravel()]


def _target_ranges(ranges: Floats) -> tuple[float, float]:
    """Return the lowest and highest range of the target; repeats while that halves the span."""
    low, high = _dense_ranges(ranges)
    if high - low > 0.5 * np.ptp(ranges):
        return low, high
    return _target_ranges(ranges[(ranges >= low) & (ranges <= high)])


def _dense_ranges(ranges: Floats) -> tuple[float, float]:
    """Return the ends of the slices with clearly more points than the median slice."""
    counts, edges = np.histogram(ranges, bins=100)
    dense = np.flatnonzero(counts > 3 * np.median(counts) + 0.002 * ranges.size)
    if counts[dense].sum() < 0.5 * ranges.size:
        low, high = np.percentile(ranges, [0.5, 99.5])
        return float(low), float(high)
    return float(edges[dense[0]]), float(edges[dense[-1] + 1])
