"""Part of the sidebar that tunes the settings of a method to the capture on screen."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from app.model.methods import METHOD_TITLES
from app.model.store import Answer, Request, same_capture
from app.pages.session import Session
from app.pages.shared.studies import OnePiece
from app.tasks.scheduler import Work
from app.widgets.cards import part
from app.widgets.controls import NARROW_TABLE, Sentence, Table
from core import Tuning, tuned
from core.parameters import spec_of
from core.tuning import Trial, is_tunable

TITLE = "Settings for this capture"
EXPLANATION = (
    "Simulates a capture of known ranges that resembles this one, tries settings on it, and keeps "
    "the default ones unless others restore clearly more."
)
COLUMNS = (
    ("Settings tried", "Those that differ from the defaults.", 1),
    ("RD", "Share of the simulated targets within 3 bins.", -1),
)
MOST_SHOWN = 8


class SettingsChooser:
    """Button that tunes the method on screen to the capture, with the result and the reason.

    Parameters
    ----------
    session : Session

    Attributes
    ----------
    work : OnePiece of Tuning
    note : Sentence
        Settings chosen, and why.
    table : Table
        The best of the settings that were tried.
    part : Part
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._subject: Request | None = None
        self.work = OnePiece(
            session,
            self._work,
            self._draw,
            "settings tried",
            label="Choose for this capture",
            help="Choose for this capture: tries settings on a simulated capture that resembles "
            "it. Undo takes the choice back.",
        )
        self.note = Sentence(live=True, sizing_mode="stretch_width", margin=(0, 8, 4, 8))
        self.table = Table(
            title=TITLE,
            columns=[list(column) for column in COLUMNS],
            stylesheets=[NARROW_TABLE],
            sizing_mode="stretch_width",
            visible=False,
            margin=0,
        )
        explanation = Sentence(text=EXPLANATION, sizing_mode="stretch_width", margin=(4, 8))
        self.part = part(
            TITLE, explanation, *self.work.controls, self.note, self.table, is_open=False
        )

    def follow(self, answer: Answer) -> None:
        """Show another estimate: what was chosen holds for one capture and one method."""
        self.part.visible = is_tunable(answer.method)
        if self._subject is not None and not _same_subject(self._subject, answer.request):
            self._subject = None
            self.work.cancel()
            self.note.text, self.table.visible = "", False

    def _work(self) -> Work[Tuning]:
        answer = self._session.answer
        self._subject = answer.request
        return lambda progress: tuned(answer.capture, answer.method, progress)

    def _draw(self, found: Tuning) -> None:
        if self._subject is None or not _same_subject(self._subject, self._session.request):
            return  # another capture was chosen, and its estimate is on the way
        chosen = "" if found.is_default else f" {_changes(found.settings)}."
        self.note.text = f"{METHOD_TITLES[found.method]}: {found.why}{chosen}"
        self.table.rows = [_row(each) for each in found.trials[:MOST_SHOWN]]
        self.table.visible = bool(found.trials)
        state = self._session.state
        if found.method == "tracking":
            state.tracking = found.settings
        else:
            state.settings = {**state.settings, found.method: found.settings}


def _same_subject(request: Request, now: Request) -> bool:
    """Whether settings chosen for a request hold for another one."""
    same = same_capture(request, now) and request.reduction == now.reduction
    return same and request.absent == now.absent and request.method == now.method


def _row(trial: Trial) -> dict[str, Any]:
    name = _changes(trial.settings) or "defaults"
    return {"name": name, "cells": [[f"{trial.rd:.3f}", trial.rd, ""]]}


def _changes(settings: Any) -> str:
    """Return the settings that differ from the defaults, with their symbols."""
    values = ((each, getattr(settings, each.name)) for each in fields(settings))
    changed = ((each, value) for each, value in values if value != each.default)
    return ", ".join(f"{spec_of(each).symbol} {_short(value)}" for each, value in changed)


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
