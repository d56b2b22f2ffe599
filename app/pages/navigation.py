"""Pages of the app, one on screen at a time, each built when it is first visited."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.model.store import Answer
from app.widgets.cards import CHOICE_PX

# As high as its parts, and not as wide as all of them side by side: that is more than a phone.
HOLDER = """
:host { flex: none !important; height: auto !important; max-height: none !important;
  min-width: 0 !important; }
"""


def _nothing(_told: Any) -> None:
    """What a page does that need not be told."""


@dataclass(frozen=True)
class View:
    """What a page consists of, and what it is told."""

    main: Any
    """An object, or several, one below the other."""
    aside: Any
    """Its own part of the sidebar, or several."""
    show: Callable[[bool], None] = _nothing
    """Called with True when it comes on screen, and with False when it leaves."""
    follow: Callable[[Answer], None] = _nothing
    """Called with each new answer, on screen or not."""
    paint: Callable[[bool], None] = _nothing
    """Called with True when the page becomes dark, with False when light; once when built."""


class Pages:
    """Navigation between pages.

    Bokeh lays out a plot inside of an ESM component only if no more than one column of plots lies
    between that component and the template: `mains` belong directly into the template.

    Parameters
    ----------
    builders : mapping of str to callable
        What builds each page, by the name on its button.
    label, help : str
        What the buttons choose, and a sentence about it.
    orientation : {"horizontal", "vertical"}
        How the buttons stand.
    first : str, optional
        The page that is opened at once; the first of all if not given.
    """

    def __init__(
        self,
        builders: Mapping[str, Callable[[], View]],
        label: str = "Page",
        help: str = "Explore looks into one method, Inspect into any pixel of a capture, Compare "
        "puts methods side by side, Trade-off measures speed against accuracy, Paper computes what "
        "the paper prints.",
        orientation: str = "horizontal",
        first: str | None = None,
    ) -> None:
        self._builders = builders
        self._built: dict[str, View] = {}
        self._dark = False
        self.mains = {name: _holder(margin=(0, 12)) for name in builders}
        self.asides = {name: _holder(margin=0) for name in builders}
        self.choice = pmui.RadioButtonGroup(
            options=list(builders),
            value=first or next(iter(builders)),
            label=label,
            description=help,
            orientation=orientation,
            size="small",
            min_height=CHOICE_PX,
            margin=(2, 0),
        )
        self.choice.param.watch(lambda event: self._go(event.old, event.new), "value")
        self._open(self.choice.value)

    def follow(self, answer: Answer) -> None:
        """Pass on a new answer."""
        for view in self._built.values():
            view.follow(answer)

    def paint(self, dark: bool) -> None:
        """Pass on the change from light to dark or back."""
        self._dark = dark
        for view in self._built.values():
            view.paint(dark)

    def show(self, is_on_screen: bool) -> None:
        """Pass on that the page that is open comes on screen with all of them, or leaves."""
        self._built[self.choice.value].show(is_on_screen)

    def _go(self, old: str, new: str) -> None:
        with pn.io.hold(pn.state.curdoc):
            if old in self._built:
                self._built[old].show(False)
                self.mains[old].visible = self.asides[old].visible = False
            try:
                self._open(new)
            except Exception:
                self.choice.value = old  # which is opened again
                raise

    def _open(self, name: str) -> None:
        if name in self._built:
            self._built[name].show(True)
        else:
            view = self._builders[name]()
            view.paint(self._dark)
            # First what is shown, then where: the browser gets the page in one piece.
            view.show(True)
            self.mains[name].extend(_several(view.main))
            self.asides[name].extend(_several(view.aside))
            self._built[name] = view
        self.mains[name].visible = self.asides[name].visible = True


def _holder(margin: Any) -> pn.Column:
    return pn.Column(visible=False, stylesheets=[HOLDER], margin=margin)


def _several(content: Any) -> Sequence[Any]:
    return content if isinstance(content, list) else [content]
