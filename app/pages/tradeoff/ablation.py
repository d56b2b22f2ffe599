"""The ablation study: parts of the scene, corrections and extensions of the likelihood."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from app.model.store import Request, same_subject
from app.pages.session import Session
from app.pages.shared.downloads import Subject, looked_at
from app.pages.shared.section import Repetitions, SettingsSection
from app.pages.shared.studies import OnePiece
from app.pages.tradeoff import ablation_text as text
from app.tasks.scheduler import Work
from app.widgets.cards import part
from app.widgets.controls import Sentence, Table
from core import CORRECTIONS, parts_of
from core.studies.ablation import EXTENSIONS, Requirement, requirements


@dataclass(frozen=True)
class Verdicts:
    """Verdicts, and what they hold for."""

    request: Request
    repetitions: int
    """0 for a capture, which is not simulated."""
    found: tuple[Requirement, ...]


class AblationSection(SettingsSection[Repetitions]):
    """A verdict on each part, correction and extension, with a button that switches it off or on.

    Extensions are other methods or settings and have no button.

    Parameters
    ----------
    session : Session
        The session whose scene or capture is studied; its pages leave out what is switched off.

    Attributes
    ----------
    study : OnePiece
    subject : Sentence
    table : Table
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, Repetitions(8), text.EXPLANATION)
        self._found: dict[str, Requirement] = {}
        self._studied, self._repetitions = session.answer.request, 0
        self.study = OnePiece(session, self.work, self.draw, "parts")
        self.subject = Sentence(live=True, sizing_mode="stretch_width", margin=(4, 8))
        self.table = Table(
            title=text.TITLE,
            columns=[list(column) for column in text.COLUMNS],
            sizing_mode="stretch_width",
            margin=(6, 0),
        )
        self.table.param.watch(lambda event: self._switch(event.new[0]), "acted")
        self.refresh()

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        super().show(is_on_screen)
        self.study.show(is_on_screen)

    def layout(self) -> tuple[Any, Any]:
        """Return the table, and its controls."""
        note = Sentence(text=text.NOTE, sizing_mode="stretch_width", margin=(6, 8, 12, 8))
        main = [self.subject, self.offer_table(self.table, "ablation"), note]
        return main, part("Ablation", self.controls(*self.study.controls))

    def about(self) -> Subject:
        """Return what the section's files are about."""
        return looked_at(self.session, self._subject)

    @property
    def _subject(self) -> Request:
        """Scene with its flux, or capture, for which the verdicts hold."""
        return self._studied if self._found else self.session.answer.request

    def _switch(self, name: str) -> None:
        state = self.session.state
        state.absent = state.absent ^ {name}

    def work(self) -> Work[Verdicts]:
        """Return the study of the present scene or capture."""
        request, whole = self.session.answer.request, self.session.answer.whole
        repetitions = self.settings.repetitions

        def work(progress: Callable[[int, int], None]) -> Verdicts:
            if not request.source.is_scene:
                return Verdicts(request, 0, requirements(whole, progress=progress))
            scene, light, seeds = request.whole_scene, request.illumination, range(repetitions)
            gate = light.acquisition(scene.acquisition)
            found = requirements(
                scene, light.flux, acquisition=gate, seeds=seeds, progress=progress
            )
            return Verdicts(request, repetitions, found)

        return work

    def draw(self, verdicts: Verdicts) -> None:
        """Show verdicts; the page says if another scene or capture has been chosen since."""
        self._studied, self._repetitions = verdicts.request, verdicts.repetitions
        self._found = {each.part: each for each in verdicts.found}
        self.refresh()

    def refresh(self) -> None:
        """Write the table."""
        request, subject = self.session.answer.request, self._subject
        absent, is_present = self.session.state.absent, same_subject(request, subject)
        parts = parts_of(request.whole_scene) if request.source.is_scene else ()
        sbr = subject.illumination.sbr if subject.source.is_scene else None
        can_switch = (*CORRECTIONS, *parts)
        with self.session.tasks.hold():
            self.subject.text = text.subject(
                subject.source.title, sbr, self._repetitions, absent, is_present
            )
            self.table.rows = [
                text.row(name, self._found.get(name), name in can_switch, name in absent)
                for name in dict.fromkeys([*CORRECTIONS, *EXTENSIONS, *parts, *self._found])
            ]
