"""Two defaults of the libraries that cost most of a slider's time, changed in one place.

Measured by ``python -m tests.latency``: neither change alone gains much, both together halve the
time from a slider's move to changed pixels.
"""

from __future__ import annotations

from typing import Any

from bokeh.server.views.ws import WSHandler
from panel.reactive import Syncable

DEBOUNCE_MS = 4
"""Panel collects property changes for 50 ms. So short a time suits callbacks as short as ours,
which hand the work to `app.jobs`; under slow ones it would build a backlog."""


def tune() -> None:
    """Apply both changes to this process."""
    Syncable._debounce = DEBOUNCE_MS
    WSHandler.open = _open_without_delay(WSHandler.open)


def _open_without_delay(open_: Any) -> Any:
    def open_now(self: WSHandler, *arguments: Any, **options: Any) -> Any:
        # TCP would hold back a small message until the last one is acknowledged, some 40 ms later.
        self.set_nodelay(True)
        return open_(self, *arguments, **options)

    return open_now
