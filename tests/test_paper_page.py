"""The Paper page: what its sliders, tables and pictures show, without a browser and in one."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from bokeh.models import Range1d
from playwright.sync_api import Locator, Page, expect

from app.model.store import built_in_sources
from app.pages.layout import Layout
from app.pages.paper import page as page_of_paper
from app.pages.paper import text
from app.pages.paper.page import (
    RangeImages,
    RepeatedAt,
    RepeatedTable,
    Scales,
    joined,
    plan_3,
    two_scales,
)
from app.pages.session import Session
from app.pages.shared.outputs import CurveCard, Gallery, curves_of, table_of
from app.plots import elements as plots
from app.theme import DARK, LIGHT
from core import PRESETS, Flux
from core.metrics import Interval
from core.studies import outputs
from core.studies.paper import figures as paper
from core.studies.trials import Condition, trials
from tests.browser import enter, eventually, slider
from tests.test_downloads import download
from tests.threads import HeldTasks

# -- plots, pictures, tables -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "make", [paper.figure_1, paper.figure_2, paper.residual_by_place, paper.weights]
)
def test_a_figure_holds_every_curve_of_its_study(make):
    item = make()
    figure = plots.curves(item, LIGHT)
    shown = {each.name: each.data_source.data["y"] for each in figure.renderers}
    assert list(shown) == [*item.curves, *item.marks]
    for name, values in item.curves.items():
        np.testing.assert_array_equal(shown[name], values)
    assert [entry.label.value for entry in figure.legend[0].items] == list(shown)
    labels = figure.title.text, figure.xaxis[0].axis_label, figure.yaxis[0].axis_label
    assert labels == (item.title, item.x_label, item.y_label)


def test_a_method_has_one_style_in_all_plots():
    def plot(*names):
        return outputs.Plot("", "", "", "", np.zeros(1), dict.fromkeys(names, np.zeros(1)))

    names = [method.name for method in paper.COMPARED]
    styles = plots.curve_styles(plot(*names), LIGHT)
    assert plots.curve_styles(plot("likelihood"), LIGHT) == {"likelihood": styles["likelihood"]}
    assert len({(color, tuple(dash)) for color, dash in styles.values()}) == len(names)


def renderer(card, name):
    (found,) = (each for each in card.figure.renderers if each.name == name)
    return found


def test_new_curves_change_values_and_nothing_else():
    card = CurveCard(Range1d(0, 100))
    card.show(two_scales(Scales(onset_bin=30))[0])
    figure, before = card.figure, set(card.figure.references())
    moved = two_scales(Scales(onset_bin=60))[0]
    card.show(moved)
    assert card.figure is figure
    assert set(figure.references()) == before
    drawn = renderer(card, "residual").data_source.data["y"]
    np.testing.assert_allclose(drawn, moved.curves["residual"], rtol=1e-6)
    assert set(renderer(card, "echo's onset").data_source.data["x"]) == {60.0}
    assert figure.title.text == moved.title
    assert figure.y_range.end > max(curve.max() for curve in moved.curves.values())


def test_curves_of_a_study_are_stated_with_bands_and_marks_as_they_are():
    x, y = np.array([0.1, 0.2]), np.array([1 / 3, 2 / 3])
    bands = {"log_peak": (y - 0.1, y + 0.1)}
    item = outputs.Plot("", "", "SBR", "Share", x, {"log_peak": y}, {"truth": 1 / 7}, bands=bands)
    low, high, curve, mark = curves_of(item)
    assert low.heading == "log peak, lowest (Share)"
    assert high.heading == "log peak, highest (Share)"
    assert (curve.heading, mark.heading, mark.x) == ("log peak (Share)", "truth", 1 / 7)
    for each, values in ((low, y - 0.1), (high, y + 0.1), (curve, y)):
        np.testing.assert_array_equal(each.y, values)
    layers = {each.name for each in plots.curves(item, LIGHT).renderers}
    assert {each.layer for each in (low, high, curve, mark)} == layers


@pytest.mark.parametrize("is_painted_first", [True, False])
def test_curves_have_the_colours_of_the_mode(is_painted_first):
    card = CurveCard(Range1d(0, 100))
    acts = [lambda: card.paint(DARK), lambda: card.show(two_scales(Scales())[0])]
    for act in acts if is_painted_first else reversed(acts):
        act()
    assert renderer(card, "small scale").glyph.line_color == DARK.small
    assert card.figure.title.text_color == DARK.text


@pytest.fixture
def pictures():
    images = {name: np.arange(6.0).reshape(2, 3) + k for k, name in enumerate(("truth", "a_b"))}
    images["truth"][0, 0] = np.nan
    return outputs.Pictures("key", "Title", "Range (m)", images, 0.0, 6.0, "Note.")


def test_pictures_share_scale_and_view_and_compare_a_pixel(pictures):
    gallery = Gallery()
    gallery.show(pictures)
    assert "**Title**" in [getattr(each, "object", None) for each in gallery.layout]
    one, other = gallery.figures
    assert one.x_range is other.x_range
    assert one.y_range is other.y_range
    assert len({each.renderers[0].glyph.color_mapper for each in (one, other)}) == 1
    assert "* 1.5 " in one.stylesheets[0]  # the frame has the proportions of 2 × 3 pixels
    row, column = gallery.place
    assert (row.high, column.high) == (1, 2)
    row.value, column.value = 0, 2
    assert [each.title.text for each in (one, other)] == ["truth: 2 m", "a b: 3 m"]
    column.value = 0
    assert one.title.text == "truth: no target"

    images = {"truth": pictures.images["truth"], "c": pictures.images["a_b"] + 1}
    gallery.show(replace(pictures, images=images))
    assert gallery.figures == [one, other]  # other values on the same scale build nothing
    assert other.title.text == "c: 2 m"


def test_a_table_shows_intervals_and_the_meaning_of_differences():
    columns = ("kind", "method", "RD, 3 bins", "printed RD", "difference", "ms")
    rows = (
        ("as defined", "peak", Interval(0.30, 0.28, 0.32), 0.26, 0.04, ""),
        ("reconstruction", "kde", Interval(0.20, 0.18, 0.22), 0.21, -0.01, ""),
        ("as defined", "tracking", Interval(0.90, 0.88, 0.92), 0.98, -0.08, ""),
        ("as defined", "oracle", Interval(0.99, 0.98, 1.0), "", "", ""),
    )
    shown, lines = table_of(outputs.Table("", "", columns, rows))
    titles = ["method", "RD, 3 bins", "printed RD", "difference"]  # not those without a value
    assert [column[0] for column in shown] == titles
    assert [line["note"] for line in lines] == ["", text.RECONSTRUCTION, "", ""]
    assert lines[0]["name"] == "Peak of the histogram"
    assert lines[0]["cells"][0] == ["0.3000", 0.30, "0.2800 to 0.3200"]
    meanings = [line["cells"][2][2] for line in lines]
    assert (meanings[0], meanings[2], meanings[3]) == ("better", "worse", "")
    assert "chance" in meanings[1]
    assert [line["cells"][2][1] for line in lines] == [0.04, -0.01, -0.08, None]


def test_a_smaller_error_is_the_better_one():
    columns = ("method", "RMSE m", "printed RMSE m", "difference")
    rows = (
        ("peak", Interval(6.0, 5.0, 7.0), 9.7, -3.7),
        ("chi", Interval(7.0, 6.5, 7.5), 1.0, 6.0),
    )
    _, lines = table_of(outputs.Table("", "", columns, rows))
    assert [line["cells"][2][2] for line in lines] == ["better", "worse"]


def test_parts_of_a_plot_are_joined_as_they_come():
    x = [1.0, 2.0, 3.0]
    parts = [
        outputs.Plot("", "", "", "", np.array([at]), {"curve": np.array([10 * at])}) for at in x[:2]
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
        return {row[1]: row[3] for row in rows if row[3] != ""}

    of_own = {"tracking": 0.9282, "tracking, literal": 0.9282}
    assert printed(0.06)["peak"] == 0.2615
    assert printed(0.05) == of_own
    assert printed(0.055) == {}


def test_a_place_alone_gives_what_it_gives_among_others():
    two = paper.by_place(size=4, onset=(42.5, 72.5))
    one = paper.by_place(size=4, onset=(72.5,))
    for name, values in two.curves.items():
        assert values[1] == one.curves[name][0]


def test_a_pixel_and_the_residual_agree_on_preset_flux_and_bin():
    pixel, curve = two_scales(Scales(onset_bin=77, sbr=0.05, preset="literal"))
    expected = paper.pixel_signals(77, PRESETS["literal"], Flux(sbr=0.05))
    np.testing.assert_array_equal(pixel.curves["residual"], expected.curves["residual"])
    assert curve.marks == {"the echo above": 77.0}
    assert "0.05" in curve.title


# -- the page without a browser --------------------------------------------------------------------


@pytest.fixture
def session():
    return Session(built_in_sources(), tasks=HeldTasks())


def test_nothing_is_computed_before_the_first_visit(monkeypatch):
    built = []
    monkeypatch.setattr(page_of_paper, "LiveFigures", lambda *_, **__: built.append(1))
    Layout(built_in_sources())
    assert built == []


def test_the_open_section_is_part_of_the_state(session):
    session.state.reported = "The weights"
    choice = page_of_paper.Paper(session).view.main[0][0]
    assert choice.value == "The weights"
    choice.value = "Figure 4: two scales"
    assert session.state.reported == "Figure 4: two scales"


def test_the_sidebar_is_closed_here_and_opens_again_unless_the_window_is_narrow():
    layout = Layout(built_in_sources())
    for is_narrow in (False, True):
        layout.page.is_narrow = is_narrow
        layout.pages.choice.value = "Paper"
        assert not layout.page.sidebar_open
        layout.pages.choice.value = "Explore"
        assert layout.page.sidebar_open != is_narrow


@pytest.fixture
def table(session, monkeypatch):
    """Table 3 of two methods, since the others take long."""
    methods = [method for method in paper.COMPARED if method.estimator in ("peak", "tracking")]
    monkeypatch.setattr(paper, "COMPARED", methods)
    settings = RepeatedAt(sbr=0.05, repetitions=3)
    return RepeatedTable(
        session, settings, "", plan_3, lambda results, chosen: paper.table_3(results, chosen.sbr)
    )


def test_a_table_over_repetitions_is_what_core_computes(table, session):
    def title():
        return table.view.main[0].object

    assert title() == text.NEEDS_TWO
    table.show(True)
    session.tasks.run_until(lambda: "3 repetitions" in title())
    results = trials(plan_3(table.settings), range(3))
    expected = paper.table_3(results, 0.05)
    last = expected.columns.index("ms")
    for row, other in zip(table.shown.rows, expected.rows, strict=True):
        assert row[:last] == other[:last]


def test_a_table_is_not_refined_while_it_is_hidden(table, session):
    table.show(True)
    session.tasks.run_until(lambda: table.shown)
    table.show(False)
    before = table.shown
    session.tasks.waiting.put(lambda: None)
    session.tasks.run_until(session.tasks.waiting.empty)
    assert table.shown is before
    table.show(True)
    session.tasks.run_until(lambda: table.shown is not before)


def test_range_images_come_on_the_first_visit(session):
    section = RangeImages(session)
    section.show(True)
    session.tasks.run_until(lambda: section.gallery.figures)
    titles = [each.title.text.split(":")[0] for each in section.gallery.figures]
    assert titles == ["truth", *(f"SBR {sbr:g}" for sbr in paper.NEAR)]


# -- in a browser ----------------------------------------------------------------------------------


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


def move_the_slider_of_figure_4(here: Page) -> None:
    go(here, "Figure 4")
    pixel, curve = figure(here, "small scale"), figure(here, "the echo above")
    for each in (pixel, curve):
        expect(each).to_be_visible()
    assert "Both scales, echo at bin 50, SBR 0.08" in titles(here)
    before = pixel.screenshot(), curve.screenshot()
    slider(here, "Bin of the echo").focus()
    for _ in range(5):
        here.keyboard.press("ArrowRight")
    eventually(lambda: "Both scales, echo at bin 55, SBR 0.08" in titles(here))
    eventually(lambda: pixel.screenshot() != before[0] and curve.screenshot() != before[1])


def change_to_dark(here: Page) -> None:
    """Expect dark plots, those that are built later, too."""
    here.get_by_role("button", name="Toggle theme").click()
    go(here, "The weights")
    expect(figure(here, "weight cubic")).to_be_visible()
    figures = ("Figure 1", "Figure 2", "The weight")
    eventually(lambda: sum(text.startswith(figures) for text in titles(here)) == 3)
    colors = {color for text, color in titles(here).items() if text.startswith(figures)}
    assert colors == {DARK.text}


def cancel_table_3_at_another_sbr(here: Page) -> None:
    go(here, "Table 3")
    rows = here.locator("tbody tr").filter(visible=True)
    expect(rows).to_have_count(len(paper.COMPARED))
    peak = rows.filter(has_text="Peak of the histogram")
    expect(peak).to_contain_text("0.2615")
    for name, typed in (("SBR", "0.05"), ("Repetitions", "100")):
        enter(here, name, typed)
    here.get_by_role("button", name=re.compile("^Compute")).press("Enter")
    expect(peak).not_to_contain_text("0.2615")
    cancel = here.get_by_role("button", name=re.compile("^Cancel"))
    cancel.press("Enter")
    stopped = here.get_by_text(re.compile("^Stopped after .* of 100 repetitions"))
    expect(stopped).to_be_visible()
    expect(cancel).to_be_disabled()


def expect_limits_below_each_other(here: Page) -> None:
    go(here, "What the paper does not report")
    limit, *others = (here.locator("table").filter(has_text=x) for x in ("Cramér-Rao", "statement"))
    chart = figure(here, "limit: probability")
    for above, below in pairwise((chart, limit, *others)):
        eventually(lambda above=above, below=below: bottom(above) < below.bounding_box()["y"])


def compare_pictures_at_a_pixel(here: Page) -> None:
    go(here, "Figures 8, 9, 11, 12")
    note = here.get_by_text(text.OUTSIDE_NOTE)
    expect(note).to_be_visible()
    drawn = here.locator(".bk-Figure:visible")
    eventually(lambda: drawn.count() == len(paper.NEAR) + 2)  # truth and scale, too
    *pictures, scale = sorted(drawn.all(), key=lambda each: each.bounding_box()["y"])
    for each in pictures:
        assert bottom(each) <= scale.bounding_box()["y"]
    assert bottom(scale) <= note.bounding_box()["y"]
    expect(here.get_by_text("Done: 1 figure.")).to_be_visible()
    expect(here.get_by_role("button", name=re.compile("^Cancel"))).to_be_disabled()
    enter(here, "Row", "0")
    eventually(lambda: "SBR 0.03: no target" in titles(here))


def expect_a_phone_to_show_figure_and_sliders(here: Page) -> None:
    """Expect the sidebar to stay closed on the next page, too."""
    here.set_viewport_size({"width": 390, "height": 844})
    go(here, "Figures 1, 2")
    above, below = slider(here, "SBR"), figure(here, "background alone")
    expect(below).to_be_visible()
    eventually(lambda: bottom(above) <= below.bounding_box()["y"])
    here.get_by_role("button", name="Explore", exact=True).click()
    expect(here.get_by_text(re.compile("^car, simulated, seed 0"))).to_be_visible()
    here.wait_for_function("Bokeh.documents[0].is_idle")
    expect(here.get_by_role("button", name="Open drawer")).to_be_visible()
    expect(slider(here, "SBR")).not_to_be_in_viewport()


def read_part_by_part(here: Page) -> None:
    expect(figure(here, "background alone")).to_be_visible()
    assert download(here, "curves", "csv")[0] == "paper_figure_1.csv"
    move_the_slider_of_figure_4(here)
    change_to_dark(here)
    cancel_table_3_at_another_sbr(here)
    go(here, "Figures 8, 9, 11, 12")  # left before it is done
    expect_limits_below_each_other(here)
    compare_pictures_at_a_pixel(here)
    expect_a_phone_to_show_figure_and_sliders(here)
