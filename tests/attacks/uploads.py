"""Files and messages that a page sends while another session is used."""

from __future__ import annotations

import asyncio
import time
from functools import partial
from typing import Any

from app.model.uploads import safe_name
from core.tests.samples import OWN_FIELDS, npz_bytes
from tests.attacks.attack import MIB, Attack, Outcome, Server
from tests.attacks.files import HUNGRY, STRAY
from tests.wire import Wire

CHUNK_BYTES = 10 * MIB
MOST_BYTES = 1536 * MIB
ANSWERED_S = 60.0


class Tab:
    """A page in which files are opened."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire
        data = wire.find("", label="Open a capture file")
        self._file = next(
            key
            for key, model in wire.models.items()
            if _id(model["attributes"].get("data")) == data
        )
        self._alert = wire.find("Sentence", warning=True)

    @property
    def alert(self) -> str:
        """Error message of the page."""
        return str(self.wire.values.get((self._alert, "text"), ""))

    @property
    def provenance(self) -> str:
        """All sentences of the page."""
        return " ".join(
            str(value)
            for (model, name), value in self.wire.values.items()
            if name == "text" and self.wire.models.get(model, {}).get("name", "") == "Sentence1"
        )

    async def say(self, **message: Any) -> None:
        """Send a message of the file input."""
        await self.wire.say(self._file, message)

    async def upload(self, name: str, content: bytes) -> None:
        """Send a file as the page's button does."""
        n_chunks = -(-len(content) // CHUNK_BYTES)
        await self.say(status="initializing")
        for number in range(n_chunks):
            part = content[number * CHUNK_BYTES : (number + 1) * CHUNK_BYTES]
            await self.chunk(name, part, number + 1, n_chunks)
        await self.say(status="finished")

    async def chunk(self, name: str, data: Any, number: Any, of: Any) -> None:
        """Send one chunk of a file, or what claims to be one."""
        await self.say(
            status="upload_event", name=name, chunk=number, data=data, total_chunks=of, mime_type=""
        )

    async def until(self, name: str, limit_s: float = ANSWERED_S) -> str:
        """Wait until a file has been opened or refused; return what happened."""
        begun = time.monotonic()

        def is_open() -> bool:
            return name in self.provenance

        try:
            async with asyncio.timeout(limit_s), self.wire.news:
                await self.wire.news.wait_for(
                    lambda: self.alert or is_open() or self.wire.is_closed
                )
        except TimeoutError:
            return f"NO answer within {limit_s:.0f} s"
        took = f"after {time.monotonic() - begun:.1f} s"
        if self.alert:
            return f"refused {took}: {self.alert[:150]}"
        return f"LOST its connection {took}" if self.wire.is_closed else f"opened {took}"


def _id(reference: Any) -> str | None:
    return reference.get("id") if isinstance(reference, dict) else None


async def opened(server: Server, query: str = "") -> Tab:
    """A new page."""
    wire = Wire()
    await wire.open(server.address + query)
    return Tab(wire)


async def uploaded(name: str, content: bytes, server: Server) -> Outcome:
    """Open a file in one session; every page then shows it."""
    tab = await opened(server)
    await tab.upload(name, content)
    said = await tab.until(safe_name(name).rsplit(".", 1)[0][-20:])
    tab.wire.close()
    held = said.startswith(("opened", "refused")) and server.memory.peak_bytes < MOST_BYTES
    return Outcome(1, said, held)


async def too_large(server: Server) -> Outcome:
    """A file of 101 MiB."""
    since = len(server.logged())
    tab = await opened(server)
    await tab.upload("large.npz", bytes(101 * MIB))
    said = await tab.until("large.npz")
    tab.wire.close()
    trace = "Traceback" in server.logged(since)
    held = "100 MiB" in said and not trace and server.memory.peak_bytes < MOST_BYTES
    return Outcome(1, said + (", with a traceback" if trace else ""), held)


async def never_finished(server: Server) -> Outcome:
    """Chunks of 60 files, none of which is ever finished."""
    base, tab = server.memory.now(), await opened(server)
    sent = 0
    try:
        for number in range(60):
            await asyncio.wait_for(tab.chunk(f"{number}.npz", bytes(CHUNK_BYTES), 1, 2), 20)
            sent += 1
        await asyncio.sleep(3)
        said = tab.alert or "no complaint"
    except Exception as error:  # the server may well hang up
        said = f"cut off ({type(error).__name__})"
    grown = server.memory.peak_bytes - base
    tab.wire.close()
    return Outcome(sent, f"{said}; +{grown / MIB:.0f} MiB for {10 * sent} MiB", grown < 350 * MIB)


async def wrong_messages(server: Server) -> Outcome:
    """Messages of the file input that no page sends."""
    base, since, wrong, times = server.memory.now(), len(server.logged()), [], 0
    for message in (
        {"status": "nonsense"},
        {},
        {"status": "finished"},
        {"status": "upload_event"},
        {"data": 2_000_000_000},
        {"data": "text"},
        {"data": [1, 2, 300]},
        {"name": ["a list"]},
        {"name": None},
        {"chunk": -1},
        {"total_chunks": 10**9},
        {"total_chunks": "many"},
    ):
        whole = {
            "status": "upload_event",
            "name": "a.npz",
            "chunk": 1,
            "data": npz_bytes(**OWN_FIELDS),
            "total_chunks": 1,
            "mime_type": "",
        }
        sends = message if "status" in message or not message else whole | message
        tab = await opened(server)
        try:
            await tab.say(**sends)
            await tab.say(status="finished")
            await asyncio.sleep(0.5)
        except ConnectionError:
            wrong.append(f"{message}: cut off")
        tab.wire.close()
        times += 1
    grown = server.memory.peak_bytes - base
    if "Traceback" in server.logged(since):
        wrong.append(f"{server.logged(since).count('Traceback')} tracebacks")
    said = "; ".join(wrong) or "refused without a traceback"
    return Outcome(times, f"{said}; +{grown / MIB:.0f} MiB", not wrong and grown < 512 * MIB)


async def long_message(server: Server) -> Outcome:
    """One message of 190 MiB that holds nothing but text."""
    base, tab = server.memory.now(), await opened(server)
    try:
        await asyncio.wait_for(tab.say(status="nonsense", more="x" * (190 * MIB)), 60)
        await asyncio.sleep(3)
        said = "cut off" if tab.wire.is_closed else tab.alert[:100] or "no complaint"
    except Exception as error:  # the server may well hang up
        said = f"cut off ({type(error).__name__})"
    grown = server.memory.peak_bytes - base
    tab.wire.close()
    return Outcome(1, f"{said}; +{grown / MIB:.0f} MiB", grown < 350 * MIB)


def named(source: str, **changed: Any) -> bytes:
    """A small capture that says where it is from."""
    return npz_bytes(**OWN_FIELDS | {"source": source} | changed)


async def same_name(server: Server) -> Outcome:
    """One name for two captures in two sessions, their chunks in turn, and twice in the first."""
    first, other = await opened(server), await opened(server)
    contents = named("content of the first tab"), named("content of the other tab")
    halves = [(each[: len(each) // 2], each[len(each) // 2 :]) for each in contents]
    for number in (1, 2):
        for tab, half in zip((first, other), halves, strict=True):
            await tab.chunk("same.npz", half[number - 1], number, 2)
    for tab in (first, other):
        await tab.say(status="finished")
    said = [await first.until("of the first tab"), await other.until("of the other tab")]
    mixed = "of the other tab" in first.provenance or "of the first tab" in other.provenance
    await first.upload("same.npz", named("second content of the first tab"))
    said.append(await first.until("second content"))
    for tab in (first, other):
        tab.wire.close()
    held = not mixed and all(each.startswith("opened") for each in said)
    return Outcome(3, "; ".join(said) + (", MIXED UP" if mixed else ""), held)


async def same_link(server: Server) -> Outcome:
    """The link of an upload in two more sessions; the first is closed, the others go on."""
    first = await opened(server)
    await first.upload("linked.npz", named("content behind a link"))
    said = [await first.until("behind a link")]
    bar = first.wire.find("AddressBar")

    def query() -> str:
        return str(first.wire.values.get((bar, "query"), ""))

    async with asyncio.timeout(ANSWERED_S), first.wire.news:
        await first.wire.news.wait_for(lambda: "source=" in query())
    link = f"?{query()}"
    others = [await opened(server, link) for _ in range(2)]
    first.wire.close()
    last = await opened(server, link)
    for tab in (*others, last):
        said.append(await tab.until("behind a link"))
    for tab in (*others, last):
        tab.wire.close()
    return Outcome(3, "; ".join(said), all(each.startswith("opened") for each in said))


ATTACKS = [
    *(
        Attack(f"upload, {name}", partial(uploaded, name, content))
        for name, content in (HUNGRY | STRAY).items()
    ),
    Attack("upload of 101 MiB", too_large),
    Attack("uploads that never end", never_finished),
    Attack("messages that are no upload", wrong_messages),
    Attack("a message of 190 MiB", long_message),
    Attack("the same name in two tabs, and twice", same_name),
    Attack("the same link in several tabs", same_link),
]
