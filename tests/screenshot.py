"""Write the README's picture: ``python -m tests.screenshot``."""

from __future__ import annotations

from tests.browser import ROOT, chromium, open_page, serving

FIRST_DRAWING_MS = 3000
"""Time to draw the point cloud in software."""


def main() -> None:
    """Save a picture of the start page to ``assets/``."""
    with chromium() as browser, serving() as address:
        page = open_page(browser, address)
        page.wait_for_timeout(FIRST_DRAWING_MS)
        page.screenshot(path=ROOT / "assets" / "screenshot.png")


if __name__ == "__main__":
    main()
