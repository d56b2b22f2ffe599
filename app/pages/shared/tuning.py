"""Settings that choose themselves: a part of the sidebar that folds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from typing import Any

from app.model.methods import METHOD_TITLES
from app.model.store import Answer, Request, same_capture
from app.pages.session import Session
from app.pages.shared.studies import OnePiece
from app.tasks.scheduler import Work
from app.widgets.cards import part
from app.widgets.controls import NARROW_TABLE, Sentence, Table
from core import ESTIMATORS, Tuning, tuned
from core.parameters import spec_of
from core.scripts import changed_fields
from core.tuning import Trial

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
    """The button that chooses settings for the capture and the method on screen, and why.

    Parameters
    ----------
    session : Session

    Attributes
    ----------
    work : OnePiece of (Request, Tuning)
    note : Sentence
        What was chosen, and why.
    table : Table
        The best of the settings that were tried.
    part : Part
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._shown_for: Request | None = None
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
        estimator = ESTIMATORS[answer.method]
        self.part.visible = not estimator.knows_flux and bool(fields(estimator.parameters))
        if self._shown_for is not None and not _same_subject(self._shown_for, answer):
            self._shown_for = None
            self.note.text, self.table.visible = "", False

    def _work(self) -> Work[tuple[Answer, Tuning]]:
        answer = self._session.answer

        def work(
            progress: Callable[[int, int], None], cancelled: Callable[[], bool]
        ) -> tuple[Answer, Tuning]:
            def report(done: int, of: int) -> None:
                if cancelled():
                    raise InterruptedError
                progress(done, of)

            return answer, tuned(answer.capture, answer.method, report)

        return work

    def _draw(self, result: tuple[Answer, Tuning]) -> None:
        answer, found = result
        session = self._session
        if not _same_subject(answer.request, session.answer):
            return
        self._shown_for = answer.request
        chosen = "" if found.is_default else f" {_changes(found.settings)}."
        self.note.text = f"{METHOD_TITLES[found.method]}: {found.why}{chosen}"
        self.table.rows = [_row(each) for each in found.trials[:MOST_SHOWN]]
        self.table.visible = bool(found.trials)
        state = session.state
        if found.method == "tracking":
            state.tracking = found.settings
        else:
            state.settings = {**state.settings, found.method: found.settings}


def _same_subject(request: Request, answer: Answer) -> bool:
    """Whether settings chosen for a request are those for the estimate on screen."""
    now = answer.request
    same = same_capture(request, now) and request.less == now.less
    return same and request.absent == now.absent and request.method == now.method


def _row(trial: Trial) -> dict[str, Any]:
    name = _changes(trial.settings) or "defaults"
    return {"name": name, "cells": [[f"{trial.rd:.3f}", trial.rd, ""]]}


def _changes(settings: Any) -> str:
    """Return the settings that differ from the defaults, with their symbols."""
    changed = changed_fields(settings)
    return ", ".join(
        f"{spec_of(each).symbol} {_short(getattr(settings, each.name))}"
        for each in fields(settings)
        if each.name in changed
    )


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
