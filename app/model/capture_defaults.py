"""Defaults of the state that depend on the capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from app.model.state import CLOUD_COLORS, IMAGES, MAPS, NEED_TRUTH, Comparison, State, Viewing
from app.model.store import Answer, same_pixels
from core.inspection import pixels_in

FROM_CAPTURE = ("pixel", "pins", "region", "viewing", "comparison")
"""Parameters of the state whose default depends on the capture."""


def defaults_of(answer: Answer) -> dict[str, Any]:
    """Return the defaults that a capture brings, by the state's parameter."""
    field_of_view_deg = own_field_of_view_deg(answer)
    comparison = Comparison()
    compared = replace(comparison.viewing, field_of_view_deg=field_of_view_deg)
    return {
        "pixel": _first_pixel(answer),
        "viewing": Viewing(field_of_view_deg=field_of_view_deg),
        "comparison": replace(comparison, viewing=compared),
    }


def enter(state: State, answer: Answer, previous: Answer | None) -> None:
    """Adapt the state to another capture; keep the pixel, pins and region that lie in it."""
    has_truth = answer.capture.truth_range_m is not None
    for name, kinds in (("image", IMAGES), ("map", MAPS), ("cloud_color", CLOUD_COLORS)):
        possible = [kind for kind in kinds if has_truth or kind not in NEED_TRUTH]
        state.param[name].objects = possible
        if getattr(state, name) not in possible:
            setattr(state, name, possible[0])
    own = defaults_of(answer)
    as_wide = {"field_of_view_deg": own["viewing"].field_of_view_deg}
    compared = replace(state.comparison.viewing, **as_wide)
    here = {"pixel": state.pixel, "pins": state.pins, "region": state.region}
    kept = {} if previous is None else carried(here, previous, answer)
    state.param.update(
        viewing=replace(state.viewing, **as_wide),
        comparison=replace(state.comparison, viewing=compared),
        **{"pixel": own["pixel"], "pins": (), "region": ()} | kept,
    )


def carried(here: Mapping[str, Any], before: Answer, answer: Answer) -> dict[str, Any]:
    """Return pixel, pins and region of one answer as places in another, if they lie in it."""
    if same_pixels(answer, before):
        return dict(here)
    files = [None if each.cutout is None else each.cutout.file for each in (before, answer)]
    if files[0] is None or files[0] is not files[1]:
        return {}

    def moved(row: int, col: int) -> tuple[int, int]:
        return answer.grid.pixel(*before.grid.place(row, col))

    def inside(pixel: tuple[int, int]) -> bool:
        return all(0 <= at < size for at, size in zip(pixel, answer.capture.shape, strict=True))

    pixel = moved(*here["pixel"])
    pins = filter(inside, dict.fromkeys(moved(*pin) for pin in here["pins"]))
    region = tuple(answer.grid.index(*before.grid.place(*each)) for each in here["region"])
    holds_some = bool(region) and pixels_in(region, answer.capture.shape).any()
    return {
        **({"pixel": pixel} if inside(pixel) else {}),
        "pins": tuple(pins),
        "region": region if holds_some else (),
    }


def _first_pixel(answer: Answer) -> tuple[int, int]:
    """Return the pixel nearest to the centre that has a target, or else a confident estimate."""
    truth_m = answer.capture.truth_range_m
    image = answer.run.image
    good = image.confidence >= 0.9 if truth_m is None else np.isfinite(truth_m)
    rows, cols = answer.capture.shape
    row, col = np.nonzero(good) if good.any() else np.nonzero(np.ones((rows, cols), bool))
    nearest = np.argmin((row - rows / 2) ** 2 + (col - cols / 2) ** 2)
    return int(row[nearest]), int(col[nearest])


def own_field_of_view_deg(answer: Answer) -> float:
    """Return the image's width as the capture states it; else about as wide as the scene is deep.

    Rounded to three digits, for links.
    """
    cols = answer.capture.shape[1]
    angle_rad = answer.capture.acquisition.pixel_angle_rad
    if angle_rad is not None:
        return float(f"{np.degrees(2 * np.arctan(cols / 2 * np.tan(angle_rad))):.3g}")
    image = answer.run.image
    range_m = image.range_m[image.confidence >= 0.9]
    range_m = range_m if range_m.size else answer.capture.acquisition.bin_to_range_m([0.0, 1.0])
    low, high = np.percentile(range_m, [5, 95])
    width_deg = np.clip(np.degrees((high - low) / max(high, 1e-3)), 0.001, 120.0)
    return float(f"{width_deg:.3g}")
