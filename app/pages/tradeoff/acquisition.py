"""The study of the acquisition: which pulses, flux and gate reach a restoration degree."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn

from app.model.store import Answer, Request, same_capture, same_subject
from app.pages.navigation import HOLDER
from app.pages.session import Session
from app.pages.shared.downloads import Subject, looked_at
from app.pages.shared.outputs import CurveCard, TableCard
from app.pages.shared.section import Repetitions, SettingsSection
from app.pages.shared.studies import OnePiece
from app.pages.tradeoff import text
from app.pages.tradeoff.speed import affordable, source_of
from app.tasks.scheduler import Work
from app.widgets.cards import part
from app.widgets.controls import Sentence
from core.studies.tradeoff import (
    Simulation,
    acquisition_items,
    acquisition_sweeps,
    surrogate_of,
)

CURVES = """
:host { display: grid !important; gap: 8px; flex: none !important; height: 668px !important;
  grid-template: repeat(2, 330px) / repeat(2, minmax(0, 1fr)); }
@media screen and (max-width: 1100px) {
  :host { grid-template: repeat(3, 330px) / minmax(0, 1fr); height: 1006px !important; }
}
"""


class AcquisitionSection(SettingsSection[Repetitions]):
    """Restoration degree against number of pulses, flux and length of the gate.

    Parameters
    ----------
    session : Session
        The session whose scene, or a simulation like whose capture, is acquired.

    Attributes
    ----------
    cards : list of CurveCard
    study : OnePiece
    subject : Sentence
        What was simulated.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, Repetitions(), text.ACQUISITION)
        self.study = OnePiece(session, self.work, self.draw, "captures", failed=self._describe)
        self.subject = Sentence(
            text=text.NOT_SIMULATED, live=True, sizing_mode="stretch_width", margin=(4, 8)
        )
        self.cards = [CurveCard() for _ in range(3)]
        self._painted = [*self.cards]
        self._required = TableCard(waiting="")
        self._results = pn.Column(
            visible=False, stylesheets=[HOLDER], sizing_mode="stretch_width", margin=0
        )
        self._simulated = self._tried = session.answer.request
        self._said = ""
        for each in self.cards:
            each.offer(session, self.about)
        self._required.offer(session, self.about)

    def layout(self) -> tuple[Any, Any]:
        """Return the curves and the table, and their controls."""
        curves = pn.Column(
            *(each.card for each in self.cards),
            sizing_mode="stretch_width",
            stylesheets=[CURVES],
            margin=0,
        )
        self._results[:] = [curves, self._required.layout]
        controls = self.controls(*self.study.controls)
        return [self.subject, self._results], part("Acquisition", controls)

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it; the first simulation starts by itself."""
        super().show(is_on_screen)
        self._start_first()

    def follow(self, answer: Answer) -> None:
        """Show another estimate; a first simulation starts where it applies."""
        self._start_first()

    def _start_first(self) -> None:
        answer = self.session.answer
        if not same_subject(answer.request, self._tried):
            self.study.retry()
        self._describe()
        self.study.show(self.is_on_screen and _applies(answer))

    def _describe(self) -> None:
        """State what was simulated and whether it is outdated, or what happens before that."""
        if self._said:
            is_present = same_capture(self.session.answer.request, self._simulated)
            self.subject.text = self._said if is_present else f"{self._said} {text.OUTDATED}"
        elif not _applies(self.session.answer):
            self.subject.text = text.FIRST_PHOTONS_ONLY
        else:
            self.subject.text = text.FAILED if self.study.has_failed else text.NOT_SIMULATED

    def about(self) -> Subject:
        """Return what the section's files are about."""
        return looked_at(self.session, self._simulated)

    def work(self) -> Work[tuple[Request, str, list[Any]]]:
        """Return the simulation of the present scene or capture."""
        if not _applies(self.session.answer):
            raise ValueError(text.FIRST_PHOTONS_ONLY)
        request, source = self.session.answer.request, source_of(self.session.answer)
        repetitions = self.settings.repetitions
        self._tried = request
        self._describe()

        def work(progress: Callable[[int, int], None]) -> tuple[Request, str, list[Any]]:
            affordable(source, ())
            simulation = (
                source if isinstance(source, Simulation) else surrogate_of(source, source.source)
            )
            found = acquisition_sweeps([simulation], range(repetitions), progress=progress)
            said = text.simulated(simulation.name, repetitions, simulation.note)
            return request, said, list(acquisition_items(found))

        return work

    def draw(self, found: tuple[Request, str, list[Any]]) -> None:
        """Show a note on the simulation, the curves and the table."""
        self._simulated, self._said, (*curves, required) = found
        self._describe()
        with self.session.tasks.hold():
            for each, curve in zip(self.cards, curves, strict=True):
                each.show(curve)
            self._required.show(required)
            self._results.visible = True


def _applies(answer: Answer) -> bool:
    """Whether pulses and flux of such a scene or capture can be varied."""
    is_scene, capture = answer.request.source.is_scene, answer.whole
    is_first = capture.detection == "first" and capture.acquisition.n_pulses is not None
    return is_scene or is_first
