"""What a browser needs for any page goes to it at once, and the page when it is built."""

from __future__ import annotations

import asyncio
import re
from typing import Any

from panel.io.server import DocHandler
from tornado.web import HTTPError, OutputTransform

from app.server.messages import full_page
from app.server.sessions import RETRY_S, Sessions

QUIET_S = 0.1
"""Time after which a browser that has not asked for a head's files has them already. They come from
the thread that builds the page, and would wait for it."""

LOOKS = 5
"""Times that is waited for at most, however many others ask for something."""

_SESSION_ID = re.compile(r"[A-Za-z0-9_-]{8,128}")


class Answers(OutputTransform):
    """Counts what is answered."""

    count = 0

    def transform_first_chunk(self, *answer: Any) -> Any:
        """As tornado calls it before anything is sent."""
        type(self).count += 1
        return super().transform_first_chunk(*answer)


class PageHandler(DocHandler):
    """Sends the head of the page before: the browser takes as long for its scripts as it is built.

    Heads are alike but for what an address asks for, and each page tells what it is for the next.
    Where there is no room for a session, none is built, and the page says so.
    """

    known_head = ""
    _is_alike = False

    def initialize(self, sessions: Sessions, **options: Any) -> None:
        """Take over what the route was made with."""
        super().initialize(**options)
        self._sessions = sessions

    async def get(self, *arguments: Any, **options: Any) -> None:
        """Build the page, or say that there is no room for it."""
        with self._sessions.opening(self._named_session()) as has_room:
            if has_room:
                await super().get(*arguments, **options)
                return
        self.set_status(503)
        self.set_header("Retry-After", str(RETRY_S))
        self.set_header("Cache-Control", "no-store")
        self.finish(full_page(RETRY_S))

    def _named_session(self) -> str | None:
        """The session that a reloaded page returns to.

        Raises
        ------
        HTTPError
            If the name is none that the server gives, or the request brings a token of its own.
        """
        named = self.get_query_argument("bokeh-session-id", None)
        is_plain = named is None or _SESSION_ID.fullmatch(named) is not None
        others = (
            "Bokeh-Session-Id" in self.request.headers or "bokeh-token" in self.request.arguments
        )
        if others or not is_plain:
            raise HTTPError(400, "the session cannot be chosen that way")
        return named

    async def get_session(self) -> Any:
        """The page, which is built in here."""
        if self.known_head:
            super().write(self.known_head)
            await self.flush()
            await _quiet()
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
