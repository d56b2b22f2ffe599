"""Presenter mode: one slide of a lesson at a time, legible across a room."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import panel as pn
import panel_material_ui as pmui

from app.model.glossary import linked
from app.model.lessons import Item, Lesson
from app.model.slides import by_digit, following, next_revealed, slides_of
from app.model.state import Learning
from app.pages.learn import text
from app.pages.learn.lesson import ROW, Job, markdown, prediction_field, settings_panel
from app.pages.learn.views import View
from app.pages.session import Session
from app.theme import Palette
from app.widgets.cards import button, typed
from app.widgets.slide_bar import SlideBar
from core.studies.lessons import Bench

STAGE = """
:host { display: flex !important; flex-direction: column; gap: 8px; padding: 12px 24px;
  position: fixed !important; inset: 0; z-index: 1300; box-sizing: border-box;
  width: 100vw !important; height: 100vh !important; max-height: none !important;
  background: var(--mui-palette-background-default, #fff);
  --type-size: 24px; }
@media (width < 700px) { :host { padding: 8px; --type-size: 15px; } }
"""
PLOT = ":host { flex: 1 1 0 !important; min-height: 0; width: 100%; overflow-y: auto; }"
SCALED = ":host { zoom: 2.2; } @media (width < 700px) { :host { zoom: 1.3; } }"
"""Style of controls, whose smallest type has 11 px."""
LABEL = {"& .MuiInputLabel-shrink, & .MuiOutlinedInput-notchedOutline": {"fontSize": "15px"}}
"""Style of the labels of fields, which are otherwise drawn at 75 %."""
TYPE = {
    "&, & p": {"fontSize": "26px", "lineHeight": 1.3},
    "& p": {"margin": "0 0 6px"},
    "& h1": {"fontSize": "30px", "margin": 0},
    "@media (width < 700px)": {"&, & p": {"fontSize": "18px"}, "& h1": {"fontSize": "22px"}},
}


class Presenter:
    """One slide of a lesson in the whole window.

    Parameters
    ----------
    session : Session
    lesson : Lesson
    change : callable
        Called with the parts of `Learning` that change, by name.
    keys : sequence of str
        All lessons, in their order.
    open_lesson : callable
        Called with the key of another lesson.
    end : callable
        Called when the presentation ends.

    Attributes
    ----------
    lesson : Lesson
    slides : tuple of Slide
    bar : SlideBar
    prediction : pmui.RadioButtonGroup or pmui.TextInput
    panel : SettingsPanel
        Has the one control.
    views : dict of (str, str) to View
        Those that have been on screen, by position and name.
    """

    def __init__(
        self,
        session: Session,
        lesson: Lesson,
        change: Callable[..., None],
        keys: Sequence[str],
        open_lesson: Callable[[str], None],
        end: Callable[[], None],
    ) -> None:
        self.lesson, self.slides = lesson, slides_of(lesson)
        self._session, self._change, self._end = session, change, end
        self._keys, self._open_lesson = keys, open_lesson
        self._step = 0
        self._colors: Palette | None = None
        self.views: dict[tuple[str, str], View] = {}
        self.bar = SlideBar(digits=sorted(by_digit(keys)), sizing_mode="stretch_width", margin=0)
        self.bar.param.watch(lambda event: self._act(event.new[0]), "pressed")
        self.prediction = prediction_field(lesson, self._commit)
        self.panel = settings_panel(lesson, change)
        control = self.panel.controls[lesson.control]
        for each in (self.prediction, control):
            if isinstance(each, pmui.TextInput | pmui.Select):
                each.sx = LABEL
        self._text = markdown("", TYPE)
        asking = pn.Row(
            self.prediction,
            button("Predict", text.COMMIT_HELP, self._commit),
            stylesheets=[ROW],
            margin=0,
        )
        # The style of the row keeps it visible.
        self._asking = pn.Column(asking, stylesheets=[SCALED])
        self._control = pn.Column(control, sizing_mode="stretch_width", stylesheets=[SCALED])
        self._stage = pn.Column(stylesheets=[PLOT], sizing_mode="stretch_both", margin=0)
        self.layout = pn.Column(
            markdown(f"# {lesson.title}", TYPE),
            self._text,
            self._asking,
            self._stage,
            self._control,
            self.bar,
            stylesheets=[STAGE],
            margin=0,
        )

    def follow(self, learning: Learning) -> None:
        """Show a slide."""
        self._step = min(learning.step, len(self.slides) - 1)
        slide = self.slides[self._step]
        self._text.object, self._text.visible = linked(slide.text), bool(slide.text)
        self._asking.visible = slide.asks
        self._text.styles = {} if slide.view else {"zoom": "1.5"}
        self._control.visible = slide.reveals and not slide.answers
        if learning.prediction:
            self.prediction.value = learning.prediction
        shown = [] if slide.view is None else [self._view(slide.view).holder]
        if self._stage.objects != shown:
            self._stage.objects = shown
        self.bar.place = f"{self._step + 1} / {len(self.slides)}"

    def jobs(self, learning: Learning) -> dict[str, Job]:
        """Return what to compute for the slide: its view, and the answer to the check."""
        slide, lesson, check = self.slides[self._step], self.lesson, self.lesson.check
        moved = lesson.moved(learning.moved)
        self.panel.show(moved)
        found = {}
        if slide.answers:
            found["answer"] = Job(None, lambda: check.answer, self._show_answer)
        if slide.view is not None:
            part, name = slide.view
            committed = None if part == "before" else lesson.prediction.parsed(learning.prediction)
            shown = {"before": lesson.bench, "after": moved, "check": check.bench}[part]
            work = partial(lesson.seen, name, shown, committed)
            draw = partial(self._draw, slide.view, shown)
            found[f"{part} {name}"] = Job((shown, committed), work, draw)
        return found

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        self._colors = colors
        for view in self.views.values():
            view.paint(colors)

    def _view(self, place: tuple[str, str]) -> View:
        if place not in self.views:
            is_large = not self.bar.is_narrow
            made = self.views[place] = View(self._session, self.lesson, is_large)
            if self._colors is not None:
                made.paint(self._colors)
        return self.views[place]

    def _draw(self, place: tuple[str, str], bench: Bench, item: Item) -> None:
        self._view(place).show(item, bench)

    def _show_answer(self, answer: float) -> None:
        if self.slides[self._step].answers:
            self._text.object = linked(f"{self.lesson.check.question}\n\n**{answer:.3g}**")

    # Actions of the lecturer

    def _act(self, what: str) -> None:
        if what == "end":
            self._end()
        elif what == "reveal":
            self._change(step=next_revealed(self.slides, self._step))
        elif what in ("back", "next"):
            self._turn(1 if what == "next" else -1)
        elif what in (lessons := by_digit(self._keys)):
            self._open_lesson(lessons[what])

    def _turn(self, by: int) -> None:
        step = self._step + by
        if 0 <= step < len(self.slides):
            self._change(step=step)
        elif (other := following(self._keys, self.lesson.key, by)) is not None:
            self._open_lesson(other)

    def _commit(self) -> None:
        step = next_revealed(self.slides, self._step)
        self._change(prediction=typed(self.prediction), step=step)
