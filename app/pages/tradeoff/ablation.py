"""The part of Trade-off that judges what the model of a scene or a capture must hold."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import panel as pn

from app.model.exports import shown_table_file
from app.model.store import Answer, same_subject
from app.pages.navigation import View
from app.pages.session import Session
from app.pages.shared.downloads import TABLE, Shown, below, downloadable, looked_at
from app.pages.shared.studies import OnePiece, aside
from app.pages.tradeoff import ablation_text as requires_words
from app.tasks.scheduler import Work
from app.widgets.cards import part
from app.widgets.controls import Sentence, SettingsPanel, Table
from core import CORRECTIONS, parts_of
from core.parameters import Number, check_fields, parameter
from core.studies.ablation import Requirement, requirements


@dataclass(frozen=True)
class Judged:
    """How much is simulated to judge a scene."""

    repetitions: int = parameter(
        8,
        Number("Repetitions", 2, 50, log=True, whole=True, least=2),
        requires_words.REPETITIONS_HELP,
    )

    def __post_init__(self) -> None:
        check_fields(self)


class Requires:
    """Verdicts on parts and corrections, each with a button that switches it off or on.

    Parameters
    ----------
    session : Session
        Whose scene or capture is judged, and in whose pictures a part is absent once it is off.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._judged = Judged()
        self._found: dict[str, Requirement] = {}
        self._of = session.answer.request
        self._panel = SettingsPanel(self._judged, self._changed)
        self._study = OnePiece(session, self._work, self._arrived, "parts")
        self._subject = Sentence(live=True, sizing_mode="stretch_width", margin=(4, 8))
        self._table = Table(
            title=requires_words.TITLE,
            columns=[list(column) for column in requires_words.COLUMNS],
            sizing_mode="stretch_width",
            margin=(6, 0),
        )
        self._table.param.watch(lambda event: self._switch(event.new[0]), "acted")
        self._note = Sentence(
            text=requires_words.NOTE, sizing_mode="stretch_width", margin=(6, 8, 12, 8)
        )
        self._draw()

    @property
    def view(self) -> View:
        """The table, and its controls."""
        controls = aside(requires_words.EXPLANATION, self._panel.layout, *self._study.controls)
        return View(
            [
                self._subject,
                downloadable(below(self._table), self._session, "table", self._shown, TABLE),
                self._note,
            ],
            part("What is judged", controls),
            follow=self._follow,
        )

    def _shown(self) -> Shown:
        table = shown_table_file(self._table.columns, self._table.rows)
        return Shown(looked_at(self._session, self._of), "what the model needs", {"csv": table})

    def _follow(self, answer: Answer) -> None:
        if not same_subject(answer.request, self._of):
            self._found, self._of = {}, answer.request  # verdicts are of that scene in that light
        self._draw()

    def _changed(self, judged: Judged) -> None:
        self._judged = judged

    def _switch(self, name: str) -> None:
        state = self._session.state
        state.absent = state.absent ^ {name}

    def _work(self) -> Work[tuple[Requirement, ...]]:
        request, whole = self._session.answer.request, self._session.answer.whole
        build, light, seeds = request.source.scene, request.light, range(self._judged.repetitions)
        self._of = request

        def work(
            progress: Callable[[int, int], None], cancelled: Callable[[], bool]
        ) -> tuple[Requirement, ...]:
            told: dict[str, Any] = {"progress": progress, "cancelled": cancelled}
            if build is None:
                return requirements(whole, **told)
            scene = build()
            gate = light.acquisition(scene.acquisition)
            return requirements(scene, light.flux, acquisition=gate, seeds=seeds, **told)

        return work

    def _arrived(self, found: tuple[Requirement, ...]) -> None:
        if same_subject(self._session.answer.request, self._of):
            self._found = {each.part: each for each in found}
        self._draw()

    def _draw(self) -> None:
        request = self._session.answer.request
        build, absent = request.source.scene, self._session.state.absent
        own = [*CORRECTIONS, *(parts_of(build()) if build is not None else ())]
        names = list(dict.fromkeys([*own, *self._found]))
        with pn.io.hold(self._session.page):
            self._subject.text = requires_words.subject(request.source.title, absent)
            self._table.rows = [
                requires_words.row(name, self._found.get(name), name in own, name in absent)
                for name in names
            ]
