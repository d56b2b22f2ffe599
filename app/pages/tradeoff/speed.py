"""The study of accuracy against computing time; a point opens on the page that it belongs to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import panel as pn
from numpy.typing import NDArray

from app.model.budget import fits, require_fitting
from app.model.download_text import NOTHING_DRAWN
from app.model.exports import table_file
from app.model.methods import METHOD_PLACES, method_style
from app.model.restore import parameters_of
from app.model.state import ALL_RETURNS, MOST_PROBABLE, ReductionSettings
from app.model.store import Answer, Request, same_capture
from app.pages.session import Session
from app.pages.shared.downloads import TABLE, Shown, Subject, below, looked_at
from app.pages.shared.outputs import layers_of, spelled
from app.pages.shared.section import Repetitions, SettingsSection
from app.pages.shared.studies import OnePiece
from app.pages.tradeoff import text
from app.plots import elements as plots
from app.tasks.scheduler import Work
from app.theme import LIGHT, palette
from app.widgets.cards import BREAK_PX, card, part, unrolled
from app.widgets.controls import Sentence, SettingsPanel, Table
from app.widgets.figures import paint_frame, pane_of
from core.cost import predicted
from core.metrics import Interval
from core.parameters import Choice, Number, Settings, parameter
from core.studies.tradeoff import (
    Candidate,
    Point,
    Simulation,
    Source,
    best_within,
    candidates,
    cheapest_reaching,
    including_flux_time,
    pareto_front,
    points_table,
    study,
)
from core.studies.trials import Method, default_methods

Array = NDArray[Any]

PLOT_HEIGHT = 430
ANY_MERGE, NO_MERGE = "1, 2 and 4", "none"


@dataclass(frozen=True)
class Effort(Repetitions):
    """Amount of measurement; by default the least, with which the page starts."""

    repeats: int = parameter(
        6, Number("Timing rounds", 6, 50, log=True, whole=True, least=6), text.REPEATS_HELP
    )
    merges: str = parameter(
        NO_MERGE, Choice("Bins merged", (NO_MERGE, ANY_MERGE)), text.MERGES_HELP
    )


@dataclass(frozen=True)
class Goal(Settings):
    """Targets that a configuration has to reach."""

    milliseconds: float = parameter(
        10.0,
        Number("Time per image", 0.1, 1e4, log=True, least=0.0, open_below=True, unit="ms"),
        text.TIME_HELP,
    )
    rd: float = parameter(
        0.95,
        Number("Within 3 bins", 0.01, 1.0, least=0.0, most=1.0, open_below=True),
        text.RD_HELP,
    )
    flux: str = parameter(
        "excluded", Choice("Flux estimation", ("excluded", "included")), text.FLUX_HELP
    )


class SpeedSection(SettingsSection[Effort]):
    """Computing time and accuracy of each method, with and without merged bins.

    A small measurement starts when it first comes on screen.

    Parameters
    ----------
    session : Session
        The session whose scene or capture is measured, with its flux and its settings of the
        tracking differentiator.

    Attributes
    ----------
    measured : list of Point
        The points that are shown.
    goal : SettingsPanel
    study : OnePiece
    subject : Sentence
        What was measured.
    advice : list of Sentence
        Most accurate point within the time; fastest point of the accuracy.
    plot : Layers
    table : Table
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, Effort(), text.EXPLANATION)
        self.measured: list[Point] = []
        self._measured_on = self._tried = session.answer.request
        self._effort = self.settings
        self._colors = LIGHT
        self._goal = Goal()
        self.goal = SettingsPanel(self._goal, self._goal_changed)
        self.study = OnePiece(session, self.work, self.draw, "images", failed=self._describe)
        self.subject, *self.advice = (
            Sentence(live=True, sizing_mode="stretch_width", margin=(4, 8)) for _ in range(3)
        )
        # Beside the sidebar, which is closed on a phone.
        self._progress = Sentence(sizing_mode="stretch_width", margin=(4, 8))
        self.study.sentence.link(self._progress, text="text")
        self._results = pn.Column(visible=False, sizing_mode="stretch_width", margin=0)
        self.plot = layers_of(plots.tradeoff(self._colors))
        self.plot.source("points").selected.on_change("indices", self._tapped)
        self.table = Table(title=text.TITLE, sizing_mode="stretch_width", margin=(6, 0))
        self.table.param.watch(lambda event: self._open(event.new[0]), "acted")

    def layout(self) -> tuple[Any, Any]:
        """Return sentences, plot and table, and the controls."""
        plot = pn.Column(
            self.offer(card(pane_of(self.plot.figure)), "plot", self._shown),
            stylesheets=[unrolled(BREAK_PX)],
            sizing_mode="stretch_width",
            height=PLOT_HEIGHT,
            margin=0,
        )
        self._results[:] = [plot, self.offer(below(self.table), "table", self._shown, TABLE)]
        controls = [
            part("Goal", self.goal.layout),
            part("Measurement", self.controls(*self.study.controls)),
        ]
        return [self.subject, self._progress, *self.advice, self._results], controls

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        super().show(is_on_screen)
        self._start_first()

    def about(self) -> Subject:
        """Return what the section's files are about."""
        return looked_at(self.session, self._measured_on)

    def _shown(self) -> Shown:
        if not self.measured:
            raise ValueError(NOTHING_DRAWN)
        return self.saved("speed and accuracy", table_file(points_table(self.measured)))

    def follow(self, answer: Answer) -> None:
        """Show another estimate; a first measurement that failed starts on another capture."""
        self._start_first()

    def _start_first(self) -> None:
        if not same_capture(self.session.answer.request, self._tried):
            self.study.retry()
        self._describe()
        self.study.show(self.is_on_screen)

    def _describe(self) -> None:
        """State what was measured and whether it is outdated, or what happens before that."""
        if self.measured:
            is_present = same_capture(self.session.answer.request, self._measured_on)
            effort = self._effort.repetitions, self._effort.repeats
            self.subject.text = text.subject(self.measured[0], *effort, is_present)
        else:
            self.subject.text = text.FAILED if self.study.has_failed else text.NOT_MEASURED

    def paint(self, dark: bool) -> None:
        """Change between light and dark mode."""
        self._colors = palette(dark)
        paint_frame(self.plot.figure, self._colors)
        plots.paint_tradeoff(self.plot.figure, self._colors)
        self._redraw()

    def _goal_changed(self, goal: Goal) -> None:
        self._goal = goal
        self._redraw()

    def _tapped(self, _name: str, _old: Any, chosen: Sequence[int]) -> None:
        if chosen:
            self.plot.source("points").selected.indices = []  # so that it can be tapped again
            self._open(chosen[0])

    def _open(self, key: int) -> None:
        show_point(self.session, self.measured[key], self._measured_on)

    # Measurement

    def work(self) -> Work[tuple[Request, Effort, list[Point]]]:
        """Return the measurement of the present scene or capture."""
        answer, effort = self.session.answer, self.settings
        self._tried = answer.request
        self._describe()
        source = source_of(answer)
        merges = (1, 2, 4) if effort.merges == ANY_MERGE else (1,)
        chosen = candidates(methods(answer), merges)

        def work(progress: Callable[[int, int], None]) -> tuple[Request, Effort, list[Point]]:
            points = study(
                [(source, affordable(source, chosen))],
                seeds=range(effort.repetitions),
                repeats=effort.repeats,
                progress=progress,
            )
            return answer.request, effort, points

        return work

    def draw(self, found: tuple[Request, Effort, list[Point]]) -> None:
        """Show measured points, with the request and the effort that they belong to."""
        self._measured_on, self._effort, self.measured = found
        self._results.visible, self._progress.visible = True, False
        self._describe()
        self._redraw()

    def _redraw(self) -> None:
        if not self.measured:
            return
        goal = self._goal
        points = including_flux_time(self.measured) if goal.flux == "included" else self.measured
        pareto = pareto_front(points)
        best = best_within(points, goal.milliseconds)
        cheapest = cheapest_reaching(points, goal.rd)
        with self.session.tasks.hold():
            self._draw_points(points, pareto)
            chosen = [found.point for found in (best, cheapest) if found is not None]
            self.plot.source("chosen").data = _line(chosen)
            plots.show_goals(self.plot.figure, goal.milliseconds, goal.rd)
            advice = text.advice(goal.milliseconds, goal.rd, best, cheapest)
            for sentence, line in zip(self.advice, advice, strict=True):
                sentence.text = line
            self.table.param.update(
                columns=[list(column) for column in text.COLUMNS],
                rows=text.rows(points, pareto),
            )

    def _draw_points(self, points: Sequence[Point], pareto: Sequence[Point]) -> None:
        methods = [point.candidate.method.estimator for point in points]
        color = [method_style(method, self._colors)[0] for method in methods]
        markers = [plots.MARKERS[METHOD_PLACES[m] // len(self._colors.methods)] for m in methods]
        ms = _ends([point.milliseconds for point in points])
        errors = _error_rates(points)
        self.plot.source("points").data = {
            "x": ms["value"],
            "y": errors["value"],
            "color": color,
            "marker": markers,
            "method": [spelled(method) for method in methods],
            "way": [text.name_of(point.candidate) for point in points],
            "tip": [text.tip(point) for point in points],
        }
        self.plot.source("times").data = {
            "x0": ms["low"],
            "x1": ms["high"],
            "y0": errors["value"],
            "y1": errors["value"],
            "color": color,
        }
        self.plot.source("degrees").data = {
            "x0": ms["value"],
            "x1": ms["value"],
            "y0": errors["low"],
            "y1": errors["high"],
            "color": color,
        }
        self.plot.source("front").data = _line(pareto)


def show_point(session: Session, point: Point, measured_on: Request) -> None:
    """Show a measured configuration on Explore."""
    state, candidate = session.state, point.candidate
    method, settings = candidate.method.estimator, candidate.settings
    reduction = ReductionSettings.of(candidate.reduction, point.shape[2])
    kept: dict[str, Any] = {"tracking": state.tracking, "settings": state.settings}
    kept["returns"] = MOST_PROBABLE if candidate.returns == 1 else ALL_RETURNS
    request = replace(measured_on, reduction=reduction, method=method, **kept).with_settings(
        settings
    )
    state.param.update(page="Explore", **parameters_of(request, session.sources))


def _ends(intervals: Sequence[Interval]) -> dict[str, Array]:
    names = ("value", "low", "high")
    return {name: np.array([getattr(each, name) for each in intervals]) for name in names}


def _error_rates(points: Sequence[Point]) -> dict[str, Array]:
    """Return shares not within 3 bins, at least half a target for the logarithmic axis."""
    least = [0.5 / sum(score.targets for score in point.scores) for point in points]
    rd = _ends([point.rd() for point in points])
    return {name: np.maximum(1 - degree, least) for name, degree in rd.items()}


def _line(points: Sequence[Point]) -> dict[str, Any]:
    x = [point.milliseconds.value for point in points]
    return {"x": x, "y": _error_rates(points)["value"]}


def source_of(answer: Answer) -> Source:
    """Return a scene to be simulated again, or the whole capture of a file."""
    request = answer.request
    if request.source.scene is None:
        return answer.whole
    scene, light = request.scene, request.illumination
    acquisition = light.acquisition(scene.acquisition)
    return Simulation(request.source.title, scene, acquisition, light.flux)


def affordable(source: Source, chosen: Sequence[Candidate]) -> list[Candidate]:
    """Return the configurations that one request may run; all of them for a scene.

    Raises
    ------
    ValueError
        If the likelihood exceeds the limits, which a simulation like the capture needs.
    """
    if isinstance(source, Simulation):
        return list(chosen)
    rows, cols, n_bins = source.cube.shape
    shape = (rows, cols, n_bins)
    require_fitting(shape, "likelihood", predicted(shape, "likelihood"))
    return [
        each
        for each in chosen
        if fits(predicted(each.reduction.shape(shape), each.method.estimator, each.settings))
    ]


def methods(answer: Answer) -> list[Method]:
    """Return all methods with their defaults, tracking with the settings of the session."""
    tracking = Method("tracking", "tracking", answer.request.tracking)
    known = default_methods(with_motion=answer.whole.groups is not None)
    return [tracking if each.name == "tracking" else each for each in known]
