"""The app with few sessions and short times: ``python -m tests.crowded``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any
from weakref import WeakSet

from tornado.ioloop import PeriodicCallback

from app import __main__ as started
from app.server.limits import HTTP_LIMITS
from app.server.serve import server_of
from app.server.sessions import Bounds

BOUNDS = Bounds(sessions=3, unconnected=2, unconnected_s=4.0, check_s=0.5, retry_s=2, queued=3)

HTTP = {name: n / 5 if name.endswith("timeout") else n for name, n in HTTP_LIMITS.items()}
"""Limits of the HTTP server, with a fifth of its times."""

COUNTED = "TESTS_COUNT_PAGES"
"""Variable with the path of a file that keeps the number of pages in memory."""


def counting(build: Any, *arguments: Any) -> Any:
    """Return a server that counts the pages which it has built and still holds."""
    pages: WeakSet[Any] = WeakSet()

    def page() -> Any:
        made = build()
        pages.add(made)
        return made

    server = server_of(page, *arguments, bounds=BOUNDS, http_limits=HTTP)
    if path := os.environ.get(COUNTED):
        PeriodicCallback(lambda: Path(path).write_text(f"{len(pages)}"), 500).start()
    return server


if __name__ == "__main__":
    started.server_of = counting
    sys.exit(started.main())
