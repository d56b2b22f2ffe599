"""The app with small limits on sessions: ``python -m tests.crowded``."""

from __future__ import annotations

import sys
from functools import partial

from app import __main__ as started
from app.server.serve import server_of
from app.server.sessions import Bounds

BOUNDS = Bounds(sessions=4, unconnected=2, unconnected_s=4.0, queued=3)

if __name__ == "__main__":
    started.server_of = partial(server_of, bounds=BOUNDS)
    sys.exit(started.main())
