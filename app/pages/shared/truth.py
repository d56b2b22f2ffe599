"""The form that adds true ranges to a capture."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import panel_material_ui as pmui

from app.model.text import cause
from app.model.truth import SUFFIXES, Truth, check_truth
from app.model.uploads import Uploads
from app.pages.session import Session
from app.widgets.cards import part, select
from app.widgets.controls import Sentence
from app.widgets.file_input import file_button
from core.io import TRUTH_UNITS

HELP = (
    "An image of the capture's shape: true ranges, another capture's estimates, or a simulated "
    "capture. Error, metrics and reliability are then shown."
)
UNITS = {"m": "m", "bins": "bins after the opening of the gate", "ns": "ns after the pulse"}


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
        self._key = ""
        self._jobs = session.tasks.latest()
        self.status = Sentence(live=True, sizing_mode="stretch_width", margin=(4, 8))
        self.file = file_button("Add a truth", SUFFIXES, self._upload, self._refuse)
        units = {"as the file states": ""} | {UNITS[unit]: unit for unit in TRUTH_UNITS}
        self.unit = select("Unit of the truth", units, "", "Unit of the numbers in the file.")
        self.variable = pmui.TextInput(
            label="Array of the truth",
            description="Name of the array, if several would fit.",
            placeholder="the one that fits",
            size="small",
            sizing_mode="stretch_width",
            margin=(6, 8, 2, 8),
        )
        self.part = part(
            "Truth from a file",
            Sentence(text=HELP, sizing_mode="stretch_width", margin=(4, 8)),
            self.file,
            self.unit,
            self.variable,
            self.status,
            is_open=False,
            is_shown=False,
        )
        for control, event in ((self.unit, "value"), (self.variable, "enter_pressed")):
            control.param.watch(lambda _: self._try(), event)

    def _upload(self, name: str, content: bytes) -> None:
        try:
            self._key = self._uploads.add(name, content, self._user)
        except (ValueError, OSError) as error:
            self._refuse(cause(error))
        else:
            self._try()

    def _try(self) -> None:
        """Read the latest file, and add it if it fits."""
        path = self._uploads.path(self._key, self._user)
        if path is None:
            return
        truth = Truth(self._key, self.unit.value, self.variable.value_input.strip())
        check = partial(check_truth, self._session.answer, truth, path)
        self._jobs.submit(check, partial(self._accept, truth), lambda e: self._refuse(cause(e)))

    def _accept(self, truth: Truth, _: Any) -> None:
        self.status.text = ""
        self._add(truth)

    def _refuse(self, reason: str) -> None:
        self.status.text = f"Not added: {reason}"
