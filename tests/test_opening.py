"""A page's head comes before the page is built, and head and page are one whole page."""

from __future__ import annotations

import asyncio
import re

import panel_material_ui as pmui
import pytest
from tornado.httpclient import AsyncHTTPClient

from app.model import text as words
from app.server import opening
from app.server.access import Access
from app.server.opening import Answers, PageHandler
from app.server.ports import free_port
from app.server.serve import server_of
from app.widgets.controls import Sentence


@pytest.fixture(autouse=True)
def as_before(monkeypatch):
    """No head is known yet."""
    monkeypatch.setattr(PageHandler, "known_head", "")


def asked(build, *queries):
    """Each page that a server of its own answers with, and what there was before it was built."""
    built = []

    def page():
        built.append(True)
        return build(len(built))

    async def ask():
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

    return asyncio.run(ask())


def alike(page):
    """A page without what is its own: names of models, and its session's token."""
    return re.sub(r'"token":"[^"]*"|p\d{4,}|[0-9a-f]{8}(-[0-9a-f]{4,12}){4}', "", page)


def of_material(_number):
    return pmui.Page(main=["what it shows"])


def test_a_head_comes_before_its_page_is_built():
    (nothing, first), (head, second), (again, third) = asked(of_material, "", "", "?l=0.1")
    assert nothing == ""
    assert "<title>firstphoton</title>" in head
    assert "<script" in head
    assert "<body" not in head
    assert head == again
    assert alike(first) == alike(second) == alike(third)
    assert first.count("</head>") == 1


def test_what_an_address_asks_for_is_in_no_other_pages_head():
    (_, dark), (nothing, light), (head, _) = asked(of_material, "?theme=dark", "", "?theme=dark")
    assert alike(dark) != alike(light)
    assert nothing == ""
    assert head == light.partition("</head>")[0]


def test_a_page_that_cannot_be_built_lends_its_head_to_none_and_stands_below_any():
    def build(number):
        return Sentence(text=words.NO_PAGE) if number in (1, 3) else of_material(number)

    (_, failed), (nothing, good), (head, told), (_, last) = asked(build, "", "", "", "")
    assert nothing == ""
    assert alike(good) == alike(last)
    assert head == good.partition("</head>")[0]
    assert alike(told).endswith(alike(failed).partition("</head>")[2])


def test_a_busy_server_is_not_waited_for_in_vain(monkeypatch):
    looks = []

    async def busily(_seconds):
        looks.append(True)
        Answers.count += 1

    monkeypatch.setattr(opening.asyncio, "sleep", busily)
    asyncio.run(opening._quiet())
    assert len(looks) == opening.LOOKS


@pytest.mark.browser
def test_the_widgets_module_is_fetched_once_before_the_page_is_there(page):
    new = page()
    started_ms = new.evaluate("""performance.getEntriesByType("resource")
      .filter(({ name }) => name.includes("panel-material-ui.bundle.js"))
      .map(({ startTime }) => startTime)""")
    there_ms = new.evaluate(
        "performance.timing.domContentLoadedEventStart - performance.timeOrigin"
    )
    assert len(started_ms) == 1
    assert started_ms[0] < there_ms
