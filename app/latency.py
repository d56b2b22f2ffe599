"""Defaults of the libraries that cost most of a slider's time, changed in one place.

Measured by ``python -m tests.latency``: neither of the first two changes alone gains much, both
together halve the time from a slider's move to changed pixels. The others are for many sessions at
once, see ``python -m tests.load``.
"""

from __future__ import annotations

import asyncio
import json
import sys
from contextlib import suppress
from typing import Any

from bokeh.protocol.message import Message
from bokeh.server.views.ws import WSHandler
from bokeh.settings import settings
from panel.reactive import Syncable
from tornado.websocket import WebSocketClosedError, WebSocketHandler

DEBOUNCE_MS = 4
"""Panel collects property changes for 50 ms. So short a time suits callbacks as short as ours,
which hand the work to `app.jobs`; under slow ones it would build a backlog."""

SWITCH_S = 1e-4
"""A thread that computes keeps the others waiting for 5 ms whenever they have let go of the
interpreter, as the page's thread does for every message it sends."""


def tune() -> None:
    """Apply the changes to this process."""
    Syncable._debounce = DEBOUNCE_MS
    WSHandler.open = _open_without_delay(WSHandler.open)
    WSHandler.send_message = _send_at_once
    # Else each array that is sent has them look for it in the environment.
    settings.simple_ids.set_value(True)
    sys.setswitchinterval(SWITCH_S)


def _open_without_delay(open_: Any) -> Any:
    def open_now(self: WSHandler, *arguments: Any, **options: Any) -> Any:
        # TCP would hold back a small message until the last one is acknowledged, some 40 ms later.
        self.set_nodelay(True)
        return open_(self, *arguments, **options)

    return open_now


async def _send_at_once(socket: WSHandler, message: Message[Any]) -> None:
    # Bokeh lets all other sessions have their turn after each of the parts, and Panel keeps what
    # it has to say until the last of them is sent.
    parts: list[tuple[str | bytes, bool]] = [
        (message.header_json, False),
        (message.metadata_json, False),
        (message.content_json, False),
    ]
    for buffer in message.buffers:
        parts += [(json.dumps(buffer.ref), False), (buffer.to_bytes(), True)]
    with await socket.write_lock.acquire(), suppress(WebSocketClosedError):  # the page is gone
        await asyncio.gather(
            *(WebSocketHandler.write_message(socket, part, binary) for part, binary in parts)
        )
