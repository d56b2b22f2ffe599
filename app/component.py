"""What our components of the page are made from."""

from __future__ import annotations

from functools import cache
from typing import Any

import param
from panel.custom import Child, JSComponent
from panel.io import hold
from panel.io.state import state
from param.parameterized import _syncing


class Component(JSComponent):
    """An ESM component whose own values take a short way to the page and back.

    Panel's way is made for style sheets, children and values that are models: with each value it
    looks up the design, walks through every model below the component and searches for names like
    those that a model has not. That is most of what a plain value costs, and a stroke changes many.
    """

    def _update_properties(self, *events: Any, doc: Any) -> dict[str, Any]:
        values = {event.name: event.new for event in events}
        if not self._are_plain(values):
            return super()._update_properties(*events, doc=doc)
        told = self._in_process__events.get(doc, {})  # by the page itself
        return {n: value for n, value in values.items() if n not in told or value != told[n]}

    def _update_model(
        self, events: Any, msg: dict[str, Any], root: Any, model: Any, doc: Any, comm: Any
    ) -> None:
        if self._are_plain(msg):
            with hold(doc):
                model.data.update(**msg)
        else:
            super()._update_model(events, msg, root, model, doc, comm)

    def _process_events(self, events: dict[str, Any]) -> None:
        if not self._are_plain(events):
            super()._process_events(events)
            return
        page = state.curdoc
        self._in_process__events[page] = events
        try:
            with _syncing(self, list(events)):
                for name, value in events.items():
                    setattr(self, name, value)  # `param.update` would copy all other values first
        finally:
            self._in_process__events.pop(page, None)

    @classmethod
    def _are_plain(cls, values: dict[str, Any]) -> bool:
        kind: Any = cls
        return values.keys() <= _plain(kind)


@cache
def _plain(kind: Any) -> frozenset[str]:
    """Names of a component's own values that are no children and are not taken back."""
    own = set(kind.param) - set(JSComponent.param)
    return frozenset(n for n in own if not isinstance(kind.param[n], Child | param.Event))
