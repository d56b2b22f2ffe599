"""The Learn page: lessons that ask for a prediction before they show anything."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import panel as pn
import panel_material_ui as pmui

from app.model.lessons import SHAPES, Lesson, number_of
from app.model.state import Learning
from app.model.text import COMPUTING
from app.pages.learn import text
from app.pages.navigation import Page
from app.pages.session import Session
from app.pages.shared.downloads import Subject
from app.pages.shared.outputs import FREE, CurveCard, Gallery
from app.pages.shared.section import Section
from app.theme import Palette, palette
from app.widgets.cards import button, select
from app.widgets.controls import Sentence, SettingsPanel
from core.studies import outputs
from core.studies.lessons import Bench

Result = TypeVar("Result")

PAGE_STYLE = """
:host { display: flex !important; flex-direction: column; gap: 6px; max-width: 1100px;
  flex: none !important; height: auto !important; max-height: none !important; }
"""
VIEWS = """
:host { display: grid !important; gap: 8px; width: 100%; flex: none !important;
  height: auto !important; max-height: none !important;
  grid-template-columns: repeat(auto-fit, minmax(min(420px, 100%), 1fr)); }
"""
CARD_PX = 330
ROW = ":host { display: flex !important; flex-wrap: wrap; align-items: center; gap: 8px 12px; }"


class View:
    """One view of a lesson: curves or pictures, whichever it turns out to be.

    Parameters
    ----------
    session : Session
    lesson : Lesson

    Attributes
    ----------
    holder : pn.Column
    item : outputs.Plot or outputs.Pictures or None
        What is shown.
    bench : Bench
        The state from which it was computed.
    """

    def __init__(self, session: Session, lesson: Lesson) -> None:
        self._session, self._lesson = session, lesson.key
        self.bench = lesson.bench
        self.item: outputs.Plot | outputs.Pictures | None = None
        self._colors: Palette | None = None
        self._shown: CurveCard | Gallery | None = None
        self.holder = pn.Column(
            Sentence(text=COMPUTING),
            stylesheets=[FREE],
            height=CARD_PX,
            sizing_mode="stretch_width",
            margin=0,
        )

    def about(self) -> Subject:
        """Return what the files of the view are about."""
        return Subject("lesson", self._lesson, (self.bench,))

    def show(self, item: outputs.Plot | outputs.Pictures, bench: Bench) -> None:
        """Show the view of a state."""
        self.item, self.bench = item, bench
        if self._shown is None:
            is_plot = isinstance(item, outputs.Plot)
            self._shown = shown = CurveCard() if is_plot else Gallery()
            shown.offer(self._session, self.about)
            if self._colors is not None:
                shown.paint(self._colors)
            if not is_plot:
                self.holder.height = None  # pictures have their own
            self.holder[:] = [shown.card if isinstance(shown, CurveCard) else shown.layout]
        self._shown.show(item)  # type: ignore[arg-type]

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        self._colors = colors
        if self._shown is not None:
            self._shown.paint(colors)


class LessonView:
    """Everything on screen of one lesson, made when it is chosen.

    Parameters
    ----------
    session : Session
    lesson : Lesson
    change : callable
        Called with the parts of `Learning` that the learner changes, by name.

    Attributes
    ----------
    lesson : Lesson
    prediction, answer : pmui.RadioButtonGroup or pmui.TextInput
    panel : SettingsPanel
        Has the one control.
    moving : pn.Column
        That control, shown after the prediction.
    views : dict of str to View
        By position and name: a view may stand before and after the prediction.
    verdict : Sentence
    """

    def __init__(
        self,
        session: Session,
        lesson: Lesson,
        change: Callable[..., None],
    ) -> None:
        self.lesson, self._change = lesson, change
        self.views = {
            (part, name): View(session, lesson)
            for part in ("before", "after")
            for name in getattr(lesson, part)
        }
        asked = lesson.prediction
        if asked.axis:
            label = text.answer_label(asked.unit)
            self.prediction = _field(label)
        else:
            self.prediction = pmui.RadioButtonGroup(
                options=list(SHAPES),
                value=next(iter(SHAPES)),
                label="",
                description=text.SHAPES_HELP,
                size="small",
                margin=0,
            )
        self.commit = button("Predict", text.COMMIT_HELP, self._commit)
        self.commit.variant = "contained"
        self.again = button("Start again", text.AGAIN_HELP, self._start_again)
        self.panel = SettingsPanel(lesson.bench, self._moved)
        control = self.panel.controls[lesson.control]
        if lesson.ends is not None:
            low, high = lesson.ends
            control.param.update(low=low, high=high)
        self.answer = _field("Your answer")
        self.answer.param.watch(lambda _: self._answer(), "value")
        self.verdict = Sentence(live=True, margin=(4, 0))
        self._checked = pn.Column(
            _markdown(lesson.explanation),
            _markdown(f"**Check.** {lesson.check.question}"),
            pn.Row(
                self.answer,
                button("Check", text.CHECK_HELP, self._answer),
                stylesheets=[ROW],
                margin=0,
            ),
            self.verdict,
            sizing_mode="stretch_width",
            margin=0,
        )
        self.moving = pn.Column(
            _markdown(text.MOVE),
            control,
            max_width=480,
            sizing_mode="stretch_width",
            margin=0,
        )
        self.layout = pn.Column(
            _markdown(f"## {lesson.title}\n\n{lesson.introduction}"),
            _markdown(f"**Predict.** {asked.question}"),
            pn.Row(self.prediction, self.commit, self.again, stylesheets=[ROW], margin=(0, 8)),
            self.moving,
            pn.Column(
                *(view.holder for view in self.views.values()),
                stylesheets=[VIEWS],
                sizing_mode="stretch_width",
                margin=0,
            ),
            self._checked,
            stylesheets=[PAGE_STYLE],
            sizing_mode="stretch_width",
            margin=0,
        )

    def _start_again(self) -> None:
        self._change(prediction="", moved="", answer="")

    def _commit(self) -> None:
        self._change(prediction=self.prediction.value)

    def _moved(self, bench: Any) -> None:
        self._change(moved=str(getattr(bench, self.lesson.control)))

    def _answer(self) -> None:
        self._change(answer=self.answer.value)

    def follow(self, learning: Learning) -> None:
        """Show how far the learner is."""
        is_committed = bool(learning.prediction)
        self.prediction.disabled = self.commit.disabled = is_committed
        if is_committed:
            self.prediction.value = learning.prediction
        self.again.visible = self.moving.visible = is_committed
        for (part, _), view in self.views.items():
            view.holder.visible = is_committed or part == "before"
        self._checked.visible = is_committed and bool(learning.moved)
        self.answer.value = learning.answer
        if not learning.answer:
            self.verdict.text = ""


class Learn(Section):
    """The page.

    Attributes
    ----------
    lessons : mapping of str to Lesson
    choice : pmui.Select
        The lesson.
    shown : LessonView
        What is on screen.
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, "learning")
        self.lessons: Mapping[str, Lesson] = session.lessons
        titles = {lesson.title: key for key, lesson in self.lessons.items()}
        self.choice = select("Lesson", titles, next(iter(self.lessons)), text.LESSON_HELP)
        self.choice.max_width = 480
        self.choice.param.watch(lambda event: self._choose(event.new), "value")
        self._stage = pn.Column(sizing_mode="stretch_width", margin=0)
        self._channels = {part: session.tasks.latest() for part in ("before", "after", "check")}
        self._requested: dict[str, Any] = {}  # what each channel last computed from
        self.shown = self._made(next(iter(self.lessons)))

    def layout(self) -> tuple[Any, Any]:
        """Return the lesson, and a note in place of controls."""
        main = pn.Column(
            self.choice,
            self._stage,
            stylesheets=[PAGE_STYLE],
            sizing_mode="stretch_width",
            margin=0,
        )
        return main, Sentence(text=text.NO_SIDEBAR, margin=8)

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        super().paint(dark)
        for view in self.shown.views.values():
            view.paint(palette(dark))

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
            if key != self.shown.lesson.key or not self._stage.objects:
                self.shown, self._requested = self._made(key), {}
                self.choice.value = key
                self._stage[:] = [self.shown.layout]
            self.shown.follow(learning)
        self._request(learning)

    # Actions of the learner

    def _choose(self, key: str) -> None:
        if key != self.shown.lesson.key:
            self.session.state.learning = Learning(lesson=key)

    def _change(self, **parts: str) -> None:
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
                learning = replace(learning, **{name: ""})
        return learning

    def _refuse(self, sentence: str) -> None:
        """Show what is wrong with a state, also while the app is built around this page."""
        self.session.refused.append(sentence)  # shown when it is built
        self.session.failures.show(sentence)

    # Drawing

    def _made(self, key: str) -> LessonView:
        made = LessonView(self.session, self.lessons[key], self._change)
        for view in made.views.values():
            view.paint(palette(self.is_dark))
        return made

    def _request(self, learning: Learning) -> None:
        """Compute the views and the verdict on the answer, where what they depend on changed."""
        shown, lesson = self.shown, self.shown.lesson
        committed = lesson.prediction.parsed(learning.prediction)
        bench = lesson.moved(learning.moved)
        shown.panel.show(bench)
        wanted: dict[str, Any] = {"before": (lesson.bench, None)}
        if committed is not None:
            wanted["after"] = bench, committed
        if learning.answer:
            wanted["check"] = number_of(learning.answer, "answer")
        before, self._requested = self._requested, wanted
        for part, given in wanted.items():
            if before.get(part) == given:
                continue
            if part == "check":
                judge = partial(self._judge, shown, given)
                self._submit(part, partial(lesson.check.verdict, given), judge)
            else:
                draw = partial(self._draw, shown, part, given[0])
                self._submit(part, partial(_seen, lesson, part, *given), draw)

    def _submit(
        self, part: str, work: Callable[[], Result], draw: Callable[[Result], None]
    ) -> None:
        """Run `work` in the background and draw its result if the page is still on screen."""
        failures, failed = self.session.failures, (self, part)

        def arrived(result: Result) -> None:
            failures.resolve(failed)
            if self.is_on_screen:
                with self.session.tasks.hold():
                    draw(result)

        self._channels[part].submit(work, arrived, partial(failures.report, part=failed))

    def _draw(
        self,
        shown: LessonView,
        part: str,
        bench: Bench,
        items: Mapping[str, outputs.Plot | outputs.Pictures],
    ) -> None:
        if shown is self.shown:
            for name, item in items.items():
                shown.views[part, name].show(item, bench)

    def _judge(self, shown: LessonView, answer: float, verdict: tuple[bool, str]) -> None:
        if shown is self.shown and self._requested.get("check") == answer:
            shown.verdict.text = verdict[1]


def _seen(
    lesson: Lesson, part: str, bench: Bench, committed: str | float | None
) -> dict[str, outputs.Plot | outputs.Pictures]:
    """Return the views before or after the prediction, by name."""
    return {name: lesson.seen(name, bench, committed) for name in getattr(lesson, part)}


def _markdown(source: str) -> pmui.Typography:
    """Return formatted text; HTML in a lesson's file is shown as text, so that none can run."""
    return pmui.Typography(
        source, renderer_options={"html": False}, sizing_mode="stretch_width", margin=(2, 8)
    )


def _field(label: str) -> pmui.TextInput:
    return pmui.TextInput(label=label, size="small", width=200, margin=(6, 0))


PAGE = Page(
    "Learn",
    Learn,
    "asks before it shows: short lessons",
    shared=frozenset(),
    is_standalone=True,
)
