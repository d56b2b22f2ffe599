"""The page that measures speed against accuracy, and opens what it recommends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import panel as pn
from numpy.typing import NDArray

from app.model.budget import fits, require_fitting
from app.model.download_text import NOTHING_DRAWN
from app.model.exports import table_file
from app.model.restore import parameters_of
from app.model.state import Less
from app.model.store import Answer, Request, bare, same_capture
from app.pages.navigation import Page, Pages, Shared, View
from app.pages.session import Session
from app.pages.shared.downloads import PLOT, TABLE, Shown, Subject, below, downloadable, looked_at
from app.pages.shared.outputs import CurveCard, TableCard, layers_of, spelled
from app.pages.shared.studies import OnePiece, aside
from app.pages.tradeoff import text as trade_words
from app.pages.tradeoff.ablation import Requires
from app.pages.tradeoff.sensitivity import Trust
from app.plots import elements as plots
from app.tasks.scheduler import Work
from app.theme import LIGHT, method_style, palette
from app.widgets.cards import card, part
from app.widgets.controls import Sentence, SettingsPanel, Table
from app.widgets.figures import paint_frame, pane_of
from core import ESTIMATORS
from core.cost import predicted
from core.metrics import Interval
from core.parameters import Choice, Number, check_fields, parameter
from core.studies.tradeoff import (
    Cancelled,
    Candidate,
    Point,
    Simulation,
    Source,
    acquired,
    acquiring_items,
    best_within,
    candidates,
    cheapest_reaching,
    front,
    like,
    points_table,
    study,
    with_light,
)
from core.studies.trials import Method, as_they_come

Array = NDArray[Any]

PLOT_HEIGHT = 430
WHOLE = ":host { height: auto !important; flex: none !important; }"
CURVES = """
:host { display: grid !important; gap: 8px; flex: none !important; height: 668px !important;
  grid-template: repeat(2, 330px) / repeat(2, minmax(0, 1fr)); }
@media (max-width: 900px) {
  :host { grid-template: repeat(3, 330px) / minmax(0, 1fr); height: 1006px !important; }
}
"""
ANY_MERGE = "1, 2 and 4"


@dataclass(frozen=True)
class Effort:
    """How much is measured."""

    repetitions: int = parameter(
        4, Number("Repetitions", 2, 50, log=True, whole=True, least=2), trade_words.REPETITIONS_HELP
    )
    repeats: int = parameter(
        7,
        Number("Rounds of timing", 6, 50, log=True, whole=True, least=6),
        trade_words.REPEATS_HELP,
    )
    merges: str = parameter(
        ANY_MERGE, Choice("Bins merged", (ANY_MERGE, "none")), trade_words.MERGES_HELP
    )

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Wanted:
    """What is asked of a way to range."""

    milliseconds: float = parameter(
        10.0,
        Number("Time for an image", 0.1, 1e4, log=True, least=0.0, open_below=True, unit="ms"),
        trade_words.TIME_HELP,
    )
    rd: float = parameter(
        0.95,
        Number("Share right", 0.01, 1.0, least=0.0, most=1.0, open_below=True),
        trade_words.RD_HELP,
    )
    light: str = parameter(
        "left out", Choice("Finding the light", ("left out", "counted in")), trade_words.LIGHT_HELP
    )

    def __post_init__(self) -> None:
        check_fields(self)


class Tradeoff:
    """The page, in parts.

    Parameters
    ----------
    session : Session
    """

    def __init__(self, session: Session) -> None:
        open_point = partial(show_point, session)
        self._sections = Pages(
            {
                "Speed against accuracy": lambda: Ways(session, open_point).view,
                "How to acquire": lambda: Acquisition(session).view,
                "What the model needs": lambda: Requires(session).view,
                "How far to trust": lambda: Trust(session).view,
            },
            label="Part of the trade",
            help=trade_words.SECTIONS_HELP,
        )

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


class Ways:
    """What each way to range costs, and how often it is right.

    Parameters
    ----------
    session : Session
        Whose scene or capture is measured, in its present light and with its settings of the
        tracking differentiator.
    open_point : callable
        Shows a way to range, and what it was measured on, on the page that it belongs to.
    """

    def __init__(self, session: Session, open_point: Callable[[Point, Request], None]) -> None:
        self._session = session
        self._open_point = open_point
        self._effort, self._wanted = Effort(), Wanted()
        self._measured: list[Point] = []
        self._asked = self._of = session.answer.request
        self._colors = LIGHT
        self._study = OnePiece(session, self._work, self._arrived, "images")
        self._effort_panel = SettingsPanel(self._effort, self._effort_changed)
        self._wanted_panel = SettingsPanel(self._wanted, self._wanted_changed)
        self._subject = Sentence(live=True, sizing_mode="stretch_width", margin=(4, 8))
        self._advice = [
            Sentence(live=True, sizing_mode="stretch_width", margin=(4, 8)) for _ in range(2)
        ]
        self._plot = layers_of(plots.tradeoff(self._colors))
        self._plot.source("points").selected.on_change("indices", self._tapped)
        self._table = Table(title=trade_words.TITLE, sizing_mode="stretch_width", margin=(6, 0))
        self._table.param.watch(lambda event: self._open(event.new[0]), "acted")
        self._subject.text = trade_words.WAITING

    @property
    def view(self) -> View:
        """The page, for the navigation."""
        holder = pn.Column(
            downloadable(
                card(pane_of(self._plot.figure)), self._session, "plot", self._shown, PLOT
            ),
            sizing_mode="stretch_width",
            height=PLOT_HEIGHT,
            margin=0,
        )
        table = downloadable(below(self._table), self._session, "table", self._shown, TABLE)
        main = [self._subject, *self._advice, holder, table]
        controls = [
            part("What is asked", self._wanted_panel.layout),
            part(
                "What is measured",
                aside(
                    trade_words.EXPLANATION,
                    self._effort_panel.layout,
                    *self._study.controls,
                ),
            ),
        ]
        return View(main, controls, follow=self._follow, paint=self._paint)

    # What the app and the user tell the page

    def _follow(self, answer: Answer) -> None:
        if self._measured:
            self._subject.text = trade_words.subject(
                self._measured[0], is_present=same_capture(answer.request, self._of)
            )

    def _paint(self, dark: bool) -> None:
        self._colors = palette(dark)
        paint_frame(self._plot.figure, self._colors)
        plots.paint_tradeoff(self._plot.figure, self._colors)
        self._draw()

    def _effort_changed(self, effort: Effort) -> None:
        self._effort = effort

    def _wanted_changed(self, wanted: Wanted) -> None:
        self._wanted = wanted
        self._draw()

    def _tapped(self, _name: str, _old: Any, chosen: Sequence[int]) -> None:
        if chosen:
            self._plot.source("points").selected.indices = []  # it can be tapped again
            self._open(chosen[0])

    def _open(self, key: int) -> None:
        self._open_point(self._measured[key], self._of)

    def _shown(self) -> Shown:
        """The plot, and everything that was measured."""
        if not self._measured:
            raise ValueError(NOTHING_DRAWN)
        files = {"csv": table_file(points_table(self._measured))}
        return Shown(looked_at(self._session, self._of), "speed against accuracy", files)

    # What is measured and drawn

    def _work(self) -> Work[list[Point]]:
        merges = (1, 2, 4) if self._effort.merges == ANY_MERGE else (1,)
        ways = candidates(methods(self._session.answer), merges)
        source, effort = source_of(self._session.answer), self._effort
        self._asked = self._session.answer.request

        def work(
            progress: Callable[[int, int], None], cancelled: Callable[[], bool]
        ) -> list[Point]:
            return study(
                [(source, affordable(source, ways))],
                seeds=range(effort.repetitions),
                repeats=effort.repeats,
                progress=progress,
                cancelled=cancelled,
            )

        return work

    def _arrived(self, points: list[Point]) -> None:
        self._measured, self._of = points, self._asked
        self._follow(self._session.answer)
        self._draw()

    def _draw(self) -> None:
        """Points, front, table and advice, as far as there are any."""
        if not self._measured:
            return
        is_lit = self._wanted.light == "counted in"
        points = with_light(self._measured) if is_lit else self._measured
        unbeaten = front(points)
        best = best_within(points, self._wanted.milliseconds)
        cheapest = cheapest_reaching(points, self._wanted.rd)
        with pn.io.hold(self._session.page):
            self._draw_points(points, unbeaten)
            self._draw_choice([found.point for found in (best, cheapest) if found is not None])
            asked = self._wanted.milliseconds, self._wanted.rd
            texts = trade_words.advice(*asked, best, cheapest)
            for sentence, text in zip(self._advice, texts, strict=True):
                sentence.text = text
            self._table.param.update(
                columns=[list(column) for column in trade_words.COLUMNS],
                rows=trade_words.rows(points, unbeaten),
            )

    def _draw_points(self, points: Sequence[Point], unbeaten: Sequence[Point]) -> None:
        methods = list(ESTIMATORS)
        places = [methods.index(point.candidate.method.estimator) for point in points]
        color = [method_style(place, self._colors)[0] for place in places]
        shapes = [plots.MARKERS[place // len(self._colors.methods)] for place in places]
        ms = _ends([point.milliseconds for point in points])
        missed = _missed(points)
        self._plot.source("points").data = {
            "x": ms["value"],
            "y": missed["value"],
            "color": color,
            "marker": shapes,
            "method": [spelled(methods[place]) for place in places],
            "way": [trade_words.name_of(point.candidate) for point in points],
            "told": [trade_words.told(point) for point in points],
        }
        self._plot.source("times").data = {
            "x0": ms["low"],
            "x1": ms["high"],
            "y0": missed["value"],
            "y1": missed["value"],
            "color": color,
        }
        self._plot.source("degrees").data = {
            "x0": ms["value"],
            "x1": ms["value"],
            "y0": missed["low"],
            "y1": missed["high"],
            "color": color,
        }
        self._plot.source("front").data = {
            "x": [point.milliseconds.value for point in unbeaten],
            "y": _missed(unbeaten)["value"],
        }

    def _draw_choice(self, chosen: Sequence[Point]) -> None:
        self._plot.source("chosen").data = {
            "x": [point.milliseconds.value for point in chosen],
            "y": _missed(chosen)["value"],
        }
        plots.show_asked(self._plot.figure, self._wanted.milliseconds, self._wanted.rd)


@dataclass(frozen=True)
class Swept:
    """How much is simulated."""

    repetitions: int = parameter(
        2, Number("Repetitions", 2, 50, log=True, whole=True, least=2), trade_words.REPETITIONS_HELP
    )

    def __post_init__(self) -> None:
        check_fields(self)


class Acquisition:
    """How many pulses, how much light and how long a gate reach a restoration degree.

    Parameters
    ----------
    session : Session
        Whose scene, or a simulation like whose capture, is acquired in many ways.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._swept = Swept()
        self._panel = SettingsPanel(self._swept, self._changed)
        self._study = OnePiece(session, self._work, self._show, "captures")
        self._subject = Sentence(
            text=trade_words.ACQUIRING_WAITS, live=True, sizing_mode="stretch_width", margin=(4, 8)
        )
        self._cards = [CurveCard() for _ in range(3)]
        self._needed = TableCard(waiting="")
        self._of = session.answer.request
        for each in self._cards:
            each.offer(session, self._about)
        self._needed.offer(session, self._about)

    @property
    def view(self) -> View:
        """The curves and the table, and their controls."""
        curves = pn.Column(
            *(each.card for each in self._cards),
            sizing_mode="stretch_width",
            stylesheets=[CURVES],
            margin=0,
        )
        controls = aside(trade_words.ACQUIRING, self._panel.layout, *self._study.controls)
        return View(
            [self._subject, curves, self._needed.layout],
            part("What is simulated", controls),
            paint=self._paint,
        )

    def _about(self) -> Subject:
        return looked_at(self._session, self._of)

    def _changed(self, swept: Swept) -> None:
        self._swept = swept

    def _paint(self, dark: bool) -> None:
        for each in self._cards:
            each.paint(palette(dark))

    def _work(self) -> Work[tuple[str, list[Any]]]:
        source, repetitions = source_of(self._session.answer), self._swept.repetitions
        self._of = self._session.answer.request

        def work(
            progress: Callable[[int, int], None], cancelled: Callable[[], bool]
        ) -> tuple[str, list[Any]]:
            def told(done: int, of: int) -> None:
                if cancelled():
                    raise Cancelled
                progress(done, of)

            affordable(source, ())
            simulation = source if isinstance(source, Simulation) else like(source, source.source)
            found = acquired([simulation], range(repetitions), progress=told)
            return simulation.note, list(acquiring_items(found))

        return work

    def _show(self, found: tuple[str, list[Any]]) -> None:
        note, (*curves, needed) = found
        self._subject.text = note
        with pn.io.hold(self._session.page):
            for each, curve in zip(self._cards, curves, strict=True):
                each.show(curve)
            self._needed.show(needed)


def show_point(session: Session, point: Point, measured: Request) -> None:
    """Show a measured configuration: the paper's method on Explore, others on Compare."""
    state, candidate = session.state, point.candidate
    method, settings = candidate.method.estimator, candidate.settings
    request = replace(measured, less=Less.of(candidate.reduction, point.shape[2]))
    if method == "tracking":
        page, comparison = "Explore", state.comparison
        request = replace(request, tracking=settings)
    else:
        page, comparison = "Compare", state.comparison.including(method, settings)
        request = replace(request, tracking=state.tracking)
    asked = parameters_of(request, session.sources)
    state.param.update(comparison=comparison, page=page, **asked)


def _ends(intervals: Sequence[Interval]) -> dict[str, Array]:
    names = ("value", "low", "high")
    return {name: np.array([getattr(each, name) for each in intervals]) for name in names}


def _missed(points: Sequence[Point]) -> dict[str, Array]:
    """Shares not within 3 bins, kept above what a logarithm cannot show: half a target."""
    least = [0.5 / sum(score.targets for score in point.scores) for point in points]
    rd = _ends([point.rd() for point in points])
    return {name: np.maximum(1 - degree, least) for name, degree in rd.items()}


def source_of(answer: Answer) -> Source:
    """What an answer's page looks at, whole: a scene to be captured again, or the capture."""
    request = answer.request
    if request.source.scene is None:
        return answer.whole
    scene, light = bare(request.source.scene(), request.absent), request.light
    acquisition = light.acquisition(scene.acquisition)
    return Simulation(request.source.title, scene, acquisition, light.flux)


def affordable(source: Source, ways: Sequence[Candidate]) -> list[Candidate]:
    """The ways to range a capture that one request may take; all of them for a scene.

    Raises
    ------
    ValueError
        If not even the likelihood may, which a simulation like the capture rests on.
    """
    if isinstance(source, Simulation):
        return list(ways)
    rows, cols, n_bins = source.cube.shape
    shape = (rows, cols, n_bins)
    require_fitting(shape, "likelihood", predicted(shape, "likelihood"))
    return [
        way
        for way in ways
        if fits(predicted(way.reduction.shape(shape), way.method.estimator, way.settings))
    ]


def methods(answer: Answer) -> list[Method]:
    """Every method with its defaults, the tracking differentiator with the page's settings."""
    tracking = Method("tracking", "tracking", answer.request.tracking)
    return [tracking if each.name == "tracking" else each for each in as_they_come()]


PAGE = Page(
    "Trade-off",
    Tradeoff,
    "measures speed against accuracy",
    shared=frozenset({Shared.TRACKING}),
)
