"""Limits on sessions: number, memory, and time without a browser."""

from __future__ import annotations

import asyncio
import gc
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
from bokeh.util.token import generate_jwt_token, generate_session_id
from playwright.sync_api import expect
from tornado.httpclient import HTTPClientError
from tornado.websocket import websocket_connect

from app.server.sessions import Bounds, Sessions
from tests.browser import eventually, serving
from tests.crowded import BOUNDS, COUNTED
from tests.site import Site, empty_site
from tests.wire import Wire, connected, token_in


class Kept:
    """A session of Bokeh."""

    def __init__(self, name, connections=0, idle_s=0.0):
        self.id, self.connection_count = name, connections
        self.milliseconds_since_last_unsubscribe = 1000 * idle_s
        self.is_ended = False

    def request_expiration(self):
        self.is_ended = True


class Clock:
    s = 0.0

    def __call__(self):
        return self.s


def kept_by(*kept, memory=lambda: 0, clock=None, **bounds):
    bounds = Bounds(**({"sessions": 3, "queued": 1, "memory_bytes": 10} | bounds))
    context = SimpleNamespace(sessions=list(kept))
    return Sessions(context, bounds, memory, clock or Clock())


def test_only_a_session_without_a_browser_ends():
    late, early, served = Kept("a", idle_s=21), Kept("b", idle_s=19), Kept("c", idle_s=99)
    clock = Clock()
    sessions = kept_by(late, early, served, clock=clock)
    sessions.connected(served)
    clock.s += Bounds.check_s
    sessions.check()
    assert (late.is_ended, early.is_ended, served.is_ended) == (True, False, False)


def test_a_busy_server_accepts_connections_before_it_ends_a_session():
    late, clock = Kept("a", idle_s=60), Clock()
    sessions = kept_by(late, clock=clock)
    clock.s += 30
    sessions.check()
    assert not late.is_ended
    clock.s += Bounds.check_s
    sessions.check()
    assert late.is_ended


def test_closed_pages_make_room_the_oldest_first():
    kept = [Kept("a", idle_s=5), Kept("b", idle_s=50), Kept("c", connections=1)]
    sessions = kept_by(*kept, queued=9)
    for each in kept:
        sessions.connected(each)
    with sessions.opening(None) as has_room:
        assert has_room
        assert [each.is_ended for each in kept] == [False, True, False]
        with sessions.opening(None) as has_more, sessions.opening(None) as has_most:
            assert (has_more, has_most) == (True, False)


def test_pages_being_built_count_and_a_returning_page_needs_no_room():
    sessions = kept_by(Kept("a"))
    with sessions.opening(None) as first, sessions.opening(None) as second:
        assert (first, second) == (True, False)
        with sessions.opening("a") as again:
            assert again
    with sessions.opening(None) as has_room:
        assert has_room


def test_a_server_out_of_memory_opens_nothing_and_ends_closed_pages():
    closed = Kept("a", idle_s=1)
    sessions = kept_by(closed, memory=lambda: 11)
    sessions.connected(closed)
    with sessions.opening(None) as has_room:
        assert not has_room
    assert closed.is_ended


# -- a server --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def empty():
    """A server of an empty page with small limits."""
    with empty_site(bounds=BOUNDS) as site:
        yield site


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    """File in which `crowded` counts the pages that it holds."""
    return tmp_path_factory.mktemp("counted") / "pages"


@pytest.fixture(scope="module")
def crowded(counted):
    """The app with small limits."""
    with serving(module="tests.crowded", **{COUNTED: str(counted)}) as address:
        yield Site(address)


def has_room(site):
    status, headers, text = site.ask()
    if status == 503:
        assert headers["Retry-After"] == str(BOUNDS.retry_s)
        assert "no room" in text and f'content="{BOUNDS.retry_s}"' in text
    return status == 200


def statuses_of(site, times):
    """Statuses of simultaneous requests of pages to which no browser connects."""
    with ThreadPoolExecutor(times) as threads:
        return [answer[0] for answer in threads.map(lambda _: site.ask(), range(times))]


def test_pages_without_a_browser_wait_or_are_refused_until_others_have_ended(empty):
    statuses = statuses_of(empty, 12)
    assert {*statuses} == {200, 503}
    assert statuses.count(200) <= BOUNDS.sessions + BOUNDS.queued
    eventually(lambda: has_room(empty))


def test_a_full_server_refuses_a_page_open_pages_go_on_and_closed_ones_are_forgotten(
    crowded, counted
):
    def is_full():
        return counted.exists() and counted.read_text() == f"{BOUNDS.sessions}"

    async def entered():
        while True:
            wire = Wire()
            try:
                await wire.open(crowded.address)
            except (HTTPClientError, ConnectionError):  # full, or connected too late
                await asyncio.sleep(0.5)
            else:
                return wire

    async def use():
        first, *others = [await entered() for _ in range(BOUNDS.sessions)]
        with pytest.raises(HTTPClientError, match="503"):
            await Wire().open(crowded.address)
        facts = first.find("Facts", timed=True), "facts"
        before = first.values[facts]
        await first.set(first.find("Knob", label="SBR"), "value", 0.05)
        async with first.news:
            await first.news.wait_for(lambda: first.values[facts] != before or first.is_closed)
        assert first.troubles == []
        others.pop().close()
        wires = [first, *others, await entered()]
        counted.unlink(missing_ok=True)  # written again, since it may be of before
        await asyncio.to_thread(eventually, is_full)  # a page that is held would be one more
        for wire in wires:
            wire.close()

    asyncio.run(use())


def test_a_socket_opens_no_session(empty):
    async def answer(token):
        socket = await connected(empty.address, token)
        message = await socket.read_message()
        socket.close()
        return message

    def closes(token):
        return asyncio.run(asyncio.wait_for(answer(token), 60)) is None

    assert closes(generate_jwt_token(generate_session_id()))
    assert closes("no token at all")
    eventually(lambda: has_room(empty))


def test_no_connection_outlives_the_loop_that_opened_it(empty, monkeypatch):
    connecting = []

    def noted(*arguments, **options):
        connecting.append(websocket_connect(*arguments, **options))
        return connecting[-1]

    async def leave():
        await Wire().open(empty.address)

    async def cancel():
        cancelled = asyncio.ensure_future(connected(empty.address, token_in(empty.ask()[2])))
        await asyncio.sleep(0)
        cancelled.cancel()
        await asyncio.wait(connecting[-1:])
        await asyncio.sleep(0)

    monkeypatch.setattr("tests.wire.websocket_connect", noted)
    for act in (leave, cancel):
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            asyncio.run(act())
            connecting.clear()
            gc.collect()
        assert not [each for each in seen if "WebSocketClient" in str(each.message)]


def open_pages(site, count):
    """Connect sessions without a browser, as soon as there is room; return their connections."""
    links = []

    def has_entered():
        status, _, text = site.ask()
        if status == 200:
            link, status = site.connect(token_in(text))
            assert status == 101
            links.append(link)
        return status == 101

    for _ in range(count):
        eventually(has_entered)
    return links


@pytest.mark.browser
def test_a_browser_that_finds_the_server_full_or_connects_too_late_gets_in_later(browser, crowded):
    page = browser.contexts[0].new_page()
    delays_s = iter([BOUNDS.unconnected_s + 3 * BOUNDS.check_s])

    def late(route):
        time.sleep(next(delays_s, 0.0))
        route.continue_()

    others = open_pages(crowded, BOUNDS.sessions)
    page.route("**/bokeh.min.js*", late)
    page.goto(crowded.address)
    expect(page.get_by_role("status")).to_contain_text("no room for another session")
    with page.expect_request("**/bokeh.min.js*", timeout=60_000):  # it has got in
        others.pop().close()
    expect(page.locator(".stage[data-camera]").first).to_be_attached()
    assert next(delays_s, None) is None
    page.close()
    for each in others:
        each.close()
