"""A client that may send any header, and a server in a thread of the tests.

The server has the routes, limits and access control of the app, but an empty page: that of the app
takes seconds to start and to build.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from http.client import HTTPConnection, HTTPMessage
from queue import SimpleQueue
from threading import Thread
from typing import Any

import panel as pn

from app.server.access import Access
from app.server.ports import free_port
from app.server.serve import server_of

TOKEN = "a token <b>of</b> ours"
NAME = "lab.example.org"

UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec_WebSocket_Version": "13",
    "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
}


class Site:
    """A client of a server on this machine."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.port = int(address.rstrip("/").rpartition(":")[2])

    def send(
        self, path: str = "/", method: str = "GET", body: str | None = None, **headers: str
    ) -> HTTPConnection:
        """Send a request, and return its connection."""
        link = HTTPConnection("127.0.0.1", self.port, timeout=120)
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        link.request(method, path, body, named)
        return link

    def ask(self, *request: str, **headers: str) -> tuple[int, HTTPMessage, str]:
        """Return status, headers and text of the response to a request."""
        with closing(self.send(*request, **headers)) as link:
            answer = link.getresponse()
            return answer.status, answer.headers, answer.read().decode(errors="replace")

    def connect(self, token: str, **headers: str) -> tuple[HTTPConnection, int]:
        """Request a session's socket; return the connection, and 101 if it was accepted."""
        protocol = f"bokeh, {token}"
        link = self.send("/ws", **UPGRADE, Sec_WebSocket_Protocol=protocol, **headers)
        return link, link.getresponse().status

    def socket(self, token: str, **headers: str) -> int:
        """Return the status of a request for a session's socket, and close it."""
        link, status = self.connect(token, **headers)
        link.close()
        return status


@contextmanager
def empty_site(
    address: str = "127.0.0.1",
    origins: Sequence[str] = (),
    token: str | None = None,
    **limits: Any,
) -> Iterator[Site]:
    """Serve an empty page as if on this address; further arguments are those of `server_of`."""
    begun: SimpleQueue[Any] = SimpleQueue()

    async def serve() -> None:
        port, ended = free_port("127.0.0.1"), asyncio.Event()
        access = Access.of(address, port, list(origins), token)
        server = server_of(pn.Column, access, "127.0.0.1", port, **limits)
        server.start()
        begun.put((port, asyncio.get_running_loop(), ended))
        await ended.wait()
        server.stop()

    thread = Thread(target=lambda: asyncio.run(serve()), daemon=True)
    thread.start()
    port, loop, ended = begun.get(timeout=60)
    try:
        yield Site(f"http://127.0.0.1:{port}/")
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
