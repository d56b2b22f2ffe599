"""The page that puts methods side by side: what is picked, what is computed, what is shown."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any

import numpy as np
import panel as pn
import panel_material_ui as pmui

from app.model.colors import cloud_of, image_of
from app.model.download_text import NOTHING_DRAWN
from app.model.exports import cloud_files, facts_file, image_files, plot_file, shown_table_file
from app.model.mesh import view_bounds
from app.model.methods import method_title
from app.model.state import CLOUDS, KINDS, Comparison, Viewing
from app.model.store import Answer
from app.pages.compare import text as ranking_words
from app.pages.compare.ranking import (
    Result,
    Task,
    Yardstick,
    run_task,
    score_curves,
    tasks_of,
    yardstick,
)
from app.pages.navigation import Page, View
from app.pages.session import Session
from app.pages.shared.downloads import (
    CLOUD,
    CORNER_PX,
    IMAGE,
    PLOT,
    TABLE,
    Download,
    Shown,
    Subject,
    below,
    downloadable,
    downloadable_facts,
    looked_at,
    pixel_on_show,
    ranged,
    viewed,
)
from app.theme import method_style, palette
from app.widgets.cards import card, part
from app.widgets.controls import Facts, Knob, PixelKeys, Sentence, SettingsPanel, Table
from app.widgets.method_picture import Picture, ScaleBar
from app.widgets.method_plots import CurvePlot, ReliabilityPlot, Style
from core import ESTIMATORS
from core.estimators import FALSE_ALARM

log = logging.getLogger(__name__)

MOST_PICTURES = 6

LOOKS = {"Range": "Estimate", CLOUDS: "Estimate"}
"""What `app.model.colors` calls what the pictures show, where it has another name."""

IMAGE_HEIGHT, CLOUD_HEIGHT = 216, 320

GRID = """
:host {{ display: grid !important; gap: 8px; width: 100%;
  grid-template-columns: repeat({columns}, minmax(0, 1fr)); }}
@media (max-width: 900px) {{ :host {{ grid-template-columns: repeat({few}, minmax(0, 1fr)); }} }}
@media (max-width: 500px) {{ :host {{ grid-template-columns: repeat({fewest}, minmax(0, 1fr)); }} }}
.scroll-button {{ display: none; }}
"""
CLOUDS_IN_A_ROW = 3

BELOW = """
:host { display: grid !important; gap: 8px; height: 290px;
  grid-template: minmax(0, 1fr) / minmax(0, 5fr) minmax(0, 3fr); }
@media (max-width: 900px) {
  :host { display: flex !important; flex-direction: column; height: 670px !important; }
}
"""
HEAD = """
:host { display: flex !important; flex-wrap: wrap; align-items: center; gap: 4px 12px;
  min-width: 0 !important; }
"""


class Compare:
    """The page's controls and views around one session.

    A method's answer is kept for as long as the capture and the method's settings stay: only what
    is missing is computed, one method after another on the worker, and only while the page is on
    screen.

    Parameters
    ----------
    session : Session
        Whose capture is ranged; the tracking differentiator has the session's own settings.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._jobs = session.tasks.latest()
        self._curve_jobs = session.tasks.latest()
        self._capture = session.answer.capture
        self._results: dict[Task, Result | str] = {}
        self._measure: Yardstick | None = None
        self._is_busy = self._is_stopped = self._is_on_screen = False
        self._dark = False
        self._scene_id = ""
        self._bounds: list[float] = []
        self._make_controls()
        self._make_views()
        self._enter()
        session.state.param.watch(lambda *_: self._choose_pixel(), ["pixel", "unit"])

    @property
    def view(self) -> View:
        """The page."""
        return View(self._main(), self._aside(), self._show, self._follow, self._paint)

    # Controls and views

    def _make_controls(self) -> None:
        chosen = self._chosen
        self._picks = pmui.CheckBoxGroup(
            label="Methods to compare",
            options={method_title(method): method for method in ESTIMATORS},
            value=list(chosen.methods),
            sizing_mode="stretch_width",
            margin=(0, 8),
        )
        self._picks.param.watch(lambda _: self._picked(), "value")
        self._false_alarm = Knob.of(
            FALSE_ALARM,
            Comparison().false_alarm,
            "Share of the pixels without an echo that may be answered: lower, and a method answers "
            "only where its score exceeds what noise alone would show. 1 answers all.",
        )
        self._false_alarm.value = chosen.false_alarm
        self._false_alarm.param.watch(lambda event: self._alarmed(event.new), "value")
        self._own = {
            method: self._panel(method)
            for method, each in ESTIMATORS.items()
            if method != "tracking" and fields(each.parameters)
        }
        self._panels = {
            method: part(ESTIMATORS[method].title, panel.layout, is_open=False)
            for method, panel in self._own.items()
        }
        self._view_panel = SettingsPanel(Comparison().viewing, self._viewing_changed)
        self._kind = pmui.RadioButtonGroup(
            options=list(KINDS),
            value=chosen.kind,
            label="",
            description="What the pictures show, on one scale for all methods.",
            size="small",
            width=345,
            margin=0,
        )
        self._kind.param.watch(lambda event: self._kind_changed(event.new), "value")
        self._bar = pmui.LinearProgress(
            variant="determinate", value=0, width=160, margin=(14, 0), visible=False
        )
        self._status = Sentence(live=True, margin=(8, 0, 0, 0))
        self._stop = pmui.Button(
            label="Cancel",
            size="small",
            variant="outlined",
            margin=0,
            visible=False,
        )
        self._stop.on_click(lambda _: self._stop_or_go_on())

    def _panel(self, method: str) -> SettingsPanel[Any]:
        def changed(settings: Any) -> None:
            self._set(method, settings)
            self._refresh()

        panel = SettingsPanel(ESTIMATORS[method].parameters(), changed)
        panel.show(self._chosen.settings[method])
        return panel

    def _make_views(self) -> None:
        self._pictures: list[Picture] = []
        self._buttons: list[Download] = []
        self._keys = PixelKeys(
            label="Pictures of the methods. Arrow keys move the pixel, with Shift by eight.",
            width=0,
            height=0,
            margin=0,
            styles={"position": "absolute"},
        )
        self._grid = pn.Column(
            self._keys,
            sizing_mode="stretch_width",
            margin=0,
        )
        self._keys.param.watch(lambda event: self._session.choose_pixel(*event.new), "pixel")
        self._scale = ScaleBar()
        self._remarks = Sentence(sizing_mode="stretch_width", margin=(2, 0))
        self._curves = CurvePlot()
        self._facts = Facts(sizing_mode="stretch_width")
        self._reliability = ReliabilityPlot()
        self._reliability.pane.object.min_border_top = CORNER_PX
        self._no_reliability = Sentence(text=ranking_words.RELIABILITY_UNKNOWN, margin=12)
        self._table = Table(
            title="Methods by their figures; a column's header sorts.",
            sizing_mode="stretch_width",
            margin=(6, 0),
        )

    def _main(self) -> list[Any]:
        head = pn.Row(
            self._kind,
            self._bar,
            self._status,
            self._stop,
            stylesheets=[HEAD],
            sizing_mode="stretch_width",
            margin=(4, 0),
        )
        reliability = card(self._reliability.pane, self._no_reliability)
        plots = pn.Column(
            downloadable(
                card(self._curves.pane), self._session, "scores", self._curves_shown, PLOT
            ),
            downloadable(reliability, self._session, "reliability", self._reliability_shown, PLOT),
            stylesheets=[BELOW],
            sizing_mode="stretch_width",
            height=290,
        )
        return [
            head,
            self._grid,
            self._scale.pane,
            self._remarks,
            downloadable_facts(self._facts, self._session, self._numbers_shown),
            plots,
            downloadable(below(self._table), self._session, "table", self._table_shown, TABLE),
        ]

    def _aside(self) -> list[Any]:
        explanation = pmui.Typography(ranking_words.EXPLANATION, margin=8)
        return [
            part("Methods", self._picks, self._false_alarm),
            *self._panels.values(),
            part("View of the pictures", self._view_panel.layout, is_open=False),
            part("How to read this page", explanation, is_open=False),
        ]

    # What the app tells the page

    def _show(self, is_on_screen: bool) -> None:
        self._is_on_screen = is_on_screen
        if is_on_screen:
            self._show_choice()
            self._refresh()

    def _show_choice(self) -> None:
        """Show methods and settings, which another page may have changed."""
        chosen = self._chosen
        for method, panel in self._own.items():
            panel.show(chosen.settings[method])
        self._picks.value = list(chosen.methods)

    def _follow(self, _answer: Answer) -> None:
        self._refresh()

    def _paint(self, dark: bool) -> None:
        self._dark, colors = dark, palette(dark)
        with pn.io.hold(self._session.page):
            for each in (self._scale, self._reliability, self._curves):
                each.paint(colors)
            for picture in self._pictures:
                self._paint_picture(picture)
            self._draw_figures()
            self._choose_pixel()

    # What the user does

    @property
    def _chosen(self) -> Comparison:
        chosen: Comparison = self._session.state.comparison
        return chosen

    def _choose(self, **changes: Any) -> None:
        self._session.state.comparison = replace(self._chosen, **changes)

    def _set(self, method: str, settings: Any) -> None:
        self._choose(settings={**self._chosen.settings, method: settings})

    def _picked(self) -> None:
        self._choose(methods=tuple(each for each in ESTIMATORS if each in self._picks.value))
        picked = self._tasks.values()
        self._results = {  # what failed is tried again once it is picked anew
            task: found
            for task, found in self._results.items()
            if isinstance(found, Result) or task in picked
        }
        self._is_stopped = False
        self._refresh()

    def _alarmed(self, share: float) -> None:
        self._choose(false_alarm=share)
        self._refresh()

    def _kind_changed(self, kind: str) -> None:
        self._choose(kind=kind)
        self._draw_pictures()

    def _viewing_changed(self, viewing: Viewing) -> None:
        self._choose(viewing=viewing)
        self._draw_pictures()

    def _stop_or_go_on(self) -> None:
        self._is_stopped = not self._is_stopped
        self._go_on()

    def _choose_pixel(self) -> None:
        # A new capture's pixel is chosen before its answer is announced: that draws it, too.
        if self._is_on_screen and self._session.answer.capture is self._capture:
            self._mark_pixel()
            self._ask_curves()

    # What is computed

    @property
    def _tasks(self) -> dict[str, Task]:
        """What is picked, in the order of the registry."""
        return tasks_of(self._chosen, self._session.answer.request.tracking)

    def _styles(self) -> dict[str, Style]:
        colors = palette(self._dark)
        return {method: method_style(place, colors) for place, method in enumerate(self._tasks)}

    def _refresh(self) -> None:
        """Show what is known of the present capture, and compute what is not."""
        if not self._is_on_screen:
            return
        if self._session.answer.capture is not self._capture:
            self._enter()
        tasks = self._tasks
        for method, panel in self._panels.items():
            panel.visible = method in tasks
        self._draw_pictures()
        self._draw_figures()
        self._choose_pixel()
        self._go_on()

    def _enter(self) -> None:
        """Come to another capture: nothing is known of it yet."""
        session = self._session
        self._capture = session.answer.capture
        self._results, self._measure, self._is_stopped = {}, None, False
        self._keys.shape = list(self._capture.shape)
        has_truth = self._capture.truth_range_m is not None
        kinds = [kind for kind in KINDS if has_truth or kind != "Error"]
        if self._kind.value not in kinds:
            self._kind.value = "Range"
        self._kind.options = kinds
        self._reliability.pane.visible, self._no_reliability.visible = has_truth, not has_truth
        if session.scene_id() != self._scene_id:
            self._scene_id = session.scene_id()
            own = session.own_field_of_view_deg
            self._view_panel.show(self._chosen.viewing)
            self._view_panel.controls["field_of_view_deg"].initial = own
            cloud, _, wrong = cloud_of(session.answer, "Range", session.state.viewing)
            self._bounds = view_bounds(cloud, None if wrong is None else ~wrong)
        for picture in self._pictures:
            picture.image.enter(*self._capture.shape, self._session.answer.grid)

    def _go_on(self) -> None:
        """Compute the next that is missing, unless something is under way or nothing is wanted."""
        missing = [task for task in self._tasks.values() if task not in self._results]
        is_idle = self._is_stopped or not self._is_on_screen
        if not (self._is_busy or is_idle):
            if missing:
                self._submit(partial(run_task, missing[0], self._session.answer), missing[0])
            elif self._measure is None:
                self._submit(partial(yardstick, self._capture), None)
        self._tell_progress(missing)

    def _submit(self, work: Callable[[], Any], task: Task | None) -> None:
        self._is_busy = True
        arrived = partial(self._arrived, self._capture, task)
        self._jobs.submit(work, arrived, arrived)

    def _arrived(self, capture: Any, task: Task | None, outcome: Any) -> None:
        """Keep and show what was computed, or why it could not be, and go on."""
        self._is_busy = False
        if isinstance(outcome, Exception) and not isinstance(outcome, ValueError):
            log.warning("a method failed", exc_info=outcome)
        if capture is self._capture:
            if task is None:
                failed = isinstance(outcome, Exception)
                why = ranking_words.no_yardstick(outcome) if failed else ""
                self._measure = Yardstick(None, None, why) if failed else outcome
            elif isinstance(outcome, Exception):
                self._results[task] = ranking_words.problem(outcome)
            else:
                self._results[task] = outcome
        if self._is_on_screen:
            with pn.io.hold(self._session.page):
                self._draw_pictures()
                self._draw_figures()
                self._choose_pixel()
                self._go_on()

    def _answers(self) -> dict[str, Answer]:
        """The answers that are there, by method."""
        found = {method: self._results.get(task) for method, task in self._tasks.items()}
        return {m: each.answer for m, each in found.items() if isinstance(each, Result)}

    def _ask_curves(self) -> None:
        answers, pixel = self._answers(), self._session.state.pixel
        tasks = {method: task for method, task in self._tasks.items() if method in answers}
        self._curve_jobs.submit(
            partial(score_curves, self._capture, tasks, *pixel),
            partial(self._draw_curves, answers, pixel),
            partial(self._session.failures.report, part=self),
        )

    # What is taken away

    @property
    def _subject(self) -> Subject:
        """All methods together."""
        return looked_at(self._session, self._session.answer.request)

    def _picture_shown(self, place: int) -> Shown:
        method = self._pictured()[place]
        answer = self._answers().get(method)
        if answer is None:
            raise ValueError(NOTHING_DRAWN)
        kind, viewing = self._kind.value, self._chosen.viewing
        least, look_name = viewing.least_confidence, LOOKS.get(kind, kind)
        _, look = image_of(self._session.answer, look_name, least)
        if kind == CLOUDS:
            what, files = "cloud", cloud_files(answer, "Range", viewing)
        else:
            figure = self._pictures[place].image.figure
            files = image_files(answer, look_name, least, figure)
            what = f"{kind} image"
        subject = ranged(self._session, answer, method, self._tasks[method].settings)
        subject = viewed(self._session, subject, viewing)
        return Shown(subject, what.lower(), files, method_title(method), look)

    def _curves_shown(self) -> Shown:
        table = plot_file(self._curves.pane.object, self._capture.acquisition)
        return Shown(self._subject, f"scores {pixel_on_show(self._session)}", {"csv": table})

    def _numbers_shown(self) -> Shown:
        what = f"numbers {pixel_on_show(self._session)}"
        return Shown(self._subject, what, {"csv": facts_file(self._facts.facts)})

    def _reliability_shown(self) -> Shown:
        table = plot_file(self._reliability.pane.object)
        return Shown(self._subject, "reliability", {"csv": table})

    def _table_shown(self) -> Shown:
        table = shown_table_file(self._table.columns, self._table.rows)
        return Shown(self._subject, "methods", {"csv": table})

    # What is drawn

    def _tell_progress(self, missing: list[Task]) -> None:
        total = len(self._tasks)
        is_running = self._is_busy and bool(missing)
        done = total - len(missing)
        current = missing[0].method if is_running else None
        self._status.text = ranking_words.progress(done, total, current)
        self._bar.param.update(value=100 * done // max(total, 1), visible=is_running)
        self._stop.label = "Cancel" if not self._is_stopped else "Go on"
        self._stop.visible = bool(missing)

    def _pictured(self) -> list[str]:
        """Methods that have a picture: the first ones, but for those that failed."""
        working = [m for m, t in self._tasks.items() if not isinstance(self._results.get(t), str)]
        return working[:MOST_PICTURES]

    def _draw_pictures(self) -> None:
        answers, methods = self._answers(), self._pictured()
        with pn.io.hold(self._session.page):
            clouds = self._kind.value == CLOUDS
            columns = max(min(len(methods), CLOUDS_IN_A_ROW if clouds else MOST_PICTURES), 1)
            self._grid.stylesheets = [
                GRID.format(columns=columns, few=1 if clouds else 3, fewest=1 if clouds else 2)
            ]
            least = self._chosen.viewing.least_confidence
            look_name = LOOKS.get(self._kind.value, self._kind.value)
            _, look = image_of(self._session.answer, look_name, least)
            self._scale.update(look)
            self._make_pictures(len(methods))
            for picture, button, method in zip(
                self._pictures, self._buttons, methods, strict=False
            ):
                picture.title.text = button.what = method_title(method)
                button.offer(CLOUD if clouds else IMAGE)
                picture.dim(method not in answers)
                picture.resize(CLOUD_HEIGHT if clouds else IMAGE_HEIGHT)
                if method in answers and clouds:
                    self._draw_cloud(picture, method, answers[method])
                elif method in answers:
                    values, _ = image_of(answers[method], look_name, least)
                    picture.draw_image(values, look)

    def _draw_cloud(self, picture: Picture, method: str, answer: Answer) -> None:
        cloud, rgb, wrong = cloud_of(answer, "Range", self._chosen.viewing)
        view = picture.show_cloud(self._dark)
        view.label = f"Point cloud: {method_title(method)}. Arrow keys turn all clouds together."
        view.draw(cloud, rgb, wrong, scene_id=self._scene_id, bounds=self._bounds)

    def _make_pictures(self, count: int) -> None:
        """Have this many pictures in the grid; what they need is made once."""
        while len(self._pictures) < count:
            picture = Picture(self._session.choose_pixel, self._session.pick, IMAGE_HEIGHT)
            show = partial(self._picture_shown, len(self._pictures))
            button = Download(self._session, "picture", show, IMAGE)
            picture.card.append(button)
            self._pictures.append(picture)
            self._buttons.append(button)
            picture.image.join(self._pictures[0].image)
            picture.image.enter(*self._capture.shape, self._session.answer.grid)
            self._paint_picture(picture)
        cards = [*(picture.card for picture in self._pictures[:count]), self._keys]
        if cards != self._grid.objects:
            self._grid.objects = cards

    def _paint_picture(self, picture: Picture) -> None:
        picture.image.paint(palette(self._dark))
        if picture.cloud is not None:
            picture.cloud.dark = self._dark

    def _draw_figures(self) -> None:
        """The table, the reliability diagram, and what else is to be said."""
        tasks, capture, styles = self._tasks, self._capture, self._styles()
        found = {method: self._results.get(task) for method, task in tasks.items()}
        self._table.param.update(
            columns=ranking_words.columns(capture),
            rows=ranking_words.rows(capture, tasks, self._results, self._measure, styles),
        )
        lines = {
            method: (each.verdict.told, each.verdict.right)
            for method, each in found.items()
            if isinstance(each, Result) and each.verdict is not None
        }
        self._reliability.update(lines, styles)
        answered = sum(not isinstance(each, str) for each in found.values())
        self._remarks.text = ranking_words.remarks(capture, answered, len(self._pictured()))

    def _mark_pixel(self) -> None:
        row, col = self._session.state.pixel
        answers = self._answers()
        with pn.io.hold(self._session.page):
            self._keys.pixel = [row, col]
            self._facts.facts = ranking_words.pixel_facts(
                self._session.answer, self._measure, row, col
            )
            for picture, method in zip(self._pictures, self._pictured(), strict=False):
                picture.image.mark(row, col)
                known = method in answers
                text = ranking_words.caption(answers[method], row, col) if known else ""
                picture.caption.text = text
                if picture.cloud is not None:
                    picture.cloud.selected = row * self._capture.shape[1] + col

    def _draw_curves(
        self, answers: dict[str, Answer], pixel: tuple[int, int], curves: dict[str, Any]
    ) -> None:
        self._session.failures.resolve(self)
        tasks = self._tasks
        answers = {method: each for method, each in answers.items() if method in tasks}
        if pixel != self._session.state.pixel or not answers:
            return  # the user has moved on
        acquisition, truth_m = self._capture.acquisition, self._capture.truth_range_m
        truth = np.nan if truth_m is None else float(truth_m[pixel])
        with pn.io.hold(self._session.page):
            self._curves.update(
                {method: curve for method, curve in curves.items() if method in answers},
                {method: float(each.run.image.bin[pixel]) for method, each in answers.items()},
                float(acquisition.range_m_to_bin(truth)),
                acquisition,
                self._styles(),
                self._session.state.unit,
            )


PAGE = Page("Compare", Compare, "puts methods side by side")
