"""Serialize references on demand, and small arrays within their message.

Bokeh collects the references of all models of the page for each message to the browser, and sends
each array as two messages of its own. Upstream: none found. Gain: a step of a slider takes 8
instead of 31 parts of messages, and 6 % less CPU time of the server.
"""

from __future__ import annotations

import gzip
from base64 import b64encode
from collections.abc import Collection
from importlib import import_module
from typing import Any

from bokeh.core.serialization import BytesRep, Serializer

INLINE_BYTES = 8192
"""Size of an array up to which it travels within the message."""


def apply() -> None:
    """Replace the serializer of messages to the browser."""
    # Not as an attribute: the package has a class of the module's name.
    vars(import_module("bokeh.protocol.messages.patch_doc"))["Serializer"] = QuickSerializer


class QuickSerializer(Serializer):
    """Serializer that asks a model for its reference when it is needed."""

    def __init__(self, *, references: Collection[Any] = (), **options: Any) -> None:
        super().__init__(**options)
        self._known = dict(zip(map(id, references), references, strict=True))

    def _encode_bytes(self, obj: bytes | memoryview) -> Any:
        if memoryview(obj).nbytes > INLINE_BYTES:
            return super()._encode_bytes(obj)
        return BytesRep(type="bytes", data=b64encode(gzip.compress(bytes(obj), 0)).decode())

    def has_ref(self, obj: Any) -> bool:
        """Whether the page has a model, or receives it with this message."""
        return id(obj) in self._known or super().has_ref(obj)

    def get_ref(self, obj: Any) -> Any:
        """Return the reference of a model, or None."""
        known = self._known.get(id(obj))
        return super().get_ref(obj) if known is None else known.ref
