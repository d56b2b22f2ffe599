"""Views of a lesson: curves, pictures, or a histogram that fills pulse by pulse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn

from app.model.exports import Curve
from app.model.lessons import Item, Lesson
from app.model.text import COMPUTING
from app.pages.session import Session
from app.pages.shared.downloads import PLOT, Shown, Subject, downloadable
from app.pages.shared.outputs import FREE, CurveCard, Gallery, layers_of
from app.plots import elements as plots
from app.theme import LIGHT, Palette
from app.widgets.cards import card
from app.widgets.controls import Sentence
from app.widgets.figures import Layers, enlarge, paint_frame, pane_of
from app.widgets.pulse_player import PulsePlayer
from core.studies import outputs
from core.studies.lessons import Bench
from core.studies.pulses import Pulses

CARD_PX = 330


class PulseCard:
    """A histogram that fills pulse by pulse, with the player below it."""

    def __init__(self) -> None:
        self._player = PulsePlayer(sizing_mode="stretch_width", margin=0)
        self._note = Sentence(sizing_mode="stretch_width", margin=(2, 10, 4, 10))
        self._plot: Layers | None = None
        self._item: Pulses | None = None
        self._colors = LIGHT
        self.card = card(self._player, self._note)

    @property
    def figures(self) -> list[Any]:
        """The figure, once there are photons."""
        return [] if self._plot is None else [self._plot.figure]

    def offer(self, session: Session, subject: Callable[[], Subject]) -> None:
        """Add a download button."""

        def show() -> Shown:
            assert self._item is not None and self._plot is not None
            return Shown(subject(), self._item.key, {"csv": self._plot.csv()})

        downloadable(self.card, session, "photons", show, PLOT)

    def show(self, item: Pulses) -> None:
        """Replace the pulses shown."""
        self._item = item
        if self._plot is None:
            self._plot = self._built(item)
            self.paint(self._colors)
        counts, expected = item.histogram, item.ends.size * item.probability
        bins = plots.centres(counts.size)
        self._plot.keep(
            "Bin (1 ns)",
            [
                Curve("histogram", "first photons", bins, counts, "Counts"),
                Curve("expected", "expected", bins, expected, "Counts"),
            ],
        )
        self._player.show(item)
        self._note.text = item.note

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        self._colors = colors
        if self._plot is not None:
            paint_frame(self._plot.figure, colors)
            for layer, (color, _) in plots.PULSE_LAYERS.items():
                self._plot.color(layer, getattr(colors, color))

    def _built(self, item: Pulses) -> Layers:
        layers = layers_of(plots.pulse_figure(item))
        self.card.insert(0, pane_of(layers.figure))
        sources = {name: layers.source(name) for name in layers.layers}
        self._player.follow(sources, layers.figure.y_range)
        return layers


UNNOTED = {"--note-display": "none"}


class View:
    """One view of a lesson, of any kind.

    Parameters
    ----------
    session : Session
    lesson : Lesson
    is_large : bool
        Whether it fills its container, and is legible across a room: then without its note and
        download buttons.

    Attributes
    ----------
    holder : pn.Column
    item : Item or None
        What is shown.
    bench : Bench
        The state from which it was computed.
    """

    def __init__(self, session: Session, lesson: Lesson, is_large: bool = False) -> None:
        self._session, self._lesson, self._is_large = session, lesson.key, is_large
        self.bench = lesson.bench
        self.item: Item | None = None
        self._colors = LIGHT
        self._enlarged: list[Any] = []
        self._shown: CurveCard | Gallery | PulseCard | None = None
        self.holder = pn.Column(
            Sentence(text=COMPUTING),
            stylesheets=[FREE],
            height=None if is_large else CARD_PX,
            sizing_mode="stretch_both" if is_large else "stretch_width",
            margin=0,
        )

    @property
    def figures(self) -> list[Any]:
        """The figures that are on screen."""
        return [] if self._shown is None else self._shown.figures

    def about(self) -> Subject:
        """Return what the files of the view are about."""
        return Subject("lesson", self._lesson, (self.bench,))

    def show(self, item: Item, bench: Bench) -> None:
        """Show the view of a state."""
        self.item, self.bench = item, bench
        shown = self._shown or self._made(item)
        shown.show(item)  # type: ignore[arg-type]
        if self._is_large:
            for figure in shown.figures:
                if figure not in self._enlarged:
                    enlarge(figure)
            self._enlarged = shown.figures
        if self._shown is None:  # drawn before it is placed, it is sent as a whole
            self._shown = shown
            self.holder[:] = [shown.layout if isinstance(shown, Gallery) else shown.card]

    def paint(self, colors: Palette) -> None:
        """Apply the colours of a theme."""
        self._colors = colors
        if self._shown is not None:
            self._shown.paint(colors)

    def _made(self, item: Item) -> CurveCard | Gallery | PulseCard:
        """Return an empty card for items of this kind."""
        shown: CurveCard | Gallery | PulseCard
        if isinstance(item, outputs.Plot):
            shown = CurveCard()
        else:
            shown = PulseCard() if isinstance(item, Pulses) else Gallery(self._is_large)
        shown.paint(self._colors)
        if self._is_large:
            self.holder.styles = UNNOTED
        else:
            shown.offer(self._session, self.about)
        if isinstance(shown, Gallery):
            self.holder.height = None  # pictures have their own
        return shown
