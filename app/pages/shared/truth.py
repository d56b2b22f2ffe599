"""The form that adds true ranges to a capture, and the offer of those in its own file."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.store import Answer, Source
from app.model.text import cause
from app.model.truth import Truth, check_truth, offered_truths
from app.model.uploads import Uploads
from app.pages.session import Session
from app.widgets.cards import button, part, select
from app.widgets.controls import Sentence
from app.widgets.file_input import file_button
from core.io import TRUTH_OPTIONS, TRUTH_UNITS, PossibleTruth

log = logging.getLogger(__name__)

HELP = "Error, metrics and reliability are then shown."
FORM_HELP = (
    "An image of the capture's shape: true ranges, another capture's estimates, or a simulated "
    f"capture. {HELP}"
)
UNITS = {"m": "m", "bins": "bins after the opening of the gate", "ns": "ns after the pulse"}

OFFER = "This file may contain the true ranges."
UNIT_QUESTION = "In which unit is {name}?"


class TruthForm:
    """A file of true ranges, with the unit and the array where the file leaves them open.

    Parameters
    ----------
    session : Session
    uploads : Uploads
        Where the file is stored.
    user : object
        Stands for the session there.
    add : callable
        Called with a truth that can be read.

    Attributes
    ----------
    part : Part
        The form as a part of the sidebar.
    file : FileInput
    unit : pmui.Select
    variable : pmui.TextInput
    status : Sentence
        What was added, or why it was refused.
    """

    def __init__(
        self, session: Session, uploads: Uploads, user: object, add: Callable[[Truth], None]
    ) -> None:
        self._session, self._uploads, self._user, self._add = session, uploads, user, add
        self._key, self._is_added = "", False
        self._source: Source | None = None
        self._jobs = session.tasks.latest()
        self.status = Sentence(live=True, sizing_mode="stretch_width", margin=(4, 8))
        self.file = file_button(TRUTH_OPTIONS["truth"], self._upload, self._refuse)
        units = {"as the file states": ""} | {UNITS[unit]: unit for unit in TRUTH_UNITS}
        label, help = TRUTH_OPTIONS["truth_unit"], "Unit of the numbers in the file."
        self.unit = select(label, units, "", help)
        self.variable = pmui.TextInput(
            label=TRUTH_OPTIONS["truth_variable"],
            description="Name of the array, if several would fit.",
            placeholder="the one that fits",
            size="small",
            sizing_mode="stretch_width",
            margin=(6, 8, 2, 8),
        )
        self.part = part(
            "Truth from a file",
            Sentence(text=FORM_HELP, sizing_mode="stretch_width", margin=(4, 8)),
            self.file,
            self.unit,
            self.variable,
            self.status,
            is_open=False,
            is_shown=False,
        )
        for control, event in ((self.unit, "value"), (self.variable, "enter_pressed")):
            control.param.watch(lambda _: self._try(), event)

    def show(self, answer: Answer) -> None:
        """Show the form for a capture; what was refused for another one is forgotten."""
        source = answer.request.source
        self.part.visible = not source.is_scene
        if source is not self._source:
            self._source, self.status.text = source, ""

    def _upload(self, files: dict[str, bytes]) -> None:
        if not self._is_added:
            self._uploads.release(self._key, self._user)
        try:
            self._key = self._uploads.add(files, self._user)
        except (ValueError, OSError) as error:
            self._refuse(cause(error))
        else:
            self._is_added = False
            self._try()

    def _try(self) -> None:
        """Read the latest file, and add it if it fits."""
        path = self._uploads.path(self._key, self._user)
        if path is None:
            return
        truth = Truth(self._key, self.unit.value, self.variable.value_input.strip())
        answer = self._session.answer
        source = answer.request.source

        def accept(_: Any) -> None:
            if source is self._session.answer.request.source:  # else it was checked for another
                self.status.text, self._is_added = "", True
                self._add(truth)

        def refuse(error: Exception) -> None:
            if source is self._session.answer.request.source:
                self._refuse(cause(error))

        self._jobs.submit(partial(check_truth, answer, truth, path), accept, refuse)

    def _refuse(self, reason: str) -> None:
        self.status.text = f"Not added: {reason}"


class TruthOffer:
    """Buttons that take an image of the capture's own file as its truth.

    Parameters
    ----------
    session : Session
    add : callable
        Called with the truth that the user chose.

    Attributes
    ----------
    layout : Column
        Visible where there is such an image, and the capture has no truth.
    """

    def __init__(self, session: Session, add: Callable[[Truth], None]) -> None:
        self._add = add
        self._jobs = session.tasks.latest()
        self._subject: Any = None
        self.layout = pn.Column(visible=False, sizing_mode="stretch_width", margin=0)

    def show(self, answer: Answer) -> None:
        """Look for images that may be the truth of a capture."""
        # A sequence has the same images for each of its records.
        subject = answer.request.source, replace(answer.request.reading, records=None)
        if subject == self._subject:
            return
        self._subject, self.layout.visible = subject, False
        offer = partial(self._offer, subject)
        self._jobs.submit(partial(offered_truths, answer), offer, self._log)

    def _offer(self, subject: Any, found: Sequence[PossibleTruth]) -> None:
        if found and subject == self._subject:  # else outdated
            self._ask(OFFER, [_button(_label(each), HELP, self._choose, each) for each in found])

    def _choose(self, truth: PossibleTruth) -> None:
        """Take an image, or ask for its unit where the file leaves it open."""
        name = truth.name
        if truth.is_unit_stated:
            self._add(Truth("", "", name))
            return
        help = f"{_label(truth)} in this unit."
        self._ask(
            UNIT_QUESTION.format(name=name),
            [_button(UNITS[each], help, self._add, Truth("", each, name)) for each in truth.units],
        )

    def _ask(self, question: str, buttons: Sequence[Any]) -> None:
        asked = Sentence(text=question, live=True, sizing_mode="stretch_width", margin=(4, 8))
        self.layout[:] = [asked, pn.FlexBox(*buttons)]
        self.layout.visible = True

    def _log(self, error: Exception) -> None:
        log.warning("could not list the images of a capture's file", exc_info=error)


def _label(truth: PossibleTruth) -> str:
    return f"Use {truth.name} as the truth"


def _button(label: str, help: str, act: Callable[[Any], None], of: Any) -> pmui.Button:
    return button(label, f"{label}: {help}", partial(act, of), (2, 0, 6, 8))
