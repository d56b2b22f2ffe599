"""Return the memory of closed pages to the system.

Panel collects garbage some time after a page is closed. This app freezes long-lived objects
(`app.server.garbage`), which that collection would skip, and glibc would keep the memory.
Upstream: none found. Gain: after 20 closed sessions of 256 × 256 pixels, 0.5 instead of 1.4 GiB
resident.
"""

from __future__ import annotations

import panel.io.document

from app.server.garbage import collect_all


def apply() -> None:
    """Replace Panel's collection."""
    panel.io.document._garbage_collect = collect_all
