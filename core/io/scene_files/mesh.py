"""Meshes as range images: Embree intersects each pixel's line of sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.checks import require
from core.geometry import sight_lines
from core.io.readers import guards
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
_MISSED_M = 1e30  # Embree answers with 1e37


@dataclass(frozen=True)
class View:
    """Arguments of `core.io.scene_files.read_scene` that define the view of a mesh."""

    size: tuple[int, int] | None
    pixel_angle_rad: float | None
    distance_m: float | None
    position_m: Sequence[float] | None
    direction: Sequence[float] | None

    @property
    def of_a_mesh(self) -> dict[str, object]:
        """Settings that apply to meshes only."""
        return {
            "size": self.size,
            "distance_m": self.distance_m,
            "position_m": self.position_m,
            "direction": self.direction,
        }


class Triangles(NamedTuple):
    """Surfaces in space."""

    vertices: Floats
    """Coordinates, shape (vertex, 3)."""
    faces: NDArray[np.int64]
    """Three vertices of each triangle, shape (face, 3)."""


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
    triangles = load(path)
    with np.errstate(over="ignore", invalid="ignore"):  # what is out of range shows below
        seen = _as_seen(triangles.vertices * unit_m, view)
    farthest_m = float(np.abs(seen).max())
    require("coordinates", farthest_m, farthest_m < FARTHEST_M, f"metres up to {FARTHEST_M:g}")
    angle_rad = view.pixel_angle_rad or _angle_to_fill(seen, size)
    return _ranges_m(Triangles(seen, triangles.faces), sight_lines(size, angle_rad)), angle_rad


def load(path: Path) -> Triangles:
    """Read the triangles of a mesh, all its parts in place, in the unit of the file.

    Raises
    ------
    ValueError
        If the file is damaged, too large, has no surfaces, or refers to other files for them.
    """
    suffix = path.suffix.lower()
    require_fits("the file", path.stat().st_size)
    _, (vertices, faces) = isolated(
        path, "the mesh", "read_mesh", guards.MAX_CUBE_BYTES, suffix=suffix, most_faces=_MOST_FACES
    )
    require("faces of the mesh", len(faces), len(faces) > 0, f"1 to {_MOST_FACES:,}")
    require_fits("the faces", len(faces) * _BYTES_A_FACE)
    if suffix == ".glb":
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    return Triangles(vertices, faces)


def _as_seen(vertices_m: Floats, view: View) -> Floats:
    """Coordinates from the sensor's point of view: right, away, up; shape (vertex, 3)."""
    away = _unit("direction", view.direction or _DEFAULT_DIRECTION)
    upwards = np.array([0.0, 1.0, 0.0] if abs(away[2]) > 1 - 1e-9 else [0.0, 0.0, 1.0])
    right = _unit("direction", np.cross(away, upwards))
    axes = np.stack([right, away, np.cross(right, away)])
    if view.position_m is None:
        distance_m = _DEFAULT_DISTANCE_M if view.distance_m is None else view.distance_m
        require("distance_m", distance_m, 0 < distance_m < np.inf, "positive, in metres")
        middle_m = (vertices_m.min(axis=0) + vertices_m.max(axis=0)) / 2
        seen = (vertices_m - middle_m) @ axes.T
        seen[:, 1] += distance_m - seen[:, 1].min()
        return np.asarray(seen)
    told = view.distance_m
    require("distance_m", told, told is None, "None: position_m says where the sensor is")
    position_m = _three("position_m", view.position_m)
    return np.asarray((vertices_m - position_m) @ axes.T)


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
    """Angle between pixels by which the mesh just fills its image."""
    ahead = seen_m[seen_m[:, 1] > 0]
    require("vertices before the sensor", len(ahead), len(ahead) > 0, "a view of the mesh")
    tangents = np.abs(ahead[:, [2, 0]]) / ahead[:, 1:2]
    step = float((2 * tangents.max(axis=0) / size).max())
    angle_rad = float(np.arctan(step))
    accepted = "told, since the mesh has no width, or the sensor is too near"
    require("pixel_angle_rad", angle_rad, 0 < angle_rad < 1, accepted)
    return angle_rad


def _ranges_m(triangles: Triangles, lines: Floats) -> Floats:
    """Range along each line of sight (row, col, 3) from the origin; NaN where it meets nothing."""
    from embreex.mesh_construction import (  # noqa: PLC0415
        TriangleMesh,
    )
    from embreex.rtcore_scene import EmbreeScene  # noqa: PLC0415

    scene = EmbreeScene()
    # Of 32-bit floats, from the sensor: exact to 1e-7 of the range, wherever the mesh's origin is.
    TriangleMesh(scene, triangles.vertices.astype(np.float32), triangles.faces.astype(np.int32))
    directions = lines.reshape(-1, 3).astype(np.float32)
    range_m = np.empty(len(directions))
    for first in range(0, len(directions), _RAYS_AT_ONCE):
        some = directions[first : first + _RAYS_AT_ONCE]
        range_m[first : first + len(some)] = scene.run(np.zeros_like(some), some, query="DISTANCE")
    return np.where(range_m < _MISSED_M, range_m, np.nan).reshape(lines.shape[:2])
