"""A page that loses its server says so, waits, and comes back to the session that it had."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any, ClassVar

import param

from app.widgets.component import Component
from core.checks import require

LINGER_S = 180
"""A session is kept for so long when no page is connected to it: while a page is loaded anew, or a
connection is lost for a minute."""


LEAST_LINGER_S, MOST_LINGER_S = 5.0, 86_400.0
"""Bounds of the option: a reloaded page needs some seconds to return to its session."""


def serving_options(linger_s: float = LINGER_S) -> dict[str, Any]:
    """What ``panel.serve`` must be told for that.

    Raises
    ------
    ValueError
        If that is too short for a page to connect, or longer than a day.
    """
    accepted = LEAST_LINGER_S <= linger_s <= MOST_LINGER_S
    require("--linger", linger_s, accepted, f"{LEAST_LINGER_S:g} to {MOST_LINGER_S:g} seconds")
    return {
        "unused_session_lifetime_milliseconds": round(1000 * linger_s),
        "check_unused_sessions_milliseconds": 1000,
    }


class Connection(Component):
    """Watches the connection of a page.

    While it is lost a dialog covers the page, for what would be chosen meanwhile would be lost.
    When the server answers again the page is loaded anew, from the same session if that is still
    kept, and else from the address.

    Bokeh's own reconnection is not used: until 3.9 at least it leaves a page as it was when it was
    cut off (bokeh/bokeh#15347), and it gives up after half a minute.
    """

    session = param.String(default="", doc="By which the server knows the session.")
    made = param.String(default="", doc="Tells this session from another of the same name.")

    _esm = Path(__file__).with_name("connection.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("connection.css")]

    def __init__(self, session: str, **params: Any) -> None:
        super().__init__(session=session, made=secrets.token_hex(8), **params)
