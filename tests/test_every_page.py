"""Every page opens first, by its own address, with plots that can be read, and can be used."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import Page, expect

from app.pages.catalog import PAGES
from tests.browser import EDGES, VIEWS, eventually, image, slider, stage
from tests.inspecting import LINK, expect_a_steady_frame, inspect_the_building
from tests.test_browser import (
    NOTE_FIRST,
    change_theme,
    expect_all_in_place,
    expect_inspect_in_place,
    show_scenes_in_every_way,
    use_the_controls,
)
from tests.test_compare import compare_the_methods
from tests.test_lessons import take_lessons_of_every_kind
from tests.test_paper_page import read_part_by_part
from tests.test_tradeoff_page import open_a_configuration

pytestmark = pytest.mark.browser

SIZES_PX = ((1440, 900), (1024, 768), (390, 844))
LEAST_HEIGHT_PX = 200

PRINT_ZOOM = "document.documentElement.style.getPropertyValue('--print-zoom')"

PLOTS = f"""() => {{
  {VIEWS}
  const isBar = (figure) => figure.below.some((each) => each.type === "ColorBar");
  const plots = views.filter(({{ model }}) => model.type === "Figure" && !isBar(model));
  return plots.map(({{ el }}) => el.getBoundingClientRect()).filter(({{ height }}) => height > 0);
}}"""
"""Places of the plots on screen, without the figure that holds the colour bar of Compare."""


PLOT_NAMES = f"""() => {{
  {VIEWS}
  const layers = views.map(({{ canvas_view }}) => canvas_view?.events_el).filter(Boolean);
  return layers.map(({{ role, ariaLabel, tabIndex }}) => [role, ariaLabel, tabIndex]);
}}"""
"""Role, name and place among the tab stops of each plot."""

LEGENDS_FIT = f"""() => {{
  {VIEWS}
  const beside = ({{ model, plot_view }}) => plot_view.model.right.includes(model);
  const legends = views.filter(({{ model }}) => model.type === "Legend");
  return legends.filter((each) => !beside(each)).every(({{ el, plot_view }}) =>
    el.getBoundingClientRect().left >= plot_view.el.getBoundingClientRect().left);
}}"""
"""Whether legends inside, above and below plots are as narrow as these."""


def expect_readable(page: Page, name: str) -> None:
    """Expect the page of this name with plots that can be read, in windows of all sizes."""
    button = page.get_by_role("button", name=name, exact=True)
    expect(button).to_have_attribute("aria-pressed", "true")
    eventually(lambda: page.evaluate(PLOTS), limit_s=300.0)  # some are of a study
    for width, height in SIZES_PX:
        page.set_viewport_size({"width": width, "height": height})

        def fit(width: int = width) -> bool:
            plots = page.evaluate(PLOTS)
            inside = all(each["left"] >= 0 and each["right"] <= width for each in plots)
            least = min((each["height"] for each in plots), default=0)
            tables = page.locator(".scroll").filter(visible=True).evaluate_all(EDGES)
            apart = not any(
                each["top"] < bottom and top < each["bottom"] - 1
                for each in plots
                for left, top, right, bottom in tables
                if each["left"] < right and left < each["right"]
            )
            return inside and least >= LEAST_HEIGHT_PX and apart and page.evaluate(LEGENDS_FIT)

        eventually(fit)
        expect(page.get_by_role("button", name="Toggle theme")).to_be_in_viewport(ratio=1)
    for role, label, tab_index in page.evaluate(PLOT_NAMES):
        assert (role, tab_index) == ("img", -1)
        assert label not in ("", "Plot")
    page.set_viewport_size({"width": 1440, "height": 900})
    expect(page.get_by_role("alert").filter(visible=True)).to_have_count(0)


def expect_a_print_of_the_content(page: Page) -> None:
    described = page.get_by_text("method: tracking; settings:")
    content, skip = page.locator(".main-content"), page.get_by_role("link", name="Skip to the")
    for width, height in SIZES_PX[:2]:  # wider and narrower than paper
        page.set_viewport_size({"width": width, "height": height})
        expect(described).to_be_hidden()
        parts = (image(page), stage(page))
        shown = [each.bounding_box() for each in parts]
        page.evaluate("dispatchEvent(new Event('beforeprint'))")
        page.set_viewport_size({"width": 1062, "height": 733})
        page.emulate_media(media="print")
        expect(described).to_be_visible()
        zoom = float(page.evaluate(PRINT_ZOOM))
        # Else what is drawn there would be cut off; rounded borders are not seen.
        for part, frame in zip(parts, shown, strict=True):
            printed = part.bounding_box()
            for side in ("width", "height"):
                assert printed[side] == pytest.approx(zoom * frame[side], abs=2)
        for unprinted in (
            page.get_by_role("button", name="Toggle theme"),
            slider(page, "SBR"),
            skip,
        ):
            expect(unprinted).to_be_hidden()
        assert content.evaluate("(each) => each.scrollHeight <= each.clientHeight")  # all of it
        page.emulate_media(media="screen")
        page.evaluate("dispatchEvent(new Event('afterprint'))")
    page.set_viewport_size({"width": 1440, "height": 900})
    expect(page.locator("html")).to_have_css("print-color-adjust", "exact")  # dark mode prints dark


def expect_a_print_that_states_its_link(page: Page) -> None:
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    page.emulate_media(media="print")
    expect(page.get_by_text(": printed page")).to_be_visible()
    expect(page.locator("body")).to_have_attribute("data-link", page.evaluate("location.href"))
    page.emulate_media(media="screen")
    page.evaluate("dispatchEvent(new Event('afterprint'))")


def expect_the_sidebar_to_be_skipped(page: Page) -> None:
    page.locator("body").focus()
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the content")).to_be_focused()
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    expect(page.get_by_role("main").locator(":focus").first).to_be_attached()


def expect_motion_only_where_it_is_wanted(page: Page) -> None:
    duration = "(each) => parseFloat(getComputedStyle(each).transitionDuration)"
    for name in ("Toggle theme", "Tour"):  # in the template, and in a component of its own
        moving = page.get_by_role("button", name=re.compile(f"^{name}"))
        assert moving.evaluate(duration) == 0
        page.emulate_media(reduced_motion="no-preference")
        assert moving.evaluate(duration) > 0.1
        page.emulate_media(reduced_motion="reduce")


def explore(page: Page) -> None:
    expect_motion_only_where_it_is_wanted(page)
    expect_a_print_of_the_content(page)
    expect_a_steady_frame(page)
    show_scenes_in_every_way(page)
    use_the_controls(page)
    expect_inspect_in_place(page)


JOURNEYS = {
    "Explore": explore,
    "Inspect": inspect_the_building,
    "Compare": compare_the_methods,
    "Trade-off": open_a_configuration,
    "Paper": read_part_by_part,
    "Learn": take_lessons_of_every_kind,
}
"""Actions of a user on a page that has just been opened, by its name."""

OTHERWISE = {"Inspect": LINK}
"""Further parts of the address of a page, by its name."""


@pytest.mark.parametrize("name", [each.name for each in PAGES])
def test_a_page_opens_first_has_plots_that_can_be_read_and_is_used(page, address, name):
    link = f"{address}?page={name}{OTHERWISE.get(name, '')}"
    is_noted = name == "Explore"
    opened = page(link, ready=".bk-Figure", prepare=NOTE_FIRST if is_noted else "")
    if is_noted:
        expect_all_in_place(opened)
        expect_the_sidebar_to_be_skipped(opened)
        opened.emulate_media(reduced_motion="no-preference")
        change_theme(opened)
        opened.emulate_media(reduced_motion="reduce")
    expect_readable(opened, name)
    expect_a_print_that_states_its_link(opened)
    JOURNEYS[name](opened)
