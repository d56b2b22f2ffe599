"""Range image with all metadata that a file may hold, the same for every format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import CaptureInfo
from core.checks import require
from core.estimators import RangeImage
from core.geometry import Points, points_m

COLORS = ("red", "green", "blue")
"""Columns of a cloud that has colours."""


class Plane(NamedTuple):
    """One image of a product, shape (row, col), its unit (by UDUNITS) and its meaning."""

    values: NDArray[Any]
    unit: str
    meaning: str


@dataclass(frozen=True, eq=False)
class Product:
    """Range image with its metadata.

    Parameters
    ----------
    capture : CaptureInfo
        Source of the range image.
    image : RangeImage
        Range image of the capture's shape.
    pixel_angle_rad : float, optional
        Angle between the lines of sight of neighbouring pixels, in radians.
    title : str
        Title; see `heading`.
    rgb : ndarray of uint8, shape (row, col, 3), optional
        Colours of the points of a cloud.
    shown : mapping of str to Plane
        Further or replacing images of the capture; they come first among `planes`.

    Raises
    ------
    ValueError
        If image and capture, image and colours, or image and what is shown differ in shape, or the
        angle is not between 0 and π/2.
    """

    capture: CaptureInfo
    image: RangeImage
    pixel_angle_rad: float | None = None
    title: str = ""
    rgb: NDArray[np.uint8] | None = None
    shown: Mapping[str, Plane] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shape, angle_rad = self.image.range_m.shape, self.pixel_angle_rad
        known = self.capture.counts.shape
        require("image", f"shape {shape}", shape == known, f"shape {known}, the capture's")
        if self.rgb is not None:
            of, dtype = self.rgb.shape, self.rgb.dtype
            fits = of == (*shape, 3) and dtype == np.uint8
            require("rgb", f"{dtype} of shape {of}", fits, f"uint8 of shape {(*shape, 3)}")
        for name, plane in self.shown.items():
            of = plane.values.shape
            require(f"shown {name!r}", f"shape {of}", of == shape, f"shape {shape}, the image's")
        possible = angle_rad is None or 0 < angle_rad < np.pi / 2
        require("pixel_angle_rad", angle_rad, possible, "an angle between 0 and π/2 radians")

    @property
    def heading(self) -> str:
        """Title, or a general one."""
        return _plain(self.title) or "Range image"

    @property
    def planes(self) -> dict[str, Plane]:
        """Images by name."""
        image, shown = self.image, dict(self.shown)
        known = {
            "range_m": Plane(image.range_m, "m", "range of the surface, NaN without an estimate"),
            "confidence": Plane(
                image.confidence,
                "1",
                "probability that the estimate is right within 3 bins",
            ),
            "counts": Plane(self.capture.counts, "1", "detections of the pixel"),
            "bin": Plane(image.bin, "1", "delay of the echo in bins, from the opening of the gate"),
            "score": Plane(image.score, "1", "score of the estimate, of the estimator's own scale"),
            "valid": Plane(image.valid, "1", "whether there is an estimate"),
        }
        return shown | {name: plane for name, plane in known.items() if name not in shown}

    @property
    def facts(self) -> dict[str, str | int | float]:
        """Acquisition and source; `n_pulses` is 0 and no `pixel_angle_rad` where not known."""
        acquisition = self.capture.acquisition
        facts: dict[str, str | int | float] = {
            "bin_width_s": float(acquisition.bin_width_s),
            "gate_delay_s": float(acquisition.gate_delay_s),
            "n_pulses": int(acquisition.n_pulses or 0),
            "detection": self.capture.detection,
            "source": _plain(self.capture.source),
        }
        if self.pixel_angle_rad is not None:
            facts["pixel_angle_rad"] = float(self.pixel_angle_rad)
        return facts

    def points(self) -> Points:
        """Return the estimates in space.

        Raises
        ------
        ValueError
            If there are none, or the angle between pixels is not known.
        """
        n_valid = int(self.image.valid.sum())
        require("valid pixels", n_valid, n_valid > 0, "an image with some: a cloud needs points")
        angle_rad = self.pixel_angle_rad
        if angle_rad is None:
            raise ValueError(
                "pixel_angle_rad = None is not accepted: give the angle between neighbouring "
                "pixels in radians, which the capture does not know and a cloud needs."
            )
        return points_m(self.image.range_m, angle_rad)

    def point_columns(self, points: Points) -> dict[str, NDArray[Any]]:
        """Return the columns of a point cloud other than coordinates; each of shape (point,)."""
        here = points.row, points.col
        rgb = {} if self.rgb is None else dict(zip(COLORS, self.rgb[here].T, strict=True))
        return {
            "range_m": self.image.range_m[here],
            "counts": np.minimum(self.capture.counts[here], 2**32 - 1).astype(np.uint32),
            "confidence": self.image.confidence[here].astype(np.float32),
            "row": points.row,
            "col": points.col,
            **rgb,
        }


def _plain(text: str) -> str:
    """Return text on one line, of characters that every format can hold."""
    return "".join(character if character.isprintable() else " " for character in text)
