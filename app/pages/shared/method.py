"""The choice of the estimator in the sidebar, with its settings."""

from __future__ import annotations

from functools import partial
from typing import Any

import panel as pn

from app.model import text
from app.model.methods import OTHERS, doubts_hold, method_title
from app.model.state import AUTOMATIC, State
from app.model.store import Answer
from app.pages.session import Session
from app.pages.shared.tuning import SettingsChooser
from app.widgets.cards import choice, part, select
from app.widgets.controls import Sentence, SettingsPanel
from core import ESTIMATORS


def judge_choice(state: State) -> Any:
    """Return buttons for what determines the confidence."""
    made = choice(text.JUDGE_HELP, state.param.judged_by)
    made.param.update(label="Confidence from", sizing_mode="stretch_width")
    return made


class MethodChoice:
    """A menu of estimators, and the settings of the one that is shown.

    Those of the tracking differentiator have a part of their own, since other pages use them, too.

    Parameters
    ----------
    session : Session

    Attributes
    ----------
    menu : pmui.Select
    note : Sentence
        Which estimator is shown, and why it was chosen.
    panels : dict of str to SettingsPanel
        The settings of each estimator that has been shown.
    chooser : SettingsChooser
    part : Part
        All of it.
    """

    def __init__(self, session: Session) -> None:
        self._state = session.state
        titles = {text.AUTOMATIC_TITLE: AUTOMATIC}
        titles |= {method_title(each): each for each in ESTIMATORS}
        self.menu = select("Method", titles, session.state.method, text.METHOD_HELP)
        self.note = Sentence(live=True, sizing_mode="stretch_width", margin=(0, 8, 4, 8))
        self.panels: dict[str, SettingsPanel[Any]] = {}
        self._settings = pn.Column(sizing_mode="stretch_width", margin=0)
        self.chooser = SettingsChooser(session)
        self.judge = judge_choice(session.state)
        self.returns = choice(text.RETURNS_HELP, session.state.param.returns)
        self.returns.param.update(label="Returns", sizing_mode="stretch_width")
        choices = self.judge, self.returns
        self.part = part(
            "Method", self.menu, self.note, self._settings, *choices, self.chooser.part
        )
        self.menu.param.watch(lambda event: setattr(self._state, "method", event.new), "value")

    def show(self, answer: Answer) -> None:
        """Show the estimator of an answer."""
        self.menu.value = self._state.method
        self.note.text = text.why_method(answer)
        if answer.method in OTHERS and answer.method not in self.panels:
            self._add_panel(answer.method)
        for method, panel in self.panels.items():
            panel.show(self._state.settings[method])
            panel.mark_doubts(doubts_hold(answer.capture))
        self.chooser.follow(answer)
        for method, layout in zip(self.panels, self._settings, strict=True):
            layout.visible = method == answer.method

    def _add_panel(self, method: str) -> None:
        settings = self._state.settings[method]
        self.panels[method] = panel = SettingsPanel(settings, partial(self._set, method))
        self._settings.append(panel.layout)

    def _set(self, method: str, settings: Any) -> None:
        self._state.settings = {**self._state.settings, method: settings}
