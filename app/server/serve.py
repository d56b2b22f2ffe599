"""The server with access control, limits and routes in place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import panel as pn
from bokeh.server.server import Server

from app.server.access import Access, Headers, guard
from app.server.limits import HTTP_LIMITS, Connections
from app.server.opening import ResponseCount
from app.server.routes import MOST_MESSAGE_BYTES, restrict
from app.server.sessions import Bounds, Sessions
from app.widgets.connection import LINGER_S, serving_options


def server_of(
    build_page: Callable[[], Any],
    access: Access,
    address: str,
    port: int,
    linger_s: float = LINGER_S,
    bounds: Bounds | None = None,
    http_limits: Mapping[str, Any] = HTTP_LIMITS,
) -> Server:
    """Return a server that has not been started.

    Parameters
    ----------
    build_page : callable
        Called once for each session.
    access : Access
    address : str
        Address to listen on.
    port : int
    linger_s : float
        Seconds for which a session is kept after its page was closed or disconnected.
    bounds : Bounds, optional
        Limits on all sessions together.
    http_limits : mapping
        Options of the HTTP server.

    Raises
    ------
    ValueError
        If `linger_s` is out of bounds.
    OSError
        If the port is not available.
    """
    server = pn.serve(
        {"/": build_page},
        port=port,
        address=address,
        websocket_origin=sorted(access.hosts),
        websocket_max_message_size=MOST_MESSAGE_BYTES,
        http_server_kwargs=dict(http_limits),
        transforms=[Headers, ResponseCount],
        title="firstphoton",
        verbose=False,
        show=False,
        start=False,
        **serving_options(linger_s),
    )
    connections, (context,) = Connections(), server._tornado.applications.values()
    sessions = Sessions(context, bounds)
    connections.bound(server._http)
    restrict(server._tornado, sessions)
    guard(server._tornado, access, connections)
    sessions.start()
    return server
