"""Limits on clients that the server does not know yet."""

from __future__ import annotations

import socket
from urllib.parse import urlencode

import psutil
import pytest

from app.__main__ import main
from app.server.limits import MOST_CONNECTIONS, WrongTokens
from tests.browser import eventually
from tests.crowded import BOUNDS, HTTP
from tests.site import NAME, TOKEN, empty_site

FORM = {"Content-Type": "application/x-www-form-urlencoded", "Host": NAME}
HEAD = f"POST / HTTP/1.1\r\nHost: {NAME}\r\nContent-Type: application/x-www-form-urlencoded\r\n"


@pytest.fixture(scope="module")
def away():
    """A server that requires a token and waits for a short time only."""
    with empty_site("0.0.0.0", [NAME], TOKEN, bounds=BOUNDS, http_limits=HTTP) as site:
        yield site


def resident_bytes():
    """Return the memory of this process, which the server shares."""
    return psutil.Process().memory_info().rss


def sending(site, text):
    link = socket.create_connection(("127.0.0.1", site.port), timeout=120)
    link.sendall(text.encode())
    return link


def is_ended(link):
    """Whether the server has closed a connection."""
    link.setblocking(False)
    try:
        return link.recv(2**16) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def try_token(site, token):
    return site.ask("/", "POST", urlencode({"token": token}), **FORM)


def test_a_large_body_is_refused_before_it_is_read(away):
    before = resident_bytes()
    for _ in range(6):
        link = sending(away, f"{HEAD}Content-Length: {95 * 2**20}\r\n\r\n")
        sent = 0
        with pytest.raises(ConnectionError):
            while sent < 95:
                link.sendall(bytes(2**20))
                sent += 1
        link.close()
    assert resident_bytes() - before < 30e6
    assert away.ask("/", Host=NAME)[0] == 403


def test_incomplete_requests_end_and_block_no_client(away):
    """More connections than accepted, with half a header or half a body."""
    halves = [
        sending(away, "GET / HTTP/1.1\r\nHo" if n % 2 else f"{HEAD}Content-Length: 9\r\n\r\ntok")
        for n in range(MOST_CONNECTIONS + 50)
    ]
    assert away.ask("/", Host=NAME)[0] == 403
    eventually(lambda: all(map(is_ended, halves)))
    for half in halves:
        half.close()


def test_a_slow_connection_ends(away):
    slow, gone = sending(away, f"{HEAD}Content-Length: 50000\r\n\r\n"), []

    def drip():
        try:
            slow.setblocking(True)
            slow.sendall(b"x")
        except ConnectionError:
            gone.append(True)
        return gone or is_ended(slow)

    eventually(drip)
    slow.close()


def test_after_some_wrong_tokens_none_is_checked_for_a_while(away):
    statuses = [try_token(away, f"wrong {n}")[0] for n in range(WrongTokens.FREE + 5)]
    assert statuses[: WrongTokens.FREE + 1] == [403] * (WrongTokens.FREE + 1)
    assert 429 in statuses
    status, headers, text = try_token(away, TOKEN)  # else parallel attempts would succeed
    assert status == 429
    assert f"Try again in {headers['Retry-After']} s" in text
    assert "Set-Cookie" not in headers
    eventually(lambda: try_token(away, TOKEN)[0] == 303)


class Clock:
    s = 0.0

    def __call__(self):
        return self.s


def test_delays_double_up_to_a_bound_and_end_with_the_right_token():
    clock = Clock()
    wrong = WrongTokens(clock)
    for _ in range(WrongTokens.FREE):
        wrong.add("192.0.2.1")
    assert wrong.delay_s("192.0.2.1") == 0
    delays = []
    for _ in range(12):
        wrong.add("192.0.2.1")
        delays.append(wrong.delay_s("192.0.2.1"))
        clock.s += delays[-1]
        assert wrong.delay_s("192.0.2.1") == 0
    assert delays[:4] == [1, 2, 4, 8]
    assert delays[-1] == WrongTokens.LONGEST_DELAY_S
    assert wrong.delay_s("192.0.2.2") == 0
    wrong.add("192.0.2.1")
    wrong.forgive("192.0.2.1")
    assert wrong.delay_s("192.0.2.1") == 0


def test_an_ipv6_network_has_one_count():
    wrong = WrongTokens(Clock())
    for n in range(WrongTokens.FREE + 1):
        wrong.add(f"2001:db8::{n:x}")
    assert wrong.delay_s("2001:db8::ffff") > 0
    assert wrong.delay_s("2001:db8:0:1::1") == 0


def test_the_oldest_of_many_addresses_are_forgotten(monkeypatch):
    monkeypatch.setattr(WrongTokens, "MOST_ADDRESSES", 3)
    wrong = WrongTokens(Clock())
    for _ in range(WrongTokens.FREE + 1):
        wrong.add("192.0.2.1")
    for n in range(2, 5):
        wrong.add(f"192.0.2.{n}")
    assert wrong.delay_s("192.0.2.1") == 0


@pytest.mark.parametrize("port", ["70000", "-1", "x", "65536"])
def test_an_invalid_port_is_refused(port, capsys):
    with pytest.raises(SystemExit):
        main(["--port", port])
    printed = capsys.readouterr().err.splitlines()[-1]
    assert f"{port!r} is not a port: give 0 to 65535." in printed
