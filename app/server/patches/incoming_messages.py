"""Look models up when a message names them, and keep the rest of a message about a removed model.

Bokeh builds a dictionary of all models of the page for each message from the browser, and drops a
whole message if one of its events concerns a model that has been removed meanwhile. Upstream:
https://github.com/bokeh/bokeh/pull/13153, which states that whole messages are dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bokeh.document.document
from bokeh.core.serialization import Deserializer, Serialized, UnknownReferenceError


def apply() -> None:
    """Replace the deserializer of documents."""
    bokeh.document.document.Deserializer = QuickDeserializer


class QuickDeserializer(Deserializer):
    """Deserializer that shares the document's index of models."""

    def __init__(self, references: Sequence[Any] = (), **options: Any) -> None:
        super().__init__((), **options)
        self._before = references
        if references:
            self._models = references[0].document.models
            self._references = _Named(self._models)

    def deserialize(self, obj: Any) -> Any:
        """Return the events of a message without those of removed models."""
        if not self._before:
            return super().deserialize(obj)
        message = obj if isinstance(obj, Serialized) else Serialized(obj)
        events = []
        for event in message.content["events"]:
            try:
                events.append(self.decode(event, message.buffers))
            except UnknownReferenceError as error:
                if not self._models.seen(error.id):
                    raise
        return {"events": events}

    def has_ref(self, obj: Any) -> bool:
        """Whether a model existed before the message or is created by it."""
        return obj in self._before or super().has_ref(obj)


class _Named(dict[str, Any]):
    """Models by identifier: those of the message, and all of a document."""

    def __init__(self, models: Any) -> None:
        super().__init__()
        self._models = models

    def get(self, name: str, default: Any = None) -> Any:
        """Return the model of an identifier."""
        return self[name] if name in self else self._models.get_by_id(name)
