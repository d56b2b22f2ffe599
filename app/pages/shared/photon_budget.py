"""The form of the photon budget: laser, optics and sunlight, step by step to signal and background.

It is made when it is first opened, so that a page without it costs nothing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.exports import table_file
from app.model.store import Request
from app.model.text import COMPUTING
from app.pages.session import Session
from app.pages.shared.downloads import TABLE, Shown, below, downloadable, looked_at
from app.units import Quantity
from app.widgets.cards import button, part
from app.widgets.controls import NARROW_TABLE, Sentence, SettingsPanel, Table
from core import PhotonBudget, Scene
from core.photon_budget import (
    GIVEN,
    OF_SCENE,
    OF_STANDARD,
    TARGET_RD,
    Reach,
    Step,
    flux_extents,
    reaching,
    steps,
)
from core.studies.budget import NEEDED_NOTE, background_note, steps_table
from core.typesetting import scientific

TITLE = "From watts and sunlight"

OFF = (
    "Signal and background follow from pulse energy, aperture, filter, target and sun. Nearer "
    "pixels get more signal."
)
ON = (
    "Signal, background and SBR above are those of this budget. Moving one of them switches it "
    "off. Over the scene, the signal is {} to {} per pulse: it falls with 1/R². {}"
)
STEPS_COLUMNS = (
    ("Step", "Each quantity and its equation, in the symbols of the steps before.", 1),
    ("Value", "For one pulse and pixel, at the median range of the scene.", -1),
)
NEEDED_COLUMNS = (
    ("Setting", "One at a time, the others unchanged.", 1),
    ("From", "Smallest value on the slider that reaches it.", -1),
    ("To", "Largest value on the slider that reaches it.", -1),
)


class PhotonBudgetForm:
    """A part of the sidebar that folds.

    Parameters
    ----------
    session : Session

    Attributes
    ----------
    part : Part
    content : Content or None
        The form; None until the part is first open.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self.content: Content | None = None
        self._holder = pn.Column(sizing_mode="stretch_width", margin=0)
        is_open = session.state.budget is not None
        self.part = part(TITLE, self._holder, is_open=is_open, is_shown=False)
        self.part.param.watch(lambda _: self.refresh(), "collapsed")
        session.state.param.watch(lambda _: self.refresh(), "budget")

    def refresh(self) -> None:
        """Show the budget of the state, if there is a scene and the part is open."""
        session = self._session
        self.part.visible = is_scene = session.request.source.is_scene
        if self.part.collapsed or not is_scene:
            return
        if self.content is None:
            self.content = Content(session)
            self._holder.append(self.content.layout)
        with session.tasks.hold():
            self.content.show(session.request)


class Content:
    """The form.

    Attributes
    ----------
    switch : pmui.Switch
    settings : SettingsPanel
    note : Sentence
    steps, needed : Table
    find : pmui.Button
    """

    def __init__(self, session: Session) -> None:
        self._session, state = session, session.state
        self._last = PhotonBudget()
        self.switch = pmui.Switch(label="Use a photon budget", size="small", margin=(4, 8))
        self.switch.param.watch(lambda event: self._turn(event.new), "value")
        self.note = Sentence(live=True, sizing_mode="stretch_width", margin=(0, 8, 4, 8))
        self.settings = SettingsPanel(PhotonBudget(), partial(setattr, state, "budget"))
        self.steps = _table("Steps of the photon budget", STEPS_COLUMNS)
        self.find = button(
            f"What reaches RD {TARGET_RD:g}?",
            "Find the pulse energy, the aperture and the filter with which the likelihood reaches "
            "this restoration degree.",
            self._find,
            (6, 8),
        )
        self.needed_note = Sentence(live=True, sizing_mode="stretch_width", margin=(0, 8, 4, 8))
        self.needed = _table(f"What reaches RD {TARGET_RD:g}", NEEDED_COLUMNS)
        self._shown_for: Any = None
        self._jobs = session.tasks.latest()
        self._body = pn.Column(
            self.settings.layout,
            downloadable(below(self.steps), session, "photon budget", self.shown, TABLE),
            self.find,
            self.needed_note,
            self.needed,
            sizing_mode="stretch_width",
            margin=0,
        )
        self.layout = pn.Column(
            self.switch, self.note, self._body, sizing_mode="stretch_width", margin=0
        )

    def show(self, request: Request) -> None:
        """Show the budget of a request, unless it is shown already."""
        budget, conditions = request.budget, _conditions(request)
        if conditions == self._shown_for:
            return
        self._shown_for = conditions
        self.switch.value = self._body.visible = budget is not None
        self.needed.rows, self.needed.visible, self.needed_note.text = [], False, ""
        if budget is None:
            self.note.text = OFF
            return
        self._last, scene = budget, _scene(request)
        self.settings.show(budget)
        signal, background = flux_extents(budget, scene)
        self.note.text = ON.format(*map(scientific, signal), background_note(*background))
        computed = (each for each in steps(budget, scene) if each.equation != GIVEN)
        self.steps.rows = [step_row(each) for each in computed]

    def shown(self) -> Shown:
        """Return the steps, for a download."""
        request = self._session.request
        budget, title = request.budget or self._last, request.source.title
        table = table_file(steps_table(budget, _scene(request), title))
        return Shown(looked_at(self._session, request), "photon budget", {"csv": table})

    def _turn(self, is_on: bool) -> None:
        state = self._session.state
        if is_on != (state.budget is not None):
            state.budget = self._last if is_on else None

    def _find(self) -> None:
        request = self._session.request
        self.needed_note.text = COMPUTING
        work = partial(reaching, request.budget or self._last, _scene(request))
        self._jobs.submit(work, partial(self._draw, _conditions(request)), self._refuse)

    def _draw(self, conditions: Any, found: tuple[Reach, ...]) -> None:
        self._session.failures.resolve(self)
        if conditions == self._shown_for:
            self.needed_note.text = NEEDED_NOTE
            self.needed.rows = [needed_row(each) for each in found]
            self.needed.visible = True

    def _refuse(self, error: Exception) -> None:
        self.needed_note.text = ""
        self._session.failures.report(error, part=self)


def _conditions(request: Request) -> Any:
    """Return what the form and its search depend on."""
    return request.budget, request.source, request.light.n_pulses, request.absent


def _scene(request: Request) -> Scene:
    """Return the scene of a request before its budget, with the pulses of the request."""
    scene = replace(request, budget=None).scene
    return replace(scene, acquisition=request.light.acquisition(scene.acquisition))


def _table(title: str, columns: Any) -> Table:
    return Table(
        title=title,
        columns=[list(column) for column in columns],
        stylesheets=[NARROW_TABLE],
        sizing_mode="stretch_width",
        margin=(4, 0),
    )


def step_row(step: Step) -> dict[str, object]:
    """Return the row of a step: its equation below its name, its unit below its value."""
    value = Quantity(scientific(step.value), step.value, step.unit)
    relation = ", " if step.equation in (OF_SCENE, OF_STANDARD) else " = "
    note = f"{step.symbol}{relation}{step.equation}"
    return {"name": step.name, "note": note, "cells": [(value, step.value, step.unit)]}


def needed_row(found: Reach) -> dict[str, object]:
    """Return the row of a setting and the values that it may have."""
    unit = found.spec.unit
    note = f"now {scientific(found.now)} {unit}"
    if math.isnan(found.low):
        note += f"; at most RD {found.best_rd:.3f}, with {scientific(found.best)} {unit}"
    ends = (found.low, found.high)
    cells = [(Quantity(scientific(end), end, unit), end, unit) for end in ends]
    return {"name": found.spec.symbol, "note": note, "cells": cells}
