"""A session of the served app without a browser.

A client of Bokeh's protocol that keeps attributes of models as plain values: a document of models,
as in `bokeh.client`, would cost more than the server's response.
"""

from __future__ import annotations

import asyncio
import gzip
import json
import re
from base64 import b64decode
from collections import defaultdict
from collections.abc import Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import WebSocketClientConnection, websocket_connect

from tests.browser import ROOT

LARGEST_MESSAGE = 2**30

READY = {
    "kind": "MessageSent",
    "msg_type": "bokeh_event",
    "msg_data": {
        "type": "event",
        "name": "document_ready",
        "values": {"type": "map", "entries": []},
    },
}
"""Sent by a page once it is drawn; the server holds back changes until then."""

RULES = (ROOT / "app" / "server" / "patches" / "latest_value.js").read_text("utf-8")
LONGEST_PAUSE_S = int(re.findall(r"const LONGEST_PAUSE_MS = (\d+);", RULES)[0]) / 1000
"""Longest time for which the browser waits for a response."""

Model = dict[str, Any]


class Wire:
    """A page that is open, once `open` has returned.

    Attributes
    ----------
    models : dict of str to dict
        Type, and attributes as they were when the page was opened, of each model by its id.
    values : mapping of (str, str) to object
        Newest value of each attribute by the model's id; of a source, by the name of the column.
    news : asyncio.Condition
        Notified when a message has come, or the connection has ended.
    troubles : list of str
        Errors of the server and the connection.
    is_closed : bool
        Whether the server has ended the connection.
    n_messages, n_bytes : int
        Parts of messages received so far, and their size.
    """

    def __init__(self) -> None:
        self.models: dict[str, Model] = {}
        self.values: dict[tuple[str, str], Any] = {}
        self.news = asyncio.Condition()
        self.troubles: list[str] = []
        self.is_closed = False
        self.n_messages = self.n_bytes = 0
        self._numbers: defaultdict[str, int] = defaultdict(int)
        self._waiting: dict[tuple[str, str], Any] = {}
        self._pause: asyncio.Future[None] | None = None

    async def open(self, address: str, **headers: str) -> None:
        """Fetch the page, connect its session and take over its document."""
        page = await AsyncHTTPClient().fetch(address, request_timeout=120, headers=headers)
        self._socket = await connected(address, token_in(page.body.decode()), **headers)
        try:
            await self._take_over()
        except BaseException:
            self._socket.close()
            raise
        self._reading = asyncio.ensure_future(self._read())
        # At the latest when the loop ends, which cancels this task: nobody need call `close`.
        self._reading.add_done_callback(lambda _: self._socket.close())

    async def _take_over(self) -> None:
        self._socket.protocol.stream.set_nodelay(True)  # as in a browser
        await self._receive()
        await self._send("PULL-DOC-REQ", {})
        _, content, buffers = await self._receive()
        for model in _objects(content):
            self.models[model["id"]] = model
            for name, value in model["attributes"].items():
                self._keep(model["id"], name, value, buffers)
        # The second round trip ensures that the server has handled the first.
        await self._send("PATCH-DOC", {"events": [READY]})
        await self._send("SERVER-INFO-REQ", {})
        while await self._take() != "SERVER-INFO-REPLY":
            pass

    def close(self) -> None:
        """Disconnect like a closed tab."""
        self._reading.cancel()

    def find(self, kind: str, **attributes: Any) -> str:
        """Id of the first model of a type with these attributes."""
        return next(
            key
            for key, model in self.models.items()
            if model["name"].startswith(kind)
            and attributes.items() <= {k: _plain(v) for k, v in model["attributes"].items()}.items()
        )

    async def set(self, model: str, attribute: str, value: Any) -> None:
        """Change a model; a value that is replaced before it can be sent is dropped."""
        self._waiting.pop((model, attribute), None)
        self._waiting[model, attribute] = value
        if self._pause is None:
            await self._send_waiting()

    async def say(self, model: str, message: Mapping[str, Any]) -> None:
        """Send a message of a component's own script to its model; bytes go as buffers."""
        buffers: dict[str, bytes] = {}

        def put(value: Any) -> Any:
            if not isinstance(value, bytes):
                return value
            buffers[f"b{len(buffers)}"] = value
            return {"type": "bytes", "data": {"id": f"b{len(buffers) - 1}"}}

        data = {"type": "map", "entries": [[name, put(each)] for name, each in message.items()]}
        await self.emit("data_event", model, {"data": data}, buffers)

    async def emit(
        self,
        event: str,
        model: str,
        values: Mapping[str, Any],
        buffers: Mapping[str, bytes] = MappingProxyType({}),
    ) -> None:
        """Send an event of a model, such as a tap on a plot."""
        entries = [["model", {"id": model}], *map(list, values.items())]
        data = {"type": "event", "name": event, "values": {"type": "map", "entries": entries}}
        sent = {"kind": "MessageSent", "msg_type": "bokeh_event", "msg_data": data}
        await self._send("PATCH-DOC", {"events": [sent]}, buffers)

    async def _send_waiting(self) -> None:
        events = [
            {"kind": "ModelChanged", "model": {"id": model}, "attr": attribute, "new": value}
            for (model, attribute), value in self._waiting.items()
        ]
        self._waiting.clear()
        self._pause = asyncio.ensure_future(asyncio.sleep(LONGEST_PAUSE_S))
        self._pause.add_done_callback(self._go_on)
        await self._send("PATCH-DOC", {"events": events})

    def _go_on(self, _pause: Any) -> None:
        """Send waiting values: the server has responded, or takes long."""
        self._pause = None
        if self._waiting and not self.is_closed:
            self._sending = asyncio.ensure_future(self._send_waiting())

    async def _send(
        self, kind: str, content: Any, buffers: Mapping[str, bytes] = MappingProxyType({})
    ) -> None:
        self._numbers[kind] += 1
        header = {"msgid": f"{kind}-{self._numbers[kind]}", "msgtype": kind}
        if buffers:
            header["num_buffers"] = len(buffers)
        # Without a pause, so that no other message comes between.
        sent = [self._socket.write_message(json.dumps(part)) for part in (header, {}, content)]
        for name, buffer in buffers.items():
            sent.append(self._socket.write_message(json.dumps({"id": name})))
            sent.append(self._socket.write_message(buffer, binary=True))
        await asyncio.gather(*sent)

    async def _receive(self) -> tuple[str, Any, dict[str, bytes]]:
        header = json.loads(await self._part())
        await self._part()
        content = json.loads(await self._part())
        buffers = {}
        for _ in range(header.get("num_buffers", 0)):
            name = json.loads(await self._part())["id"]
            buffers[name] = await self._part()
        return header["msgtype"], content, buffers

    async def _part(self) -> Any:
        part = await self._socket.read_message()
        if part is None:
            raise ConnectionError("the server has closed the connection")
        self.n_messages += 1
        self.n_bytes += len(part)
        return part

    async def _read(self) -> None:
        try:
            while True:
                await self._take()
                async with self.news:
                    self.news.notify_all()
        except Exception as error:  # in any case, nothing more is read
            self.troubles.append(f"{type(error).__name__}: {error}")
            self.is_closed = True
            async with self.news:
                self.news.notify_all()

    async def _take(self) -> str:
        """Handle the next message, and return its kind."""
        kind, content, buffers = await self._receive()
        if kind == "ERROR":
            self.troubles.append(json.dumps(content))
        if kind == "PATCH-DOC" and self._pause is not None:
            self._pause.cancel()
        for event in content.get("events", ()) if kind == "PATCH-DOC" else ():
            self._follow(event, buffers)
        return kind

    def _follow(self, event: Any, buffers: dict[str, bytes]) -> None:
        if event["kind"] == "ModelChanged":
            self._keep(event["model"]["id"], event["attr"], event["new"], buffers)
        elif event["kind"] == "ColumnDataChanged":
            self._keep(event["model"]["id"], "data", event["data"], buffers)

    def _keep(self, model: str, name: str, value: Any, buffers: dict[str, bytes]) -> None:
        if name == "data" and isinstance(value, dict) and value.get("type") == "map":
            for column, values in value["entries"]:
                self._keep(model, column, values, buffers)
        elif isinstance(value, dict) and value.get("type") == "ndarray":
            held = value["array"]["data"]
            array = (
                gzip.decompress(b64decode(held)) if isinstance(held, str) else buffers[held["id"]]
            )
            self.values[model, name] = np.frombuffer(array, value["dtype"])
        else:
            self.values[model, name] = value


def token_in(page: str) -> str:
    """Return the token of a page's session."""
    found = re.search(r'"token":"([^"]+)"', page)
    if found is None:
        raise ValueError(f"no page of the app: {page[:200]!r}")
    return found[1]


async def connected(address: str, token: str, **headers: str) -> WebSocketClientConnection:
    """Return the websocket of a session; raise `HTTPClientError` if it is refused."""
    place = address.partition("?")[0].replace("http", "ws", 1)
    connecting = asyncio.ensure_future(
        websocket_connect(
            HTTPRequest(f"{place}ws", headers=headers),
            subprotocols=["bokeh", token],
            max_message_size=LARGEST_MESSAGE,
        )
    )
    try:
        return await asyncio.shield(connecting)
    except asyncio.CancelledError:  # it connects nevertheless
        connecting.add_done_callback(lambda done: done.exception() or done.result().close())
        raise


def _objects(content: Any) -> Iterator[Model]:
    """Yield every model that is defined in a document."""
    parts = content.values() if isinstance(content, dict) else content
    if isinstance(content, dict) and content.get("type") == "object" and "id" in content:
        yield {"attributes": {}, **content}
    for part in parts:
        if isinstance(part, dict | list):
            yield from _objects(part)


def _plain(value: Any) -> Any:
    return value if isinstance(value, str | int | float) else None
