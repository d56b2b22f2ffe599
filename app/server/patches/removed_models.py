"""Keep the rest of a message from the browser if one of its events concerns a removed model.

Bokeh drops the whole message: values of other widgets are lost if, for example, the user moves two
sliders while a plot is replaced. Upstream: https://github.com/bokeh/bokeh/pull/13153, which states
that whole messages are dropped. Fixes lost changes (`tests.test_patches` fails without it).

Bokeh also lists all models for each message; this one asks its document. Gain: 0.6 ms of
each message to a page of 3000 models.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Sequence
from typing import Any

import bokeh.document.document
from bokeh.core.serialization import Deserializer, Serialized, UnknownReferenceError


def apply() -> None:
    """Replace the deserializer of documents."""
    bokeh.document.document.Deserializer = PartialDeserializer


class PartialDeserializer(Deserializer):
    """Deserializer that leaves out events of removed models."""

    def __init__(self, references: Sequence[Any] = (), **options: Any) -> None:
        super().__init__(**options)
        self._document = references[0].document if references else None
        if self._document is not None:
            self._references = ChainMap({}, self._document.models)

    def deserialize(self, obj: Any) -> Any:
        """Return the events of a message without those of removed models."""
        if self._document is None:
            return super().deserialize(obj)
        message = obj if isinstance(obj, Serialized) else Serialized(obj)
        events = []
        for event in message.content["events"]:
            try:
                events.append(self.decode(event, message.buffers))
            except UnknownReferenceError as error:
                if not self._document.models.seen(error.id):
                    raise
        return {"events": events}
