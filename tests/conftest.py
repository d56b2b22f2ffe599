"""Fixtures of the app's tests: the served app, a browser, watched pages, real captures."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, expect

from app.model.store import Answer, compute
from app.server.patches import apply_patches
from core.tests.captures import real_capture_path
from core.tests.garbage import pytest_collection, pytest_collection_finish  # noqa: F401 - hooks
from tests.browser import TIMEOUT_MS, chromium, open_page, serving
from tests.states import ask

expect.set_options(timeout=TIMEOUT_MS)


OWN_SCHEMES = ("data", "blob")

# Else distributed, once imported, would silence the loggers of Tornado and Bokeh, which tests read.
os.environ |= {"DASK_LOGGING__VERSION": "1", "DASK_LOGGING__DISABLE_EXISTING_LOGGERS": "False"}


def pytest_sessionstart() -> None:
    """Apply the server's patches, with which pages are built faster."""
    apply_patches()


@pytest.fixture(scope="session")
def address() -> Iterator[str]:
    """Address of an app that serves all tests."""
    with serving() as running_at:
        yield running_at


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """One browser for all tests; without one the tests fail, they are never skipped."""
    with chromium(is_still=True) as running:
        yield running


@pytest.fixture(scope="session")
def troubles() -> list[str]:
    """Errors of the pages of the present test."""
    return []


@pytest.fixture(scope="session")
def open_watched(
    browser: Browser, troubles: list[str], request: pytest.FixtureRequest
) -> Callable[..., Page]:
    """Open a page of the app; note its errors and its requests to other machines."""

    def note_console(message: ConsoleMessage) -> None:
        if message.type == "error":
            troubles.append(f"console: {message.text}")

    def note_url(url: str) -> None:
        parts = urlsplit(url)
        if parts.hostname not in ("127.0.0.1", "localhost") and parts.scheme not in OWN_SCHEMES:
            troubles.append(f"request to another machine: {url}")

    def watch(page: Page) -> None:
        page.on("console", note_console)
        page.on("pageerror", lambda error: troubles.append(f"page error: {error}"))
        page.on("request", lambda request: note_url(request.url))
        page.on("websocket", lambda socket: note_url(socket.url))

    def open_(address: str | None = None, **options: Any) -> Page:
        address = address or request.getfixturevalue("address")
        return open_page(browser, address, watch=watch, **options)

    return open_


@pytest.fixture
def page(open_watched: Callable[..., Page], troubles: list[str]) -> Iterator[Callable[..., Page]]:
    """Open pages with sessions of their own; any error on a page fails the test."""
    opened: list[Page] = []

    def open_(*arguments: Any, **options: Any) -> Page:
        opened.append(open_watched(*arguments, **options))
        return opened[-1]

    yield open_
    found, troubles[:] = list(troubles), []
    for each in opened:
        if not each.is_closed():
            each.evaluate("localStorage.clear(), sessionStorage.clear()")
            each.close()
    assert found == []


@pytest.fixture
def start_page(page: Callable[..., Page]) -> Page:
    """The start page, just opened."""
    return page()


@pytest.fixture(scope="module")
def car() -> Answer:
    """The estimate of the car, with truth and with pixels without a target."""
    return compute(ask("car"), None)


@pytest.fixture(scope="module")
def sample() -> Answer:
    """The estimate of a file, without truth."""
    return compute(ask("sample"), None)


@pytest.fixture
def real_capture() -> Callable[[str], Path]:
    """Path of a published capture."""
    return real_capture_path
