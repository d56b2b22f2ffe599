"""The 3D cloud: a PyVista mesh whose points and colours the browser draws.

Coordinates are those of `core.geometry`. The server, where OpenGL may be missing, never renders the
mesh; the browser does, with the vtk.js that Panel bundles.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import param
import pyvista as pv
from numpy.typing import ArrayLike

from app.model.mesh import pixel_index, spacing_m, view_bounds
from app.theme import WRONG_COLOR, palette
from app.widgets.component import Component


class PointCloud(Component):
    """Draw a point cloud in the browser.

    `draw` sends a cloud in one message, which is painted in one frame. The camera stays where the
    user left it until ``scene_id`` changes or ``home`` is triggered. The page requires
    ``pn.extension("vtk")``.
    """

    positions = param.Bytes(default=b"", doc="float32 x, y, z of each point in metres.")
    colors = param.Bytes(default=b"", doc="uint8 red, green, blue of each point.")
    pixels = param.Bytes(default=b"", doc="int32 index of each point's pixel.")
    wrong = param.Bytes(default=b"", doc="uint8, 1 for points drawn as crosses; empty for none.")
    selected = param.Integer(
        default=-1,
        doc="Index of the pixel marked by a ring, -1 for none; a click on a point sets it.",
    )
    pinned = param.List(default=[], item_type=int, doc="Indices of further pixels with a ring.")
    spacing_m = param.Number(default=0.0, doc="Distance between neighbouring points in metres.")
    bounds = param.List(
        default=[],
        item_type=float,
        doc="Box that the home view frames: xmin, xmax, ymin, ymax, zmin, zmax in metres.",
    )
    scene_id = param.String(default="", doc="Name of the scene; a new one resets the camera.")
    home = param.Event(doc="Reset the camera.")
    link = param.String(
        default="", doc="Clouds of a page with the same name share their camera; empty for none."
    )
    dark = param.Boolean(default=False, doc="Whether ink and paper come from the dark palette.")
    ink = param.Color(default=palette(dark=False).text, doc="Colour of text, as #rrggbb.")
    paper = param.Color(default=palette(dark=False).paper, doc="Background, as #rrggbb.")
    wrong_color = param.Color(default=WRONG_COLOR, doc="Colour of the crosses, as #rrggbb.")
    label = param.String(
        default="Point cloud. Arrow keys rotate it, plus and minus zoom, 0 resets the view.",
        doc="Name of the picture for screen readers.",
    )
    caption = param.String(default="", doc="Lines of text in the lower left corner.")

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
        """Show a cloud in place of the last one.

        Parameters
        ----------
        cloud : pyvista.PolyData
            From `point_cloud`.
        rgb : array_like of uint8, shape (point, 3)
            Colour of each point.
        wrong : array_like of bool, shape (point,), optional
            Points to draw as crosses.
        scene_id : str, optional
            Name of the scene; a new name resets the camera.
        bounds : sequence of float, optional
            Box for the home view; for a new scene by default `view_bounds` of the points that are
            not wrong.

        Raises
        ------
        ValueError
            If the length of ``rgb`` or ``wrong`` is not the number of points.
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
            update["bounds"] = view_bounds(cloud, None if wrong is None else ~mask)
        if bounds is not None:
            update["bounds"] = [float(value) for value in bounds]
        self.param.update(**update)
