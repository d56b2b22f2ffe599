"""What a browser needs for any page goes to it at once, and the page when it is built."""

from __future__ import annotations

import asyncio
from typing import Any

from bokeh.server.urls import per_app_patterns
from panel.io.server import DocHandler
from tornado.web import OutputTransform

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
    """Sends the head of the page before: the browser takes as long for its scripts as it is built.

    Heads are alike but for what an address asks for, and each page tells what it is for the next.
    """

    head = ""
    _is_alike = False

    async def get_session(self) -> Any:
        """The page, which is built in here."""
        if self.head:
            super().write(self.head)
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
            type(self).head = head
        super().write(chunk)


async def _quiet() -> None:
    for _ in range(LOOKS):
        before = Answers.count
        await asyncio.sleep(QUIET_S)
        if Answers.count == before:
            return


def send_heads_first() -> None:
    """Have pages served that way by servers that are made from now on."""
    per_app_patterns[:] = [
        (path, PageHandler if handler is DocHandler else handler)
        for path, handler in per_app_patterns
    ]
