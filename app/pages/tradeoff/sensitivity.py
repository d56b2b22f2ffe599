"""The sensitivity study: accuracy of a method as a function of each of its settings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import panel as pn

from app.model.methods import METHOD_TITLES
from app.pages.session import Session
from app.pages.shared.downloads import Subject
from app.pages.shared.outputs import CurveCard, TableCard
from app.pages.shared.section import StudySection
from app.pages.tradeoff import text
from app.tasks.scheduler import Step
from app.widgets.cards import part
from core.parameters import Choice, Number, Settings, parameter
from core.studies.sensitivity import (
    Sweep,
    along,
    numbers,
    ranges_table,
    setting_plot,
    setting_sweep,
)

METHODS = {METHOD_TITLES[method]: method for method, *_ in numbers()}

CARDS = """
:host {{ display: grid !important; gap: 8px; flex: none !important; height: {wide}px !important;
  grid-template-columns: repeat(2, minmax(0, 1fr)); grid-auto-rows: 330px; }}
@media screen and (max-width: 1100px) {{
  :host {{ grid-template-columns: minmax(0, 1fr); height: {narrow}px !important; }}
}}
"""
ROW_PX = 338


@dataclass(frozen=True)
class Swept(Settings):
    """The method whose settings are swept."""

    method: str = parameter(
        METHOD_TITLES["tracking"], Choice("Method", tuple(METHODS)), text.METHOD_HELP
    )


class SensitivitySection(StudySection[Swept]):
    """A sweep over each numeric setting of a method; the session's capture is not used.

    Attributes
    ----------
    found : list of Sweep
        The sweeps that are shown.
    cards : list of CurveCard
    study : Study
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, Swept(), text.SENSITIVITY, "settings")
        self.found: list[Sweep] = []
        self.cards: list[CurveCard] = []
        self._grid = pn.Column(sizing_mode="stretch_width", margin=0)
        self._table = TableCard()
        self._table.offer(session, self.about)

    def layout(self) -> tuple[Any, Any]:
        """Return the plots and the table, and their controls."""
        controls = self.controls(*self.study.controls)
        return [self._grid, self._table.layout], part("Sweep", controls)

    def about(self) -> Subject:
        """Return what the section's files are about."""
        return Subject("settings swept", METHODS[self.settings.method])

    def change(self, settings: Swept) -> None:
        """Sweep the settings of another method."""
        super().change(settings)
        self.study.start()

    def steps(self) -> list[Step[Sweep]]:
        """Return a sweep of each setting."""
        method = METHODS[self.settings.method]
        swept = [(field, spec, default) for of, field, spec, default in numbers() if of == method]
        self.found = []
        self.cards = [CurveCard(waiting=text.not_swept(spec)) for _, spec, _ in swept]
        self._painted = [*self.cards]
        for each in self.cards:
            each.offer(self.session, self.about)
        self.paint(self.is_dark)
        rows = (len(swept) + 1) // 2
        with self.session.tasks.hold():
            self._grid.stylesheets = [CARDS.format(wide=rows * ROW_PX, narrow=len(swept) * ROW_PX)]
            self._grid.objects = [each.card for each in self.cards]
        return [
            Step(
                partial(setting_sweep, method, field, along(spec, default)),
                partial(self._draw, card, spec),
            )
            for card, (field, spec, default) in zip(self.cards, swept, strict=True)
        ]

    def _draw(self, card: CurveCard, spec: Number, sweep: Sweep) -> None:
        self.found.append(sweep)
        with self.session.tasks.hold():
            card.show(setting_plot(sweep, spec))
            self._table.show(ranges_table("sensitivity", text.SENSITIVITY_TABLE, self.found))
