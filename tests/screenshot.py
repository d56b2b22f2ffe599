"""The picture in the README: ``python -m tests.screenshot`` writes ``assets/screenshot.png``."""

from __future__ import annotations

from tests.browser import ROOT, chromium, open_page, serving


def main() -> None:
    """Open the start page in a browser and photograph it."""
    with serving() as address, chromium() as browser:
        page = open_page(browser, address)
        page.wait_for_timeout(3000)  # the first drawing of the cloud, in software
        page.screenshot(path=ROOT / "assets" / "screenshot.png")


if __name__ == "__main__":
    main()
