"""The page "Paper": what its sliders, tables and pictures show, without a browser and in one."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from bokeh.models import Range1d
from playwright.sync_api import Locator, Page, expect

from app.model.address import Wanted
from app.model.store import built_in_sources
from app.pages.layout import Layout
from app.pages.paper import page as page_of_paper
from app.pages.paper import text as paper_words
from app.pages.paper.page import RangeImages, RepeatedAt, Scales, Trials, joined, two_scales
from app.pages.session import Session
from app.pages.shared.outputs import CurveCard, Gallery, table_of
from app.plots import elements as plots
from app.theme import DARK, LIGHT
from core import PRESETS, Flux
from core.studies import outputs as items
from core.studies.paper import figures as paper
from core.studies.trials import Condition, trials
from tests.browser import eventually

SOON_MS = 20_000


# -- plots, pictures, tables -----------------------------------------------------------------------


@pytest.mark.parametrize("make", [paper.figure_1, paper.figure_2, paper.figure_5, paper.figure_6])
def test_a_figure_holds_every_curve_of_its_study(make):
    item = make()
    drawing = plots.curves(item, LIGHT)
    assert drawing.title.text == item.title
    assert (drawing.xaxis[0].axis_label, drawing.yaxis[0].axis_label) == (
        item.x_label,
        item.y_label,
    )
    shown = {each.name: each.data_source.data["y"] for each in drawing.renderers}
    assert list(shown) == [*item.curves, *item.marks]
    for name, values in item.curves.items():
        np.testing.assert_array_equal(shown[name], values)
    assert [entry.label.value for entry in drawing.legend[0].items] == list(shown)


def test_a_method_has_one_style_in_all_plots():
    def plot(*names):
        return items.Plot("", "", "", "", np.zeros(1), dict.fromkeys(names, np.zeros(1)))

    names = [method.name for method in paper.COMPARED]
    styles = plots.curve_styles(plot(*names), LIGHT)
    assert plots.curve_styles(plot("likelihood"), LIGHT) == {"likelihood": styles["likelihood"]}
    assert len({(color, tuple(dash)) for color, dash in styles.values()}) == len(names)


def test_new_curves_change_values_and_nothing_else():
    card = CurveCard(Range1d(0, 100))
    card.show(two_scales(Scales(onset_bin=30))[0])
    figure, before = card.figure, set(card.figure.references())
    moved = two_scales(Scales(onset_bin=60))[0]
    card.show(moved)
    assert card.figure is figure
    assert set(figure.references()) == before
    (residual,) = (each for each in figure.renderers if each.name == "residual")
    np.testing.assert_allclose(residual.data_source.data["y"], moved.curves["residual"], rtol=1e-6)
    (onset,) = (each for each in figure.renderers if each.name == "echo's onset")
    assert set(onset.data_source.data["x"]) == {60.0}
    assert figure.title.text == moved.title
    assert figure.y_range.end > max(curve.max() for curve in moved.curves.values())


def test_curves_take_on_the_colours_of_the_mode():
    card = CurveCard(Range1d(0, 100))
    for order in ("painted before", "painted after"):
        if order == "painted before":
            card.paint(DARK)
        card.show(two_scales(Scales())[0])
        colors = {each.name: each.glyph.line_color for each in card.figure.renderers}
        assert colors["small scale"] == DARK.small
        assert card.figure.title.text_color == DARK.text
    card.paint(LIGHT)
    colors = {each.name: each.glyph.line_color for each in card.figure.renderers}
    assert colors["large scale"] == LIGHT.large


@pytest.fixture
def pictures():
    images = {name: np.arange(6.0).reshape(2, 3) + k for k, name in enumerate(("truth", "a_b"))}
    images["truth"][0, 0] = np.nan
    return items.Pictures("key", "Title", "Range (m)", images, 0.0, 6.0, "Note.")


def test_pictures_share_scale_and_view_and_tell_of_one_pixel(pictures):
    gallery = Gallery()
    gallery.show(pictures)
    one, other = gallery.figures
    assert one.x_range is other.x_range
    assert one.y_range is other.y_range
    mappers = {each.renderers[0].glyph.color_mapper for each in (one, other)}
    assert len(mappers) == 1
    row, column = gallery.place
    assert (row.high, column.high) == (1, 2)
    row.value, column.value = 0, 2
    assert [each.title.text for each in (one, other)] == ["truth: 2 m", "a b: 3 m"]
    column.value = 0
    assert one.title.text == "truth: no target"


def test_other_values_on_the_same_scale_build_nothing(pictures):
    gallery = Gallery()
    gallery.show(pictures)
    before = gallery.figures
    images = {"truth": pictures.images["truth"], "c": pictures.images["a_b"] + 1}
    gallery.show(replace(pictures, images=images))
    assert all(one is other for one, other in zip(gallery.figures, before, strict=True))
    assert gallery.figures[1].title.text == "c: 7 m"


def test_a_tables_interval_and_difference_are_said_in_words():
    columns = ("kind", "method", "RD, 3 bins", "low", "high", "printed RD", "difference")
    rows = (
        ("as defined", "peak", 0.30, 0.28, 0.32, 0.26, 0.04),
        ("reconstruction", "kde", 0.20, 0.18, 0.22, 0.21, -0.01),
        ("as defined", "tracking", 0.90, 0.88, 0.92, 0.98, -0.08),
        ("as defined", "oracle", 0.99, 0.98, 1.0, "", ""),
    )
    shown, lines = table_of(items.Table("", "", columns, rows))
    assert [column[0] for column in shown] == ["method", "RD, 3 bins", "printed RD", "difference"]
    assert [line["note"] for line in lines] == ["", paper_words.RECONSTRUCTION, "", ""]
    assert lines[0]["name"] == "Peak of the histogram"
    assert lines[0]["cells"][0] == ["0.3000", 0.30, "0.2800 to 0.3200"]
    assert [line["cells"][2][2] for line in lines] == ["better", "chance may do", "worse", ""]
    assert [line["cells"][2][1] for line in lines] == [0.04, -0.01, -0.08, None]


def test_a_smaller_error_is_the_better_one():
    columns = ("method", "RMSE m", "low", "high", "printed RMSE m", "difference")
    rows = (("peak", 6.0, 5.0, 7.0, 9.7, -3.7), ("chi", 7.0, 6.5, 7.5, 1.0, 6.0))
    _, lines = table_of(items.Table("", "", columns, rows))
    assert [line["cells"][2][2] for line in lines] == ["better", "worse"]


def test_columns_without_a_value_are_left_out():
    columns, _ = table_of(items.Table("", "", ("method", "ms", "printed RD"), (("peak", 1.0, ""),)))
    assert [column[0] for column in columns] == ["method", "ms"]


def test_parts_of_a_plot_are_joined_as_they_come():
    x = [1.0, 2.0, 3.0]
    parts = [
        items.Plot("", "", "", "", np.array([at]), {"curve": np.array([10 * at])}) for at in x[:2]
    ]
    plot = joined(parts, x)
    np.testing.assert_array_equal(plot.x, x)
    np.testing.assert_array_equal(plot.curves["curve"], [10.0, 20.0, np.nan])


# -- what core computes for the page ---------------------------------------------------------------


def test_the_table_of_all_methods_has_printed_values_only_where_the_paper_prints_them():
    def printed(sbr):
        condition = Condition("car", sbr)
        methods = [method for method in paper.COMPARED if method.estimator in ("peak", "tracking")]
        known = trials({condition: methods}, range(2))
        results = {(condition, m.name): known[condition, methods[0].name] for m in paper.COMPARED}
        rows = paper.table_3(results, sbr).rows
        return {row[1]: row[5] for row in rows if row[5] != ""}

    of_own = {"tracking": 0.9282, "tracking as printed": 0.9282}
    assert printed(0.06)["peak"] == 0.2615
    assert printed(0.05) == of_own
    assert printed(0.055) == {}


def test_a_place_alone_gives_what_it_gives_among_others():
    two = paper.by_place(size=4, onset=(42.5, 72.5))
    one = paper.by_place(size=4, onset=(72.5,))
    for name, values in two.curves.items():
        assert values[1] == one.curves[name][0]


def test_figures_4_and_5_agree_on_preset_light_and_place():
    pixel, curve = two_scales(Scales(onset_bin=77, sbr=0.05, preset="as printed"))
    expected = paper.figure_5_at(77, PRESETS["as printed"], Flux(sbr=0.05))
    np.testing.assert_array_equal(pixel.curves["residual"], expected.curves["residual"])
    assert curve.marks == {"the echo above": 77.0}
    assert "0.05" in curve.title


# -- the page without a browser --------------------------------------------------------------------


@pytest.fixture
def session():
    return Session(built_in_sources())


def test_nothing_is_computed_before_the_first_visit(monkeypatch):
    built = []
    monkeypatch.setattr(page_of_paper, "Sliders", lambda *_, **__: built.append(1))
    Layout(built_in_sources())
    assert built == []


def test_the_page_puts_the_sidebar_away_and_brings_it_back():
    layout = Layout(built_in_sources())
    layout.pages.choice.value = "Paper"
    assert not layout.page.sidebar_open
    layout.pages.choice.value = "Explore"
    assert layout.page.sidebar_open
    layout.page.is_narrow = True
    layout.pages.choice.value = "Paper"
    layout.pages.choice.value = "Explore"
    assert not layout.page.sidebar_open


def test_a_link_opens_on_paper_without_the_sidebar():
    layout = Layout(built_in_sources(), Wanted({"page": "Paper"}))
    assert layout.pages.choice.value == "Paper"
    assert not layout.page.sidebar_open
    layout.pages.choice.value = "Explore"
    assert layout.page.sidebar_open


@pytest.fixture
def few(session, monkeypatch):
    """Table 3 of two methods; the others take long and are in the table all the same."""
    methods = [method for method in paper.COMPARED if method.estimator in ("peak", "tracking")]
    monkeypatch.setattr(paper, "COMPARED", methods)

    def build(repetitions):
        return Trials(
            session,
            RepeatedAt(sbr=0.05, repetitions=repetitions),
            "",
            lambda chosen: {Condition("car", chosen.sbr): methods},
            lambda results, chosen: paper.table_3(results, chosen.sbr),
        )

    return build


def shown_table(view):
    title, table, note, _ = view.main
    return title.object, table.rows, note.text


def test_a_table_over_repetitions_is_what_core_computes(few):
    section = few(3)
    view = section.view
    assert shown_table(view)[0] == paper_words.NEEDS_TWO
    view.show(True)
    eventually(lambda: "3 repetitions" in shown_table(view)[0])
    condition = Condition("car", 0.05)
    results = trials({condition: paper.COMPARED}, range(3))
    expected = table_of(paper.table_3(results, 0.05))[1]
    for row, other in zip(shown_table(view)[1], expected, strict=True):
        assert row["name"] == other["name"]
        assert row["cells"][:-1] == other["cells"][:-1]  # the last is how long it took


def test_a_table_stands_still_while_it_is_hidden(few):
    view = few(100).view
    view.show(True)
    eventually(lambda: shown_table(view)[1])
    view.show(False)
    time.sleep(0.3)
    before = shown_table(view)[0]
    time.sleep(0.3)
    assert shown_table(view)[0] == before
    view.show(True)
    eventually(lambda: shown_table(view)[0] != before)
    *_, buttons, _, sentence = view.aside
    buttons[1].clicks += 1  # Cancel
    assert sentence.text.startswith("Stopped after")


def test_range_images_come_on_the_first_visit(session):
    section = RangeImages(session)
    view = section.view
    view.show(True)
    eventually(lambda: paper_words.OUTSIDE_NOTE in view.main[-1].text)  # written last
    titles = [each.title.text.split(":")[0] for each in section._gallery.figures]
    assert titles == ["truth", *(f"SBR {sbr:g}" for sbr in paper.NEAR)]


# -- in a browser ----------------------------------------------------------------------------------


def slider(page: Page, name: str) -> Locator:
    return page.get_by_role("slider", name=name, exact=True)


def go(page: Page, part: str) -> None:
    page.get_by_role("button", name=re.compile(f"^{part}")).click()


def figure(page: Page, line: str) -> Locator:
    """The plot whose legend names this line."""
    return page.locator(".bk-Figure").filter(has_text=line).last


def bottom(locator: Locator) -> float:
    box = locator.bounding_box()
    return box["y"] + box["height"]


def titles(page: Page) -> dict[str, str]:
    """Colour of each plot's title, by the title: they are drawn, and no text to the browser."""
    return page.evaluate(
        """() => Object.fromEntries([...Bokeh.documents[0].all_models]
        .filter((model) => model.type === "Title")
        .map((model) => [model.text, model.text_color]))"""
    )


@pytest.fixture
def paper_page(start_page):
    """The Paper page with its first figures."""
    start_page.get_by_role("button", name="Paper", exact=True).click()
    expect(figure(start_page, "background alone")).to_be_visible(timeout=SOON_MS)
    return start_page


@pytest.mark.browser
def test_the_slider_of_figure_5_moves_the_curves(paper_page):
    go(paper_page, "Figures 4, 5")
    pixel, curve = figure(paper_page, "small scale"), figure(paper_page, "the echo above")
    for each in (pixel, curve):
        expect(each).to_be_visible(timeout=SOON_MS)
    assert "Both scales, echo at bin 50, SBR 0.08" in titles(paper_page)
    before = pixel.screenshot(), curve.screenshot()
    slider(paper_page, "Echo's bin").focus()
    for _ in range(20):
        paper_page.keyboard.press("ArrowRight")
    eventually(lambda: "Both scales, echo at bin 70, SBR 0.08" in titles(paper_page))
    eventually(lambda: pixel.screenshot() != before[0] and curve.screenshot() != before[1])


@pytest.mark.browser
def test_what_a_part_shows_is_below_each_other(paper_page):
    go(paper_page, "Figures 8, 9, 12")
    go(paper_page, "What is left unsaid")
    limit, *others = (
        paper_page.locator("table").filter(has_text=text) for text in ("Cramér-Rao", "statement")
    )
    chart = figure(paper_page, "limit: probability")
    for above, below in pairwise((chart, limit, *others)):
        eventually(lambda above=above, below=below: bottom(above) < below.bounding_box()["y"])
    go(paper_page, "Figures 8, 9, 12")
    note = paper_page.get_by_text(paper_words.OUTSIDE_NOTE)
    expect(note).to_be_visible(timeout=SOON_MS)
    drawn = paper_page.locator(".bk-Figure:visible")
    eventually(lambda: drawn.count() == len(paper.NEAR) + 2)  # truth and scale, too
    *pictures, scale = sorted(drawn.all(), key=lambda each: each.bounding_box()["y"])
    for each in pictures:
        assert bottom(each) <= scale.bounding_box()["y"]
    assert bottom(scale) <= note.bounding_box()["y"]


@pytest.mark.browser
def test_table_3_runs_at_the_chosen_sbr_and_can_be_cancelled(paper_page):
    go(paper_page, "Table 3")
    rows = paper_page.locator("tbody tr")
    expect(rows).to_have_count(len(paper.COMPARED), timeout=60_000)
    peak = rows.filter(has_text="Peak of the histogram")
    expect(peak).to_contain_text("0.2615")
    for name, text in (("SBR", "0.05"), ("Repetitions", "100")):
        field = paper_page.get_by_role("textbox", name=name, exact=True)
        field.fill(text)
        field.press("Enter")
    paper_page.get_by_role("button", name=re.compile("^Compute")).press("Enter")
    expect(peak).not_to_contain_text("0.2615", timeout=60_000)
    cancel = paper_page.get_by_role("button", name=re.compile("^Cancel"))
    cancel.press("Enter")
    stopped = paper_page.get_by_text(re.compile("^Stopped after .* of 100 repetitions"))
    expect(stopped).to_be_visible(timeout=SOON_MS)
    expect(cancel).to_be_disabled()


@pytest.mark.browser
def test_the_page_is_dark_where_the_app_is(paper_page):
    paper_page.get_by_role("button", name="Toggle theme").click()
    go(paper_page, "Figure 6")
    expect(figure(paper_page, "weight cubic")).to_be_visible(timeout=SOON_MS)
    figures = ("Figure 1", "Figure 2", "Figure 6")
    eventually(lambda: sum(text.startswith(figures) for text in titles(paper_page)) == 3)
    colors = {color for text, color in titles(paper_page).items() if text.startswith(figures)}
    assert colors == {DARK.text}


@pytest.mark.browser
def test_range_images_are_compared_at_a_pixel(paper_page):
    go(paper_page, "Figures 8, 9, 12")
    expect(paper_page.get_by_text("Done: 1 figure.")).to_be_visible(timeout=60_000)
    expect(paper_page.get_by_role("button", name=re.compile("^Cancel"))).to_be_disabled()
    row = paper_page.get_by_role("textbox", name="Row", exact=True)
    row.fill("0")
    row.press("Enter")
    eventually(lambda: "SBR 0.03: no target" in titles(paper_page))
