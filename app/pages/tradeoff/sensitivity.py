"""The part of Trade-off that sweeps a method's settings: where its answers are to be trusted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import panel as pn

from app.model.methods import METHOD_TITLES
from app.pages.navigation import View
from app.pages.session import Session
from app.pages.shared.downloads import Subject
from app.pages.shared.outputs import CurveCard, TableCard
from app.pages.shared.studies import Study, aside
from app.pages.tradeoff import sensitivity_text as trust_words
from app.tasks.scheduler import Step
from app.theme import palette
from app.widgets.cards import part
from app.widgets.controls import SettingsPanel
from core.parameters import Choice, Number, check_fields, parameter
from core.studies.sensitivity import (
    Sweep,
    along,
    numbers,
    ranges_table,
    setting_plot,
    setting_sweep,
)

SWEPT = tuple(dict.fromkeys(method for method, *_ in numbers()))
METHODS = {METHOD_TITLES[method]: method for method in SWEPT}

CARDS = """
:host {{ display: grid !important; gap: 8px; flex: none !important; height: {wide}px !important;
  grid-template-columns: repeat(2, minmax(0, 1fr)); grid-auto-rows: 300px; }}
@media (max-width: 900px) {{
  :host {{ grid-template-columns: minmax(0, 1fr); height: {narrow}px !important; }}
}}
"""
ROW = 308


@dataclass(frozen=True)
class Swept:
    """Which method's settings are swept."""

    method: str = parameter(
        METHOD_TITLES["tracking"], Choice("Method", tuple(METHODS)), trust_words.METHOD_HELP
    )

    def __post_init__(self) -> None:
        check_fields(self)


class Trust:
    """Sweeps over all settings of a method that are numbers, a plot for each.

    Parameters
    ----------
    session : Session
        Whose page it is; its capture has no part in this.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._swept = Swept()
        self._found: list[Sweep] = []
        self._dark = False
        self._panel = SettingsPanel(self._swept, self._changed)
        self._study = Study(session, self._steps, "settings")
        self._cards: list[CurveCard] = []
        self._grid = pn.Column(sizing_mode="stretch_width", margin=0)
        self._table = TableCard()
        self._table.offer(session, self._subject)

    @property
    def view(self) -> View:
        """The plots and the table, and their controls."""
        controls = aside(trust_words.EXPLANATION, self._panel.layout, *self._study.controls)
        return View(
            [self._grid, self._table.layout],
            part("What is swept", controls),
            show=self._study.show,
            paint=self._paint,
        )

    def _subject(self) -> Subject:
        return Subject("settings swept", METHODS[self._swept.method])

    def _changed(self, swept: Swept) -> None:
        self._swept = swept
        self._study.start()

    def _paint(self, dark: bool) -> None:
        self._dark = dark
        for each in self._cards:
            each.paint(palette(dark))

    def _steps(self) -> list[Step[Sweep]]:
        method = METHODS[self._swept.method]
        swept = [(field, spec, default) for of, field, spec, default in numbers() if of == method]
        self._found = []
        self._cards = [CurveCard(waiting=trust_words.swept(spec)) for _, spec, _ in swept]
        for each in self._cards:
            each.offer(self._session, self._subject)
        self._paint(self._dark)
        rows = (len(swept) + 1) // 2
        with pn.io.hold(self._session.page):
            self._grid.stylesheets = [CARDS.format(wide=rows * ROW, narrow=len(swept) * ROW)]
            self._grid.objects = [each.card for each in self._cards]
        return [
            Step(
                partial(setting_sweep, method, field, along(spec, default)),
                partial(self._show, card, spec),
            )
            for card, (field, spec, default) in zip(self._cards, swept, strict=True)
        ]

    def _show(self, card: CurveCard, spec: Number, sweep: Sweep) -> None:
        self._found.append(sweep)
        with pn.io.hold(self._session.page):
            card.show(setting_plot(sweep, spec))
            self._table.show(ranges_table("trust", trust_words.TABLE, self._found))
