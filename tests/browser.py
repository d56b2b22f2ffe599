"""The served app and a real browser, for tests and benchmarks."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import psutil
from playwright.sync_api import Browser, BrowserType, Locator, Page, sync_playwright

from app.server.ports import free_port

VIEWS = """
const views = [];
const walk = (view) => { views.push(view); (view.child_views ?? []).forEach(walk); };
[...Bokeh.index.roots].forEach(walk);
"""
"""JavaScript that sets ``views``: all that Bokeh has drawn, or keeps ready, on the page."""

ROOT = Path(__file__).resolve().parent.parent

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")

ARGUMENTS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


def browser_path() -> str | None:
    """The machine's own browser; None leaves it to the one that Playwright has installed."""
    named = os.environ.get("BROWSER_PATH")
    return named or next(filter(None, map(shutil.which, BROWSERS)), None)


@contextmanager
def chromium() -> Iterator[Browser]:
    """A running browser without a window; fails, and says so, where there is none."""
    with sync_playwright() as playwright:
        browser = launch(playwright.chromium)
        yield browser
        browser.close()


def launch(kind: BrowserType) -> Browser:
    """A browser whose first context is that of `open_page`."""
    browser = kind.launch(executable_path=browser_path(), args=ARGUMENTS)
    browser.new_context()
    return browser


@contextmanager
def serving(
    *arguments: str | Path, module: str = "app", log_path: Path | None = None, **environment: str
) -> Iterator[str]:
    """The app in a process of its own, at the address that is yielded.

    What it prints goes to `log_path`, where one is given.
    """
    port = free_port()
    command = [sys.executable, "-m", module, "--port", str(port), *map(str, arguments)]
    # Into a file: a pipe that nobody reads would stop the server once it is full.
    with (
        TemporaryFile("w+") if log_path is None else log_path.open("w+") as log,
        subprocess.Popen(
            command,
            cwd=ROOT,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=os.environ | environment,
        ) as server,
    ):
        try:
            yield when_up(f"http://127.0.0.1:{port}/", server, log)
        finally:
            server.terminate()
            _gone(server, log)


def open_page(
    browser: Browser,
    address: str,
    width: int = 1440,
    height: int = 900,
    prepare: str = "",
    watch: Callable[[Page], None] = lambda page: None,
) -> Page:
    """A page of its own session, drawn and ready for input: a tab beside the other ones.

    `prepare` is a script to run first, `watch` is shown the page before it loads anything.
    """
    page = browser.contexts[0].new_page()  # which knows the scripts from other pages
    page.set_viewport_size({"width": width, "height": height})
    watch(page)
    page.add_init_script(prepare)
    page.goto(address)
    # Explore's cloud or, where a capture is opened, the pins of Inspect.
    page.locator(".stage[data-camera], [aria-label='Pinned pixels']").first.wait_for(
        state="attached"
    )
    page.wait_for_function("Bokeh.documents[0].is_idle")
    return page


def eventually(holds: Callable[[], object], limit_s: float = 60.0) -> None:
    """Wait until something is so; for what the page's elements cannot tell.

    Looking takes no more of the machine than waiting does: what is waited for needs it, too.
    """
    until = time.monotonic() + limit_s
    while True:
        begun = time.monotonic()
        if holds():
            return
        assert time.monotonic() < until
        time.sleep(max(0.02, time.monotonic() - begun))


def fact(page: Page, name: str) -> Locator:
    """The value of a figure or of a pixel's number on the page that is shown."""
    term = page.locator("dt").filter(has_text=re.compile(f"^{re.escape(name)}$"))
    return page.locator("dl div", has=term).locator("dd").filter(visible=True)


def server_process(address: str) -> psutil.Process:
    """Process of a server that this one has started, by its address."""
    port = str(urlsplit(address).port)
    alive = (
        each
        for each in psutil.Process().children(recursive=True)
        if each.status() != psutil.STATUS_ZOMBIE
    )
    return next(each for each in alive if port in each.cmdline())


def _gone(server: subprocess.Popen[bytes], log: IO[str], limit_s: float = 60.0) -> None:
    """Wait until it has ended; where it does not, it is ended, and that is an error."""
    try:
        server.wait(limit_s)
    except subprocess.TimeoutExpired as late:
        server.kill()
        log.seek(0)
        raise RuntimeError(f"the app was asked to stop, and went on:\n{log.read()}") from late


def when_up(
    address: str, server: subprocess.Popen[bytes], log: IO[str], limit_s: float = 120.0
) -> str:
    """The address, once it answers; a first start compiles the kernels."""
    until = time.monotonic() + limit_s
    while time.monotonic() < until:
        if server.poll() is not None:
            log.seek(0)
            raise RuntimeError(f"the app stopped at once:\n{log.read()}")
        try:
            urlopen(f"{address}favicon.ico", timeout=5).close()
        except HTTPError as refusal:  # it answers, if only to ask for a token
            refusal.close()
            return address
        except OSError:
            time.sleep(0.2)
        else:
            return address
    raise TimeoutError(f"the app did not answer at {address} within {limit_s:.0f} s")
