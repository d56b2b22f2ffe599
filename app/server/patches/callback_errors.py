"""Show an exception in a callback of a Bokeh model on the page where it occurred.

Bokeh sends the traceback to the browser, where it is seen only in the console. Panel shows
exceptions of its own callbacks through its exception handler; this one goes the same way, and the
browser receives no traceback. Upstream: none found. Fixes errors that are not shown.
"""

from __future__ import annotations

import sys
from typing import Any

from bokeh.protocol.message import Message
from bokeh.server.connection import ServerConnection
from panel.io.state import set_curdoc, state


def apply() -> None:
    """Replace the error message of Bokeh's connections."""
    ServerConnection.error = _show_on_page


def _show_on_page(connection: ServerConnection, message: Message[Any], text: str) -> Message[Any]:
    failure = sys.exception()
    if failure is not None:
        with set_curdoc(connection.session.document):
            state._handle_exception(failure)
    answer = connection.protocol.create(
        "ERROR", message.header["msgid"], "The error is shown in the app."
    )
    answer.content["traceback"] = None
    return answer
