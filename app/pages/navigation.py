"""Pages of the app, one on screen at a time, each built when it is first visited."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import TYPE_CHECKING, Any, Protocol

import panel as pn
import panel_material_ui as pmui

from app.model.store import Answer
from app.widgets.cards import CHOICE_PX

if TYPE_CHECKING:
    from app.pages.session import Session

# As high as its parts, and not as wide as all of them side by side, which exceeds a phone.
HOLDER = """
:host { flex: none !important; height: auto !important; max-height: none !important;
  min-width: 0 !important; }
"""


class Shared(Enum):
    """Parts of the sidebar that pages share, all about the session's capture."""

    UNIT = auto()
    """Unit of the axes along the gate."""
    TRACKING = auto()
    """Settings of the tracking differentiator."""
    REDUCTION = auto()
    """Which part of the capture is used."""


def _ignore(_value: Any) -> None:
    """Do nothing: the default of a page that needs no notification."""


@dataclass(frozen=True)
class View:
    """The content of a page, and its reactions."""

    main: Any
    """An object, or several, one below the other."""
    aside: Any
    """Its own part of the sidebar, or several."""
    show: Callable[[bool], None] = _ignore
    """Called with True when it comes on screen, and with False when it leaves."""
    follow: Callable[[Answer], None] = _ignore
    """Called with each new answer, on screen or not."""
    paint: Callable[[bool], None] = _ignore
    """Called with True when the page becomes dark, with False when light; once when built."""


class Content(Protocol):
    """What builds the content of a page."""

    @property
    def view(self) -> View:
        """The content."""


@dataclass(frozen=True)
class Page:
    """A page of the app, listed in `app.pages.catalog`."""

    name: str
    """On its button, and in links."""
    build: Callable[[Session], Content]
    """Called when the page is first visited."""
    help: str
    """What the page does: the rest of a sentence that begins with its name."""
    shared: frozenset[Shared] = frozenset(Shared)
    """Parts of the sidebar that have an effect on this page."""
    is_standalone: bool = False
    """Whether the session's capture has no part in the page: the sidebar is closed."""
    sidebar_last: bool = False
    """Whether its own part of the sidebar stands below the shared ones."""


class Pages:
    """Navigation between pages.

    Bokeh lays out a plot inside of an ESM component only if no more than one column of plots lies
    between that component and the template: `mains` belong directly into the template.

    Parameters
    ----------
    builders : mapping of str to callable
        The builder of each page, by the name on its button.
    label, help : str
        Name of the row of buttons, and a sentence about it.
    orientation : {"horizontal", "vertical"}
        Orientation of the buttons.
    first : str, optional
        The page that is opened at once; by default the first one.
    """

    def __init__(
        self,
        builders: Mapping[str, Callable[[], View]],
        label: str = "Page",
        help: str = "",
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
        """Pass on that the open page comes on screen together with its parent, or leaves."""
        self._built[self.choice.value].show(is_on_screen)

    def _go(self, old: str, new: str) -> None:
        with pn.io.hold(pn.state.curdoc):
            if old in self._built:
                self._built[old].show(False)
                self.mains[old].visible = self.asides[old].visible = False
            try:
                self._open(new)
            except Exception:
                self.choice.value = old  # reopens it
                raise

    def _open(self, name: str) -> None:
        if name in self._built:
            self._built[name].show(True)
        else:
            view = self._builders[name]()
            view.paint(self._dark)
            # Drawn before it is placed, the page reaches the browser in one piece.
            view.show(True)
            self.mains[name].extend(_several(view.main))
            self.asides[name].extend(_several(view.aside))
            self._built[name] = view
        self.mains[name].visible = self.asides[name].visible = True


def _holder(margin: Any) -> pn.Column:
    return pn.Column(visible=False, stylesheets=[HOLDER], margin=margin)


def _several(content: Any) -> Sequence[Any]:
    return content if isinstance(content, list) else [content]
