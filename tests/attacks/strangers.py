"""Whoever does not know the token of a server: bodies, half requests, guesses, a socket."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import urlencode

from tests.attacks.attack import MIB, TOKEN, WITH_TOKEN, Attack, Outcome, Server, counted
from tests.attacks.routes import ask, own_token

BODY_BYTES = 95_000_000
MOST_GROWTH_BYTES = 64 * MIB
MOST_CHECKED_A_SECOND = 20
CLOSED_S = 30.0
"""By then a request that does not come to its end is given up."""

FORM = {"Content-Type": "application/x-www-form-urlencoded"}


async def connected(server: Server) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.wait_for(asyncio.open_connection("127.0.0.1", server.port), 10)


def head(server: Server, *more: str) -> bytes:
    """The beginning of a POST, whose end is still to come."""
    lines = ("POST / HTTP/1.1", f"Host: 127.0.0.1:{server.port}", *more)
    return "\r\n".join(lines).encode() + b"\r\n"


async def big_bodies(server: Server) -> Outcome:
    """Six bodies of 95 MB at once."""
    base = server.memory.now()

    async def send() -> int | str:
        reader, writer = await connected(server)
        kind = f"Content-Type: {FORM['Content-Type']}"
        writer.write(head(server, kind, f"Content-Length: {BODY_BYTES}") + b"\r\n")
        with suppress(ConnectionError):
            for _ in range(BODY_BYTES // MIB):
                writer.write(b"x" * MIB)
                await asyncio.wait_for(writer.drain(), 10)
        status: int | str = "closed"
        with suppress(ConnectionError):
            first = await asyncio.wait_for(reader.readline(), 30)
            status = int(first.split()[1]) if first else "closed"
        writer.close()
        return status

    said = await asyncio.gather(*(send() for _ in range(6)), return_exceptions=True)
    printed = [each if isinstance(each, int | str) else type(each).__name__ for each in said]
    grown = server.memory.peak_bytes - base
    return Outcome(6, f"{counted(printed)}; +{grown / MIB:.0f} MiB", grown < MOST_GROWTH_BYTES)


Links = list[tuple[asyncio.StreamReader, asyncio.StreamWriter]]


async def linger(server: Server, number: int, begin: bytes, more: Callable[[int], bytes]) -> str:
    """Open connections whose requests never end; in words, how many are still open after a while.

    Empty if none is.
    """
    links: Links = []
    for _ in range(number):
        with suppress(OSError):
            links.append(await connected(server))
            links[-1][1].write(begin)
    for beat in range(int(CLOSED_S)):
        for _, writer in links:
            if content := more(beat):
                writer.write(content)
        await asyncio.sleep(1)
    still = 0
    for reader, writer in links:
        try:
            while await asyncio.wait_for(reader.read(2**16), 0.01):
                pass
        except TimeoutError:
            still += 1
        except ConnectionError:
            pass
        writer.close()
    return f"{still} of {number}" if still else ""


async def lingering(server: Server) -> Outcome:
    """Headers and bodies that never end, each a little at a time or not at all."""
    body = head(server, f"Content-Type: {FORM['Content-Type']}", "Content-Length: 1000") + b"\r\n"
    kinds = {
        "half-open": (300, head(server), lambda beat: b""),
        "silent": (300, b"", lambda beat: b""),
        "a header line a second": (50, head(server), lambda beat: f"X{beat}: y\r\n".encode()),
        "a byte of the body a second": (50, body, lambda beat: b"x"),
    }
    found = await asyncio.gather(*(linger(server, *kind) for kind in kinds.values()))
    open_ = [f"{still} {name}" for name, still in zip(kinds, found, strict=True) if still]
    begun = time.monotonic()
    status = (await asyncio.to_thread(ask, server, "/"))[0]
    said = (
        f"open after {CLOSED_S:.0f} s: {', '.join(open_) or 'none'}; "
        f"then {status} to another in {time.monotonic() - begun:.1f} s"
    )
    return Outcome(700, said, not open_ and status in (200, 403))


async def guesses(server: Server) -> Outcome:
    """As many wrong tokens as there is time for; how many are looked at, and who else gets in?"""
    said: list[int | str] = []
    begun = time.monotonic()

    async def guess(number: int) -> None:
        form = urlencode({"token": f"wrong {number}"}).encode()
        status, text = await asyncio.to_thread(ask, server, "/", "POST", form, 20.0, **FORM)
        said.append("looked at" if "not the token" in text else status)

    async def some(first: int) -> None:
        for number in range(first, 500, 20):
            if time.monotonic() - begun < 15:
                await guess(number)

    await asyncio.gather(*(some(first) for first in range(20)))
    took_s = time.monotonic() - begun
    rate = said.count("looked at") / took_s
    right_s, status = time.monotonic(), 0
    while time.monotonic() - right_s < 40 and status != 303:
        status = (await asyncio.to_thread(ask, server, f"/?{urlencode({'token': TOKEN})}"))[0]
        await asyncio.sleep(0 if status == 303 else 1)
    words = (
        f"{counted(said)} in {took_s:.1f} s, {rate:.0f} a second; "
        f"the right one {status} after {time.monotonic() - right_s:.1f} s"
    )
    return Outcome(len(said), words, rate <= MOST_CHECKED_A_SECOND and status == 303)


async def sockets(server: Server) -> Outcome:
    """Sockets and pages of a session without the token."""
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec-WebSocket-Protocol": f"bokeh, {own_token()}",
    }
    paths = ("/ws", "/", "/autoload.js", "/static/js/bokeh.min.js", "/components/this/x/_css/y")
    said = [(await asyncio.to_thread(ask, server, path, **upgrade))[0] for path in paths]
    return Outcome(len(said), counted(said), all(status == 403 for status in said))


ATTACKS = [
    Attack("no token: six bodies of 95 MB", big_bodies, WITH_TOKEN),
    Attack("no token: requests that never end", lingering, WITH_TOKEN),
    Attack("no token: a socket, a page, a module", sockets, WITH_TOKEN),
    Attack("no token: guesses", guesses, WITH_TOKEN),
]
