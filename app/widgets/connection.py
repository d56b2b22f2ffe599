"""Return of a page to its session after the connection to the server was lost."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any, ClassVar

import param

from app.widgets.component import Component
from core.checks import require

LINGER_S = 180
"""Time for which a session without a page is kept: during a reload or a lost connection."""

LEAST_LINGER_S, MOST_LINGER_S = 5.0, 86_400.0
"""Bounds of the option: a reloaded page needs some seconds to return to its session."""


def serving_options(linger_s: float = LINGER_S) -> dict[str, Any]:
    """Return the options of ``panel.serve`` that keep sessions for so long.

    Raises
    ------
    ValueError
        If the time is too short for a page to connect, or longer than a day.
    """
    accepted = LEAST_LINGER_S <= linger_s <= MOST_LINGER_S
    require("--linger", linger_s, accepted, f"{LEAST_LINGER_S:g} to {MOST_LINGER_S:g} seconds")
    return {
        "unused_session_lifetime_milliseconds": round(1000 * linger_s),
        "check_unused_sessions_milliseconds": 1000,
    }


class Connection(Component):
    """Watch the connection of a page.

    While it is lost, a dialog covers the page, since changes would be lost. When the server
    responds again the page is reloaded, with the same session if it is still kept, else from the
    address.

    Panel's ``reconnect`` is not used: it leaves the page as it was when the connection was lost
    (bokeh/bokeh#15347, Bokeh 3.9), and gives up after half a minute.
    """

    session = param.String(default="", doc="The server's name of the session.")
    made = param.String(default="", doc="Distinguishes this session from others of that name.")

    _esm = Path(__file__).with_name("connection.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("connection.css")]

    def __init__(self, session: str, **params: Any) -> None:
        super().__init__(session=session, made=secrets.token_hex(8), **params)
