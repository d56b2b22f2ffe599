"""The app with few sessions and short times: ``python -m tests.crowded``."""

from __future__ import annotations

import sys
from functools import partial

from app import __main__ as started
from app.server.limits import HTTP_LIMITS
from app.server.serve import server_of
from app.server.sessions import Bounds

BOUNDS = Bounds(sessions=4, unconnected=2, unconnected_s=4.0, check_s=0.5, retry_s=2, queued=3)

TIMES_S = {"body_timeout": 2.0, "idle_connection_timeout": 3.0}
"""Times of the HTTP server."""

if __name__ == "__main__":
    started.server_of = partial(server_of, bounds=BOUNDS, http_limits=HTTP_LIMITS | TIMES_S)
    sys.exit(started.main())
