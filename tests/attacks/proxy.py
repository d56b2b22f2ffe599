"""A proxy between a browser and its server whose connections can be cut."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from app.server.ports import free_port


class Proxy:
    """Forwards connections to a port of this machine, unless it is cut.

    Attributes
    ----------
    port : int
        Where it listens.
    """

    def __init__(self, port: int) -> None:
        self.port = port
        self._target = 0
        self._is_cut = False
        self._writers: set[asyncio.StreamWriter] = set()
        self._loop = asyncio.new_event_loop()

    def forward_to(self, port: int) -> None:
        """Forward from now on."""
        self._target = port

    def cut(self) -> None:
        """End all connections, and refuse others until `mend`."""
        self._is_cut = True
        self._loop.call_soon_threadsafe(self._end_all)

    def mend(self) -> None:
        """Forward again."""
        self._is_cut = False

    def _end_all(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _serve(self, over: threading.Event) -> None:
        server = await asyncio.start_server(self._forward, "127.0.0.1", self.port)
        async with server:
            while not over.is_set():
                await asyncio.sleep(0.05)
            self._end_all()

    async def _forward(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._is_cut:
            writer.transport.abort()
            return
        there, back = await asyncio.open_connection("127.0.0.1", self._target)
        self._writers |= {writer, back}
        with suppress(ConnectionError):
            await asyncio.gather(_pump(reader, back), _pump(there, writer))
        self._writers -= {writer, back}


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while content := await reader.read(2**16):
        writer.write(content)
        await writer.drain()
    writer.close()


@contextmanager
def proxy() -> Iterator[Proxy]:
    """A running proxy, whose port is known before that of its server."""
    made, over = Proxy(free_port()), threading.Event()
    thread = threading.Thread(target=lambda: made._loop.run_until_complete(made._serve(over)))
    thread.start()
    try:
        yield made
    finally:
        over.set()
        thread.join()
