"""Sessions that nobody looks at: pages fetched and never connected, sockets without a page."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from functools import partial

from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import websocket_connect

from app.server.sessions import Bounds
from tests.attacks.attack import MIB, Attack, Outcome, Server, counted
from tests.attacks.routes import own_token
from tests.wire import Wire

MOST_GROWTH_BYTES = 2 * Bounds().unconnected * 64 * MIB
"""By the sessions that wait for a browser, of the largest scene, and by as many that have ended and
are not collected yet."""

MOST_GROWTH_AGAIN_BYTES = 128 * MIB
"""By a second wave, once the sessions of the first have been forgotten."""

FORGOTTEN_S = 30.0
AT_ONCE = 4

Status = int | str


async def fetched(address: str, limit_s: float) -> Status:
    """Status of a GET whose page is thrown away."""
    answer = await AsyncHTTPClient().fetch(
        address, raise_error=False, request_timeout=limit_s, headers={"Accept-Encoding": "gzip"}
    )
    return int(answer.code)


async def wave(times: int, seconds: float, once: Callable[[], Awaitable[Status]]) -> list[Status]:
    """Do something several times, a few at once, bounded in count and time."""
    until_s, said = time.monotonic() + seconds, []

    async def some() -> None:
        while len(said) < times and time.monotonic() < until_s:
            try:
                said.append(await once())
            except Exception as error:  # refused, however that looks
                said.append(type(error).__name__)

    await asyncio.gather(*(some() for _ in range(AT_ONCE)))
    return said


async def flood(
    once: Callable[[Server], Awaitable[Status]], times: int, seconds: float, server: Server
) -> Outcome:
    """A wave of sessions that nobody looks at."""
    base = server.memory.now()
    said = await wave(times, seconds, partial(once, server))
    grown = server.memory.peak_bytes - base
    return Outcome(len(said), f"{counted(said)}; +{grown / MIB:.0f} MiB", grown < MOST_GROWTH_BYTES)


async def flood_again(
    once: Callable[[Server], Awaitable[Status]], times: int, seconds: float, server: Server
) -> Outcome:
    """A wave of sessions, a pause in which they should be forgotten, a page, a smaller wave."""
    first = await flood(once, times, seconds, server)
    await asyncio.sleep(FORGOTTEN_S)
    begun = time.monotonic()
    try:
        wire = Wire()
        await asyncio.wait_for(wire.open(server.address, **server.headers), 20)
        wire.close()
        opened, is_open = f"a new page in {time.monotonic() - begun:.1f} s", True
    except Exception as error:  # whatever it is, no page was had
        opened, is_open = f"NO new page ({type(error).__name__})", False
    before = server.memory.peak_bytes
    said = await wave(times // 3, seconds / 3, partial(once, server))
    again = server.memory.peak_bytes - before
    words = (
        f"{first.said}; {FORGOTTEN_S:.0f} s later {opened}, then {counted(said)}: "
        f"another +{again / MIB:.0f} MiB"
    )
    held = first.held and is_open and again < MOST_GROWTH_AGAIN_BYTES
    return Outcome(first.times + len(said), words, held)


async def page(query: str, server: Server) -> Status:
    """Fetch a page and never connect."""
    return await fetched(server.address + query, 60)


async def socket(server: Server) -> Status:
    """Open a socket with a token of our own making, and close it at once."""
    link = await websocket_connect(
        HTTPRequest(server.address.replace("http", "ws", 1) + "ws", request_timeout=60),
        subprotocols=["bokeh", own_token()],
    )
    said = await asyncio.wait_for(link.read_message(), 60)
    link.close()
    return "closed" if said is None else "session made"


ATTACKS = [
    Attack("pages never connected", partial(flood_again, partial(page, ""), 150, 40)),
    Attack(
        "pages of a large scene, never connected",
        partial(flood_again, partial(page, "?source=car_256"), 12, 30),
    ),
    Attack(
        "autoload.js, never connected",
        partial(flood, partial(page, "autoload.js?bokeh-autoload-element=x"), 60, 20),
    ),
    Attack("sockets with tokens of our own", partial(flood, socket, 60, 20)),
]
