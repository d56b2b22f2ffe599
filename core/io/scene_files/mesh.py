"""Meshes as range images: Embree intersects each pixel's line of sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.checks import require
from core.geometry import sight_lines
from core.io.readers.guards import require_fits
from core.io.readers.isolation import isolated

SUFFIXES = (".ply", ".stl", ".obj", ".glb")

_DEFAULT_SIZE = (64, 64)
_DEFAULT_DISTANCE_M = 50.0
_DEFAULT_DIRECTION = (0.0, 1.0, 0.0)
_BYTES_A_PIXEL = 128  # of memory, while its line of sight is followed
_MOST_FACES = 4_000_000
_BYTES_A_FACE = 400  # of memory: its corners, twice, and the tree that finds it
_RAYS_AT_ONCE = 2**18
FARTHEST_M = 1e8
_MISSED_M = 1e30  # Embree returns 1e37


@dataclass(frozen=True)
class View:
    """Arguments of `core.io.scene_files.read_scene` that define the view of a mesh."""

    size: tuple[int, int] | None
    pixel_angle_rad: float | None
    distance_m: float | None
    position_m: Sequence[float] | None
    direction: Sequence[float] | None

    def refuse(self, why: str) -> None:
        """Raise ``ValueError`` if a setting is given that applies to meshes only."""
        for name, value in asdict(self).items():
            require(name, value, value is None or name == "pixel_angle_rad", f"None: {why}")


def read(path: Path, unit_m: float, view: View) -> tuple[Floats, float]:
    """Render a mesh as a range image.

    Parameters
    ----------
    unit_m : float
        Unit of the mesh in metres.

    Returns
    -------
    range_m : ndarray, shape (row, col)
        Metres along each line of sight; NaN where it meets nothing.
    pixel_angle_rad : float
        Angle between neighbouring pixels.
    """
    size = view.size or _DEFAULT_SIZE
    fits = len(size) == 2 and all(isinstance(n, int | np.integer) and n >= 1 for n in size)
    require("size", view.size, fits, "rows and columns, each at least 1")
    require_fits("the view", int(size[0]) * int(size[1]) * _BYTES_A_PIXEL, "a smaller size")
    vertices, faces = _triangles(path)
    with np.errstate(over="ignore", invalid="ignore"):  # values out of range are refused below
        seen_m = _as_seen(vertices * unit_m, view)
    farthest_m = float(np.abs(seen_m).max())
    require("coordinates", farthest_m, farthest_m < FARTHEST_M, f"metres up to {FARTHEST_M:g}")
    angle_rad = view.pixel_angle_rad or _angle_to_fill(seen_m, size)
    return _ranges_m(seen_m, faces, sight_lines(size, angle_rad)), angle_rad


def _triangles(path: Path) -> tuple[Floats, NDArray[Any]]:
    """Read vertices (vertex, 3) and faces (face, 3), z up, in the unit of the file."""
    suffix = path.suffix.lower()
    require_fits("the file", path.stat().st_size)
    _, (vertices, faces) = isolated(
        path, "the mesh", "read_mesh", suffix=suffix, most_faces=_MOST_FACES
    )
    require_fits("the faces", len(faces) * _BYTES_A_FACE)
    if suffix == ".glb":
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    return vertices, faces


def _as_seen(vertices_m: Floats, view: View) -> Floats:
    """Return coordinates from the sensor's point of view: right, away, up; shape (vertex, 3)."""
    away = _unit("direction", view.direction or _DEFAULT_DIRECTION)
    upwards = np.array([0.0, 1.0, 0.0] if abs(away[2]) > 1 - 1e-9 else [0.0, 0.0, 1.0])
    right = _unit("direction", np.cross(away, upwards))
    axes = np.stack([right, away, np.cross(right, away)])
    distance_m = view.distance_m
    if view.position_m is not None:
        what = "None: position_m determines the distance"
        require("distance_m", distance_m, distance_m is None, what)
        position_m = _three("position_m", view.position_m)
        return np.asarray((vertices_m - position_m) @ axes.T)
    distance_m = _DEFAULT_DISTANCE_M if distance_m is None else distance_m
    require("distance_m", distance_m, 0 < distance_m < np.inf, "positive, in metres")
    middle_m = (vertices_m.min(axis=0) + vertices_m.max(axis=0)) / 2
    seen_m = (vertices_m - middle_m) @ axes.T
    seen_m[:, 1] += distance_m - seen_m[:, 1].min()
    return np.asarray(seen_m)


def _unit(name: str, vector: Sequence[float] | Floats) -> Floats:
    xyz = _three(name, vector)
    length = float(np.linalg.norm(xyz))
    require(name, tuple(xyz.tolist()), 0 < length < np.inf, "a vector of some length")
    return np.asarray(xyz / length)


def _three(name: str, vector: Sequence[float] | Floats) -> Floats:
    xyz = np.asarray(vector, float)
    fits = xyz.shape == (3,) and bool(np.isfinite(xyz).all())
    require(name, tuple(xyz.ravel().tolist()), fits, "three finite numbers, x, y and z")
    return xyz


def _angle_to_fill(seen_m: Floats, size: tuple[int, int]) -> float:
    """Return the angle between pixels at which the mesh just fills its image."""
    ahead = seen_m[seen_m[:, 1] > 0]
    require("vertices in front of the sensor", len(ahead), len(ahead) > 0, "a view of the mesh")
    tangents = np.abs(ahead[:, [2, 0]]) / ahead[:, 1:2]
    angle_rad = float(np.arctan((2 * tangents.max(axis=0) / size).max()))
    accepted = "an angle yourself, since the mesh has no width, or the sensor is too near"
    require("pixel_angle_rad", angle_rad, 0 < angle_rad < 1, accepted)
    return angle_rad


def _ranges_m(vertices_m: Floats, faces: NDArray[Any], lines: Floats) -> Floats:
    """Return ranges along lines of sight (row, col, 3) from the origin; NaN without a surface."""
    from embreex.mesh_construction import TriangleMesh  # noqa: PLC0415 - slow to import
    from embreex.rtcore_scene import EmbreeScene  # noqa: PLC0415

    scene = EmbreeScene()
    # 32-bit floats from the sensor: exact to 1e-7 of the range, wherever the mesh's origin is.
    TriangleMesh(scene, vertices_m.astype(np.float32), faces.astype(np.int32))
    directions = lines.reshape(-1, 3).astype(np.float32)
    range_m = np.empty(len(directions))
    for first in range(0, len(directions), _RAYS_AT_ONCE):
        some = directions[first : first + _RAYS_AT_ONCE]
        range_m[first : first + len(some)] = scene.run(np.zeros_like(some), some, query="DISTANCE")
    return np.where(range_m < _MISSED_M, range_m, np.nan).reshape(lines.shape[:2])
