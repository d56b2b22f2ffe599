"""Measuring between pixels that are pinned, on the cloud or on the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
import panel as pn

from app.model.state import MOST_PINS, Viewing
from app.model.store import Answer, Pixel, inspect
from app.model.text import WIDTH_GUESSED, pixel_name
from app.pages.session import Session
from app.pages.shared.section import Section
from app.units import plus_minus
from app.widgets.cards import button, part
from app.widgets.controls import Sentence
from core.geometry import distance_m, pixel_angle_of, sight_lines

TITLE = "Measure in the cloud"
HOW = "Tap a point of the cloud and pin it, then another one: their distance appears here."
TOO_MANY_PINS = "Four pixels are pinned already: remove one first."


class MeasureSection(Section):
    """A part of the sidebar that pins pixels and states their distances.

    Attributes
    ----------
    note : Sentence
        The distances, or what to do.
    part : Part
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, "pins", "viewing")
        self.note = Sentence(text=HOW, live=True, sizing_mode="stretch_width", margin=(0, 8, 8, 8))
        buttons = pn.Row(
            button("Pin", "Pin the selected point.", self._pin),
            button("Clear", "Remove all pins.", partial(session.state.param.update, pins=())),
            button("Profile", "Show the ranges along the line of pins.", self._show_profile),
            margin=(4, 8),
        )
        is_open = bool(session.state.pins)
        self.part = part(TITLE, buttons, self.note, is_open=is_open)

    def layout(self) -> tuple[Any, Any]:
        """Return no content, and the part of the sidebar."""
        return None, self.part

    def refresh(self) -> None:
        """Inspect the pinned pixels."""
        if not self.is_on_screen:
            return
        answer, state = self.session.answer, self.session.state
        viewing, pins = state.viewing, state.pins
        if len(pins) < 2:
            self.note.text = HOW
            return

        def write(measured: str) -> None:
            if pins == state.pins:  # no pin has been removed since
                self.note.text = measured

        self.submit(
            lambda: distances(answer, [inspect(answer, *pin) for pin in pins], viewing), write
        )

    def _pin(self) -> None:
        try:
            pin_pixel(self.session)
        except ValueError as error:
            self.note.text = str(error)

    def _show_profile(self) -> None:
        self.session.state.param.update(page="Inspect", subject="Profile")


def pin_pixel(session: Session) -> None:
    """Pin the selected pixel.

    Raises
    ------
    ValueError
        If `MOST_PINS` are pinned already.
    """
    state = session.state
    if state.pixel in state.pins:
        return
    if len(state.pins) >= MOST_PINS:
        raise ValueError(TOO_MANY_PINS)
    state.pins = (*state.pins, state.pixel)


def distances(answer: Answer, pixels: Sequence[Pixel], viewing: Viewing) -> str:
    """Return the distances of pixels from the first one; empty for fewer than two.

    Pixels of less confidence than is shown are left out.
    """
    if len(pixels) < 2:
        return ""
    least = viewing.least_confidence
    names = [pixel_name((each.row, each.col), answer.grid) for each in pixels]
    named = list(zip(names, pixels, strict=True))
    left_out = " and ".join(name for name, pixel in named if pixel.confidence < least)
    reason = f"confidence below {least:g} at {left_out}."
    kept = [(name, pixel) for name, pixel in named if pixel.confidence >= least]
    if len(kept) < 2:
        return f"No distances: {reason}"
    shape = answer.capture.shape
    lines = sight_lines(shape, pixel_angle_of(answer.field_of_view_deg(viewing), shape[1]))
    (origin, first), *others = kept
    sentences = []
    for name, pixel in others:
        ends_m = np.array([(p.interval_95_m.low, p.interval_95_m.high) for p in (first, pixel)])
        half_m = (ends_m[:, 1] - ends_m[:, 0]) / 2
        towards = [lines[p.row, p.col] for p in (first, pixel)]
        length_m, margin_m = distance_m(towards, ends_m.mean(axis=1), half_m)
        known = math.isfinite(length_m)
        length = plus_minus(length_m - margin_m, length_m + margin_m, "m") if known else "not known"
        sentences.append(f"{length} to {name}")
    without = f" Left out: {reason}" if left_out else ""
    guessed = f" {WIDTH_GUESSED}" if answer.is_width_guessed(viewing) else ""
    return f"Distance from {origin}: {'; '.join(sentences)} (95 %).{without}{guessed}"
