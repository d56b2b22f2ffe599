"""Serve the head of a page at once, and the page itself when it is built."""

from __future__ import annotations

import asyncio
from typing import Any
from urllib.parse import urlsplit

from panel.io.server import DocHandler
from tornado.web import HTTPError, OutputTransform

from app.server.messages import full_page
from app.server.sessions import RETRY_S, Sessions

QUIET_S = 0.1
"""Time after which a browser that has not asked for a head's files has them already. They come from
the thread that builds the page, and would wait for it."""

LOOKS = 5
"""Times that is waited for at most, however many others ask for something."""


class Answers(OutputTransform):
    """Counts what is answered."""

    count = 0

    def transform_first_chunk(self, *answer: Any) -> Any:
        """As tornado calls it before anything is sent."""
        type(self).count += 1
        return super().transform_first_chunk(*answer)


class PageHandler(DocHandler):
    """Sends the head of a page first: the browser loads its scripts while the page is built.

    Heads differ only by what an address asks for, so that each page keeps its head for the next.
    Where there is no room for a session, none is built, and the page says so.
    """

    known_head = ""
    _is_alike = _is_left = False

    def initialize(self, sessions: Sessions, **options: Any) -> None:
        """Take over what the route was made with."""
        super().initialize(**options)
        self._sessions = sessions

    async def get(self, *arguments: Any, **options: Any) -> None:
        """Build the page, or say that there is no room for it."""
        with self._sessions.opening(self._returning()) as has_room:
            if has_room:
                await super().get(*arguments, **options)
                return
        self.set_status(503)
        self.set_header("Retry-After", str(RETRY_S))
        self.set_header("Cache-Control", "no-store")
        self.finish(full_page(RETRY_S))

    def on_connection_close(self) -> None:
        """Nobody waits for the page any more."""
        self._is_left = True

    def _returning(self) -> str | None:
        """The session that one of its own pages returns to, where that is still there.

        A name that comes by a link, or a token, is ignored: whoever made the link would know the
        session of whoever follows it.
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
        """The page, which is built in here."""
        if self.known_head:
            super().write(self.known_head)
            await self.flush()
            await _quiet()
        async with self._sessions.building():
            if self._is_left:
                raise HTTPError(400, "the browser has left")
            session = await super().get_session()
        self._is_alike = "is_page" in session.document.template_variables and not self.request.query
        return session

    def write(self, chunk: str) -> None:
        """Send the page, as Panel calls it, without what was sent before."""
        head, *rest = chunk.partition("</head>")
        if self._headers_written:
            chunk = "".join(rest)
        elif self._is_alike:
            type(self).known_head = head
        super().write(chunk)


async def _quiet() -> None:
    for _ in range(LOOKS):
        before = Answers.count
        await asyncio.sleep(QUIET_S)
        if Answers.count == before:
            return
