"""The Compare page: methods side by side."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from functools import partial
from statistics import median_low
from typing import Any

import numpy as np
import panel as pn
import panel_material_ui as pmui

from app.model.colors import Unseen, cloud_of, image_of, n_below, unseen
from app.model.download_text import NOTHING_DRAWN
from app.model.exports import cloud_files, image_files
from app.model.mesh import view_bounds
from app.model.methods import doubts_hold, method_style, method_title
from app.model.state import CLOUDS, KINDS, Comparison, Viewing
from app.model.store import Answer
from app.pages.compare import text
from app.pages.compare.ranking import (
    Reference,
    Result,
    Task,
    reference_of,
    run_task,
    score_curves,
    tasks_of,
)
from app.pages.navigation import Page, Shared
from app.pages.session import Session
from app.pages.shared.downloads import (
    CLOUD,
    CORNER_PX,
    IMAGE,
    Download,
    Shown,
    Subject,
    looked_at,
    pixel_on_show,
    ranged,
    viewed,
)
from app.pages.shared.echo_zoom import EchoZoom
from app.pages.shared.method import judge_choice
from app.pages.shared.section import Section
from app.pages.shared.viewing import show_own_width
from app.tasks.scheduler import RETURN_MS
from app.theme import palette
from app.widgets.cards import card, part
from app.widgets.controls import Facts, Knob, PixelKeys, Sentence, SettingsPanel, Table, legend_line
from app.widgets.method_picture import Picture, ScaleBar
from app.widgets.method_plots import CurvePlot, ReliabilityPlot, Style
from core import ESTIMATORS, Capture
from core.estimators import FALSE_ALARM
from core.inference import has_fit

log = logging.getLogger(__name__)

MAX_PICTURES = 6

IMAGE_KINDS = {"Range": "Estimate", CLOUDS: "Estimate"}
"""Names in `app.model.colors` of kinds of pictures, where they differ."""

IMAGE_HEIGHT, CLOUD_HEIGHT = 216, 320

GRID = """
:host {{ display: grid !important; gap: 8px; width: 100%;
  grid-template-columns: repeat({columns}, minmax(0, 1fr)); }}
@media screen and (max-width: 1280px) {{
  :host {{ grid-template-columns: repeat({few}, minmax(0, 1fr)); }}
}}
@media screen and (max-width: 500px) {{
  :host {{ grid-template-columns: repeat({fewest}, minmax(0, 1fr)); }}
}}
.scroll-button {{ display: none; }}
"""
CLOUDS_IN_A_ROW = 3

PLOTS = """
:host { display: grid !important; gap: 8px; height: 290px;
  grid-template: minmax(0, 1fr) / minmax(0, 5fr); grid-auto-flow: column;
  grid-auto-columns: minmax(0, 3fr); }
.scroll-button { display: none; }
@media screen and (max-width: 900px) {
  :host { display: flex !important; flex: none !important; flex-direction: column;
    height: 670px !important; }
}
"""
HEAD = """
:host { display: flex !important; flex-wrap: wrap; align-items: center; gap: 4px 12px;
  min-width: 0 !important; }
"""


class Compare(Section):
    """The page.

    Results are kept as long as the capture and a method's settings stay the same. Missing ones are
    computed one method after another, only while the page is on screen.

    Parameters
    ----------
    session : Session
        The session whose capture is used, and whose settings the methods have.

    Attributes
    ----------
    results : dict of Task to Result or str
        The results on the present capture, or why there is none.
    reference : Reference or None
        What the methods are compared with; None until it has been computed.
    picks : pmui.CheckBoxGroup
        The methods to compare.
    kind : pmui.RadioButtonGroup
        What the pictures show.
    panels : dict of str to SettingsPanel
        Settings of each method that has any, except tracking.
    pictures : list of Picture
    table : Table
    status, remarks : Sentence
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self._method_jobs = session.tasks.latest()
        self._capture = session.answer.capture
        self.results: dict[Task, Result | str] = {}
        self.reference: Reference | None = None
        self._is_busy = self._is_stopped = False
        self._scene_id = ""
        self._bounds: list[float] = []
        self._make_controls()
        self._make_views()
        self._enter()
        session.state.param.watch(lambda *_: self._choose_pixel(), ["pixel", "unit"])

    # Layout

    def _make_controls(self) -> None:
        chosen = self._chosen
        self.picks = pmui.CheckBoxGroup(
            label="Methods to compare",
            options={method_title(method): method for method in ESTIMATORS},
            value=list(chosen.methods),
            sizing_mode="stretch_width",
            margin=(0, 8),
        )
        self.picks.param.watch(lambda _: self._picked(), "value")
        self._false_alarm = Knob.of(FALSE_ALARM, Comparison().false_alarm, text.FALSE_ALARM_HELP)
        self._false_alarm.value = chosen.false_alarm
        self._false_alarm.param.watch(lambda event: self._choose(false_alarm=event.new), "value")
        self.panels = {
            method: SettingsPanel(each.parameters(), partial(self._set, method))
            for method, each in ESTIMATORS.items()
            if method != "tracking" and fields(each.parameters)
        }
        self._folds = {
            method: part(ESTIMATORS[method].title, panel.layout, is_open=False)
            for method, panel in self.panels.items()
        }
        self._viewing = SettingsPanel(Comparison().viewing, self._change_view)
        self._viewing.controls["least_confidence"].max_width = 480
        self.kind = pmui.RadioButtonGroup(
            options=list(KINDS),
            value=chosen.kind,
            label="",
            description="What the pictures show, on one scale for all methods.",
            size="small",
            width=345,
            margin=0,
        )
        self.kind.param.watch(lambda event: self._change_kind(event.new), "value")
        self._bar = pmui.LinearProgress(
            variant="determinate", value=0, width=160, margin=(14, 0), visible=False
        )
        self.status = Sentence(live=True, margin=(8, 0, 0, 0))
        self._stop = pmui.Button(
            label="Cancel", size="small", variant="outlined", margin=0, visible=False
        )
        self._stop.on_click(lambda _: self._toggle_stopped())

    def _make_views(self) -> None:
        self.pictures: list[Picture] = []
        self._buttons: list[Download] = []
        self._keys = PixelKeys(
            label="Pictures of the methods. Arrow keys move the pixel, with Shift by eight.",
            width=0,
            height=0,
            margin=0,
            styles={"position": "absolute"},
        )
        self._keys.param.watch(lambda event: self.session.choose_pixel(*event.new), "pixel")
        self._grid = pn.Column(self._keys, sizing_mode="stretch_width", margin=0)
        self._scale = ScaleBar()
        self.legend = legend_line()
        self.remarks = Sentence(sizing_mode="stretch_width", margin=(2, 0))
        self._curves = CurvePlot()
        self._zoom = EchoZoom(self._curves.plot.figure.x_range)
        self._facts = Facts(sizing_mode="stretch_width")
        self._reliability = ReliabilityPlot()
        self._reliability.pane.object.min_border_top = CORNER_PX
        self._reliability_card = card(self._reliability.pane)
        self._painted = [self._scale, self._reliability, self._curves]
        self.table = Table(title=text.TABLE, sizing_mode="stretch_width", margin=(6, 0))

    def layout(self) -> tuple[Any, Any]:
        """Return pictures, plots and table, and the controls."""
        head = pn.Row(
            self.kind,
            self._bar,
            self.status,
            self._stop,
            stylesheets=[HEAD],
            sizing_mode="stretch_width",
            margin=(4, 0),
        )
        self.offer_plot(
            self._reliability_card, "reliability", self._reliability.plot, "reliability"
        )
        plots = pn.Column(
            self.offer(card(self._curves.pane, self._zoom.button), "scores", self._curves_shown),
            self._reliability_card,
            stylesheets=[PLOTS],
            sizing_mode="stretch_width",
            height=290,
        )
        main = [
            head,
            self._grid,
            self._scale.pane,
            self.legend,
            self._viewing.controls["least_confidence"],
            self.remarks,
            self.offer_facts(self._facts, lambda: f"numbers {pixel_on_show(self.session)}"),
            plots,
            self.offer_table(self.table, "methods"),
        ]
        return main, [
            part("Methods", self.picks, self._false_alarm, judge_choice(self.session.state)),
            *self._folds.values(),
            part("View", self._viewing.without("least_confidence"), is_open=False),
        ]

    # Notifications

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        self.is_on_screen = is_on_screen
        if is_on_screen:
            self._show_controls()  # another page may have changed the state
            self.refresh()

    def follow(self, answer: Answer) -> None:
        """Show another estimate of the session."""
        if self.is_on_screen:
            self._show_controls()
            self.refresh()

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        with self.session.tasks.hold():
            super().paint(dark)
            for picture in self.pictures:
                self._paint_picture(picture)
            self._draw_figures()
            self._choose_pixel()

    def _show_controls(self) -> None:
        chosen = self._chosen
        for method, panel in self.panels.items():
            panel.show(self.session.state.settings[method])
            panel.mark_doubts(doubts_hold(self.session.answer.capture))
        self._viewing.show(chosen.viewing)
        self._false_alarm.value = chosen.false_alarm
        if chosen.kind in self.kind.options:
            self.kind.value = chosen.kind
        if set(self.picks.value) != set(chosen.methods):
            self.picks.value = list(chosen.methods)

    # Actions of the user

    @property
    def _chosen(self) -> Comparison:
        chosen: Comparison = self.session.state.comparison
        return chosen

    def _choose(self, **changes: Any) -> None:
        self.session.state.comparison = replace(self._chosen, **changes)
        self.refresh()

    def _set(self, method: str, settings: Any) -> None:
        state = self.session.state
        state.settings = {**state.settings, method: settings}

    def _picked(self) -> None:
        picked = tuple(each for each in ESTIMATORS if each in self.picks.value)
        chosen = replace(self._chosen, methods=picked)
        tasks = tasks_of(chosen, self.session.answer.request).values()
        self.results = {  # a failed method runs again when it is picked again
            task: result
            for task, result in self.results.items()
            if isinstance(result, Result) or task in tasks
        }
        self._is_stopped = False
        self._choose(methods=picked)

    def _change_kind(self, kind: str) -> None:
        self.session.state.comparison = replace(self._chosen, kind=kind)
        self._draw_pictures()

    def _change_view(self, viewing: Viewing) -> None:
        self.session.state.comparison = replace(self._chosen, viewing=viewing)
        self._draw_pictures()

    def _toggle_stopped(self) -> None:
        self._is_stopped = not self._is_stopped
        self._continue()

    def _choose_pixel(self) -> None:
        # The pixel of a new capture is chosen before its estimate is announced, which draws it too.
        if self.is_on_screen and self.session.answer.capture is self._capture:
            self._mark_pixel()
            self.request_curves()

    # Computation

    @property
    def tasks(self) -> dict[str, Task]:
        """The picked methods, in the order of the registry."""
        return tasks_of(self._chosen, self.session.answer.request)

    @property
    def answers(self) -> dict[str, Answer]:
        """The estimates so far, by method."""
        found = {method: self.results.get(task) for method, task in self.tasks.items()}
        return {m: each.answer for m, each in found.items() if isinstance(each, Result)}

    @property
    def pictured(self) -> list[str]:
        """Methods that have a picture: the first ones that have not failed."""
        working = [m for m, t in self.tasks.items() if not isinstance(self.results.get(t), str)]
        return working[:MAX_PICTURES]

    @property
    def is_complete(self) -> bool:
        """Whether all that was picked has been computed."""
        done = all(task in self.results for task in self.tasks.values())
        return done and self.reference is not None

    def refresh(self) -> None:
        """Show what is known of the present capture, and compute the rest."""
        if not self.is_on_screen:
            return
        if self.session.answer.capture is not self._capture:
            self._enter()
        tasks = self.tasks
        for method, fold in self._folds.items():
            fold.visible = method in tasks
        self._draw_all()

    def _enter(self) -> None:
        """Begin with another capture."""
        session = self.session
        self._capture = session.answer.capture
        self.results, self.reference, self._is_stopped = {}, None, False
        self.remarks.text = ""
        self._keys.shape = list(self._capture.shape)
        has_truth = self._capture.truth_range_m is not None
        kinds = [kind for kind in KINDS if has_truth or kind != "Error"]
        if self.kind.value not in kinds:
            self.kind.value = "Range"
        self.kind.options = kinds
        self._reliability_card.visible = has_truth  # a reliability diagram requires the truth
        if session.scene_id() != self._scene_id:
            self._scene_id = session.scene_id()
            self._viewing.show(self._chosen.viewing)
            show_own_width(self._viewing, session.answer)
            cloud, _, wrong, _ = cloud_of(session.answer, "Range", session.state.viewing)
            self._bounds = view_bounds(cloud, None if wrong is None else ~wrong)
        for picture in self.pictures:
            picture.enter(*self._capture.shape, session.answer.grid)

    def _continue(self) -> None:
        """Compute the next missing result, unless something is running or stopped."""
        missing = [task for task in self.tasks.values() if task not in self.results]
        page = self.session.tasks
        if not (self._is_busy or self._is_stopped or not self.is_on_screen):
            if page.is_away:
                page.call_later(RETURN_MS, partial(page.queue, self._continue))
            elif missing:
                self._run(partial(run_task, missing[0], self.session.answer), missing[0])
            elif self.reference is None:
                self._run(partial(reference_of, self._capture), None)
        self._show_progress(missing)

    def _run(self, work: Callable[[], Any], task: Task | None) -> None:
        self._is_busy = True
        arrived = partial(self._arrived, self._capture, task)
        self._method_jobs.submit(work, arrived, arrived)

    def _arrived(self, capture: Capture, task: Task | None, result: Any) -> None:
        """Keep and show a result, or why there is none, and continue."""
        self._is_busy = False
        failed = isinstance(result, Exception)
        if failed and not isinstance(result, ValueError):
            log.warning("a method failed", exc_info=result)
        if capture is self._capture:
            if task is not None:
                self.results[task] = text.failure(result) if failed else result
            elif failed:
                self.reference = Reference(None, None, text.no_reference(result))
            else:
                self.reference = result
        if self.is_on_screen:
            self._draw_all()

    def request_curves(self) -> None:
        """Compute the scores of the chosen pixel."""
        answers, pixel = self.answers, self.session.state.pixel
        tasks = {method: task for method, task in self.tasks.items() if method in answers}
        self.submit(
            partial(score_curves, self._capture, tasks, *pixel),
            partial(self._draw_curves, answers, pixel),
        )

    # Downloads

    def about(self) -> Subject:
        """Return what files about all methods are about."""
        answer = self.session.answer
        methods = {
            method: f"{task.settings}, false alarms {task.false_alarm:g}"
            for method, task in self.tasks.items()
        }
        subject = looked_at(self.session, answer.request)
        return replace(subject, source=answer.capture.source, methods=methods)

    def picture_shown(self, place: int) -> Shown:
        """Return the picture at a place, as it is saved."""
        method = self.pictured[place]
        answer = self.answers.get(method)
        if answer is None:
            raise ValueError(NOTHING_DRAWN)
        kind, viewing = self.kind.value, self._chosen.viewing
        image_kind = IMAGE_KINDS.get(kind, kind)
        _, look = image_of(self.session.answer, image_kind, viewing)
        if kind == CLOUDS:
            what, files = "cloud", cloud_files(answer, "Range", viewing)
        else:
            figure = self.pictures[place].image.figure
            files = image_files(answer, image_kind, viewing, figure, look, method_title(method))
            what = f"{kind} image"
        subject = ranged(self.session, answer, method, self.tasks[method].settings)
        subject = viewed(self.session, subject, viewing)
        return Shown(subject, what.lower(), files, method_title(method), look)

    def _curves_shown(self) -> Shown:
        return self.saved(f"scores {pixel_on_show(self.session)}", self._curves.plot.csv())

    # Drawing

    def _draw_all(self) -> None:
        with self.session.tasks.hold():
            self._draw_pictures()
            self._draw_figures()
            self._choose_pixel()
            self._continue()

    def _show_progress(self, missing: list[Task]) -> None:
        total, done = len(self.tasks), len(self.tasks) - len(missing)
        is_running = self._is_busy and bool(missing)
        running = missing[0].method if is_running else None
        n_failed = sum(isinstance(self.results.get(each), str) for each in self.tasks.values())
        self.status.text = text.progress(done, total, running, n_failed)
        for picture, method in zip(self.pictures, self.pictured, strict=False):
            if self.tasks[method] in missing:
                picture.caption.text = text.waiting(method, running)
        self._bar.param.update(value=100 * done // max(total, 1), visible=is_running)
        self._stop.param.update(
            label="Resume" if self._is_stopped else "Cancel", visible=bool(missing)
        )

    def _styles(self) -> dict[str, Style]:
        colors = palette(self.is_dark)
        return {method: method_style(method, colors) for method in self.tasks}

    def _draw_pictures(self) -> None:
        answers, methods, is_clouds = self.answers, self.pictured, self.kind.value == CLOUDS
        viewing = self._chosen.viewing
        image_kind = IMAGE_KINDS.get(self.kind.value, self.kind.value)
        with self.session.tasks.hold():
            columns = max(min(len(methods), CLOUDS_IN_A_ROW if is_clouds else MAX_PICTURES), 1)
            few, fewest = (1, 1) if is_clouds else (min(columns, 3), 2)
            self._grid.stylesheets = [GRID.format(columns=columns, few=few, fewest=fewest)]
            _, look = image_of(self.session.answer, image_kind, viewing)
            self._scale.update(look)
            self._make_pictures(len(methods))
            drawn = zip(self.pictures, self._buttons, methods, strict=False)
            found = {}
            for picture, button, method in drawn:
                picture.title.text = button.what = method_title(method)
                button.offer(CLOUD if is_clouds else IMAGE)
                picture.dim(method not in answers)
                picture.resize(CLOUD_HEIGHT if is_clouds else IMAGE_HEIGHT)
                if method not in answers:
                    continue
                answer = answers[method]
                if is_clouds:
                    self._draw_cloud(picture, method, answer)
                    found[method] = Unseen(n_hidden=n_below(answer, viewing.least_confidence))
                else:
                    values, _ = image_of(answer, image_kind, viewing)
                    picture.draw_image(values, look)
                    found[method] = unseen(answer, image_kind, viewing, values, look)
            self.legend.text = text.legend(found, viewing.least_confidence)

    def _draw_cloud(self, picture: Picture, method: str, answer: Answer) -> None:
        cloud, rgb, wrong, _ = cloud_of(answer, "Range", self._chosen.viewing)
        view = picture.show_cloud(self.is_dark)
        view.label = f"Point cloud: {method_title(method)}. Arrow keys turn all clouds together."
        view.draw(cloud, rgb, wrong, scene_id=self._scene_id, bounds=self._bounds)

    def _make_pictures(self, count: int) -> None:
        """Show this many pictures; each is built once."""
        while len(self.pictures) < count:
            picture = Picture(self.session.choose_pixel, self.session.pick, IMAGE_HEIGHT)
            show = partial(self.picture_shown, len(self.pictures))
            button = Download(self.session, "picture", show, IMAGE)
            picture.card.append(button)
            self.pictures.append(picture)
            self._buttons.append(button)
            picture.image.join(self.pictures[0].image)
            picture.enter(*self._capture.shape, self.session.answer.grid)
            self._paint_picture(picture)
        cards = [*(picture.card for picture in self.pictures[:count]), self._keys]
        if cards != self._grid.objects:
            self._grid.objects = cards

    def _paint_picture(self, picture: Picture) -> None:
        picture.image.paint(palette(self.is_dark))
        if picture.cloud is not None:
            picture.cloud.dark = self.is_dark

    def _draw_figures(self) -> None:
        """Draw table, reliability diagram and remarks."""
        tasks, capture, styles = self.tasks, self._capture, self._styles()
        found = {method: self.results.get(task) for method, task in tasks.items()}
        self.table.param.update(
            columns=text.columns(capture),
            rows=text.rows(capture, tasks, self.results, self.reference, styles),
        )
        lines = {
            method: (each.accuracy.confidence, each.accuracy.correct)
            for method, each in found.items()
            if isinstance(each, Result) and each.accuracy is not None
        }
        self._reliability.update(lines, styles)
        if has_fit(capture):
            working = [
                task for task in tasks.values() if not isinstance(self.results.get(task), str)
            ]
            self.remarks.text = text.remarks(capture, working, len(self.pictured))

    def _mark_pixel(self) -> None:
        row, col = self.session.state.pixel
        answers = self.answers
        with self.session.tasks.hold():
            self._keys.pixel = [row, col]
            self._facts.facts = text.pixel_facts(self.session.answer, self.reference, row, col)
            for picture, method in zip(self.pictures, self.pictured, strict=False):
                picture.image.mark(row, col)
                answer = answers.get(method)
                if answer is not None:
                    picture.caption.text = text.caption(answer, row, col)
                if picture.cloud is not None:
                    picture.cloud.selected = row * self._capture.shape[1] + col

    def _draw_curves(
        self, answers: Mapping[str, Answer], pixel: tuple[int, int], curves: dict[str, Any]
    ) -> None:
        answers = {method: each for method, each in answers.items() if method in self.tasks}
        if pixel != self.session.state.pixel or not answers:
            return  # outdated
        answer = next(iter(answers.values()))
        acquisition, truth_m = answer.capture.acquisition, answer.capture.truth_range_m
        truth = np.nan if truth_m is None else float(truth_m[pixel])
        estimates = {m: float(each.run.image.bin[pixel]) for m, each in answers.items()}
        known = [each for each in estimates.values() if not np.isnan(each)]
        # Not to all: estimates of a method that fails may lie far off.
        self._zoom.follow(answer.capture, median_low(known or [np.nan]))
        self._curves.update(
            {method: curve for method, curve in curves.items() if method in answers},
            estimates,
            float(acquisition.range_m_to_bin(truth)),
            answer.gate,
            self._styles(),
            self.session.state.unit,
        )


PAGE = Page(
    "Compare",
    Compare,
    "shows methods side by side",
    text.EXPLANATION,
    shared=frozenset({Shared.UNIT, Shared.TRACKING, Shared.REDUCTION}),
)
