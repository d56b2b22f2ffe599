"""Every page opens first, by its link and after a reload, with plots that can be read."""

from __future__ import annotations

import pytest
from playwright.sync_api import Page, expect

from app.pages.catalog import PAGES
from tests.browser import VIEWS, eventually

pytestmark = pytest.mark.browser

SIZES_PX = ((1440, 900), (1024, 768), (390, 844))
LEAST_HEIGHT_PX = 200

HEIGHTS = f"""() => {{
  {VIEWS}
  const isBar = (figure) => figure.below.some((each) => each.type === "ColorBar");
  const plots = views.filter(({{ model }}) => model.type === "Figure" && !isBar(model));
  return plots.map(({{ el }}) => el.getBoundingClientRect().height).filter((px) => px > 0);
}}"""
"""Heights of the plots on screen, without the figure that holds the colour bar of Compare."""


def expect_drawn(page: Page, name: str) -> None:
    button = page.get_by_role("button", name=name, exact=True)
    expect(button).to_have_attribute("aria-pressed", "true")
    eventually(lambda: page.evaluate(HEIGHTS))
    expect(page.get_by_role("alert").filter(visible=True)).to_have_count(0)


@pytest.mark.parametrize("name", [each.name for each in PAGES])
def test_a_page_opens_first_with_plots_that_can_be_read(page, address, name):
    opened = page(f"{address}?page={name}", ready=f"[aria-pressed=true]:text-is('{name}')")
    expect_drawn(opened, name)
    opened.reload()
    expect_drawn(opened, name)
    for width, height in SIZES_PX:
        opened.set_viewport_size({"width": width, "height": height})
        eventually(lambda: min(opened.evaluate(HEIGHTS)) >= LEAST_HEIGHT_PX)
