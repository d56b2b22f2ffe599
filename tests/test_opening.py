"""The head of a page is sent before the page is built, and both make one complete page."""

from __future__ import annotations

import asyncio
import re

import panel_material_ui as pmui
import pytest
from tornado.httpclient import AsyncHTTPClient

from app.model import text
from app.server import opening
from app.server.access import Access
from app.server.opening import MOST_WAITS, PageHandler, ResponseCount, when_quiet
from app.server.ports import free_port
from app.server.serve import server_of
from app.widgets.controls import Sentence


@pytest.fixture(autouse=True)
def no_known_head(monkeypatch):
    monkeypatch.setattr(PageHandler, "known_head", "")


def fetched(build, *queries):
    """Pages of a server: the part that was sent before the page was built, and the whole."""
    built = []

    def page():
        built.append(True)
        return build(len(built))

    async def fetch():
        port = free_port("127.0.0.1")
        server = server_of(page, Access.of("127.0.0.1", port, [], None), "127.0.0.1", port)
        server.start()
        pages = []
        for number, query in enumerate(queries, 1):
            parts = {False: "", True: ""}

            def take(part, parts=parts, number=number):
                parts[len(built) == number] += part.decode()

            at = f"http://127.0.0.1:{port}/{query}"
            await AsyncHTTPClient().fetch(at, streaming_callback=take)
            pages.append((parts[False], parts[False] + parts[True]))
        server.stop()
        return pages

    return asyncio.run(fetch())


def common(page):
    """A page without names of models and its session's token."""
    return re.sub(r'"token":"[^"]*"|p\d{4,}|[0-9a-f]{8}(-[0-9a-f]{4,12}){4}', "", page)


def material_page(_number):
    return pmui.Page(main=["content"])


def test_the_head_is_sent_before_the_page_is_built():
    (early, first), (head, second), (again, third) = fetched(material_page, "", "", "?l=0.1")
    assert early == ""
    assert "<title>firstphoton</title>" in head
    assert "<script" in head and "<body" not in head
    assert head == again
    assert common(first) == common(second) == common(third)
    assert first.count("</head>") == 1


def test_a_query_changes_no_other_head():
    (_, dark), (early, light), (head, _) = fetched(material_page, "?theme=dark", "", "?theme=dark")
    assert common(dark) != common(light)
    assert early == ""
    assert head == light.partition("</head>")[0]


def test_a_page_that_could_not_be_built_leaves_its_head_to_none():
    def build(number):
        return Sentence(text=text.NO_PAGE) if number in (1, 3) else material_page(number)

    (_, failed), (early, good), (head, mixed), (_, last) = fetched(build, "", "", "", "")
    assert early == ""
    assert common(good) == common(last)
    assert head == good.partition("</head>")[0]
    assert common(mixed).endswith(common(failed).partition("</head>")[2])


def test_a_busy_server_does_not_delay_a_page_for_ever(monkeypatch):
    waits = []

    async def busy(_seconds):
        waits.append(True)
        ResponseCount.count += 1

    monkeypatch.setattr(opening.asyncio, "sleep", busy)
    asyncio.run(when_quiet())
    assert len(waits) == MOST_WAITS
