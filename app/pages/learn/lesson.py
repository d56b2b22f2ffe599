"""One lesson on screen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import panel as pn
import panel_material_ui as pmui

from app.model.lessons import SHAPES, Item, Lesson, number_of
from app.model.state import Learning
from app.pages.learn import text
from app.pages.learn.views import View
from app.pages.session import Session
from app.pages.shared.downloads import CORNER
from app.theme import Palette
from app.widgets.cards import button, typed
from app.widgets.controls import Sentence, SettingsPanel
from app.widgets.glossary import explained
from core.studies.lessons import Bench

PAGE_STYLE = """
:host { display: flex !important; flex-direction: column; gap: 6px; max-width: 1100px;
  flex: none !important; height: auto !important; max-height: none !important; }
"""
VIEWS = """
:host { display: grid !important; gap: 8px; width: 100%; flex: none !important;
  height: auto !important; max-height: none !important;
  grid-template-columns: repeat(auto-fit, minmax(min(420px, 100%), 1fr)); }
"""
ROW = ":host { display: flex !important; flex-wrap: wrap; align-items: center; gap: 8px 12px; }"

# Beside the plots that it changes, also where they need scrolling: then above their buttons.
MOVING = f"""
:host {{ position: sticky !important; top: 0; z-index: {int(CORNER["z-index"]) + 1};
  background: var(--mui-palette-background-default, #fff); }}
"""


class Job(NamedTuple):
    """Something to compute in the background for what is on screen."""

    given: Any
    """Input of the computation, which is not repeated while this stays equal."""
    work: Callable[[], Any]
    draw: Callable[[Any], None]
    """Called with the result."""


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
    past : pmui.Typography
        Heading of the views from before the prediction, which stay as they were.
    views : dict of (str, str) to View
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
        self._answered = ""
        self.prediction = prediction_field(lesson, self._commit)
        self.commit = button("Predict", text.COMMIT_HELP, self._commit)
        self.commit.variant = "contained"
        self.again = button("Start again", text.AGAIN_HELP, self._start_again)
        self.panel = settings_panel(lesson, change)
        control = self.panel.controls[lesson.control]
        control.max_width = 480
        self.answer = _field("Your answer")
        self.answer.param.watch(lambda _: self._answer(), "value")
        self.verdict = Sentence(live=True, margin=(4, 0))
        self._checked = pn.Column(
            markdown(f"{lesson.explanation}\n\n{lesson.further}"),
            markdown(f"**Check.** {lesson.check.question}"),
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
            markdown(text.MOVE),
            control,
            stylesheets=[MOVING],
            sizing_mode="stretch_width",
            margin=0,
        )
        self.past = markdown(text.PAST)
        self.layout = pn.Column(
            markdown(f"## {lesson.title}\n\n{lesson.introduction}"),
            markdown(f"**Predict.** {lesson.prediction.question}"),
            pn.Row(self.prediction, self.commit, self.again, stylesheets=[ROW], margin=(0, 8)),
            self.moving,
            self._grid("after"),
            self._checked,
            self.past,
            self._grid("before"),
            stylesheets=[PAGE_STYLE],
            sizing_mode="stretch_width",
            margin=0,
        )

    def _grid(self, part: str) -> pn.Column:
        """Return the views before or after the prediction, side by side where there is room."""
        return pn.Column(
            *(self.views[part, name].holder for name in getattr(self.lesson, part)),
            stylesheets=[VIEWS],
            sizing_mode="stretch_width",
            margin=0,
        )

    def _start_again(self) -> None:
        self._change(prediction="", moved="", answer="")

    def _commit(self) -> None:
        self._change(prediction=typed(self.prediction) or text.NOTHING)

    def _answer(self) -> None:
        self._change(answer=self.answer.value)

    def follow(self, learning: Learning) -> None:
        """Show how far the learner is."""
        is_committed = bool(learning.prediction)
        self.prediction.disabled = self.commit.disabled = is_committed
        if is_committed:
            self.prediction.value = learning.prediction
        self.again.visible = self.moving.visible = self.past.visible = is_committed
        for (part, _), view in self.views.items():
            view.holder.visible = is_committed or part == "before"
        self._checked.visible = is_committed and bool(learning.moved)
        self.answer.value = self._answered = learning.answer
        if not learning.answer:
            self.verdict.text = ""

    def jobs(self, learning: Learning) -> dict[str, Job]:
        """Return what to compute: the views on both sides of the prediction, and the verdict."""
        lesson = self.lesson
        committed = lesson.prediction.parsed(learning.prediction)
        bench = lesson.moved(learning.moved)
        self.panel.show(bench)
        found = {"before": self._views("before", lesson.bench, None)}
        if committed is not None:
            found["after"] = self._views("after", bench, committed)
        if learning.answer:
            work = partial(lesson.check.verdict, number_of(learning.answer, "answer"))
            judge = partial(self._judge, learning.answer)
            found["check"] = Job(learning.answer, work, judge)
        return found

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        for view in self.views.values():
            view.paint(colors)

    def _views(self, part: str, bench: Bench, committed: str | float | None) -> Job:
        work = partial(_seen, self.lesson, part, bench, committed)
        return Job((bench, committed), work, partial(self._draw, part, bench))

    def _draw(self, part: str, bench: Bench, items: Mapping[str, Item]) -> None:
        for name, item in items.items():
            self.views[part, name].show(item, bench)

    def _judge(self, answer: str, verdict: tuple[bool, str]) -> None:
        if answer == self._answered:
            self.verdict.text = verdict[1]


def _seen(
    lesson: Lesson, part: str, bench: Bench, committed: str | float | None
) -> dict[str, Item]:
    """Return the views before or after the prediction, by name."""
    return {name: lesson.seen(name, bench, committed) for name in getattr(lesson, part)}


def prediction_field(lesson: Lesson, commit: Callable[[], None]) -> Any:
    """Return the control with which a learner predicts; Enter commits a number."""
    asked = lesson.prediction
    if asked.axis:
        field = _field(text.answer_label(asked.unit))
        field.param.watch(lambda _: commit(), "enter_pressed")
        return field
    return pmui.RadioButtonGroup(
        options=list(SHAPES),
        value=next(iter(SHAPES)),
        label="",
        description=text.SHAPES_HELP,
        size="small",
        margin=0,
    )


def settings_panel(lesson: Lesson, change: Callable[..., None]) -> SettingsPanel[Bench]:
    """Return the settings of a lesson, of which the one control is shown."""

    def moved(bench: Bench) -> None:
        change(moved=str(getattr(bench, lesson.control)))

    panel = SettingsPanel(lesson.bench, moved)
    if lesson.ends is not None:
        low, high = lesson.ends
        panel.controls[lesson.control].param.update(low=low, high=high)
    return panel


def markdown(source: str, sx: dict[str, Any] | None = None) -> pmui.Typography:
    """Return formatted text; HTML in a lesson's file is shown as text, so that none can run."""
    return explained(
        source,
        sx,
        renderer_options={"html": False},
        sizing_mode="stretch_width",
        margin=(2, 8),
    )


def _field(label: str) -> pmui.TextInput:
    return pmui.TextInput(label=label, size="small", width=200, margin=(6, 0))
