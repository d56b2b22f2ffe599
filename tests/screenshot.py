"""The pictures in the README: ``python -m tests.screenshot`` writes them to ``assets/``."""

from __future__ import annotations

import argparse
from pathlib import Path

from playwright.sync_api import Browser

from tests.browser import ROOT, chromium, open_page, serving

FIRST_DRAWING_MS = 3000
"""Of the cloud, in software."""


def photograph(browser: Browser, address: str, name: str) -> None:
    """Open a page in a browser and take its picture."""
    page = open_page(browser, address)
    page.wait_for_timeout(FIRST_DRAWING_MS)
    page.screenshot(path=ROOT / "assets" / name)
    page.close()


def main() -> None:
    """Take the start page, and Inspect with a capture."""
    parser = argparse.ArgumentParser(prog="python -m tests.screenshot", description=__doc__)
    parser.add_argument("capture", type=Path, nargs="?", help="of which Inspect is taken, too")
    chosen = parser.parse_args()
    with chromium() as browser:
        with serving() as address:
            photograph(browser, address, "screenshot.png")
        if chosen.capture is not None:
            with serving(chosen.capture) as address:
                photograph(browser, address, "inspect.png")


if __name__ == "__main__":
    main()
