"""Limits on requests and connections before the client is known."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from ipaddress import ip_address, ip_network
from time import monotonic
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.iostream import IOStream

HTTP_LIMITS: dict[str, Any] = {
    "max_body_size": 2**16,  # the token form is the only body
    "body_timeout": 10.0,
    # Also limits the time until the header of a request has arrived.
    "idle_connection_timeout": 15.0,
}
"""Options of the HTTP server, sizes in bytes and times in seconds. Websockets have their own."""

MOST_CONNECTIONS = 500
"""Most connections at once. A browser opens up to seven for a page, and keeps one."""


class Connections:
    """The open connections of a server, limited in number.

    A new connection beyond the limit replaces the oldest one that has not completed a request. If
    all have completed one, the new connection is closed.

    Parameters
    ----------
    most : int
    """

    def __init__(self, most: int = MOST_CONNECTIONS) -> None:
        self._most = most
        self._has_completed: dict[IOStream, bool] = {}  # oldest first

    def bound(self, server: HTTPServer) -> None:
        """Apply the limit to a server that has not been started."""
        serve = server.handle_stream

        def handle_stream(stream: IOStream, address: Any) -> None:
            if self._has_room():
                self._has_completed[stream] = False
                serve(stream, address)
            else:
                stream.close()

        server.handle_stream = handle_stream  # type: ignore[method-assign]

    def completed(self, request: HTTPServerRequest) -> None:
        """Record that the header of a request has arrived."""
        self._has_completed[request.connection.stream] = True  # type: ignore[union-attr]

    def _has_room(self) -> bool:
        # Checked here, since HTTP connections replace each other's close callbacks.
        still_open = {s: done for s, done in self._has_completed.items() if not s.closed()}
        self._has_completed = still_open
        if len(still_open) < self._most:
            return True
        silent = next((stream for stream, done in still_open.items() if not done), None)
        if silent is None:
            return False
        del still_open[silent]
        silent.close()
        return True


class WrongTokens:
    """Delays of clients that have sent wrong tokens.

    The first few are free; each further one doubles the delay. An attempt during the delay is
    refused unread, so that parallel attempts gain nothing.

    Parameters
    ----------
    clock : callable
        Returns the time in seconds.
    """

    FREE = 10
    FIRST_DELAY_S = 1.0
    LONGEST_DELAY_S = 300.0
    MOST_ADDRESSES = 10_000

    def __init__(self, clock: Callable[[], float] = monotonic) -> None:
        self._clock = clock
        self._known: OrderedDict[str, tuple[int, float]] = OrderedDict()

    def delay_s(self, address: str) -> float:
        """Return the seconds until an address may try again."""
        _, until_s = self._known.get(_network_of(address), (0, 0.0))
        return max(0.0, until_s - self._clock())

    def add(self, address: str) -> None:
        """Count a wrong token."""
        network = _network_of(address)
        n_wrong = self._known.pop(network, (0, 0.0))[0] + 1
        doublings = min(n_wrong - self.FREE, 32)
        delay_s = self.FIRST_DELAY_S * 2.0 ** (doublings - 1) if doublings > 0 else 0.0
        self._known[network] = (n_wrong, self._clock() + min(delay_s, self.LONGEST_DELAY_S))
        if len(self._known) > self.MOST_ADDRESSES:
            self._known.popitem(last=False)

    def forgive(self, address: str) -> None:
        """Reset the count after the right token."""
        self._known.pop(_network_of(address), None)


def _network_of(address: str) -> str:
    """Return the address, or the /64 network of an IPv6 address, which belongs to one user."""
    try:
        is_ipv6 = ip_address(address).version == 6
    except ValueError:  # a Unix socket has no address
        return address
    return str(ip_network(f"{address}/64", strict=False)) if is_ipv6 else address
