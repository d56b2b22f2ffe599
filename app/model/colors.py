"""Values and colour scales of images and point clouds, which share one scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from app.model.mesh import point_cloud
from app.model.state import Viewing
from app.model.store import Answer, is_wrong
from app.theme import COUNT_COLORS, ERROR_COLORS, OUTSIDE_COLOR, RANGE_COLORS
from core import inspection

Array = NDArray[Any]

ERROR_SCALE_BINS = 5

MAP_TITLES = {
    "Peak": "Largest count of each pixel",
    "Fired": "Share of the pulses that fired",
    "SBR": "Signal over background, estimated from the counts",
}
FIRED_UNKNOWN = "Share of pulses that fired: pulses not known"


@dataclass(frozen=True)
class ColorScale:
    """A colour scale with its title; values beyond it are drawn in `outside`, if given."""

    title: str
    unit: str
    low: float
    high: float
    colors: list[str]
    outside: str | None = None

    @property
    def legend(self) -> str:
        """Title with the unit."""
        return f"{self.title} ({self.unit})" if self.unit else self.title

    def rgb(self, values: Array) -> NDArray[np.uint8]:
        """Return the colours of values (n,), as uint8 (n, 3)."""
        table = _table(tuple(self.colors))
        share = (values - self.low) / (self.high - self.low)
        index = np.clip(np.nan_to_num(share) * len(table), 0, len(table) - 1).astype(int)
        colors = table[index]
        if self.outside is not None:
            colors[(share < 0) | (share > 1)] = _rgb(self.outside)
        return colors


@cache
def _table(colors: tuple[str, ...]) -> NDArray[np.uint8]:
    return np.array([_rgb(color) for color in colors], np.uint8)


def _rgb(color: str) -> tuple[int, int, int]:
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)


def shown(answer: Answer, least_confidence: float) -> NDArray[np.bool_]:
    """Return the pixels whose estimate is confident enough to be shown."""
    image = answer.run.image
    return np.asarray(image.valid & (image.confidence >= least_confidence))


def image_of(answer: Answer, kind: str, least_confidence: float) -> tuple[Array, ColorScale]:
    """Return an image (row, col), NaN where there is no value, and its colour scale.

    Parameters
    ----------
    kind : {"Estimate", "Truth", "Error", "Counts", "Confidence"}
        Without a truth, "Truth" and "Error" return the estimate.
    """
    capture, image = answer.capture, answer.run.image
    truth_m = capture.truth_range_m
    if kind == "Counts":
        counts = capture.counts.astype(float)
        if answer.cutout is not None and answer.cutout.read < 1:
            counts[counts == 0] = np.nan  # not read yet
        return counts, _count_scale(capture.counts)
    if kind == "Confidence":
        # Not masked by the confidence itself.
        confidence = np.where(image.valid, image.confidence, np.nan)
        return confidence, ColorScale(
            "Confidence: probability of being right", "", 0.0, 1.0, COUNT_COLORS
        )
    if kind == "Error" and truth_m is not None:
        limit_m = ERROR_SCALE_BINS * capture.acquisition.bin_length_m
        error_m = np.where(shown(answer, least_confidence), image.range_m - truth_m, np.nan)
        return error_m, ColorScale(
            "Error: estimate minus truth", "m", -limit_m, limit_m, ERROR_COLORS
        )
    if kind == "Truth" and truth_m is not None:
        return truth_m, _range_scale(answer, "True range")
    range_m = np.where(shown(answer, least_confidence), image.range_m, np.nan)
    return range_m, _range_scale(answer, "Estimated range")


def map_of(answer: Answer, kind: str, least_confidence: float) -> tuple[Array, ColorScale]:
    """Return the image (row, col) of one of `MAPS`, NaN without a value, and its colour scale."""
    if kind not in inspection.maps:
        return image_of(answer, kind, least_confidence)
    values = inspection.maps[kind](answer.capture)
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [1, 99]).tolist() if known.size else (0.0, 1.0)
    is_unknown = kind == "Fired" and answer.capture.gated_pulses is None
    title = FIRED_UNKNOWN if is_unknown else MAP_TITLES[kind]
    return values, ColorScale(title, "", low, max(high, low + 1e-6), COUNT_COLORS)


def color_values(answer: Answer, kind: str) -> tuple[Array, ColorScale]:
    """Return values (row, col) that colour a cloud by "Range", "Error" or "Counts", and a scale."""
    return image_of(answer, "Estimate" if kind == "Range" else kind, 0.0)


def cloud_of(
    answer: Answer, kind: str, viewing: Viewing
) -> tuple[pv.PolyData, NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Return a point cloud, its points' colours, and which are wrong; None without a truth."""
    visible = shown(answer, viewing.least_confidence)
    values, look = color_values(answer, kind)
    half_rad = np.radians(viewing.field_of_view_deg) / 2
    angle_rad = float(np.arctan(2 * np.tan(half_rad) / answer.capture.shape[1]))
    range_m = np.where(visible, answer.run.image.range_m, np.nan)
    wrong = is_wrong(answer)
    return (
        point_cloud(range_m, angle_rad),
        look.rgb(values[visible]),
        None if wrong is None else wrong[visible],
    )


def _range_scale(answer: Answer, title: str) -> ColorScale:
    """Return the scale that truth and estimate share: the scene's, or the confident estimates'."""
    truth_m, image = answer.capture.truth_range_m, answer.run.image
    bin_m = answer.capture.acquisition.bin_length_m
    if truth_m is not None and np.isfinite(truth_m).any():
        low, high = float(np.nanmin(truth_m)), float(np.nanmax(truth_m))
    else:
        range_m = image.range_m[image.confidence >= 0.9]
        range_m = range_m if range_m.size else image.range_m[image.valid]
        low, high = np.percentile(range_m, [2, 98]).tolist() if range_m.size else (0.0, 1.0)
    return ColorScale(title, "m", low - bin_m, high + bin_m, RANGE_COLORS, OUTSIDE_COLOR)


def _count_scale(counts: Array) -> ColorScale:
    low, high = float(counts.min()), float(counts.max())
    return ColorScale("Detections of each pixel", "counts", low, max(high, low + 1), COUNT_COLORS)
