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

# As high as its content, and no wider than a phone.
HOLDER = """
:host { flex: none !important; height: auto !important; max-height: none !important;
  min-width: 0 !important; }
"""


class Shared(Enum):
    """Parts of the sidebar that pages share."""

    UNIT = auto()
    """Unit of the axes along the gate."""
    METHOD = auto()
    """Choice of the estimator, with its settings."""
    TRACKING = auto()
    """Settings of the tracking differentiator, unless the page shows another estimator."""
    REDUCTION = auto()
    """Reduction of the capture."""


def _ignore(_value: Any) -> None:
    """Do nothing: the default of a page that needs no notification."""


@dataclass(frozen=True)
class View:
    """The content of a page and its reactions to events."""

    main: Any
    """One object, or a list of several."""
    aside: Any
    """Its own part of the sidebar, or a list of several."""
    show: Callable[[bool], None] = _ignore
    """Called with True when it comes on screen, and with False when it leaves."""
    follow: Callable[[Answer], None] = _ignore
    """Called with each new estimate, on screen or not."""
    paint: Callable[[bool], None] = _ignore
    """Called when the theme changes, and once when built; True stands for dark."""


class Content(Protocol):
    """Object that holds the content of a page."""

    @property
    def view(self) -> View:
        """The content."""


@dataclass(frozen=True)
class Page:
    """A page of the app, listed in `app.pages.catalog`."""

    name: str
    """Label of its button, and its name in links."""
    build: Callable[[Session], Content]
    """Called when the page is first visited."""
    help: str
    """Purpose of the page: the rest of a sentence that begins with its name."""
    explanation: str = ""
    """How to read the page, as Markdown; empty if the page needs none."""
    shared: frozenset[Shared] = frozenset(Shared)
    """Shared parts of the sidebar that affect this page."""
    is_standalone: bool = False
    """Whether the page ignores the session's capture: the sidebar is closed."""
    sidebar_last: bool = False
    """Whether its own part of the sidebar comes below the shared ones."""


class Pages:
    """Navigation between pages.

    Place `mains` directly into the template: Bokeh lays out a plot inside an ESM component only if
    at most one column lies between that component and the template.

    Parameters
    ----------
    session : Session
    builders : mapping of str to callable
        The builder of each page from the session, by the name on its button.
    label, help : str
        Label and description of the row of buttons.
    orientation : {"horizontal", "vertical"}
        Orientation of the buttons.
    first : str, optional
        The page to open first; by default the first builder.

    Attributes
    ----------
    contents : dict of str to Content
        What was built.
    """

    def __init__(
        self,
        session: Session,
        builders: Mapping[str, Callable[[Session], Content]],
        label: str = "Page",
        help: str = "",
        orientation: str = "horizontal",
        first: str | None = None,
    ) -> None:
        self._session, self._builders = session, builders
        self.contents: dict[str, Content] = {}
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
        """Pass on a new estimate."""
        for view in self._built.values():
            view.follow(answer)

    def paint(self, dark: bool) -> None:
        """Pass on a change of the theme."""
        self._dark = dark
        for view in self._built.values():
            view.paint(dark)

    def show(self, is_on_screen: bool) -> None:
        """Pass on that the parent, and with it the open page, comes on screen or leaves."""
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
            self.contents[name] = self._builders[name](self._session)
            view = self.contents[name].view
            view.paint(self._dark)
            # Drawn before it is placed, the page reaches the browser in one message.
            view.show(True)
            self.mains[name].extend(_several(view.main))
            self.asides[name].extend(_several(view.aside))
            self._built[name] = view
        self.mains[name].visible = self.asides[name].visible = True


def _holder(margin: Any) -> pn.Column:
    return pn.Column(visible=False, stylesheets=[HOLDER], margin=margin)


def _several(content: Any) -> Sequence[Any]:
    return content if isinstance(content, list) else [content]
