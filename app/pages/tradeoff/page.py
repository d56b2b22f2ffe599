"""The Trade-off page: studies of accuracy against time, acquisition, model and settings."""

from __future__ import annotations

import panel as pn

from app.pages.navigation import Page, Pages, Shared, View
from app.pages.session import Session
from app.pages.tradeoff import text
from app.pages.tradeoff.ablation import AblationSection
from app.pages.tradeoff.acquisition import AcquisitionSection
from app.pages.tradeoff.sensitivity import SensitivitySection
from app.pages.tradeoff.speed import SpeedSection

WHOLE = ":host { height: auto !important; flex: none !important; }"


class Tradeoff:
    """The page."""

    def __init__(self, session: Session) -> None:
        self._sections = Pages(
            session,
            {
                "Speed and accuracy": SpeedSection,
                "Acquisition": AcquisitionSection,
                "Ablation": AblationSection,
                "Sensitivity": SensitivitySection,
            },
            label="Study",
            help=text.SECTIONS_HELP,
            first=session.state.study,
        )
        self._sections.choice.link(session.state, value="study", bidirectional=True)

    @property
    def view(self) -> View:
        """The page, for the navigation."""
        sections = self._sections
        main = pn.Column(
            sections.choice,
            *sections.mains.values(),
            sizing_mode="stretch_both",
            stylesheets=[WHOLE],
            margin=0,
        )
        return View(
            main,
            [*sections.asides.values()],
            show=sections.show,
            follow=sections.follow,
            paint=sections.paint,
        )


PAGE = Page(
    "Trade-off",
    Tradeoff,
    "measures speed against accuracy",
    shared=frozenset({Shared.TRACKING}),
)
