"""Scenes from files: meshes and depth maps.

The gate is chosen so that it holds all surfaces: 1 ns bins, or the narrowest of whole nanoseconds
that keep to 1024 of them, with 20 bins or so to spare on both sides and never fewer than 100. It
opens with the pulse at the earliest. 1000 pulses are sent for each pixel.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from math import ceil, floor
from pathlib import Path

import numpy as np

from core.acquisition import Acquisition, Floats
from core.checks import refusing, require
from core.io.scene_files import depth, mesh
from core.scene import Scene

__all__ = ["SceneError", "read_scene"]

_LEAST_BINS, _MOST_BINS = 100, 1024
_SPARE_BINS = 20  # at either side of the surfaces
_N_PULSES = 1000


class SceneError(ValueError):
    """File that cannot be read as a scene: names the file, the field, the value, the remedy."""


def read_scene(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    pixel_angle_rad: float | None = None,
    unit_m: float | None = None,
    distance_m: float | None = None,
    position_m: Sequence[float] | None = None,
    direction: Sequence[float] | None = None,
) -> Scene:
    """Read a scene to simulate; the file's suffix determines the format.

    A mesh (``.ply``, ``.stl``, ``.obj``, ``.glb``) is rendered by the pinhole model, as the point
    clouds of this package are drawn: along `direction`, rows from the top, columns from the left.
    Axes are those of the file, z up; but glTF, whose y is up, is turned first, so that y points
    away from a viewer of its front. Materials and other files that a mesh refers to are not read.

    A depth map (16-bit ``.png``; ``.tif``, ``.tiff`` of 16-bit numbers or 32-bit floats) holds for
    each pixel the range along its line of sight; 0 and NaN mean that there is no target.

    Parameters
    ----------
    path : path-like
    size : tuple of int, optional
        Rows and columns of the view of a mesh, (64, 64) by default.
    pixel_angle_rad : float, optional
        Angle between neighbouring pixels in radians. By default a mesh fills its image.
    unit_m : float, optional
        Unit of the file in metres. Default: 1 for a mesh and for floats, 0.001 for the whole
        numbers of a depth map.
    distance_m : float, optional
        From the sensor to the nearest point of a mesh, along `direction`, the middle of its
        bounding box in the middle of the image; 50 m by default.
    position_m : sequence of 3 floats, optional
        Position of the sensor, in place of `distance_m`, in metres.
    direction : sequence of 3 floats, optional
        Line of sight of the sensor, (0, 1, 0) by default. The z axis points up in the image, or
        for a view straight up or down, the y axis.

    Returns
    -------
    Scene
        With the acquisition that suits it.

    Raises
    ------
    SceneError
        If the file or an argument is refused: names the file, the field, its value and the remedy.
    """
    path = Path(path)
    view = mesh.View(size, pixel_angle_rad, distance_m, position_m, direction)
    with refusing(path, SceneError):
        require("path", str(path), path.is_file(), "an existing file")
        accepted = pixel_angle_rad is None or 0 < pixel_angle_rad < 1
        require("pixel_angle_rad", pixel_angle_rad, accepted, "between 0 and 1 radian")
        require("unit_m", unit_m, unit_m is None or 0 < unit_m < np.inf, "positive, in metres")
        suffix = path.suffix.lower()
        known = ", ".join((*mesh.SUFFIXES, *depth.SUFFIXES))
        require("suffix", path.suffix, suffix in known.split(", "), f"one of {known}")
        if suffix in mesh.SUFFIXES:
            range_m, pixel_angle_rad = mesh.read(path, unit_m or 1.0, view)
        else:
            view.refuse("a depth map has a view of its own")
            range_m = depth.read(path, unit_m)
        return Scene(range_m, acquisition=suitable_acquisition(range_m, pixel_angle_rad))


def suitable_acquisition(range_m: Floats, pixel_angle_rad: float | None) -> Acquisition:
    """Return the gate for surfaces at these ranges, by the rule above.

    Parameters
    ----------
    range_m : ndarray, any shape
        Metres, NaN where there is no target.
    pixel_angle_rad : float or None

    Returns
    -------
    Acquisition

    Raises
    ------
    ValueError
        If no pixel has a target, or one is farther than 1e8 m.
    """
    n_targets = int(np.count_nonzero(np.isfinite(range_m)))
    require("pixels with a target", n_targets, n_targets > 0, "a view that meets some surface")
    nearest, farthest = float(np.nanmin(range_m)), float(np.nanmax(range_m))
    accepted = nearest > 0 and farthest <= mesh.FARTHEST_M
    require("ranges", (nearest, farthest), accepted, f"metres above 0, up to {mesh.FARTHEST_M:g}")
    first_ns, last_ns = Acquisition(1, 1e-9, 0.0).range_m_to_bin([nearest, farthest])
    # One bin more for each edge that lies within a bin.
    width_ns = max(1, ceil((last_ns - first_ns) / (_MOST_BINS - 2 * _SPARE_BINS - 2)))
    first, last = floor(first_ns / width_ns), floor(last_ns / width_ns)
    n_bins = max(_LEAST_BINS, last - first + 1 + 2 * _SPARE_BINS)
    opening = max(0, (first + last + 1 - n_bins) // 2)
    width_s = width_ns * 1e-9
    return Acquisition(n_bins, width_s, opening * width_s, _N_PULSES, pixel_angle_rad)
