"""The picture in the README: ``python -m tests.screenshot`` writes it to ``assets/``."""

from __future__ import annotations

from tests.browser import ROOT, chromium, open_page, serving

FIRST_DRAWING_MS = 3000
"""Of the point cloud, in software."""


def main() -> None:
    """Save a picture of the start page."""
    with chromium() as browser, serving() as address:
        page = open_page(browser, address)
        page.wait_for_timeout(FIRST_DRAWING_MS)
        page.screenshot(path=ROOT / "assets" / "screenshot.png")


if __name__ == "__main__":
    main()
