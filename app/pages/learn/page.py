"""The Learn page: lessons that ask for a prediction before they show anything."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import panel as pn

from app.model.glossary import ANCHOR
from app.model.lessons import Lesson, number_of, number_of_lesson
from app.model.slides import demonstration
from app.model.state import Learning
from app.pages.learn import text
from app.pages.learn.lesson import PAGE_STYLE, ROW, Job, LessonView, markdown
from app.pages.learn.presenter import Presenter
from app.pages.navigation import Page
from app.pages.session import Session
from app.pages.shared.section import Section
from app.tasks.scheduler import Latest
from app.theme import palette
from app.widgets.cards import button, select
from app.widgets.controls import Sentence
from app.widgets.qr_code import QrCode


class Learn(Section):
    """The page.

    Attributes
    ----------
    lessons : mapping of str to Lesson
    choice : pmui.Select
        The lesson.
    shown : LessonView or Presenter
        What is on screen.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, "learning", "present")
        self.lessons: Mapping[str, Lesson] = session.lessons
        linked = session.state.learning.lesson
        key = linked if linked in self.lessons else next(iter(self.lessons))
        self.shown = self._made(key, session.state.present)
        titles = {numbered(lesson): key for key, lesson in self.lessons.items()}
        self.choice = select("Lesson", titles, key, text.LESSON_HELP)
        self.choice.max_width = 480
        self.choice.param.watch(lambda event: self._choose(event.new), "value")
        tools = pn.Row(
            button("Present", text.PRESENT_HELP, partial(self._present, None)),
            button("Twenty-minute demonstration", text.DEMONSTRATION_HELP, self._demonstrate),
            QrCode(margin=0),
            markdown(f"[Glossary]({ANCHOR})"),
            stylesheets=[ROW],
            margin=(0, 8),
        )
        self._head = pn.Column(self.choice, tools, sizing_mode="stretch_width", margin=0)
        self._stage = pn.Column(self.shown.layout, sizing_mode="stretch_width", margin=0)
        self._channels: defaultdict[str, Latest] = defaultdict(session.tasks.latest)
        self._requested: dict[str, Any] = {}  # what each channel last computed from

    def layout(self) -> tuple[Any, Any]:
        """Return the lesson, and a note in place of controls."""
        main = pn.Column(
            self._head, self._stage, stylesheets=[PAGE_STYLE], sizing_mode="stretch_width", margin=0
        )
        return main, Sentence(text=text.NO_SIDEBAR, margin=8)

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        super().paint(dark)
        self.shown.paint(palette(dark))

    def refresh(self) -> None:
        """Show how far the learner is."""
        if not self.is_on_screen:
            self._requested = {}  # results that arrive now are not drawn
            return
        state = self.session.state
        learning = self._possible(state.learning)
        if learning != state.learning:
            state.learning = learning  # which refreshes; a bad value would be reported each time
            return
        key = learning.lesson or next(iter(self.lessons))
        with self.session.tasks.hold():
            is_same = isinstance(self.shown, Presenter) == state.present
            if key != self.shown.lesson.key or not is_same:
                self.shown, self._requested = self._made(key, state.present), {}
                self.choice.value = key
                self._stage[:] = [self.shown.layout]
            self._head.visible = not state.present
            self.shown.follow(learning)
            self._compute(self.shown.jobs(learning))

    # Actions of the learner

    def _choose(self, key: str) -> None:
        if key != self.shown.lesson.key:
            self.session.state.learning = Learning(lesson=key)

    def _present(self, key: str | None) -> None:
        """Present a lesson from its beginning; by default the one on screen."""
        learning = Learning(lesson=key or self.shown.lesson.key)
        self.session.state.param.update(learning=learning, present=1)

    def _demonstrate(self) -> None:
        self._present(next(iter(demonstration(self.lessons)), None))

    def _end(self) -> None:
        self.session.state.present = 0

    def _change(self, **parts: Any) -> None:
        state = self.session.state
        state.learning = replace(state.learning, **parts)

    def _possible(self, learning: Learning) -> Learning:
        """Return what can be shown of a state, which may come from a link; report the rest."""
        if learning.lesson and learning.lesson not in self.lessons:
            self._refuse(text.no_lesson(learning.lesson))
            return Learning()
        lesson = self.lessons[learning.lesson or next(iter(self.lessons))]
        for name, parse in (
            ("prediction", lesson.prediction.parsed),
            ("moved", lesson.moved),
            ("answer", lambda given: given and number_of(given, "answer")),
        ):
            try:
                parse(getattr(learning, name))
            except ValueError as error:
                self._refuse(str(error))
                empty: dict[str, Any] = {name: ""}
                learning = replace(learning, **empty)
        return learning

    def _refuse(self, sentence: str) -> None:
        """Show what is wrong with a state, also while the app is built around this page."""
        self.session.refused.append(sentence)  # shown when it is built
        self.session.failures.show(sentence)

    # Drawing

    def _made(self, key: str, is_presented: bool) -> LessonView | Presenter:
        lesson = self.lessons[key]
        made: LessonView | Presenter
        if is_presented:
            made = Presenter(
                self.session, lesson, self._change, [*self.lessons], self._choose, self._end
            )
            made.bar.param.watch(lambda _: self._fit(made), "is_narrow")
        else:
            made = LessonView(self.session, lesson, self._change)
        made.paint(palette(self.is_dark))
        return made

    def _fit(self, presenter: Presenter) -> None:
        """Draw the slides in the size that the window needs."""
        if presenter is self.shown:
            presenter.views.clear()
            self._requested = {}
            self.refresh()

    def _compute(self, jobs: Mapping[str, Job]) -> None:
        """Compute what is not on screen yet."""
        before, self._requested = self._requested, {name: job.given for name, job in jobs.items()}
        for name, job in jobs.items():
            if name not in before or before[name] != job.given:
                self._submit(name, job)

    def _submit(self, name: str, job: Job) -> None:
        """Run a job in the background and draw its result if it is still on screen."""
        failures, failed, shown = self.session.failures, (self, name), self.shown

        def arrived(result: Any) -> None:
            failures.resolve(failed)
            if self.is_on_screen and shown is self.shown:
                with self.session.tasks.hold():
                    job.draw(result)

        self._channels[name].submit(job.work, arrived, partial(failures.report, part=failed))


def numbered(lesson: Lesson) -> str:
    """Return the title of a lesson, after its number if it has one."""
    number = number_of_lesson(lesson.key)
    return lesson.title if number is None else f"{number}. {lesson.title}"


PAGE = Page(
    "Learn",
    Learn,
    "teaches the measurement in short lessons",
    shared=frozenset(),
    is_standalone=True,
)
