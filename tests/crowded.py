"""The app with few sessions and short times: ``python -m tests.crowded``."""

from __future__ import annotations

import sys
from functools import partial

from app import __main__ as started
from app.server.limits import HTTP_LIMITS
from app.server.serve import server_of
from app.server.sessions import Bounds

BOUNDS = Bounds(sessions=3, unconnected=2, unconnected_s=4.0, check_s=0.5, retry_s=2, queued=3)

HTTP = {name: n / 5 if name.endswith("timeout") else n for name, n in HTTP_LIMITS.items()}
"""Limits of the HTTP server, with a fifth of its times."""

if __name__ == "__main__":
    started.server_of = partial(server_of, bounds=BOUNDS, http_limits=HTTP)
    sys.exit(started.main())
