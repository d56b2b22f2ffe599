"""Changes to how Bokeh and Panel keep a page and its document together."""

from __future__ import annotations

import sys
from typing import Any

from bokeh.protocol.message import Message
from bokeh.server.connection import ServerConnection
from bokeh.server.session import ServerSession
from panel.io.state import set_curdoc, state


def keep_tracebacks() -> None:
    """Tell what goes wrong in a callback of a Bokeh model by its page, as Panel does of its own.

    Bokeh sends the traceback to the browser, which shows it to nobody but the curious.
    """
    ServerConnection.error = _told


def _told(connection: ServerConnection, message: Message[Any], text: str) -> Message[Any]:
    failure = sys.exception()
    if failure is not None:
        with set_curdoc(connection.session.document):
            state._handle_exception(failure)
    answer = connection.protocol.create(
        "ERROR", message.header["msgid"], "The error is shown in the app."
    )
    answer.content["traceback"] = None
    return answer


def send_early_changes() -> None:
    """Send what changes on a page between its first picture and the moment it is all drawn.

    The browser has then pulled the document, but Panel takes it for not connected before it says
    that it has drawn it, and drops what changes until then.
    """
    ServerSession._handle_pull = _connecting(ServerSession._handle_pull)


def _connecting(pull: Any) -> Any:
    async def pull_now(session: ServerSession, *arguments: Any) -> Any:
        document = await pull(session, *arguments)
        state._connected[session.document] = True  # no sooner: the document goes first
        return document

    return pull_now
