"""The page that computes what the paper prints, at settings of one's own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Generic, TypeVar

import numpy as np
import panel as pn
from bokeh.models import Range1d

from app.model.text import NOT_COMPUTED
from app.pages.navigation import Page, Pages, View
from app.pages.paper import text as paper_words
from app.pages.session import Session
from app.pages.shared.downloads import Subject
from app.pages.shared.outputs import CurveCard, Gallery, TableCard
from app.pages.shared.studies import Study, aside
from app.tasks.scheduler import Step
from app.theme import palette
from app.widgets.controls import Sentence, SettingsPanel
from core import PRESETS, Flux
from core.parameters import Choice, Number, check_fields, parameter
from core.studies import outputs as items
from core.studies.paper import figures as paper
from core.studies.trials import Condition, Method, Results, trials

Settings = TypeVar("Settings")

PAPER = "paper"
"""What files are named after that hold something of it."""

# The paper's own method before those that bound it.
TABLE_2_METHODS = sorted(paper.TABLE_2_METHODS, key=lambda method: method.estimator != "tracking")

# The parts' buttons and controls on the left of what they control; above it on a phone.
BOARD = """
:host { display: grid !important; gap: 14px; align-items: start;
  grid-template-columns: 270px minmax(0, 1fr); flex: none !important; height: auto !important; }
.bk-panel-models-layout-Column { flex: none !important; height: auto !important; }
@media (max-width: 900px) {
  :host { display: flex !important; flex-direction: column; }
  .bk-panel-models-layout-Column { width: 100%; }
}
"""
STACK = """
:host { display: flex !important; flex-direction: column; gap: 8px;
  flex: none !important; max-height: none !important;
  height: max(640px, calc(100vh - 122px)) !important; }
@media (max-width: 900px) { :host { height: auto !important; } }
"""

_LIGHT = Number("SBR", 0.02, 0.2, log=True, least=0.0, open_below=True)
_PLACE = Number("Echo's bin", 20, 99, whole=True, least=0, most=99)
_PRESET = Choice("Preset", tuple(PRESETS))
_SBR_HELP = "Signal over background, both in photons per pulse. The paper has 0.03 to 0.08."


@dataclass(frozen=True)
class Jump:
    """Settings of Figures 1 and 2."""

    onset_bin: int = parameter(50, _PLACE, "Where the echo begins: 50 in the paper.")
    signal: float = parameter(
        paper.FIGURE_1.signal,
        Number("Signal", 0.01, 5.0, log=True, least=0.0, unit="photons per pulse"),
        "Photons of the echo, were the detector always armed: 0.5203 in the paper.",
    )
    sbr: float = parameter(0.08, _LIGHT, _SBR_HELP)

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Scales:
    """Settings of Figures 4 and 5."""

    onset_bin: int = parameter(50, _PLACE, "Where the target is: 20, 50 and 90 in Figure 4.")
    sbr: float = parameter(0.08, _LIGHT, _SBR_HELP)
    preset: str = parameter(
        "recommended", _PRESET, "The best on random depths, or the paper's text taken literally."
    )

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Weights:
    """Settings of Figure 6."""

    onset_bin: int = parameter(80, _PLACE, "Where the target is.")
    sbr: float = parameter(0.08, _LIGHT, _SBR_HELP)

    def __post_init__(self) -> None:
        check_fields(self)


_REPETITIONS = Number("Repetitions", 2, 100, log=True, whole=True, least=2)
_REPETITIONS_HELP = "Captures of the same scene with other noise: more make intervals narrower."


@dataclass(frozen=True)
class Repeated:
    """Settings of Table 2."""

    repetitions: int = parameter(5, _REPETITIONS, _REPETITIONS_HELP)

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class RepeatedAt:
    """Settings of Table 3."""

    sbr: float = parameter(0.06, _LIGHT, _SBR_HELP)
    repetitions: int = parameter(5, _REPETITIONS, _REPETITIONS_HELP)

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Images:
    """Settings of the range images."""

    figure: str = parameter(
        "Figure 8",
        Choice("Figure", ("Figure 8", "Figure 9", "Figure 12")),
        "8: the car under six SBRs. 9: the car by every method. 12: the building likewise.",
    )
    sbr: float = parameter(0.06, _LIGHT, "Of Figure 9. " + _SBR_HELP)

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Unsaid:
    """Settings of what the paper leaves unsaid."""

    sbr: float = parameter(0.06, _LIGHT, _SBR_HELP)

    def __post_init__(self) -> None:
        check_fields(self)


class Paper:
    """The page.

    Parameters
    ----------
    session : Session
        Whose page it is; its capture has no part in this.
    """

    def __init__(self, session: Session) -> None:
        self._sections = Pages(
            {
                "Figures 1, 2: the jump": lambda: (
                    Sliders(session, Jump(), paper_words.JUMP, jump, count=2).view
                ),
                "Figures 4, 5: two scales": lambda: (
                    Sliders(session, Scales(), paper_words.SCALES, two_scales, count=2).view
                ),
                "Figure 6: the weights": lambda: (
                    Sliders(session, Weights(), paper_words.WEIGHTS, weights, count=1).view
                ),
                "Table 2: six SBRs": lambda: (
                    Trials(
                        session,
                        Repeated(),
                        paper_words.TABLE_2,
                        lambda _: dict.fromkeys(paper.NEAR.values(), TABLE_2_METHODS),
                        lambda results, _: paper.table_2(results, TABLE_2_METHODS),
                    ).view
                ),
                "Table 3: all methods": lambda: (
                    Trials(
                        session,
                        RepeatedAt(),
                        paper_words.TABLE_3,
                        lambda chosen: {Condition("car", chosen.sbr): paper.COMPARED},
                        lambda results, chosen: paper.table_3(results, chosen.sbr),
                    ).view
                ),
                "Figures 8, 9, 12: images": lambda: RangeImages(session).view,
                "What is left unsaid": lambda: LeftUnsaid(session).view,
            },
            label="Part of the paper",
            help=paper_words.SECTIONS_HELP,
            orientation="vertical",
        )

    @property
    def view(self) -> View:
        """The page, for the navigation."""
        sections = self._sections
        left = pn.Column(
            sections.choice, *sections.asides.values(), sizing_mode="stretch_width", margin=0
        )
        right = pn.Column(*sections.mains.values(), sizing_mode="stretch_both", margin=0)
        return View(
            pn.Column(left, right, stylesheets=[BOARD], sizing_mode="stretch_both", margin=0),
            Sentence(text=paper_words.SIDEBAR_AWAY, margin=8),
            show=sections.show,
            paint=sections.paint,
        )


# What the sliders compute


def jump(chosen: Jump) -> list[items.Plot]:
    """Figures 1 and 2."""
    flux = Flux(chosen.signal, chosen.sbr)
    return [figure(flux, chosen.onset_bin) for figure in (paper.figure_1, paper.figure_2)]


# The curve is the same for all places of the target, and takes three times as long as the pixel.
_figure_5 = lru_cache(maxsize=64)(paper.figure_5)


def two_scales(chosen: Scales) -> list[items.Plot]:
    """One pixel of Figure 4, and Figure 5 with the pixel's place marked."""
    parameters, flux = PRESETS[chosen.preset], Flux(sbr=chosen.sbr)
    pixel = paper.figure_5_at(chosen.onset_bin, parameters, flux)
    curve = replace(_figure_5(parameters, flux), marks={"the echo above": float(chosen.onset_bin)})
    return [pixel, curve]


def weights(chosen: Weights) -> list[items.Plot]:
    """Figure 6."""
    return [paper.figure_6(Flux(sbr=chosen.sbr), chosen.onset_bin)]


class Sliders(Generic[Settings]):
    """Figures that follow their controls at once, above each other on one axis.

    Parameters
    ----------
    settings : dataclass
        What the figures begin with, its fields made by `core.parameters.parameter`.
    words : str
        What there is to see.
    compute : callable
        Settings to as many plots as `count`.
    """

    def __init__(
        self,
        session: Session,
        settings: Settings,
        words: str,
        compute: Callable[[Settings], Sequence[items.Plot]],
        count: int,
    ) -> None:
        self._session = session
        self._compute = compute
        self._words = words
        self._jobs = session.tasks.latest()
        across = Range1d(-0.5, 100)
        self._cards = [CurveCard(across, NOT_COMPUTED) for _ in range(count)]
        self._settings = settings
        self._panel = SettingsPanel(settings, self._ask)
        for card in self._cards:
            card.offer(session, lambda: Subject(PAPER, "", (self._settings,)))
        self._ask(settings)

    @property
    def view(self) -> View:
        """The figures, and their controls."""
        return View(_stack(*self._cards), aside(self._words, self._panel.layout), paint=self._paint)

    def _ask(self, settings: Settings) -> None:
        self._settings = settings
        fail = partial(self._session.failures.report, part=self)
        self._jobs.submit(partial(self._compute, settings), self._draw, fail)

    def _draw(self, plots: Sequence[items.Plot]) -> None:
        self._session.failures.resolve(self)
        with pn.io.hold(self._session.page):
            for card, plot in zip(self._cards, plots, strict=True):
                card.show(plot)

    def _paint(self, dark: bool) -> None:
        for card in self._cards:
            card.paint(palette(dark))


class Trials(Generic[Settings]):
    """A table over repetitions, which grows with each of them.

    Parameters
    ----------
    settings : dataclass
        What the controls begin with; it has a field `repetitions`.
    words : str
        What there is to see.
    plan : callable
        Settings to the methods under each condition.
    table : callable
        Results and settings to the table.
    """

    def __init__(
        self,
        session: Session,
        settings: Settings,
        words: str,
        plan: Callable[[Settings], Mapping[Condition, Sequence[Method]]],
        table: Callable[[Results, Settings], items.Table],
    ) -> None:
        self._session = session
        self._settings = settings
        self._words = words
        self._plan = plan
        self._item = table
        self._panel = SettingsPanel(settings, self._choose)
        self._study = Study(session, self._steps, "repetitions")
        self._card = TableCard(paper_words.NEEDS_TWO)
        self._card.offer(session, lambda: Subject(PAPER, "", (self._settings,)))

    @property
    def view(self) -> View:
        """The table, and its controls."""
        controls = aside(self._words, self._panel.layout, *self._study.controls)
        return View(self._card.layout, controls, show=self._study.show)

    def _choose(self, settings: Settings) -> None:
        self._settings = settings

    def _steps(self) -> list[Step[Results]]:
        chosen: Any = self._settings
        plan = self._plan(chosen)
        results: Results = {}
        draw = partial(self._draw, chosen, results)
        return [Step(partial(trials, plan, [seed]), draw) for seed in range(chosen.repetitions)]

    def _draw(self, chosen: Settings, results: Results, new: Results) -> None:
        for key, scores in new.items():
            results.setdefault(key, []).extend(scores)
        count = len(next(iter(results.values())))
        if count > 1:  # an interval needs two
            item = self._item(results, chosen)
            title = f"{item.title}, {count} repetitions"
            note = f"{item.note} {paper_words.READING_TRIALS}".strip()
            with pn.io.hold(self._session.page):
                self._card.show(replace(item, title=title, note=note))


class RangeImages:
    """Figures 8, 9 and 12."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._settings = Images()
        self._panel = SettingsPanel(self._settings, self._choose)
        self._study = Study(session, self._steps, "figure")
        self._gallery = Gallery()
        self._gallery.offer(session, lambda: Subject(PAPER, "", (self._settings,)))

    @property
    def view(self) -> View:
        """The images, and their controls."""
        self._panel.controls["sbr"].visible = False
        controls = aside(
            paper_words.IMAGES,
            self._panel.layout,
            *self._study.controls,
            *self._gallery.place,
        )
        return View(self._gallery.layout, controls, self._study.show, paint=self._paint)

    def _choose(self, settings: Images) -> None:
        self._settings = settings
        self._panel.controls["sbr"].visible = settings.figure == "Figure 9"
        self._study.start()

    def _steps(self) -> list[Step[items.Pictures]]:
        work: dict[str, Callable[[], items.Pictures]] = {
            "Figure 8": paper.figure_8,
            "Figure 9": partial(paper.figure_9, self._settings.sbr),
            "Figure 12": paper.figure_12,
        }
        return [Step(work[self._settings.figure], self._draw)]

    def _draw(self, pictures: items.Pictures) -> None:
        with pn.io.hold(self._session.page):
            self._gallery.show(pictures)

    def _paint(self, dark: bool) -> None:
        self._gallery.paint(palette(dark))


class LeftUnsaid:
    """What methods assume, what an echo's place does, what physics allows, and sums that fail."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._settings = Unsaid()
        self._panel = SettingsPanel(self._settings, self._choose)
        self._study = Study(session, self._steps, "steps")
        across = Range1d(0, 100)
        self._no_echo, self._by_place = (CurveCard(across, NOT_COMPUTED) for _ in range(2))
        self._limits, self._arithmetic = TableCard(), TableCard()
        for each in (self._no_echo, self._by_place, self._limits, self._arithmetic):
            each.offer(session, lambda: Subject(PAPER, "", (self._settings,)))

    @property
    def view(self) -> View:
        """Plots and tables, and their controls."""
        main = [
            _stack(self._no_echo, self._by_place),
            self._limits.layout,
            self._arithmetic.layout,
        ]
        controls = aside(paper_words.UNSAID, self._panel.layout, *self._study.controls)
        return View(main, controls, self._study.show, paint=self._paint)

    def _choose(self, settings: Unsaid) -> None:
        self._settings = settings

    def _steps(self) -> list[Step[Any]]:
        sbr, found = self._settings.sbr, []

        def draw(plot: items.Plot) -> None:
            found.append(plot)
            self._by_place.show(joined(found, paper.PLACES))

        return [
            Step(partial(paper.echo_free, sbr), self._no_echo.show),
            Step(paper.arithmetic, self._arithmetic.show),
            Step(paper.limits, self._limits.show),
            *(Step(partial(paper.by_place, sbr, onset=[place]), draw) for place in paper.PLACES),
        ]

    def _paint(self, dark: bool) -> None:
        for card in (self._no_echo, self._by_place):
            card.paint(palette(dark))


def joined(plots: Sequence[items.Plot], x: Sequence[float]) -> items.Plot:
    """Plots of the same curves over one part of `x` after the other; NaN where none has come."""
    missing = np.full(len(x) - sum(plot.x.size for plot in plots), np.nan)
    curves = {
        name: np.concatenate([*(plot.curves[name] for plot in plots), missing])
        for name in plots[0].curves
    }
    return replace(plots[0], x=np.array(x), curves=curves)


def _stack(*cards: CurveCard) -> pn.Column:
    content = [card.card for card in cards]
    return pn.Column(*content, stylesheets=[STACK], sizing_mode="stretch_both", margin=0)


PAGE = Page(
    "Paper",
    Paper,
    "computes what the paper prints",
    shared=frozenset(),
    is_standalone=True,
)
