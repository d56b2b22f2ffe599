"""Pages that are requested but never connected, with the server's own limits."""

from __future__ import annotations

import asyncio
import time
from functools import partial

from tornado.httpclient import AsyncHTTPClient

from app.server.sessions import Bounds
from tests.attacks.attack import MIB, Attack, Outcome, Server, counted
from tests.wire import Wire

MOST_GROWTH_BYTES = 2 * Bounds().unconnected * 64 * MIB
"""Memory of the sessions of the largest scene that wait for a browser, and of as many that have
ended and are not collected yet."""

MOST_GROWTH_AGAIN_BYTES = 128 * MIB
"""Memory of a second wave, once the sessions of the first have ended."""

ENDED_S = 30.0
AT_ONCE = 4


async def wave(address: str, times: int, seconds: float) -> list[int | str]:
    """Request a page several times, a few at once; return the statuses."""
    until_s, statuses = time.monotonic() + seconds, []

    async def some() -> None:
        while len(statuses) < times and time.monotonic() < until_s:
            try:
                answer = await AsyncHTTPClient().fetch(
                    address, raise_error=False, request_timeout=60
                )
                statuses.append(int(answer.code))
            except Exception as error:  # refused, however that looks
                statuses.append(type(error).__name__)

    await asyncio.gather(*(some() for _ in range(AT_ONCE)))
    return statuses


async def flood(query: str, times: int, seconds: float, server: Server) -> Outcome:
    """A wave of pages, a pause in which they should end, a real page, and a smaller wave."""
    base = server.memory.now()
    first = await wave(server.address + query, times, seconds)
    grown = server.memory.peak_bytes - base
    await asyncio.sleep(ENDED_S)
    begun = time.monotonic()
    try:
        wire = Wire()
        await asyncio.wait_for(wire.open(server.address), 20)
        wire.close()
        opened, is_open = f"a new page in {time.monotonic() - begun:.1f} s", True
    except Exception as error:  # in any case, no page was opened
        opened, is_open = f"NO new page ({type(error).__name__})", False
    before = server.memory.peak_bytes
    second = await wave(server.address + query, times // 3, seconds / 3)
    again = server.memory.peak_bytes - before
    text = (
        f"{counted(first)}; +{grown / MIB:.0f} MiB; {ENDED_S:.0f} s later {opened}, "
        f"then {counted(second)}: another +{again / MIB:.0f} MiB"
    )
    held = grown < MOST_GROWTH_BYTES and is_open and again < MOST_GROWTH_AGAIN_BYTES
    return Outcome(len(first) + len(second), text, held)


ATTACKS = [
    Attack("pages never connected", partial(flood, "", 150, 40)),
    Attack("pages of a large scene, never connected", partial(flood, "?source=car_256", 12, 30)),
]
