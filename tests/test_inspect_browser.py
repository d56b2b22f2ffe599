"""The Inspect page in a browser, on the 21 km capture and on the simulated building.

Expected numbers are computed by `core`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from csv import DictReader
from dataclasses import dataclass
from io import StringIO
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

import core
from app.model.state import Illumination
from app.pages.inspect import text
from app.pages.inspect.results import SHARES
from core import Capture, RangeImage, inspection
from core.tests.captures import real_capture_path
from tests.browser import VIEWS, chosen, enter, eventually, fact, field, serving, slider
from tests.browser import image as picture
from tests.test_downloads import columns_of, download
from tests.test_lasting import here as address_of
from tests.test_lasting import rests

pytestmark = pytest.mark.browser

CAPTURE = "21km_K11_night.mat"


@dataclass(frozen=True, eq=False)
class Subject:
    """A capture, and the address at which the app shows it."""

    address: str
    capture: Capture
    image: RangeImage
    name: str
    """The capture's name in files' names."""
    pixel: tuple[int, int]
    """A pixel with a surface, which continues to its right."""


@dataclass(frozen=True, eq=False)
class Inspected(Subject):
    """A subject on a page of its own."""

    page: Page


@pytest.fixture(scope="module")
def at_21_km() -> Iterator[Subject]:
    """The real capture, opened as ``make app CAPTURE=path`` does."""
    path = real_capture_path(CAPTURE)
    capture = core.read_capture(path)
    with serving(path) as address:
        yield Subject(address, capture, ranged(capture), path.stem, (100, 190))


@pytest.fixture(scope="module")
def facade(address: str) -> Subject:
    """The simulated building."""
    scene, illumination = core.scenes["building"](), Illumination()
    acquisition = illumination.acquisition(scene.acquisition)
    capture = core.simulate(scene, acquisition, illumination.flux, seed=illumination.seed)
    address = f"{address}?source=building&page=Inspect"
    return Subject(address, capture, ranged(capture), "building", (30, 20))


def ranged(capture: Capture) -> RangeImage:
    return core.run(capture, "tracking", core.TrackingParameters()).image


BOTH = pytest.mark.parametrize("here", ["at_21_km", "facade"], indirect=True)
"""Run on the real capture as well; other tests use the building only."""


@pytest.fixture
def here(request: pytest.FixtureRequest, page: Callable[..., Page]) -> Inspected:
    """The Inspect page on a capture, just opened."""
    subject = request.getfixturevalue(getattr(request, "param", "facade"))
    shown = page(subject.address)
    expect(button(shown, "Inspect")).to_have_attribute("aria-pressed", "true")
    return Inspected(**vars(subject), page=shown)


# -- parts of the page -----------------------------------------------------------------------------


def button(page: Page, name: str) -> Locator:
    return page.get_by_role("button", name=name, exact=True).filter(visible=True)


def described_button(page: Page, name: str) -> Locator:
    """Return a button whose accessible name begins with its label."""
    named = re.compile(f"^{re.escape(name)}:")
    return page.get_by_role("button", name=named).filter(visible=True)


def within(page: Page, across: float, down: float, figure: int = 0) -> tuple[float, float]:
    """Return the page position of a place in a figure, given in shares of its width and height."""
    box = page.locator(".bk-Figure").filter(visible=True).nth(figure).bounding_box()
    return box["x"] + across * box["width"], box["y"] + down * box["height"]


def in_figure(page: Page, title: str, values: str) -> Any:
    """Evaluate JavaScript with ``figure``, the visible figure whose title begins so."""
    found = page.wait_for_function(
        f"""(title) => {{
          {VIEWS}
          const figure = views.find(({{model, el}}) => model.type === "Figure" &&
            (model.title?.text ?? "").startsWith(title) && el.checkVisibility())?.model;
          const layer = (name) =>
            figure.renderers.find((each) => each.name === name).data_source;
          const plain = (x) =>
            x?.[Symbol.iterator] && typeof x !== "string" ? [...x].map(plain) : x;
          return figure && {{found: plain({values})}};
        }}""",
        arg=title,
    )
    return found.json_value()["found"]


def drawn(page: Page, title: str, layer: str, column: str) -> np.ndarray:
    """Return values of a layer of the visible figure whose title begins so."""
    return np.array(in_figure(page, title, f"layer('{layer}').get_array('{column}')"), float)


def of_picture(page: Page, values: str) -> Any:
    """Evaluate JavaScript with ``found``, the map's model."""
    return page.evaluate(f"""() => {{
      {VIEWS}
      const {{el, frame, model: found}} = views.find(({{model, el}}) =>
        model.type === "Figure" && model.match_aspect && el.checkVisibility());
      return {values};
    }}""")


def place_at(page: Page, across: float, down: float) -> tuple[float, float]:
    """Return row and column at a place of the map, given in shares of its width and height."""
    row, col = (
        f"frame.{axis}_scale.invert({share} * el.getBoundingClientRect().{side})"
        for axis, share, side in (("y", down, "height"), ("x", across, "width"))
    )
    return tuple(of_picture(page, f"[{row}, {col}]"))


COUNTS, RATE, STAGES = "Counts, and the two scales", "Rate", "Residual, and enhanced"


# -- actions of a user -----------------------------------------------------------------------------


def go_to(page: Page, row: int, col: int) -> None:
    """Choose a pixel, and focus the map."""
    enter(page, "Row", str(row))
    enter(page, "Column", str(col))
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col}")
    picture(page).focus()


def choose_map(page: Page, name: str) -> None:
    chosen(page, "Map").click()
    page.get_by_role("menuitem", name=name, exact=True).click()
    expect(page.locator(".MuiMenu-root")).to_have_count(0)  # it takes all clicks until it has faded


TOOLS = {"Rectangle": "BoxSelectTool", "Lasso": "LassoSelectTool", "Zoom": "BoxZoomTool"}
"""What a drag on the map does, and Bokeh's tool that does it."""


def choose_drag(page: Page, mode: str) -> None:
    button(page, mode).click()
    eventually(lambda: of_picture(page, "found.toolbar.active_drag.type") == TOOLS[mode])


def drag(page: Page, mode: str, *places: tuple[float, float]) -> None:
    """Drag on the map from one place to the others, in shares of its width and height."""
    choose_drag(page, mode)
    first, *others = (within(page, *each) for each in places)
    page.mouse.move(*first)
    page.mouse.down()
    for each in others:
        page.mouse.move(*each, steps=5)
        page.evaluate("new Promise(requestAnimationFrame)")  # moves within a frame are joined
    page.mouse.up()
    button(page, "Zoom").click()


def clear_region(page: Page) -> None:
    described_button(page, "Clear region").click()
    expect(button(page, "Pixel")).to_have_attribute("aria-pressed", "true")
    eventually(lambda: not region_in(page))


def region_in(page: Page) -> tuple[tuple[float, float], ...]:
    """Return the corners of the region in the address."""
    found = re.search(r"region=(\[\[.*?\]\])", address_of(page))
    numbers = re.findall(r"[-\d.]+", found[1]) if found else []
    return tuple(zip(map(float, numbers[::2]), map(float, numbers[1::2]), strict=True))


# -- the pixel -------------------------------------------------------------------------------------


@BOTH
def test_everything_about_a_pixel_is_shown(here):
    page, (row, col) = here.page, here.pixel
    expect(button(page, "Inspect")).to_have_attribute("aria-pressed", "true")
    go_to(page, row, col)
    tracking = core.TrackingParameters()
    report = inspection.pixel_report(here.capture, here.image, row, col, "tracking", tracking)
    for name, found in zip(("Signal S", "Background B", "SBR"), report.flux, strict=True):
        expect(fact(page, name)).to_have_text(text.interval(found))
    name, table = download(page, "numbers", "csv")
    assert name == f"{here.name}_tracking_numbers-row{row}-col{col}.csv"
    saved = {row["quantity"]: row for row in DictReader(StringIO(table.decode()))}["SBR"]
    sbr = report.flux.sbr
    ends = [float(saved[end]) for end in ("value", "low", "high")]
    assert ends == pytest.approx([sbr.value, sbr.low, sbr.high])
    shown = fact(page, "Detections")
    expect(shown).to_have_text(re.compile(rf"^{here.capture.counts[row, col]:,}( \(.* %\))?$"))
    verdict = f"Verdict: {report.verdict.health}. {report.verdict.why}"
    expect(page.get_by_text(verdict)).to_be_visible()
    for title in ("Rank", "Bin", "Score", "Probability"):
        expect(page.get_by_role("columnheader", name=title).filter(visible=True)).to_be_visible()
    ranks = page.get_by_role("rowheader").filter(visible=True)
    expect(ranks).to_have_text([str(n + 1) for n in range(len(report.candidates))])
    signals = core.tracking_signals(
        here.capture.cube[row, col], tracking, here.capture.gated_pulses
    )
    for title, layer, column, expected in (
        (COUNTS, "raw", "raw", signals.raw),
        (COUNTS, "raw", "small", signals.small),
        (COUNTS, "raw", "large", signals.large),
        (COUNTS, "candidates", "x", [each.bin for each in report.candidates]),
        (RATE, "rate", "rate", report.rate),
        (STAGES, "residual", "residual", signals.residual),
        (STAGES, "residual", "enhanced", signals.enhanced),
    ):
        seen = drawn(page, title, layer, column)
        np.testing.assert_allclose(seen, expected, rtol=1e-6, err_msg=column)  # as 32-bit floats


def test_keys_taps_and_fields_move_the_pixel(here):
    page, (row, col) = here.page, here.pixel
    go_to(page, row, col)
    page.keyboard.press("ArrowRight")
    page.keyboard.press("Shift+ArrowDown")
    expect(fact(page, "Pixel")).to_have_text(f"{row + 8}, {col + 1}")
    (down, across), tapped = place_at(page, 0.5, 0.4), within(page, 0.5, 0.4)
    page.mouse.click(*tapped)
    expect(fact(page, "Pixel")).to_have_text(f"{down:.0f}, {across:.0f}")
    expect(field(page, "Row")).to_have_value(f"{down:.0f}")  # late, it would replace an entry
    rows, _ = here.capture.shape
    enter(page, "Row", str(rows))
    refused = page.get_by_role("alert").filter(has_text=f"0 to {rows - 1}")
    expect(refused).to_be_visible()
    enter(page, "Row", str(row))
    expect(fact(page, "Pixel")).to_have_text(re.compile(f"^{row}, "))
    expect(refused).to_be_hidden()


def test_a_move_paints_each_plot_once_and_then_writes_the_numbers(here):
    page, (row, col) = here.page, here.pixel
    go_to(page, row, col)
    page.evaluate("""() => {
      const plot = Bokeh.Models.get("Figure").prototype.default_view.prototype;
      const paint = plot._actual_paint;
      window.seen = [];
      plot._actual_paint = function () {
        seen.push(this.model.id);
        paint.call(this);
      };
    }""")
    fact(page, "Pixel").locator("xpath=ancestor::dl").evaluate(
        "l => new MutationObserver(() => seen.push('numbers')).observe(l, { childList: true })"
    )
    page.keyboard.press("ArrowRight")
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col + 1}")
    *painted, last = page.evaluate("seen")
    assert last == "numbers"
    assert len(painted) == len(set(painted)) == 4  # the picture, and three plots


# -- the map ---------------------------------------------------------------------------------------


EACH = 17
"""Only every so many-th pixel of a map is compared, since all take the browser a second."""


@BOTH
def test_every_map_is_shown(here):
    page, capture, image = here.page, here.capture, here.image
    visible = image.valid & (image.confidence >= 0.9)
    expected = {
        "Counts": capture.counts,
        "Confidence": np.where(image.valid, image.confidence, np.nan),
        **{name: find(capture) for name, find in inspection.maps.items()},
        "Estimate": np.where(visible, image.range_m, np.nan),
    }
    if capture.truth_range_m is not None:
        error_m = np.where(visible, image.range_m - capture.truth_range_m, np.nan)
        expected = {"Truth": capture.truth_range_m, "Error": error_m, **expected}
    for name, values in expected.items():
        choose_map(page, name)

        def is_shown(values: np.ndarray = values) -> bool:
            seen = of_picture(
                page,
                "[...found.renderers.find((r) => r.glyph.type === 'Image')"
                f".data_source.get_array('image')[0]].filter((_, at) => at % {EACH} === 0)",
            )
            shown = np.array(seen, float)
            return np.allclose(shown, values.flat[::EACH], rtol=1e-5, atol=1e-6, equal_nan=True)

        eventually(is_shown)
    _, content = download(page, "map", "csv")
    *_, range_m = columns_of(content).values()
    np.testing.assert_allclose(range_m, expected["Estimate"].ravel())


def test_zoom_stays_when_map_and_pixel_change(here):
    page, (row, col) = here.page, here.pixel
    go_to(page, row, col)
    spans = "[found.x_range, found.y_range].flatMap(({start, end}) => [start, end])"
    whole, middle = of_picture(page, spans), within(page, 0.5, 0.4)
    page.mouse.move(*middle)
    page.mouse.wheel(0, -200)
    eventually(lambda: of_picture(page, spans) != whole)
    zoomed = of_picture(page, spans)
    choose_map(page, "Confidence")
    enter(page, "Column", str(col + 7))
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col + 7}")
    np.testing.assert_allclose(of_picture(page, spans), zoomed)
    page.mouse.dblclick(*middle)
    last = here.capture.shape[0] - 0.5

    def shows_all() -> bool:
        left, right, top, bottom = of_picture(page, spans)
        return min(left, bottom, top) <= -0.5 and min(right, max(top, bottom)) >= last

    eventually(shows_all)


def test_what_a_drag_does_is_chosen_in_the_browser(here):
    page = here.page
    page.evaluate("""() => {
      WebSocket.prototype.send = () => {};
    }""")
    for mode in TOOLS:
        choose_drag(page, mode)


# -- regions and pins ------------------------------------------------------------------------------


DRAGS = {
    "Rectangle": [(0.4, 0.3), (0.5, 0.55)],
    "Lasso": [(0.4, 0.4), (0.7, 0.45), (0.5, 0.6), (0.4, 0.4)],
}


@pytest.mark.parametrize("mode", DRAGS)
def test_a_region_is_dragged_outlined_and_its_sum_shown(here, mode):
    page, capture = here.page, here.capture
    dragged = [place_at(page, *each) for each in DRAGS[mode]]
    drag(page, mode, *DRAGS[mode])
    expect(button(page, "Region")).to_have_attribute("aria-pressed", "true")
    rests(page, "region=[")
    region = region_in(page)
    inside = inspection.pixels_in(region, capture.shape)
    assert (len(region) == 4) == (mode == "Rectangle")
    for end in (np.min, np.max):  # a pixel of the screen is up to one of the picture
        np.testing.assert_allclose(end(region, axis=0), end(dragged, axis=0), atol=1)
    expect(fact(page, "Pixels")).to_have_text(f"{inside.sum():,}")
    sum_of_all = capture.cube[inside].sum(axis=0)
    np.testing.assert_array_equal(drawn(page, COUNTS, "raw", "raw"), sum_of_all)
    gated_pulses = capture.gated_pulses and capture.gated_pulses * int(inside.sum())
    signals = core.tracking_signals(sum_of_all, core.TrackingParameters(), gated_pulses)
    residual = drawn(page, STAGES, "residual", "residual")
    np.testing.assert_allclose(residual, signals.residual, rtol=1e-6)
    outline = of_picture(
        page,
        "['ys', 'xs'].map((of) => [...found.renderers.find((r) => r.name === 'region line')"
        ".data_source.get_array(of)[0]])",
    )
    np.testing.assert_allclose(np.transpose(outline), region, atol=0.01)
    name, content = download(page, "counts", "csv")
    rows, cols = np.nonzero(inside)
    place = f"rows{rows.min()}-{rows.max()}_cols{cols.min()}-{cols.max()}"
    assert name == f"{here.name}_{place}_tracking_counts-region.csv"
    np.testing.assert_array_equal(columns_of(content)["counts"][: sum_of_all.size], sum_of_all)
    clear_region(page)


def test_region_and_pins_outlast_a_reload(here):
    page, (row, col) = here.page, here.pixel
    go_to(page, row, col)
    page.keyboard.press("p")
    drag(page, "Lasso", *DRAGS["Lasso"])
    n_pixels = fact(page, "Pixels").inner_text()
    rests(page, "region=[", f"pins=[[{row},{col}]]", "subject=Region")
    page.reload()
    expect(fact(page, "Pixels")).to_have_text(n_pixels)
    button(page, f"Remove {row}, {col}").press("Enter")
    clear_region(page)


def test_four_pixels_are_pinned_compared_and_a_fifth_is_refused(here):
    page, (row, col) = here.page, here.pixel
    go_to(page, row, col)
    pins = [(row, col + n) for n in range(4)]
    names = [f"{row}, {col}" for row, col in pins]
    for name in names:
        page.keyboard.press("p")
        expect(button(page, f"Remove {name}")).to_be_visible()
        page.keyboard.press("ArrowRight")
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col + 4}")
    page.keyboard.press("p")
    expect(page.get_by_text(text.TOO_MANY_PINS)).to_be_visible()
    button(page, "Pins").click()
    headers = page.get_by_role("rowheader").filter(visible=True)
    expect(headers).to_have_text(names)
    np.testing.assert_array_equal(
        drawn(page, "Counts of the pinned", "lines", "ys"), [here.capture.cube[pin] for pin in pins]
    )
    while names:
        button(page, f"Remove {names.pop()}").press("Enter")
        expect(headers).to_have_text(names)
    expect(page.get_by_text(text.NO_PINS)).to_be_visible()


def test_units_change_axes_and_table_and_the_pointer_reads_out_all(here):
    page = here.page
    for unit, title, other in (
        ("ns", "Time (ns)", "Range (m)"),
        ("m", "Range (m)", "Bin"),
        ("bins", "Bin", "Range (m)"),
    ):
        button(page, unit).click()
        header = page.get_by_role("columnheader", name=title).filter(visible=True)
        expect(header).to_be_visible()
        axes = "[...figure.below, ...figure.above].map((each) => each.axis_label)"
        assert in_figure(page, COUNTS, axes) == [title, other]
        for each in (RATE, STAGES):
            assert in_figure(page, each, axes) == [title]
    page.mouse.move(*within(page, 0.5, 0.6, figure=1))
    tip = page.locator(".bk-Tooltip").filter(visible=True)
    expect(tip).to_contain_text("Large scale")
    expect(tip).to_contain_text(re.compile(r"\d ns"))
    expect(tip).to_contain_text(re.compile(r"\d m"))


def test_a_phone_shows_all_parts_below_each_other(page, facade):
    page = page(facade.address, width=390, height=844)
    shown = page.get_by_text("64 × 64 pixels, 334 bins")
    for subject, n_plots in (("Capture", 3), ("Region", 1), ("Pins", 3), ("Pixel", 4)):
        button(page, subject).click()
        plots = page.locator(".bk-Figure").filter(visible=True)
        expect(plots).to_have_count(n_plots)
        bottom = 0.0
        for box in [*(plot.bounding_box() for plot in plots.all()), shown.bounding_box()]:
            assert 0 <= box["x"] < box["x"] + box["width"] <= 390
            assert box["y"] >= bottom
            bottom = box["y"] + box["height"]


# -- the capture as a whole ------------------------------------------------------------------------


@pytest.fixture
def whole(here) -> Inspected:
    """The page with its section on the capture."""
    button(here.page, "Capture").click()
    return here


@BOTH
def test_the_capture_is_reported(whole):
    report = inspection.capture_report(whole.capture)
    for name, found in zip(("Signal (PPP)", "Background", "SBR"), report.flux, strict=True):
        expect(fact(whole.page, name)).to_have_text(text.interval(found))
    shown = whole.page.get_by_text(f"Signal, background and SBR: {report.flux_method}")
    expect(shown).to_be_visible()
    counts = drawn(whole.page, "Counts of all pixels", "raw", "raw")
    np.testing.assert_array_equal(counts, report.histogram)


def test_accuracy_is_studied_and_a_bar_shows_the_progress(whole):
    page = whole.page
    done = page.get_by_text(re.compile("^Done: 8"))
    expect(done).to_be_visible()
    *_, bar = page.get_by_role("progressbar").filter(visible=True).all()
    bar.evaluate("""(bar) => {
      window.seen = [];
      new MutationObserver(() => seen.push(Number(bar.ariaValueNow)))
        .observe(bar, { attributeFilter: ["aria-valuenow"] });
    }""")
    described_button(page, "Compute").click()
    eventually(lambda: page.evaluate("seen.at(-1)") == 100)
    shares = page.evaluate("seen")
    assert shares == sorted(shares)
    assert any(0 < each < 100 for each in shares)
    expect(done).to_be_visible()
    title = "Accuracy against number"
    near, taken = (drawn(page, title, "points", column) for column in ("value", "pulses"))
    expected = inspection.accuracy_over_pulses(
        whole.capture, (SHARES[4], 1.0), "tracking", core.TrackingParameters()
    )
    np.testing.assert_allclose(near[[4, 7]], [each.within.value for each in expected])
    np.testing.assert_allclose(taken, np.multiply(SHARES, whole.capture.acquisition.n_pulses or 1))


@BOTH
def test_fewer_pulses_are_taken_live(whole):
    page, slide = whole.page, slider(whole.page, "Pulses used (of all)").filter(visible=True)
    for _ in range(3):
        slide.press("PageDown")
    share = float(slide.get_attribute("aria-valuetext").split()[0])
    assert 0.001 < share < 0.9
    fewer = core.reductions.share_of_pulses(whole.capture, share)
    expect(fact(page, "Detections")).to_have_text(f"{fewer.counts.mean():.4g}")
    counts = inspection.capture_report(fewer).histogram
    eventually(lambda: np.array_equal(drawn(page, "Counts of all pixels", "raw", "raw"), counts))


def test_suggestions_are_shown_with_reasons_and_applied(whole):
    page, suggested = whole.page, inspection.capture_report(whole.capture).suggestion
    first, end = suggested.gate
    for shown in (
        f"Suggested gate, in bins: {first} to {end}. {suggested.why_gate}",
        f"Suggested T_n: {suggested.t_n}. {suggested.why_t_n}",
    ):
        expect(page.get_by_text(shown)).to_be_visible()
    apply_t_n, apply_gate = (
        described_button(page, f"Apply {name}") for name in ("T_n", "the gate")
    )
    t_n = slider(page, "T_n (bins)")
    for _ in range(2):  # one of them is not the one that is suggested
        t_n.press("PageUp")
    apply_t_n.click()
    expect(t_n).to_have_attribute("aria-valuetext", f"{suggested.t_n} bins")
    expect(apply_t_n).to_be_disabled()
    apply_gate.click()
    rows, cols = whole.capture.shape
    expect(page.get_by_text(f"{rows} × {cols} pixels, {end - first} bins")).to_be_visible()
    within_gate = core.reductions.cut_gate(whole.capture, first, end)
    expect(fact(page, "Detections")).to_have_text(f"{within_gate.counts.mean():.4g}")
