"""Defaults of the state that depend on the capture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from app.model.state import (
    CLOUD_COLORS,
    IMAGES,
    MAPS,
    NEEDED,
    VELOCITY,
    Crop,
    State,
)
from app.model.store import Answer, same_pixels
from core.inspection import pixels_in
from core.report import representative_pixel

KINDS = {"image": IMAGES, "map": MAPS, "cloud_color": CLOUD_COLORS}
"""Parameters of which some values require an image of the capture, with all values."""

FROM_CAPTURE = ("pixel", "pins", "region", "crop", "viewing", "comparison", *KINDS)
"""Parameters of the state whose default or possible values depend on the capture."""


def possible_kinds(answer: Answer) -> dict[str, list[str]]:
    """Return the possible values of the parameters `KINDS`; the first is the default."""

    def exists(kind: str) -> bool:
        if kind == VELOCITY:
            return answer.run.image.velocity is not None
        return kind not in NEEDED or getattr(answer.capture, NEEDED[kind]) is not None

    return {name: [kind for kind in kinds if exists(kind)] for name, kinds in KINDS.items()}


def defaults_of(answer: Answer) -> dict[str, Any]:
    """Return the defaults that a capture brings, by the state's parameter."""
    return {"pixel": representative_pixel(answer.capture, answer.run.image)}


def offer_kinds(state: State, answer: Answer) -> None:
    """Offer the kinds of images that an answer has, and leave one that it lacks."""
    for name, possible in possible_kinds(answer).items():
        if list(state.param[name].objects) != possible:
            state.param[name].objects = possible
        if getattr(state, name) not in possible:
            setattr(state, name, possible[0])


def enter(state: State, answer: Answer, previous: Answer | None) -> None:
    """Adapt the state to another capture; keep what still holds for it.

    Parameters
    ----------
    state : State
    answer, previous : Answer
        Its estimate, and the one before.
    """
    offer_kinds(state, answer)
    own = defaults_of(answer)
    here = {"pixel": state.pixel, "pins": state.pins, "region": state.region}
    kept: dict[str, Any] = {} if previous is None else carried(here, previous, answer)
    changed: dict[str, Any] = {}
    if previous is not None and not _same_scene(previous, answer):
        changed, kept["crop"] = {"color_from_m": None, "color_to_m": None}, Crop()
    if previous is None or not same_pixels(answer, previous):
        changed["field_of_view_deg"] = None
    compared = replace(state.comparison, viewing=replace(state.comparison.viewing, **changed))
    state.param.update(
        viewing=replace(state.viewing, **changed),
        comparison=compared,
        **{"pixel": own["pixel"], "pins": (), "region": ()} | kept,
    )


def _same_scene(one: Answer, other: Answer) -> bool:
    return one.request.source.without_truth is other.request.source.without_truth


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
