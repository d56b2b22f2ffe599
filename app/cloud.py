"""The 3D cloud: a range image as a PyVista mesh, as a file, and as points in the browser.

Coordinates are right-handed, in metres, with the sensor at the origin: x to the right of the
image, y away from the sensor along the optical axis, z up. Distances are thus positive and the
cloud stands upright in programs that take z as up.

The mesh never becomes a picture on the server, where OpenGL may be missing: its points and colours
go to the browser, which draws them with the vtk.js that Panel bundles.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import panel as pn
import param
import pyvista as pv
from numpy.typing import ArrayLike, NDArray

from app.theme import WRONG_COLOR, palette

Floats = NDArray[np.float64]

PLY_TYPES = {"b": "char", "u": "uchar", "i": "int", "f": "float"}


def sight_lines(shape: tuple[int, int], pixel_angle_rad: float) -> Floats:
    """Direction in which each pixel looks, by the pinhole model with square pixels.

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
    """
    rows, cols = shape
    step = np.tan(pixel_angle_rad)
    right = (np.arange(cols) - (cols - 1) / 2) * step
    up = ((rows - 1) / 2 - np.arange(rows)) * step
    lines = np.ones((rows, cols, 3))
    lines[..., 0] = right
    lines[..., 2] = up[:, np.newaxis]
    return np.asarray(lines / np.linalg.norm(lines, axis=-1, keepdims=True))


def point_cloud(range_m: ArrayLike, pixel_angle_rad: float, **images: ArrayLike) -> pv.PolyData:
    """Turn a range image into a cloud of one vertex per pixel that has a range.

    Parameters
    ----------
    range_m : array_like, shape (row, col)
        Range along each line of sight in metres; pixels that are not finite are left out.
    pixel_angle_rad : float
        Angle between the lines of sight of neighbouring pixels, in radians.
    **images : array_like, shape (row, col) or (row, col, component)
        Further images of the same size, kept as point data under their names; one named ``rgb``
        with three uint8 components gives the colours of an exported PLY file.

    Returns
    -------
    pyvista.PolyData
        Point data ``range_m``, ``row``, ``col`` and the images; field data ``image_shape`` and
        ``pixel_angle_rad``.

    Raises
    ------
    ValueError
        If an image has another size than ``range_m``.
    """
    ranges = np.asarray(range_m, float)
    if ranges.ndim != 2:
        raise ValueError(f"range_m has shape {ranges.shape}: give an image (row, col).")
    row, col = np.nonzero(np.isfinite(ranges))
    lines = sight_lines(ranges.shape, pixel_angle_rad)
    cloud = pv.PolyData(ranges[row, col, np.newaxis] * lines[row, col])
    cloud["range_m"] = ranges[row, col]
    cloud["row"] = row.astype(np.int32)
    cloud["col"] = col.astype(np.int32)
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


def pixel_index(cloud: pv.PolyData) -> NDArray[np.int32]:
    """Index of each point's pixel in the flattened image, ``row * n_cols + col``."""
    n_cols = cloud.field_data["image_shape"][1]
    return np.asarray(cloud["row"] * n_cols + cloud["col"], np.int32)


def spacing_m(cloud: pv.PolyData) -> float:
    """Distance between neighbouring points of a surface at the middle range; 0 without points."""
    if cloud.n_points == 0:
        return 0.0
    return float(np.median(cloud["range_m"]) * cloud.field_data["pixel_angle_rad"][0])


def view_bounds(cloud: pv.PolyData, keep: ArrayLike | None = None) -> list[float]:
    """Box around the target, not around points scattered through the gate.

    False detections lie evenly over the ranges of the gate, so a slice of range belongs to the
    target where it holds clearly more points than the middle slice. Where most points lie in no
    such slice the target itself fills the gate, and nearly all ranges count.

    Parameters
    ----------
    cloud : pyvista.PolyData
        From `point_cloud`.
    keep : array_like of bool, shape (point,), optional
        Points to look at, such as those known to be right; all points if it names none.

    Returns
    -------
    list of float
        xmin, xmax, ymin, ymax, zmin, zmax in metres; empty for a cloud without points.
    """
    if cloud.n_points == 0:
        return []
    kept = np.ones(cloud.n_points, bool) if keep is None else np.asarray(keep, bool)
    if not kept.any():
        kept = ~kept
    points, ranges = np.asarray(cloud.points)[kept], np.asarray(cloud["range_m"])[kept]
    low, high = _target_ranges(ranges)
    inside = points[(ranges >= low) & (ranges <= high)]
    margin = spacing_m(cloud)
    box = np.column_stack([inside.min(axis=0) - margin, inside.max(axis=0) + margin])
    return [float(value) for value in box.ravel()]


def _target_ranges(ranges: Floats) -> tuple[float, float]:
    """Lowest and highest range of the target; looks closer while that halves the span."""
    low, high = _dense_ranges(ranges)
    if high - low > 0.5 * np.ptp(ranges):
        return low, high
    return _target_ranges(ranges[(ranges >= low) & (ranges <= high)])


def _dense_ranges(ranges: Floats) -> tuple[float, float]:
    """Ends of the slices that hold clearly more points than the middle one, see `view_bounds`."""
    counts, edges = np.histogram(ranges, bins=100)
    dense = np.flatnonzero(counts > 3 * np.median(counts) + 0.002 * ranges.size)
    if counts[dense].sum() < 0.5 * ranges.size:
        low, high = np.percentile(ranges, [0.5, 99.5])
        return float(low), float(high)
    return float(edges[dense[0]]), float(edges[dense[-1] + 1])


def export_bytes(cloud: pv.PolyData, suffix: str) -> bytes:
    """Content of a binary file that holds the cloud.

    Parameters
    ----------
    cloud : pyvista.PolyData
        From `point_cloud`.
    suffix : str
        ``.vtp`` keeps every array in its own type. ``.ply`` keeps every array of one component,
        as float, int or char, and ``rgb`` as red, green and blue.

    Raises
    ------
    ValueError
        If the suffix is another one.
    """
    if suffix == ".ply":
        return _ply_bytes(cloud)
    if suffix != ".vtp":
        raise ValueError(f"suffix {suffix!r} is not accepted: give '.ply' or '.vtp'.")
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cloud.vtp"
        cloud.save(path)
        return path.read_bytes()


def _ply_bytes(cloud: pv.PolyData) -> bytes:
    """Write the PLY by hand: VTK's writer drops all point data but colours."""
    columns = dict(zip("xyz", np.asarray(cloud.points, "<f4").T, strict=True))
    for name in cloud.point_data:
        values = np.asarray(cloud[name])
        if name == "rgb":
            columns |= dict(zip(("red", "green", "blue"), values.astype("u1").T, strict=True))
        elif values.ndim == 1:
            columns[name] = _ply_column(values)
    table = np.empty(cloud.n_points, [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        table[name] = values
    properties = [f"property {PLY_TYPES[v.dtype.kind]} {name}" for name, v in columns.items()]
    header = ["ply", "format binary_little_endian 1.0", "comment x right, y away, z up, in metres"]
    header += [f"element vertex {cloud.n_points}", *properties, "end_header", ""]
    return "\n".join(header).encode("ascii") + table.tobytes()


def _ply_column(values: NDArray[Any]) -> NDArray[Any]:
    """Give the values in the nearest type that every PLY reader knows."""
    if values.dtype.kind == "f":
        return values.astype("<f4")
    if values.dtype.itemsize == 1:
        return values.view("u1") if values.dtype.kind == "b" else values
    return values.astype("<i4")


class PointCloud(pn.custom.JSComponent):
    """Draw a point cloud in the browser.

    Call `draw` to show a cloud; all of it travels in one message and is painted in one frame. The
    camera stays where the user left it until ``scene_id`` changes or ``home`` is triggered. The
    page must have been set up with ``pn.extension("vtk")``.
    """

    positions = param.Bytes(default=b"", doc="float32 x, y, z of each point in metres.")

    colors = param.Bytes(default=b"", doc="uint8 red, green, blue of each point.")

    pixels = param.Bytes(default=b"", doc="int32 index of each point's pixel.")

    wrong = param.Bytes(default=b"", doc="uint8, 1 for points drawn as crosses; empty for none.")

    selected = param.Integer(
        default=-1,
        doc="Index of the pixel that carries a ring, -1 for none; a click on a point sets it.",
    )

    point_size = param.Number(
        default=1.4,
        bounds=(0.2, 5.0),
        doc="Diameter of a point as a multiple of the distance between neighbouring points.",
    )

    spacing_m = param.Number(default=0.0, doc="Distance between neighbouring points in metres.")

    bounds = param.List(
        default=[],
        item_type=float,
        doc="Box that the home view frames: xmin, xmax, ymin, ymax, zmin, zmax in metres.",
    )

    scene_id = param.String(default="", doc="Name of the scene; a new one resets the camera.")

    home = param.Event(doc="Reset the camera.")

    link = param.String(
        default="", doc="Clouds of a page that share this name share their camera; empty for none."
    )

    dark = param.Boolean(default=False, doc="Take ink and paper from the dark palette.")

    ink = param.Color(default=palette(dark=False).text, doc="Colour of text, as #rrggbb.")

    paper = param.Color(default=palette(dark=False).paper, doc="Background, as #rrggbb.")

    wrong_color = param.Color(default=WRONG_COLOR, doc="Colour of the crosses, as #rrggbb.")

    label = param.String(
        default="Point cloud. Arrow keys turn it, plus and minus zoom, 0 resets the view.",
        doc="What a screen reader says of the picture.",
    )

    caption = param.String(default="", doc="A line of text in the lower left corner.")

    _esm = Path(__file__).with_name("cloud.js")

    @param.depends("dark", watch=True, on_init=True)
    def _take_palette(self) -> None:
        colors = palette(self.dark)
        self.param.update(ink=colors.text, paper=colors.paper)

    def draw(
        self,
        cloud: pv.PolyData,
        rgb: ArrayLike,
        wrong: ArrayLike | None = None,
        *,
        scene_id: str | None = None,
        bounds: Sequence[float] | None = None,
    ) -> None:
        """Show a cloud in place of the present one.

        Parameters
        ----------
        cloud : pyvista.PolyData
            From `point_cloud`.
        rgb : array_like of uint8, shape (point, 3)
            Colour of each point.
        wrong : array_like of bool, shape (point,), optional
            Points to draw as crosses.
        scene_id : str, optional
            Name of the scene; if it differs from the present one the camera is reset.
        bounds : sequence of float, optional
            Box for the home view; for a new scene `view_bounds` of the points not wrong is taken
            where none is given.

        Raises
        ------
        ValueError
            If ``rgb`` or ``wrong`` does not fit the number of points.
        """
        colors = np.ascontiguousarray(rgb, np.uint8)
        if colors.shape != (cloud.n_points, 3):
            raise ValueError(f"rgb has shape {colors.shape}: give {(cloud.n_points, 3)}.")
        mask = np.zeros(cloud.n_points, bool) if wrong is None else np.asarray(wrong, bool)
        if mask.shape != (cloud.n_points,):
            raise ValueError(f"wrong has shape {mask.shape}: give {(cloud.n_points,)}.")
        update: dict[str, Any] = {
            "positions": np.asarray(cloud.points, "<f4").tobytes(),
            "colors": colors.tobytes(),
            "pixels": pixel_index(cloud).astype("<i4").tobytes(),
            "wrong": mask.tobytes(),
            "spacing_m": spacing_m(cloud),
        }
        if scene_id is not None and scene_id != self.scene_id:
            update["scene_id"] = scene_id
        if "scene_id" in update or not self.bounds:
            update["bounds"] = view_bounds(cloud, ~mask)
        if bounds is not None:
            update["bounds"] = [float(value) for value in bounds]
        self.param.update(**update)
