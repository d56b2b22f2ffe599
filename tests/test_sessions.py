"""Sessions are bounded in number, memory and the time that they wait for their browser."""

from __future__ import annotations

import asyncio
import time
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest
from bokeh.util.token import generate_jwt_token, generate_session_id
from playwright.sync_api import expect
from tornado.httpclient import HTTPClientError

from app.server.sessions import LOOK_S, RETRY_S, Bounds, Sessions
from tests.browser import eventually, server_process, serving
from tests.crowded import BOUNDS
from tests.test_serving import Site
from tests.wire import Wire, connected


class Kept:
    """A session as Bokeh's contexts keep it."""

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


def test_a_session_without_a_browser_ends_and_one_with_a_browser_stays():
    late, early, served = Kept("a", idle_s=21), Kept("b", idle_s=19), Kept("c", idle_s=99)
    clock = Clock()
    sessions = kept_by(late, early, served, clock=clock)
    sessions.connected(served)
    clock.s += LOOK_S
    sessions.look()
    assert (late.is_ended, early.is_ended, served.is_ended) == (True, False, False)


def test_a_server_that_was_busy_listens_before_it_ends_a_session():
    late, clock = Kept("a", idle_s=60), Clock()
    sessions = kept_by(late, clock=clock)
    clock.s += 30
    sessions.look()
    assert not late.is_ended
    clock.s += LOOK_S
    sessions.look()
    assert late.is_ended


def test_closed_pages_make_room_the_longest_closed_first():
    kept = [Kept("a", idle_s=5), Kept("b", idle_s=50), Kept("c", connections=1)]
    sessions = kept_by(*kept, queued=9)
    for each in kept:
        sessions.connected(each)
    with sessions.opening(None) as has_room:
        assert has_room
        assert [each.is_ended for each in kept] == [False, True, False]
        with sessions.opening(None) as has_more, sessions.opening(None) as has_most:
            assert (has_more, has_most) == (True, False)


def test_pages_being_built_count_and_a_page_that_comes_back_needs_no_room():
    sessions = kept_by(Kept("a"))
    with sessions.opening(None) as first, sessions.opening(None) as second:
        assert (first, second) == (True, False)
        with sessions.opening("a") as again:
            assert again
    with sessions.opening(None) as has_room:
        assert has_room


def test_beyond_its_memory_a_server_opens_nothing_and_lets_go_of_closed_pages():
    closed = Kept("a", idle_s=1)
    sessions = kept_by(closed, memory=lambda: 11)
    sessions.connected(closed)
    with sessions.opening(None) as has_room:
        assert not has_room
    assert closed.is_ended


# -- a real server ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def crowded():
    """A server with room for a few sessions, which wait for their browsers a few seconds only."""
    with serving(module="tests.crowded") as address:
        yield Site(address)


def has_room(site):
    status, headers, text = site.ask()
    if status == 503:
        assert headers["Retry-After"] == str(RETRY_S)
        assert "no room" in text and f'content="{RETRY_S}"' in text
    return status == 200


def asked_at_once(site, times):
    """Statuses of requests of pages that nobody looks at."""
    with ThreadPoolExecutor(times) as threads:
        return [answer[0] for answer in threads.map(lambda _: site.ask(), range(times))]


def test_requests_of_pages_that_nobody_looks_at_wait_or_are_refused(crowded):
    eventually(lambda: has_room(crowded))
    statuses = asked_at_once(crowded, 12)
    assert {*statuses} == {200, 503}
    assert statuses.count(200) <= BOUNDS.sessions + BOUNDS.queued
    eventually(lambda: has_room(crowded))


def test_requests_of_pages_that_nobody_looks_at_do_not_fill_the_memory(crowded):
    server = server_process(crowded.address)
    eventually(lambda: has_room(crowded))
    before = server.memory_info().rss
    built = 0
    for _ in range(20):
        built += asked_at_once(crowded, 8).count(200)
        if built >= 8:
            break
    assert built >= 8
    grown = server.memory_info().rss - before
    assert grown < 50e6  # as many sessions that are kept take 80 MB


def test_beyond_the_bound_a_page_is_refused_and_those_that_are_open_go_on(crowded):
    async def entered():
        while True:
            wire = Wire()
            try:
                await wire.open(crowded.address)
            except HTTPClientError as refusal:
                assert refusal.code == 503
                await asyncio.sleep(0.5)
            else:
                return wire

    async def fill():
        wires = [await entered() for _ in range(BOUNDS.sessions)]
        with pytest.raises(HTTPClientError, match="503"):
            await Wire().open(crowded.address)
        first, second, *_ = wires
        facts = first.find("Facts", timed=True), "facts"
        before = first.values[facts]
        await first.set(first.find("Knob", label="SBR"), "value", 0.05)
        async with first.news:
            await first.news.wait_for(lambda: first.values[facts] != before or first.is_closed)
        assert first.troubles == []
        second.close()  # and makes room
        for wire in [*wires, await entered()]:
            wire.close()

    asyncio.run(asyncio.wait_for(fill(), 120))


def test_a_socket_opens_no_session(crowded):
    """One whose page was never asked for, and one whose session has ended."""

    async def answer(token):
        socket = await connected(crowded.address, token)
        said = await socket.read_message()
        socket.close()
        return said

    def closes(token):
        return asyncio.run(asyncio.wait_for(answer(token), 60)) is None

    assert closes(generate_jwt_token(generate_session_id()))
    assert closes("no token at all")
    eventually(lambda: has_room(crowded))


@pytest.mark.browser
def test_a_page_that_connects_too_late_is_loaded_again(browser, crowded):
    page = browser.contexts[0].new_page()
    delays_s = iter([BOUNDS.unconnected_s + 3 * LOOK_S])

    def late(route):
        time.sleep(next(delays_s, 0.0))
        route.continue_()

    eventually(lambda: has_room(crowded))
    page.route("**/bokeh.min.js*", late)
    page.goto(crowded.address)
    expect(page.locator(".stage[data-camera]").first).to_be_attached()
    assert next(delays_s, None) is None
    page.close()


@pytest.mark.browser
def test_a_browser_that_finds_no_room_is_told_and_comes_in_later(browser, crowded):

    def opened():
        page = browser.contexts[0].new_page()
        page.goto(crowded.address)
        return page

    pages = [opened() for _ in range(BOUNDS.sessions)]
    for page in pages:
        expect(page.locator(".stage[data-camera]").first).to_be_attached()
    late = opened()
    expect(late.get_by_role("status")).to_contain_text("no room for another session")
    pages[0].close()
    expect(late.locator(".stage[data-camera]").first).to_be_attached()
    for page in [*pages[1:], late]:
        page.close()
