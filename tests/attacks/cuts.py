"""A network that fails during long work."""

from __future__ import annotations

import re
import time
from pathlib import Path

from playwright.sync_api import Locator, Page

from tests.attacks.attack import Attack, Outcome, running
from tests.attacks.proxy import proxy
from tests.browser import chromium, eventually

CUT_S = 20.0


def shown(page: Page, pattern: str) -> Locator:
    """Return the first of the texts on screen that match a pattern."""
    return page.get_by_text(re.compile(pattern)).filter(visible=True).first


def done(page: Page) -> int:
    """Return the number of steps of the study that the page reports."""
    text = shown(page, r"^(\d+ of \d+|Done: \d+) ")
    return int(re.findall(r"\d+", text.inner_text())[0])


def study(_folder: Path) -> Outcome:
    """Cut the connection in the middle of a study on Trade-off, in Chromium."""
    with (
        proxy() as between,
        running("--origin", f"127.0.0.1:{between.port}") as server,
        chromium() as browser,
    ):
        between.forward_to(server.port)
        page = browser.new_page()
        page.goto(f"http://127.0.0.1:{between.port}/?page=Trade-off")
        page.get_by_role("button", name=re.compile("^Compute")).press("Enter")
        shown(page, r"^[1-9]\d* of ").wait_for(timeout=60_000)
        before, begun = done(page), time.monotonic()
        between.cut()
        lost = page.get_by_role("alertdialog").filter(has_text="connection to the server is lost")
        lost.wait_for(timeout=30_000)
        time.sleep(max(0.0, CUT_S - (time.monotonic() - begun)))
        between.mend()
        back = page.get_by_role("status").filter(has_text="The connection is back")
        back.wait_for(timeout=60_000)
        kept = "everything is as it was" in back.inner_text()
        eventually(lambda: done(page) > before)
        after, peak = done(page), server.memory.peak_bytes
    text = f"{before} steps done before, {after} after; " + ("nothing lost" if kept else "LOST")
    return Outcome(1, text, kept and after > before, peak)


ATTACKS = [Attack(f"connection cut for {CUT_S:.0f} s in a study", study, needs_server=False)]
