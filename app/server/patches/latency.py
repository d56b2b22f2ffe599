"""Defaults of the libraries that cost most of a slider's time, changed in one place.

Measured by ``python -m tests.latency``: neither of the first two changes alone gains much, both
together halve the time from a slider's move to changed pixels. The others are for many sessions at
once, see ``python -m tests.load``.
"""

from __future__ import annotations

import asyncio
import gzip
import json
import sys
from base64 import b64encode
from collections.abc import Collection, Sequence
from contextlib import suppress
from importlib import import_module
from typing import Any

from bokeh.core.has_props import HasProps
from bokeh.core.property.descriptors import PropertyDescriptor
from bokeh.core.serialization import (
    BytesRep,
    Deserializer,
    Serialized,
    Serializer,
    UnknownReferenceError,
)
from bokeh.protocol.message import Message
from bokeh.server.views.ws import WSHandler
from bokeh.settings import settings
from panel.reactive import Syncable
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from app.server.garbage import collect_all

DEBOUNCE_MS = 0
"""Panel collects property changes for 50 ms. So short a time suits callbacks as short as ours,
which hand the work to `app.tasks.scheduler`; under slow ones it would build a backlog."""

SWITCH_S = 1e-4
"""A thread that computes keeps the others waiting for 5 ms whenever they have let go of the
interpreter, as the page's thread does for every message it sends."""


FEW_BYTES = 8192
"""Of an array, up to which it travels within the message that it belongs to."""


def tune() -> None:
    """Apply the changes to this process."""
    Syncable._debounce = DEBOUNCE_MS
    WSHandler.open = _open_without_delay(WSHandler.open)
    WSHandler.send_message = _send_at_once
    # Else each array that is sent has them look for it in the environment.
    settings.simple_ids.set_value(True)
    # Else each new page is searched for slips that only a change of the code could make.
    settings.perform_document_validation.set_value(False)
    settings.perform_error_diagnostics.set_value(False)
    sys.setswitchinterval(SWITCH_S)
    PropertyDescriptor._get_default = _kept(PropertyDescriptor._get_default)
    for (module, name), ours in REPLACED.items():
        # Not as an attribute: of some modules' names their packages speak as of what is in them.
        vars(import_module(module))[name] = ours


class QuickSerializer(Serializer):
    """Asks a model for its reference when it is needed: a page has hundreds."""

    def __init__(self, *, references: Collection[Any] = (), **options: Any) -> None:
        super().__init__(**options)
        self._known = dict(zip(map(id, references), references, strict=True))

    def _encode_bytes(self, obj: bytes | memoryview) -> Any:
        # Each array would travel as two messages of its own.
        if memoryview(obj).nbytes > FEW_BYTES:
            return super()._encode_bytes(obj)
        return BytesRep(type="bytes", data=b64encode(gzip.compress(bytes(obj), 0)).decode())

    def has_ref(self, obj: Any) -> bool:
        """Whether the page knows a model, or is told of it in this message."""
        return id(obj) in self._known or super().has_ref(obj)

    def get_ref(self, obj: Any) -> Any:
        """What names a model, or None."""
        known = self._known.get(id(obj))
        return super().get_ref(obj) if known is None else known.ref


class QuickDeserializer(Deserializer):
    """Looks for a model when a message names it: a page has hundreds."""

    def __init__(self, references: Sequence[Any] = (), **options: Any) -> None:
        super().__init__((), **options)
        self._before = references
        if references:
            self._models = references[0].document.models
            self._references = _Named(self._models)

    def deserialize(self, obj: Any) -> Any:
        """What the page says, but for what it says of models that are gone.

        Bokeh would drop all of such a message, whatever else a hand has done in the meantime.
        """
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
        """Whether a model was there before, or was made by this message."""
        return obj in self._before or super().has_ref(obj)


class _Named(dict[str, Any]):
    """Models by their names: those that are put in here, and all of a document."""

    def __init__(self, models: Any) -> None:
        super().__init__()
        self._models = models

    def get(self, name: str, default: Any = None) -> Any:
        """The model of a name; of a document's if there is none in here."""
        return self[name] if name in self else self._models.get_by_id(name)


REPLACED: dict[tuple[str, str], Any] = {
    ("bokeh.protocol.messages.patch_doc", "Serializer"): QuickSerializer,
    ("bokeh.document.document", "Deserializer"): QuickDeserializer,
    # What Panel calls a while after pages are gone.
    ("panel.io.document", "_garbage_collect"): collect_all,
}
"""What stands in the place of which name of which module."""


def _kept(get_default: Any) -> Any:
    """Finds a default that is the same for all models of a kind only once, and checks it then."""
    known: dict[tuple[type, str], Any] = {}

    def get(descriptor: PropertyDescriptor[Any], model: HasProps) -> Any:
        key = type(model), descriptor.name
        if vars(model).get("__themed_values__") is not None:
            return get_default(descriptor, model)
        if key not in known:
            default = get_default(descriptor, model)
            if descriptor.has_unstable_default(model):
                return default
            known[key] = default
        return known[key]

    return get


def _open_without_delay(open_: Any) -> Any:
    def open_now(self: WSHandler, *arguments: Any, **options: Any) -> Any:
        # TCP would hold back a small message until the last one is acknowledged, some 40 ms later.
        self.set_nodelay(True)
        return open_(self, *arguments, **options)

    return open_now


async def _send_at_once(socket: WSHandler, message: Message[Any]) -> None:
    # Bokeh lets all other sessions have their turn after each of the parts, under a lock: Panel
    # then keeps what it has to say, and what is said of models in there would come before them.
    parts: list[tuple[str | bytes, bool]] = [
        (message.header_json, False),
        (message.metadata_json, False),
        (message.content_json, False),
    ]
    for buffer in message.buffers:
        parts += [(json.dumps(buffer.ref), False), (buffer.to_bytes(), True)]
    with suppress(WebSocketClosedError):  # the page is gone
        await asyncio.gather(
            *(WebSocketHandler.write_message(socket, part, binary) for part, binary in parts)
        )
