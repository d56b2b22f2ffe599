"""What our components of the page are made from."""

from __future__ import annotations

from contextlib import nullcontext
from functools import cache
from typing import Any

import param
from panel.custom import Child, JSComponent
from panel.io import hold


class Component(JSComponent):
    """An ESM component whose own values take a short way to the page and back.

    Panel's way is made for style sheets, children and values that are models: with each value it
    looks up the design, walks through every model below the component and searches for names like
    those that a model has not. That is most of what a plain value costs, and a stroke changes many.
    """

    def _update_properties(self, *events: Any, doc: Any) -> dict[str, Any]:
        values = {event.name: event.new for event in events}
        return values if self._are_plain(values) else super()._update_properties(*events, doc=doc)

    def _update_model(
        self, events: Any, msg: dict[str, Any], root: Any, model: Any, doc: Any, comm: Any
    ) -> None:
        if self._are_plain(msg):
            # Whoever holds the document sends it all; each hold looks through what is held so far.
            with nullcontext() if doc and doc.callbacks.hold_value else hold(doc):
                model.data.update(**msg)  # what comes from there is no news to it
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
    """Names of a component's own values that are no children and are not taken back."""
    own = set(kind.param) - set(JSComponent.param)
    return frozenset(n for n in own if not isinstance(kind.param[n], Child | param.Event))
