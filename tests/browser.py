"""The served app in a real browser, for tests and benchmarks: start, actions and observations."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import urlopen

import numpy as np
import psutil
from PIL import Image
from playwright.sync_api import Browser, BrowserType, Locator, Page, expect, sync_playwright

from app.server.ports import free_port

VIEWS = """
const views = [];
const walk = (view) => { views.push(view); (view.child_views ?? []).forEach(walk); };
[...Bokeh.index.roots].forEach(walk);
"""
"""JavaScript that sets ``views`` to all views of Bokeh on the page."""

TITLES_FIT = f"""() => {{
  {VIEWS}
  const pen = document.createElement("canvas").getContext("2d");
  const roomBeside = ({{ el, frame, model: {{ title }} }}) => {{
    pen.font = `${{title.text_font_style}} ${{title.text_font_size}} ${{title.text_font}}`;
    return el.clientWidth - frame.bbox.left - pen.measureText(title.text).width;
  }};
  const plots = views.filter(({{ el, model }}) => model.type === "Figure" && el.clientWidth);
  return plots.every((plot) => roomBeside(plot) >= 24);
}}"""
"""Whether the titles of plots end before the download button in the corner."""

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
    """Return the path of the machine's browser; None stands for Playwright's own."""
    named = os.environ.get("BROWSER_PATH")
    return named or next(filter(None, map(shutil.which, BROWSERS)), None)


TIMEOUT_MS = 120_000
"""Limit of each wait for a page: pages are drawn in software, on few cores."""

TOUR = "firstphoton.tour"
"""Name under which the browser keeps that the tour was ended; else it starts by itself."""

READY = ".stage[data-camera], [aria-label='Pinned pixels']"
"""Part of a page that is drawn late: Explore's cloud, or the pins of Inspect."""


@contextmanager
def chromium(*, is_still: bool = False) -> Iterator[Browser]:
    """Start a browser without a window; raise where there is none."""
    with sync_playwright() as playwright, launched(playwright.chromium, is_still) as browser:
        yield browser


@contextmanager
def launched(kind: BrowserType, is_still: bool) -> Iterator[Browser]:
    """Start a browser whose first context is that of `open_page`.

    It has a folder of its own: in private contexts, each page would compile all scripts again. If
    `is_still`, it asks pages to reduce motion, so that it has less to draw.
    """
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        context = kind.launch_persistent_context(
            folder,
            executable_path=browser_path(),
            args=ARGUMENTS,
            reduced_motion="reduce" if is_still else "no-preference",
        )
        context.set_default_timeout(TIMEOUT_MS)
        assert context.browser is not None
        yield context.browser
        context.close()


@contextmanager
def serving(*arguments: str | Path, module: str = "app", **environment: str) -> Iterator[str]:
    """Serve the app in a process of its own and yield its address."""
    port = free_port()
    command = [sys.executable, "-m", module, "--port", str(port), *map(str, arguments)]
    # A pipe that nobody reads would block the server when it is full.
    with (
        TemporaryFile("w+") as log,
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
    ready: str = READY,
) -> Page:
    """Open a tab with a session of its own, and wait until it is drawn and ready for input.

    `prepare` is a script to run first; `watch` is called with the page before it loads anything.
    """
    page = browser.contexts[0].new_page()
    page.set_viewport_size({"width": width, "height": height})
    watch(page)
    page.add_init_script(f"localStorage['{TOUR}'] ??= 'ended'")
    page.add_init_script(prepare)
    page.goto(address)
    page.locator(ready).first.wait_for(state="attached")
    page.wait_for_function("Bokeh.documents[0].is_idle")
    return page


def eventually(holds: Callable[[], object], limit_s: float = 60.0) -> None:
    """Wait until a condition holds that no `expect` can express.

    Pauses last as long as checks: the app needs the machine, too.
    """
    until = time.monotonic() + limit_s
    while True:
        begun = time.monotonic()
        if holds():
            return
        assert time.monotonic() < until
        time.sleep(max(0.02, time.monotonic() - begun))


def fact(page: Page, name: str) -> Locator:
    """Return the value of a named fact on the visible page."""
    term = page.locator("dt").filter(has_text=re.compile(f"^{re.escape(name)}$"))
    return page.locator("dl div", has=term).locator("dd").filter(visible=True)


def slider(page: Page, name: str) -> Locator:
    return page.get_by_role("slider", name=name, exact=True)


def field(page: Page, name: str) -> Locator:
    return page.get_by_role("textbox", name=name, exact=True)


def chosen(page: Page, name: str) -> Locator:
    """Return the box of a list that shows the selected option."""
    return page.get_by_role("combobox", name=re.compile(f"^{name}"))


def warning(page: Page) -> Locator:
    """Return the sentence about a failed request."""
    return page.get_by_role("alert").filter(has_text="The page still shows")


def image(page: Page) -> Locator:
    return page.locator("[data-part=image]").filter(visible=True)


def stage(page: Page) -> Locator:
    """Return the place where the 3D cloud is drawn."""
    return page.locator(".stage")


PARTS = ("image", "cloud", "histogram", "residual", "enhanced")
"""Pictures of Explore, from the top down where they are stacked."""


def parts(page: Page) -> Locator:
    """Return the pictures of Explore, in the order of `PARTS`, once all are visible."""
    figures = page.locator(".bk-Figure").filter(has_text=re.compile("estimate"))
    found = image(page).or_(stage(page)).or_(figures).filter(visible=True)
    expect(found).to_have_count(len(PARTS))
    return found


def choose(page: Page, name: str, option: str) -> None:
    """Choose an option from a list.

    While the list opens, its options move: a button pressed on one and released on another chooses
    nothing. Until it has faded, the list takes all clicks.
    """
    chosen(page, name).click()
    expect(page.locator(".MuiMenu-paper")).to_have_css("transform", "none")
    page.get_by_role("menuitem", name=option, exact=True).click()
    expect(chosen(page, name)).to_have_text(option)
    expect(page.locator(".MuiMenu-root")).to_have_count(0)


def unfold(page: Page, title: str) -> None:
    """Unfold a section of the sidebar by keyboard."""
    head = page.get_by_role("button", name=title, exact=True).filter(visible=True)
    head.press("Enter")
    expect(head).to_have_attribute("aria-expanded", "true")


def enter(page: Page, name: str, text: str) -> None:
    field(page, name).fill(text)
    field(page, name).press("Enter")


def upload(page: Page, name: str, content: bytes) -> None:
    file = {"name": name, "mimeType": "application/octet-stream", "buffer": content}
    page.locator("input[type=file]").set_input_files(file)
    # The button is replaced when it first shows a name: a file set on the old one would be lost.
    expect(page.get_by_role("button", name=name, exact=True)).to_be_visible()
    expect(page.get_by_text("Open a capture file")).to_be_visible()


def pixels(png: bytes) -> np.ndarray:
    """Decode a picture to uint8 (row, col, rgb)."""
    return np.asarray(Image.open(BytesIO(png)).convert("RGB"))


EDGES = """all => all.map((each) => {
  const { left, top, right, bottom } = each.getBoundingClientRect();
  return [left, top, right, bottom].map(Math.round);
})"""


def look(page: Page) -> dict[str, np.ndarray]:
    """Return a screenshot of each picture of Explore, uint8 (row, col, rgb)."""
    found, whole = parts(page), pixels(page.screenshot())
    edges = found.evaluate_all(EDGES)
    return {
        name: whole[top:bottom, left:right]
        for name, (left, top, right, bottom) in zip(PARTS, edges, strict=True)
    }


def pixel_on_show(page: Page) -> tuple[int, int]:
    row, col = re.findall(r"\d+", fact(page, "Pixel").inner_text())
    return int(row), int(col)


def server_process(address: str) -> psutil.Process:
    """Return the process of a server that this process has started."""
    port = str(urlsplit(address).port)
    alive = (
        each
        for each in psutil.Process().children(recursive=True)
        if each.status() != psutil.STATUS_ZOMBIE
    )
    return next(each for each in alive if port in each.cmdline())


def _gone(server: subprocess.Popen[bytes], log: IO[str], limit_s: float = 60.0) -> None:
    """Wait for the end of a server; kill it and raise where it does not end."""
    try:
        server.wait(limit_s)
    except subprocess.TimeoutExpired as late:
        server.kill()
        log.seek(0)
        raise RuntimeError(f"the app did not stop when terminated:\n{log.read()}") from late


def when_up(
    address: str, server: subprocess.Popen[bytes], log: IO[str], limit_s: float = 600.0
) -> str:
    """Return the address when it responds; a first start compiles the kernels for minutes."""
    until = time.monotonic() + limit_s
    while time.monotonic() < until:
        if server.poll() is not None:
            log.seek(0)
            raise RuntimeError(f"the app stopped at once:\n{log.read()}")
        try:
            urlopen(f"{address}favicon.ico", timeout=5).close()
        except HTTPError as refusal:  # it requires a token
            refusal.close()
            return address
        except OSError:
            time.sleep(0.2)
        else:
            return address
    raise TimeoutError(f"the app did not answer at {address} within {limit_s:.0f} s")
