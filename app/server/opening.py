"""Serve the head of a page at once, and its body when it has been built."""

from __future__ import annotations

import asyncio
from typing import Any
from urllib.parse import urlsplit

from panel.io.server import DocHandler
from tornado.web import HTTPError, OutputTransform

from app.server.messages import full_page
from app.server.sessions import Sessions

QUIET_S = 0.1
"""Time without requests after which a browser has the files of the head. They come from the thread
that builds the page, and would wait for it."""

MOST_WAITS = 5
"""Most times that this is waited for, however many other requests come."""


class ResponseCount(OutputTransform):
    """Counts responses."""

    count = 0

    def transform_first_chunk(self, *response: Any) -> Any:
        """Count a response before anything is sent; called by Tornado."""
        type(self).count += 1
        return super().transform_first_chunk(*response)


class PageHandler(DocHandler):
    """Sends the head first, so that the browser loads its scripts while the page is built.

    Heads differ only by the query of the address; the head of a page without one is used for the
    next pages. Without room for a session, none is built, and the page says so.
    """

    known_head = ""
    _has_common_head = _is_left = False

    def initialize(self, sessions: Sessions, **options: Any) -> None:
        """Store the arguments of the route."""
        super().initialize(**options)
        self._sessions = sessions

    async def get(self, *arguments: Any, **options: Any) -> None:
        """Build the page, or report that the server is full."""
        with self._sessions.opening(self._returning()) as has_room:
            if has_room:
                await super().get(*arguments, **options)
                return
        retry_s = self._sessions.bounds.retry_s
        self.set_status(503)
        self.set_header("Retry-After", str(retry_s))
        self.set_header("Cache-Control", "no-store")
        self.finish(full_page(retry_s))

    def on_connection_close(self) -> None:
        """Record that the browser has left."""
        self._is_left = True

    def _returning(self) -> str | None:
        """Return the existing session to which one of its own pages returns.

        A session or a token in a link of another origin is ignored: its author would know the
        session of everyone who follows the link.
        """
        arguments, headers = self.request.arguments, self.request.headers
        named = self.get_query_argument("bokeh-session-id", None)
        is_own_page = urlsplit(headers.get("Referer", "")).netloc == self.request.host
        headers.pop("Bokeh-Session-Id", None)
        arguments.pop("bokeh-token", None)
        if named is not None and is_own_page and self._sessions.has(named):
            return named
        arguments.pop("bokeh-session-id", None)
        return None

    async def get_session(self) -> Any:
        """Send the known head, and build the page."""
        if self.known_head:
            super().write(self.known_head)
            await self.flush()
            await when_quiet()
        async with self._sessions.building():
            if self._is_left:
                raise HTTPError(400, "the browser has left")
            session = await super().get_session()
        is_page = "is_page" in session.document.template_variables
        self._has_common_head = is_page and not self.request.query
        return session

    def write(self, chunk: str) -> None:
        """Send the page without what was sent before; called by Panel."""
        head, *rest = chunk.partition("</head>")
        if self._headers_written:
            chunk = "".join(rest)
        elif self._has_common_head:
            type(self).known_head = head
        super().write(chunk)


async def when_quiet() -> None:
    """Wait until there are no requests for a moment, but not for long."""
    for _ in range(MOST_WAITS):
        before = ResponseCount.count
        await asyncio.sleep(QUIET_S)
        if ResponseCount.count == before:
            return
