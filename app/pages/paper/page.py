"""The Paper page: the paper's figures and tables, computed for chosen settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import panel as pn
from bokeh.models import Range1d

from app.model.text import NOT_COMPUTED
from app.pages.navigation import Page, Pages, View
from app.pages.paper import text
from app.pages.session import Session
from app.pages.shared.downloads import Subject
from app.pages.shared.outputs import CurveCard, Gallery, TableCard
from app.pages.shared.section import AnySettings, Repetitions, SettingsSection, StudySection
from app.tasks.scheduler import Step
from app.widgets.controls import Sentence
from core import PRESETS, Flux
from core.parameters import Choice, Number, Settings, parameter
from core.studies import outputs
from core.studies.paper import figures as paper
from core.studies.paper import pile_up as figures_5_6
from core.studies.trials import Condition, Method, Results, trials

# The paper's own method before the methods that bound it.
TABLE_2_METHODS = sorted(paper.TABLE_2_METHODS, key=lambda method: method.estimator != "tracking")

# Buttons and controls on the left of what they control; above it on a phone.
BOARD = """
:host { display: grid !important; gap: 14px; align-items: start;
  grid-template-columns: 270px minmax(0, 1fr); flex: none !important; height: auto !important; }
.bk-panel-models-layout-Column { flex: none !important; height: auto !important; }
@media screen and (max-width: 900px) {
  :host { display: flex !important; flex-direction: column; }
  .bk-panel-models-layout-Column { width: 100%; }
}
"""
STACK = """
:host { display: flex !important; flex-direction: column; gap: 8px;
  flex: none !important; max-height: none !important;
  height: max(640px, calc(var(--window-height, 100vh) - 122px)) !important; }
@media screen and (max-width: 900px) { :host { height: auto !important; } }
"""

_SBR = Number("SBR", 0.02, 0.2, log=True, least=0.0, open_below=True)
_SBR_HELP = "Signal divided by background flux. The paper has 0.03 to 0.08."
_ECHO = Number("Bin of the echo", 20, 99, whole=True, least=0, most=99)


@dataclass(frozen=True)
class Jump(Settings):
    """Settings of Figures 1 and 2."""

    onset_bin: int = parameter(50, _ECHO, "Where the echo begins: 50 in the paper.")
    signal: float = parameter(
        paper.FIGURE_1.signal,
        Number("Signal", 0.01, 5.0, log=True, least=0.0, unit="per pulse"),
        "Signal flux, if the detector were always armed: 0.5203 in the paper.",
    )
    sbr: float = parameter(0.08, _SBR, _SBR_HELP)


@dataclass(frozen=True)
class Scales(Settings):
    """Settings of Figure 4."""

    onset_bin: int = parameter(50, _ECHO, "Bin of the target: 20, 50 and 90 in Figure 4.")
    sbr: float = parameter(0.08, _SBR, _SBR_HELP)
    preset: str = parameter(
        "recommended",
        Choice("Preset", tuple(PRESETS)),
        "recommended: best on random depths. literal: the paper's equations, with an l chosen "
        "here, since it prints none.",
    )


@dataclass(frozen=True)
class Weights(Settings):
    """Settings of the weights."""

    onset_bin: int = parameter(80, _ECHO, "Bin of the target.")
    sbr: float = parameter(0.08, _SBR, _SBR_HELP)


@dataclass(frozen=True)
class RepeatedAt(Repetitions):
    """Settings of Table 3."""

    sbr: float = parameter(0.06, _SBR, _SBR_HELP)


@dataclass(frozen=True)
class Images(Settings):
    """Settings of the range images."""

    figure: str = parameter(
        "Figure 8",
        Choice("Figure", ("Figure 8", "Figure 9", "Figure 11", "Figure 12")),
        "8: the car at six SBRs. 9: the car with every method. 11: the building without "
        "background, the paper's reference. 12: the building with every method.",
    )
    sbr: float = parameter(0.06, _SBR, "SBR of Figure 9. " + _SBR_HELP)


@dataclass(frozen=True)
class AtSBR(Settings):
    """Settings of sections in which only the SBR varies."""

    sbr: float = parameter(0.06, _SBR, _SBR_HELP)


class Paper:
    """The page.

    Parameters
    ----------
    session : Session
        The session of the page; its capture is not used.
    """

    def __init__(self, session: Session) -> None:
        def table_2(results: Results, _: Repetitions) -> outputs.Table:
            return paper.table_2(results, TABLE_2_METHODS)

        def table_3(results: Results, settings: RepeatedAt) -> outputs.Table:
            return paper.table_3(results, settings.sbr)

        self._sections = Pages(
            session,
            {
                "Figures 1, 2: the jump": lambda session: LiveFigures(
                    session, Jump(), text.JUMP, jump, count=2
                ),
                "Figure 4: two scales": lambda session: LiveFigures(
                    session, Scales(), text.SCALES, two_scales, count=2
                ),
                "Figures 5, 6: pile-up": lambda session: LiveFigures(
                    session, AtSBR(0.08), text.PILE_UP, pile_up, count=2
                ),
                "The weights": lambda session: LiveFigures(
                    session, Weights(), text.WEIGHTS, weights, count=1
                ),
                "Table 2: six SBRs": lambda session: RepeatedTable(
                    session, Repetitions(5), text.TABLE_2, plan_2, table_2
                ),
                "Table 3: all methods": lambda session: RepeatedTable(
                    session, RepeatedAt(5), text.TABLE_3, plan_3, table_3
                ),
                "Figures 8, 9, 11, 12: images": RangeImages,
                "What the paper does not report": NotReported,
            },
            label="Section",
            help=text.SECTIONS_HELP,
            orientation="vertical",
            first=session.state.reported,
        )
        self._sections.choice.link(session.state, value="reported", bidirectional=True)

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
            Sentence(text=text.NO_SIDEBAR, margin=8),
            show=sections.show,
            paint=sections.paint,
        )


# Figures and plans as functions of their settings


def jump(settings: Jump) -> list[outputs.Plot]:
    """Return Figures 1 and 2."""
    flux = Flux(settings.signal, settings.sbr)
    return [figure(flux, settings.onset_bin) for figure in (paper.figure_1, paper.figure_2)]


# The curve does not depend on the echo's bin, and takes three times as long as the pixel.
_residual_by_place = lru_cache(maxsize=64)(paper.residual_by_place)


def two_scales(settings: Scales) -> list[outputs.Plot]:
    """Return a pixel as in Figure 4, and its residual at other bins with its own marked."""
    parameters, flux = PRESETS[settings.preset], Flux(sbr=settings.sbr)
    pixel = paper.pixel_signals(settings.onset_bin, parameters, flux)
    marks = {"the echo above": float(settings.onset_bin)}
    return [pixel, replace(_residual_by_place(parameters, flux), marks=marks)]


def pile_up(settings: AtSBR) -> list[outputs.Plot]:
    """Return Figures 5 and 6."""
    flux = Flux(sbr=settings.sbr)
    return [figures_5_6.figure_6(flux), figures_5_6.figure_5b(flux)]


def weights(settings: Weights) -> list[outputs.Plot]:
    """Return a pixel's enhanced signal under each weight."""
    return [paper.weights(Flux(sbr=settings.sbr), settings.onset_bin)]


Plan = Mapping[Condition, Sequence[Method]]
"""The methods to run under each condition."""


def plan_2(settings: Repetitions) -> Plan:
    """Return the plan of Table 2."""
    return dict.fromkeys(paper.NEAR.values(), TABLE_2_METHODS)


def plan_3(settings: RepeatedAt) -> Plan:
    """Return the plan of Table 3."""
    return {Condition("car", settings.sbr): paper.COMPARED}


# Sections


class PaperSection(SettingsSection[AnySettings]):
    """A section of this page: its files are named after the paper and the settings."""

    def about(self) -> Subject:
        """Return what the section's files are about."""
        return Subject("paper", "", (self.settings,))


class LiveFigures(PaperSection[AnySettings]):
    """Figures that follow their settings at once, one below the other on a common axis.

    Parameters
    ----------
    session : Session
    settings : Settings
        Initial settings.
    explanation : str
        Text above the controls.
    compute : callable
        Maps settings to `count` plots.
    count : int

    Attributes
    ----------
    cards : list of CurveCard
    shown : list of core.studies.outputs.Plot
        What is drawn.
    """

    def __init__(
        self,
        session: Session,
        settings: AnySettings,
        explanation: str,
        compute: Callable[[AnySettings], Sequence[outputs.Plot]],
        count: int,
    ) -> None:
        super().__init__(session, settings, explanation)
        self._compute = compute
        self.shown: Sequence[outputs.Plot] = []
        across = Range1d(-0.5, 100)
        self.cards = [CurveCard(across, NOT_COMPUTED) for _ in range(count)]
        self._painted = [*self.cards]
        for card in self.cards:
            card.offer(session, self.about)
        self.change(settings)

    def layout(self) -> tuple[Any, Any]:
        """Return the figures, and their controls."""
        return _stack(*self.cards), self.controls()

    def change(self, settings: AnySettings) -> None:
        """Compute the figures for other settings."""
        super().change(settings)
        self._jobs.submit(partial(self._compute, settings), self._draw, self.report_error)

    def _draw(self, plots: Sequence[outputs.Plot]) -> None:
        self.session.failures.resolve(self)
        with self.session.tasks.hold():
            for card, plot in zip(self.cards, plots, strict=True):
                card.show(plot)
        self.shown = plots


class RepeatedTable(PaperSection[AnySettings], StudySection[AnySettings]):
    """A table over repetitions that is refined with each of them.

    Parameters
    ----------
    session : Session
    settings : Settings
        Initial settings, with a field `repetitions`.
    explanation : str
        Text above the controls.
    plan : callable
        Maps settings to a `Plan`.
    table : callable
        Maps results and settings to the table.

    Attributes
    ----------
    shown : core.studies.outputs.Table or None
        What the table shows.
    """

    def __init__(
        self,
        session: Session,
        settings: AnySettings,
        explanation: str,
        plan: Callable[[AnySettings], Plan],
        table: Callable[[Results, AnySettings], outputs.Table],
    ) -> None:
        super().__init__(session, settings, explanation, "repetitions")
        self._plan, self._table = plan, table
        self.shown: outputs.Table | None = None
        self._card = TableCard(text.NEEDS_TWO)
        self._card.offer(session, self.about)

    def layout(self) -> tuple[Any, Any]:
        """Return the table, and its controls."""
        return self._card.layout, self.controls(*self.study.controls)

    def steps(self) -> list[Step[Results]]:
        """Return a step for each repetition."""
        settings: Any = self.settings
        plan = self._plan(settings)
        results: Results = {}
        draw = partial(self._draw, settings, results)
        return [Step(partial(trials, plan, [seed]), draw) for seed in range(settings.repetitions)]

    def _draw(self, settings: AnySettings, results: Results, new: Results) -> None:
        for key, scores in new.items():
            results.setdefault(key, []).extend(scores)
        count = len(next(iter(results.values())))
        if count < 2:
            return  # an interval needs two
        table = self._table(results, settings)
        title = f"{table.title}, {count} repetitions"
        note = f"{table.note} {text.READING_TRIALS}".strip()
        with self.session.tasks.hold():
            self._card.show(replace(table, title=title, note=note))
        self.shown = table


class RangeImages(PaperSection[Images], StudySection[Images]):
    """Figures 8, 9, 11 and 12.

    Attributes
    ----------
    gallery : Gallery
    """

    def __init__(self, session: Session) -> None:
        super().__init__(session, Images(), text.IMAGES, "figure")
        self.gallery = Gallery()
        self.gallery.offer(session, self.about)
        self._painted = [self.gallery]
        self.panel.controls["sbr"].visible = False

    def layout(self) -> tuple[Any, Any]:
        """Return the images, and their controls."""
        return self.gallery.layout, self.controls(*self.study.controls, *self.gallery.place)

    def change(self, settings: Images) -> None:
        """Show another figure."""
        super().change(settings)
        self.panel.controls["sbr"].visible = settings.figure == "Figure 9"
        self.study.start()

    def steps(self) -> list[Step[outputs.Pictures]]:
        """Return the one step, which computes the chosen figure."""
        work: dict[str, Callable[[], outputs.Pictures]] = {
            "Figure 8": paper.figure_8,
            "Figure 9": partial(paper.figure_9, self.settings.sbr),
            "Figure 11": paper.figure_11,
            "Figure 12": paper.figure_12,
        }
        return [Step(work[self.settings.figure], self._draw)]

    def _draw(self, pictures: outputs.Pictures) -> None:
        with self.session.tasks.hold():
            self.gallery.show(pictures)


class NotReported(PaperSection[AtSBR], StudySection[AtSBR]):
    """False alarms, dependence on the echo's bin, limits, and the paper's inconsistent sums."""

    def __init__(self, session: Session) -> None:
        super().__init__(session, AtSBR(), text.NOT_REPORTED, "steps")
        across = Range1d(0, 100)
        self._no_echo, self._by_place = (CurveCard(across, NOT_COMPUTED) for _ in range(2))
        self._limits, self._arithmetic = TableCard(), TableCard()
        self._painted = [self._no_echo, self._by_place]
        for each in (self._no_echo, self._by_place, self._limits, self._arithmetic):
            each.offer(session, self.about)

    def layout(self) -> tuple[Any, Any]:
        """Return plots and tables, and their controls."""
        main = [
            _stack(self._no_echo, self._by_place),
            self._limits.layout,
            self._arithmetic.layout,
        ]
        return main, self.controls(*self.study.controls)

    def steps(self) -> list[Step[Any]]:
        """Return a step for each plot and table, and for each bin of the echo."""
        sbr, found = self.settings.sbr, []

        def draw(plot: outputs.Plot) -> None:
            found.append(plot)
            self._by_place.show(joined(found, paper.PLACES))

        return [
            Step(partial(paper.echo_free, sbr), self._no_echo.show),
            Step(paper.arithmetic, self._arithmetic.show),
            Step(paper.limits, self._limits.show),
            *(Step(partial(paper.by_place, sbr, onset=[place]), draw) for place in paper.PLACES),
        ]


def joined(plots: Sequence[outputs.Plot], x: Sequence[float]) -> outputs.Plot:
    """Join plots of the same curves over consecutive parts of `x`; NaN where none exists yet."""
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
    "computes the paper's figures and tables",
    shared=frozenset(),
    is_standalone=True,
)
