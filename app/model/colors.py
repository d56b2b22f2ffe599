"""Values and colour scales of images and point clouds, which share one scale."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from app.model.budget import spending
from app.model.mesh import point_cloud, returns_cloud
from app.model.state import FIT, VELOCITY, Viewing
from app.model.store import Answer, is_wrong
from app.theme import COUNT_COLORS, ERROR_COLORS
from core import RangeImage, inspection
from core.cost import predicted_fit_time
from core.geometry import WHOLE, Box, pixel_angle_of
from core.inference import fit_of, fit_p_values, has_fit, share_below
from core.io import ColorScale, p_value_scale, range_scale

Array = NDArray[Any]

ERROR_SCALE_BINS = 5

MAP_TITLES = {
    "Peak": "Largest count of each pixel",
    "Fired": "Share of the pulses that fired",
    "SBR": "Signal over background, estimated from the counts",
    "Returns": "Number of returns found in each pixel",
}
REPORTED_TITLE = "Distance reported by the sensor"
FIRED_UNKNOWN = "Share of pulses that fired: pulses not known"


def shown(answer: Answer, least_confidence: float, box: Box = WHOLE) -> NDArray[np.bool_]:
    """Return the pixels whose estimate is confident enough to be shown, and inside a box."""
    image = answer.run.image
    visible = image.valid & (image.confidence >= least_confidence)
    return np.asarray(visible if box == WHOLE else visible & box.contains(image.range_m))


NO_VALUE = {
    "Estimate": "without an estimate",
    "Truth": "without a target",
    "Error": "without an estimate or truth",
    "Reported": "without a reported distance",
    "Confidence": "without an estimate",
    VELOCITY: "without an estimate",
}
"""Pixels that are blank in images of a kind, hidden estimates aside."""


class Unseen(NamedTuple):
    """How many pixels of an image or cloud its colours do not show."""

    n_blank: int = 0
    """Pixels without a value, hidden estimates aside."""
    n_hidden: int = 0
    """Estimates that are not confident enough to be shown."""
    n_outside: int = 0
    """Values beyond the colour scale."""


def unseen(answer: Answer, kind: str, viewing: Viewing, values: Array, look: ColorScale) -> Unseen:
    """Count the pixels of an image that are blank or grey; parameters are those of `legend`."""
    hides = kind in ("Estimate", "Error", VELOCITY)
    n_hidden = n_below(answer, viewing.least_confidence) if hides else 0
    return Unseen(int(np.isnan(values).sum()) - n_hidden, n_hidden, look.n_outside(values))


DOUBTED = ("Estimate", "Error", "Confidence")
"""Kinds of images that are affected if the model does not describe the capture."""


def legend(answer: Answer, kind: str, viewing: Viewing, values: Array, look: ColorScale) -> str:
    """Return why pixels of an image (row, col) of a kind of `map_of` are blank or grey.

    For `DOUBTED` kinds, also the `doubt` about confidences; for p-values, how many are small, and
    whether the model fits the capture.

    Parameters
    ----------
    values, look
        Of `map_of`.
    """
    sentences = [left_out(answer, kind, viewing, values, look)]
    if kind in DOUBTED:
        sentences.append(doubt(answer))
    if kind == FIT:
        sentences += [share_below(values), fit_of(answer.capture).verdict]
    return " ".join(filter(None, sentences))


def doubt(answer: Answer) -> str:
    """Return why confidences are unreliable; empty unless known (`has_fit`)."""
    if answer.follows_motion:
        return ""  # the fit is that of surfaces at rest
    misfit = fit_of(answer.capture).remark if has_fit(answer.capture) else ""
    return f"{misfit.capitalize()}." if misfit else ""


def left_out(answer: Answer, kind: str, viewing: Viewing, values: Array, look: ColorScale) -> str:
    """Return why pixels of an image are blank, or grey; parameters are those of `legend`."""
    found, reasons, sentences = unseen(answer, kind, viewing, values, look), [], []
    if found.n_hidden:
        reasons.append(hidden(answer, viewing.least_confidence))
    if found.n_blank:
        reasons.append(f"{found.n_blank:,} pixels {NO_VALUE.get(kind, 'without a value')}")
    if reasons:
        sentences.append(f"Blank: {', '.join(reasons)}.")
    if kind in ("Estimate", "Error") and answer.run.image.valid.any() and np.isnan(values).all():
        sentences.append("Lower “Show from confidence”.")
    if found.n_outside:
        sentences.append(f"Grey: {found.n_outside:,} beyond the colour scale.")
    return " ".join(sentences)


def n_below(answer: Answer, least_confidence: float) -> int:
    """Return how many estimates are not confident enough to be shown."""
    return int(answer.run.image.valid.sum() - shown(answer, least_confidence).sum())


def hidden(answer: Answer, least_confidence: float) -> str:
    """Return how many of the estimates are hidden, and why."""
    n_hidden, n_estimates = n_below(answer, least_confidence), int(answer.run.image.valid.sum())
    return f"{n_hidden:,} of {n_estimates:,} estimates hidden below confidence {least_confidence:g}"


def image_of(answer: Answer, kind: str, viewing: Viewing) -> tuple[Array, ColorScale]:
    """Return an image (row, col), NaN where there is no value, and its colour scale.

    Parameters
    ----------
    kind : {"Estimate", "Truth", "Error", "Reported", "Counts", "Confidence"}
        Without a truth, "Truth" and "Error" return the estimate; likewise "Reported".
    viewing : Viewing
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
        visible = shown(answer, viewing.least_confidence)
        error_m = np.where(visible, image.range_m - truth_m, np.nan)
        return error_m, ColorScale(
            "Error: estimate minus truth", "m", -limit_m, limit_m, ERROR_COLORS
        )
    kept = image.confident(viewing.least_confidence)
    if kind == "Truth" and truth_m is not None:
        return truth_m, range_scale(capture, kept, viewing, "True range")
    if kind == "Reported" and capture.reported_range_m is not None:
        return capture.reported_range_m, range_scale(capture, kept, viewing, REPORTED_TITLE)
    return kept.range_m, range_scale(capture, kept, viewing)


def map_of(answer: Answer, kind: str, viewing: Viewing) -> tuple[Array, ColorScale]:
    """Return the image (row, col) of one of `MAPS`, NaN without a value, and its colour scale."""
    if kind not in (VELOCITY, *inspection.maps):
        return image_of(answer, kind, viewing)
    if kind == VELOCITY:
        return velocity_of(answer, viewing)
    if kind == FIT:
        rows, cols, n_bins = answer.capture.cube.shape
        cost = predicted_fit_time(rows * cols, n_bins)
        with spending((rows, cols, n_bins), FIT.lower(), cost):
            return fit_p_values(answer.capture), p_value_scale()
    values = inspection.maps[kind](answer.capture)
    known, whole = values[np.isfinite(values)], np.issubdtype(values.dtype, np.integer)
    # A few pixels with several surfaces are what the map is for.
    ends = [0, 100] if kind == "Returns" else [1, 99]
    low, high = np.percentile(known, ends).tolist() if known.size else (0.0, 1.0)
    is_unknown = kind == "Fired" and answer.capture.gated_pulses is None
    title = FIRED_UNKNOWN if is_unknown else MAP_TITLES[kind]
    high = max(high, low + (1 if whole else 1e-6))
    return values, ColorScale(title, "", low, high, COUNT_COLORS, whole=whole)


def velocity_of(answer: Answer, viewing: Viewing) -> tuple[Array, ColorScale]:
    """Return the radial velocities of shown pixels (row, col), and a scale around 0."""
    velocity, visible = answer.run.image.velocity, shown(answer, viewing.least_confidence)
    values = np.full(visible.shape, np.nan) if velocity is None else velocity.values
    values = np.where(visible, values, np.nan)
    limit = float(np.nanpercentile(np.abs(values), 99)) if visible.any() else 0.0
    unit = "" if velocity is None else velocity.unit
    title = "Radial velocity: positive if the surface recedes"
    return values, ColorScale(title, unit, -limit or -1.0, limit or 1.0, ERROR_COLORS)


def color_values(answer: Answer, kind: str, viewing: Viewing) -> tuple[Array, ColorScale]:
    """Return values (row, col) that colour a cloud by "Range", "Error" or "Counts", and a scale."""
    return image_of(answer, "Estimate" if kind == "Range" else kind, viewing)


class ColoredCloud(NamedTuple):
    """The shown points of an estimate."""

    points: pv.PolyData
    rgb: NDArray[np.uint8]
    """Shape (point, 3)."""
    wrong: NDArray[np.bool_] | None
    """Shape (point,); None without a truth."""
    unseen: Unseen
    """Estimates inside the box that are hidden, and points that are grey."""


def cloud_of(answer: Answer, kind: str, viewing: Viewing, box: Box = WHOLE) -> ColoredCloud:
    """Return the confident points inside a box, with their colours."""
    if answer.run.image.returns is not None:
        return _cloud_of_returns(answer, kind, viewing, box)
    image = answer.run.image
    inside, visible = (shown(answer, least, box) for least in (0.0, viewing.least_confidence))
    values, look = color_values(answer, kind, viewing)
    angle_rad = pixel_angle_of(answer.field_of_view_deg(viewing), answer.capture.shape[1])
    range_m = np.where(visible, image.range_m, np.nan)
    wrong = is_wrong(answer)
    return ColoredCloud(
        point_cloud(range_m, angle_rad, confidence=image.confidence),
        look.rgb(values[visible]),
        None if wrong is None else wrong[visible],
        Unseen(n_hidden=int((inside & ~visible).sum()), n_outside=look.n_outside(values[visible])),
    )


def shown_image(answer: Answer, least_confidence: float, box: Box = WHOLE) -> RangeImage:
    """Return the estimate without what is not confident enough to be shown, or outside a box."""
    image = answer.run.image.confident(least_confidence)
    return image if box == WHOLE else image.cropped(box)


def _cloud_of_returns(answer: Answer, kind: str, viewing: Viewing, box: Box) -> ColoredCloud:
    """Return the confident returns; a truth of one surface does not show which are wrong."""
    every, found = (
        shown_image(answer, least, box).returns for least in (0.0, viewing.least_confidence)
    )
    assert every is not None
    assert found is not None
    values, look = color_values(answer, kind, viewing)
    of_points = found.range_m if kind == "Range" else values[found.row, found.col]
    angle_rad = pixel_angle_of(answer.field_of_view_deg(viewing), answer.capture.shape[1])
    return ColoredCloud(
        returns_cloud(found, answer.capture.shape, angle_rad),
        look.rgb(of_points),
        None,
        Unseen(n_hidden=len(every) - len(found), n_outside=look.n_outside(of_points)),
    )


def cloud_legend(unseen: Unseen, least_confidence: float) -> str:
    """Return which estimates a cloud hides, and which of its points are grey."""
    sentences = []
    if unseen.n_hidden:
        sentences.append(f"Hidden: {unseen.n_hidden:,} below confidence {least_confidence:g}.")
    if unseen.n_outside:
        sentences.append(f"Grey: {unseen.n_outside:,} beyond the colour scale.")
    return " ".join(sentences)


def _count_scale(counts: Array) -> ColorScale:
    low, high = float(counts.min()), float(counts.max())
    return ColorScale("Detections of each pixel", "counts", low, max(high, low + 1), COUNT_COLORS)
