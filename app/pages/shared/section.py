"""Base classes of the parts of a page: downloads, background work, and settings of their own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, Generic, Protocol, TypeVar

import panel as pn

from app.model.exports import Write, facts_file, shown_table_file
from app.model.store import Answer
from app.pages.navigation import View
from app.pages.session import Session
from app.pages.shared.downloads import (
    PLOT,
    TABLE,
    Shown,
    Subject,
    below,
    downloadable,
    downloadable_facts,
    explored,
    shown_with,
)
from app.pages.shared.studies import Study, aside
from app.tasks.scheduler import Lane, Latest, Step
from app.theme import Palette, palette
from app.widgets.controls import Facts, SettingsPanel, Table
from app.widgets.figures import Layers
from core.parameters import Number, Settings, parameter

Result = TypeVar("Result")


class Paintable(Protocol):
    """Parts that follow the page between light and dark mode."""

    def paint(self, colors: Palette) -> None:
        """Take on the colours of a mode."""


AnySettings = TypeVar("AnySettings", bound=Settings)


@dataclass(frozen=True)
class Repetitions(Settings):
    """Amount of simulation."""

    repetitions: int = parameter(
        2,
        Number("Repetitions", 2, 100, log=True, whole=True, least=2),
        "Captures of the same scene with other noise, the same for all methods. More repetitions "
        "narrow the intervals.",
    )


class Section(ABC):
    """A part of a page.

    Parameters
    ----------
    session : Session
    *watched : str
        Parameters of the state that `refresh` is called for.

    Attributes
    ----------
    downloads : dict of str to callable
        What each download button saves, by what the button says it shows.
    is_on_screen, is_dark : bool
    """

    def __init__(self, session: Session, *watched: str) -> None:
        self.session = session
        self.downloads: dict[str, Callable[[], Shown]] = {}
        self.is_on_screen = self.is_dark = False
        self._painted: list[Paintable] = []
        self._jobs = session.tasks.latest()
        if watched:
            session.state.param.watch(lambda *_: self.refresh(), list(watched))

    @cached_property
    def view(self) -> View:
        """The section, for the navigation."""
        main, sidebar = self.layout()
        return View(main, sidebar, self.show, self.follow, self.paint)

    @abstractmethod
    def layout(self) -> tuple[Any, Any]:
        """Return the content, and the section's part of the sidebar."""

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        self.is_on_screen = is_on_screen
        self.refresh()

    def follow(self, answer: Answer) -> None:
        """Show another estimate of the session."""
        self.refresh()

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        self.is_dark = dark
        for each in self._painted:
            each.paint(palette(dark))

    def refresh(self) -> None:
        """Update what is shown, if it is on screen; by default, nothing changes."""
        return

    # Background work

    def submit(
        self,
        work: Callable[[], Result],
        draw: Callable[[Result], None],
        failed: Callable[[Exception], None] | None = None,
        own: Latest | None = None,
        lane: Lane | None = None,
    ) -> None:
        """Run `work` in a lane, by default in the background; draw its result unless outdated then.

        Work that other work of the section must neither replace nor report as successful needs a
        channel of its `own`, which is also the part of its failures.
        """
        session, answer = self.session, self.session.answer
        part = own or self

        def arrived(result: Result) -> None:
            session.failures.resolve(part)
            if self.is_on_screen and answer is session.answer:
                with session.tasks.hold():
                    draw(result)

        report = partial(session.failures.report, part=part)
        (own or self._jobs).submit(work, arrived, failed or report, lane)

    def report_error(self, error: Exception) -> None:
        """Show an error until this section works again."""
        self.session.failures.report(error, part=self)

    # Downloads

    def about(self) -> Subject:
        """Return what the section's files are about."""
        return explored(self.session)

    def saved(self, what: str, csv: Write) -> Shown:
        """Return a plot or a table as it is saved."""
        return Shown(self.about(), what, {"csv": csv})

    def offer(
        self,
        holder: pn.Column,
        button: str,
        show: Callable[[], Shown],
        formats: Iterable[str] = PLOT,
    ) -> pn.Column:
        """Add a download button to a card."""
        self.downloads[button] = show
        return downloadable(holder, self.session, button, show, formats)

    def offer_plot(self, holder: pn.Column, button: str, plot: Layers, what: str) -> pn.Column:
        """Add a download button to the card of a plot."""
        return self.offer(holder, button, lambda: self.saved(what, plot.csv()))

    def offer_facts(self, facts: Facts, what: Callable[[], str]) -> pn.Column:
        """Return a list of facts with a download button."""

        def show() -> Shown:
            return self.saved(what(), facts_file(facts.facts))

        self.downloads["numbers"] = show
        return downloadable_facts(facts, self.session, show)

    def offer_table(self, table: Table, what: str) -> pn.Column:
        """Return a table with a download button."""

        def show() -> Shown:
            return self.saved(what, shown_table_file(table.columns, table.rows))

        return shown_with(self.offer(below(table), "table", show, TABLE), table, "rows")


class SettingsSection(Section, Generic[AnySettings]):
    """A section with settings of its own.

    Parameters
    ----------
    session : Session
    settings : Settings
        Initial settings.
    explanation : str
        Text above the controls.

    Attributes
    ----------
    settings : Settings
        The present settings.
    panel : SettingsPanel
    """

    def __init__(self, session: Session, settings: AnySettings, explanation: str = "") -> None:
        super().__init__(session)
        self.settings = settings
        self.panel = SettingsPanel(settings, self.change)
        self._explanation = explanation

    def change(self, settings: AnySettings) -> None:
        """Take other settings."""
        self.settings = settings

    def controls(self, *more: Any) -> pn.Column:
        """Return the explanation and the settings, with further controls below."""
        return aside(self._explanation, self.panel.layout, *more)


class StudySection(SettingsSection[AnySettings]):
    """A section whose content is a study in steps, started when it first comes on screen.

    Parameters
    ----------
    session : Session
    settings : Settings
        Initial settings.
    explanation : str
        Text above the controls.
    noun : str
        Name of the steps.
    """

    def __init__(
        self, session: Session, settings: AnySettings, explanation: str, noun: str
    ) -> None:
        super().__init__(session, settings, explanation)
        self.study = Study(session, self.steps, noun)

    @abstractmethod
    def steps(self) -> list[Step[Any]]:
        """Return the steps of the study, from the present settings."""

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        self.study.show(is_on_screen)
