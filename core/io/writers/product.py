"""Range image with all metadata that a file may hold, the same for every format."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from textwrap import wrap
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.capture import CaptureInfo
from core.checks import require
from core.estimators import RangeImage
from core.geometry import (
    Points,
    guessed_field_of_view_deg,
    pixel_angle_of,
    points_m,
    sight_lines,
)
from core.inference import RangeInterval
from core.io.writers.colors import RangeColors
from core.labels import Plane, software

_MOST_IN_LINE = 500  # characters

P_VALUE = "fit_p_value"
"""Name of the p-values of the goodness of fit."""

COLORS = ("red", "green", "blue")
"""Columns of a cloud that has colours."""


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
        Colours of the points of a cloud; of an image with returns also theirs, (return, 3).
    shown : mapping of str to Plane
        Further or replacing images of the capture; they come first among `planes`.
    remark : str
        Added to the fact of that name.
    interval : RangeInterval, optional
        95 % interval of each range.
    interval_68 : RangeInterval, optional
        68 % interval of each range.
    p_value : ndarray, shape (row, col), optional
        P-values of the goodness of fit.
    colors : RangeColors, optional
        Colours of a picture.

    Raises
    ------
    ValueError
        If image and capture, or image and one of colours, interval, p-values and what is shown,
        differ in shape, or the angle is not between 0 and π/2.
    """

    capture: CaptureInfo
    image: RangeImage
    pixel_angle_rad: float | None = None
    title: str = ""
    rgb: NDArray[np.uint8] | None = None
    shown: Mapping[str, Plane] = field(default_factory=dict)
    remark: str = ""
    interval: RangeInterval | None = None
    interval_68: RangeInterval | None = None
    p_value: NDArray[np.float64] | None = None
    colors: RangeColors | None = None

    def __post_init__(self) -> None:
        shape, angle_rad = self.image.range_m.shape, self.pixel_angle_rad
        known = self.capture.counts.shape
        require("image", f"shape {shape}", shape == known, f"shape {known}, the capture's")
        if self.rgb is not None:
            of, dtype = self.rgb.shape, self.rgb.dtype
            returns = self.image.returns
            per_return = returns is not None and of == (len(returns), 3)
            fits = (of == (*shape, 3) or per_return) and dtype == np.uint8
            require("rgb", f"{dtype} of shape {of}", fits, f"uint8 of shape {(*shape, 3)}")
        for name, plane in self.shown.items():
            of = plane.values.shape
            require(f"shown {name!r}", f"shape {of}", of == shape, f"shape {shape}, the image's")
        for name, values in (self.interval_columns | self.p_value_columns).items():
            of = values.shape
            require(name, f"shape {of}", of == shape, f"shape {shape}, the image's")
        possible = angle_rad is None or 0 < angle_rad < np.pi / 2
        require("pixel_angle_rad", angle_rad, possible, "an angle between 0 and π/2 radians")

    @property
    def heading(self) -> str:
        """Title, or a general one."""
        return plain(self.title) or "Range image"

    @property
    def interval_columns(self) -> dict[str, NDArray[np.float64]]:
        """Limits of the intervals that are given, by name."""
        given = {"": self.interval, "68_": self.interval_68}
        return {
            f"range_{end}_{level}m": limit_m
            for level, interval in given.items()
            if interval is not None
            for end, limit_m in (("low", interval.low_m), ("high", interval.high_m))
        }

    @property
    def range_sd_m(self) -> NDArray[np.float64] | None:
        """Half the width of the 68 % intervals, if they are given."""
        known = self.interval_68
        return None if known is None else np.asarray((known.high_m - known.low_m) / 2)

    @property
    def range_step_m(self) -> NDArray[np.float64]:
        """Step (row, col) that texts of the ranges resolve.

        A tenth of `range_sd_m`, but at most a tenth of a bin; where that is not known, a hundredth
        of a bin.
        """
        bin_m, known = self.capture.acquisition.bin_length_m, self.range_sd_m
        sd_m = np.full(self.image.range_m.shape, np.nan) if known is None else known
        return np.where(np.isnan(sd_m), bin_m / 100, np.minimum(sd_m, bin_m) / 10)

    @property
    def p_value_columns(self) -> dict[str, NDArray[np.float64]]:
        """P-values by their name; empty if they are not given."""
        return {} if self.p_value is None else {P_VALUE: self.p_value}

    @property
    def velocity_columns(self) -> dict[str, NDArray[np.float64]]:
        """Radial velocities, if the method estimates them, by name."""
        velocity, valid = self.image.velocity, self.image.valid
        known = {} if velocity is None else velocity.planes(valid)
        return {name: plane.values for name, plane in known.items()}

    @property
    def planes(self) -> dict[str, Plane]:
        """Images by name."""
        shown, own = dict(self.shown), self.image.planes
        counts = Plane(self.capture.counts, "1", "detections of the pixel")
        known = {name: own.pop(name) for name in ("range_m", "confidence")}
        known |= {"counts": counts, **own}
        for name, limit_m in self.interval_columns.items():
            level = 68 if "68" in name else 95
            meaning = f"limit of the {level} % interval of the range, if the estimate is right"
            known[name] = Plane(limit_m, "m", meaning)
        meaning = "p-value of the goodness of fit of the model behind the confidence"
        known |= {name: Plane(p, "1", meaning) for name, p in self.p_value_columns.items()}
        return shown | {name: plane for name, plane in known.items() if name not in shown}

    @property
    def facts(self) -> dict[str, str | int | float]:
        """Acquisition, method, version and source.

        `n_pulses` is 0, and what is not known, such as `pixel_angle_rad`, is left out.
        """
        acquisition = self.capture.acquisition
        facts: dict[str, str | int | float] = {
            "bin_width_s": float(acquisition.bin_width_s),
            "gate_delay_s": float(acquisition.gate_delay_s),
            "n_pulses": int(acquisition.n_pulses or 0),
            "detection": self.capture.detection,
        }
        if self.pixel_angle_rad is not None:
            facts["pixel_angle_rad"] = float(self.pixel_angle_rad)
        if self.image.made_by is not None:
            facts |= self.image.made_by.facts
        if self.remark:
            facts["remark"] = "; ".join(filter(None, (str(facts.get("remark", "")), self.remark)))
        facts |= {"software": software(), "source": self.capture.source}
        return {
            name: plain(fact) if isinstance(fact, str) else fact for name, fact in facts.items()
        }

    @property
    def lines(self) -> list[str]:
        """Facts as lines ``name: value``, for formats that hold text only."""
        return [f"{name}: {fact}" for name, fact in self.facts.items()]

    @property
    def ascii_lines(self) -> list[str]:
        """`lines` for headers that some programs read into short buffers of ASCII."""
        escaped = [line.encode("ascii", "backslashreplace").decode() for line in self.lines]
        return [part for line in escaped for part in wrap(line, _MOST_IN_LINE)]

    def points(self) -> Points:
        """Return the estimates in space; all returns of the pixels, if there are any.

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
        found = self.image.returns
        if found is None:
            return points_m(self.image.range_m, angle_rad)
        lines = sight_lines(self.image.range_m.shape, angle_rad)[found.row, found.col]
        row, col = (each.astype(np.int32) for each in (found.row, found.col))
        return Points(found.range_m[:, np.newaxis] * lines, row, col)

    def point_columns(self, points: Points) -> dict[str, NDArray[Any]]:
        """Return the columns of a point cloud other than coordinates; each of shape (point,)."""
        here = points.row, points.col
        sd_m = self.range_sd_m
        deviation = {} if sd_m is None else {"range_sd_m": sd_m[here].astype(np.float32)}
        rgb = {}
        if self.rgb is not None:
            of_points = self.rgb if self.rgb.ndim == 2 else self.rgb[here]
            rgb = dict(zip(COLORS, of_points.T, strict=True))
        found, range_m = self.image.returns, self.image.range_m[here]
        confidence, of_returns = self.image.confidence[here], dict[str, NDArray[Any]]()
        if found is not None:
            is_other = found.range_m != range_m  # than the estimate, whose interval is known
            deviation = {name: np.where(is_other, np.nan, sd) for name, sd in deviation.items()}
            range_m, confidence = found.range_m, found.confidence
            of_returns = {
                "strength": found.strength.astype(np.float32),
                "return_number": found.number.astype(np.uint8),
                "number_of_returns": found.count(self.image.range_m.shape)[here].astype(np.uint8),
            }
        return {
            "range_m": range_m,
            "counts": np.minimum(self.capture.counts[here], 2**32 - 1).astype(np.uint32),
            "confidence": confidence.astype(np.float32),
            **deviation,
            **of_returns,
            "row": points.row,
            "col": points.col,
            **rgb,
        }


def guessed_angle(field_of_view_deg: float) -> str:
    """Return the remark on a cloud whose angle between pixels comes from a field of view."""
    return (
        f"the width of the cloud rests on a guess: a field of view of {field_of_view_deg:g} "
        "degrees, which the capture does not state"
    )


def guessed_view(capture: CaptureInfo, image: RangeImage) -> dict[str, Any]:
    """Return the arguments by which `core.save_image` can write a cloud of a capture.

    Where the capture does not state the angle between pixels, the scene is guessed to be as wide
    as it is deep, as in the app, and the file says so; empty otherwise.
    """
    acquisition = capture.acquisition
    if acquisition.pixel_angle_rad is not None:
        return {}
    width_deg = guessed_field_of_view_deg(image.range_m, image.confidence, acquisition)
    angle_rad = pixel_angle_of(width_deg, image.range_m.shape[1])
    return {"pixel_angle_rad": angle_rad, "remark": guessed_angle(width_deg)}


def plain(text: str) -> str:
    """Return text on one line, of characters that every format can hold."""
    return "".join(character if character.isprintable() else " " for character in text)
