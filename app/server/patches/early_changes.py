"""Send changes that are made while the browser draws the page for the first time.

Panel regards a page as disconnected until the browser reports that it has drawn it, and drops what
changes between then and the moment at which the browser pulled the document. Upstream: none found.
Fixes lost changes: a link to a region would show "Computing …" for ever.
"""

from __future__ import annotations

from typing import Any

from bokeh.server.session import ServerSession
from panel.io.state import state


def apply() -> None:
    """Mark a document as connected as soon as it is pulled."""
    ServerSession._handle_pull = _connecting(ServerSession._handle_pull)


def _connecting(pull: Any) -> Any:
    async def pull_now(session: ServerSession, *arguments: Any) -> Any:
        document = await pull(session, *arguments)
        state._connected[session.document] = True  # no sooner: the document goes first
        return document

    return pull_now
