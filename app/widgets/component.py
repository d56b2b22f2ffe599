"""Base class of the app's own components, and the lifetime of callbacks that run in the browser."""

from __future__ import annotations

from contextlib import nullcontext
from functools import cache
from pathlib import Path
from typing import Any

import panel as pn
import param
from panel.custom import Child, JSComponent
from panel.io import hold
from panel.links import Callback


class Component(JSComponent):
    """An ESM component that sends and receives its plain values without Panel's general machinery.

    For each value Panel looks up the design, walks through all models below the component and
    searches for references, in case it is a style sheet, a child or a model. That is most of the
    cost of a plain value, and a slider move changes many. Most values stay the same in a move, for
    which a comparison is all that is needed.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        kind: Any = type(self)
        if name not in _plain(kind) or getattr(self, name) != value:
            super().__setattr__(name, value)

    def _update_properties(self, *events: Any, doc: Any) -> dict[str, Any]:
        values = {event.name: event.new for event in events}
        return values if self._are_plain(values) else super()._update_properties(*events, doc=doc)

    def _update_model(
        self, events: Any, msg: dict[str, Any], root: Any, model: Any, doc: Any, comm: Any
    ) -> None:
        if self._are_plain(msg):
            # An outer hold sends everything; each further hold would scan what is held so far.
            with nullcontext() if doc and doc.callbacks.hold_value else hold(doc):
                model.data.update(**msg)  # a value that came from the browser is equal: not sent
        else:
            super()._update_model(events, msg, root, model, doc, comm)

    def _process_events(self, events: dict[str, Any]) -> None:
        if self._are_plain(events):
            for name, value in events.items():
                setattr(self, name, value)  # `param.update` would copy all other values first
        else:
            super()._process_events(events)

    @classmethod
    def _are_plain(cls, values: dict[str, Any]) -> bool:
        kind: Any = cls
        return values.keys() <= _plain(kind)


@cache
def _plain(kind: Any) -> frozenset[str]:
    """Return the names of a component's own values, without children and events."""
    own = set(kind.param) - set(JSComponent.param)
    return frozenset(n for n in own if not isinstance(kind.param[n], Child | param.Event))


def script(name: str) -> str:
    """Return the script of a component, after the functions that these scripts share."""
    folder = Path(__file__).parent
    return "".join((folder / each).read_text("utf-8") for each in ("element.js", name))


def until_session_ends(callback: Callback) -> None:
    """Remove a JavaScript callback when its session ends.

    Panel registers callbacks globally, by their source. Their arguments lead back to the source, so
    that neither they nor anything else of the page would ever be freed.
    """
    if pn.state.curdoc is not None:
        pn.state.on_session_destroyed(lambda _: callback.unwatch())
