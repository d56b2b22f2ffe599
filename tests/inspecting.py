"""The Inspect page in a browser.

Expected numbers are computed by `core`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from playwright.sync_api import Locator, Page, expect

import core
from app.model.state import Illumination
from app.pages.inspect import text
from app.pages.shared.measure import TOO_MANY_PINS
from app.plots.elements import READ_OUT as VALUE_READ_OUT
from core import Capture, RangeImage, inspection
from core.inference import predictive_of
from tests.browser import TITLES_FIT, VIEWS, choose, enter, eventually, fact, field, slider
from tests.browser import image as picture
from tests.test_downloads import columns_of, download
from tests.test_lasting import here as address_of
from tests.test_lasting import rests


@dataclass(frozen=True, eq=False)
class Subject:
    """A capture, and what is expected of it."""

    capture: Capture
    image: RangeImage
    pixel: tuple[int, int]
    """A pixel with a surface, which continues to its right."""

    @property
    def visible_m(self) -> np.ndarray:
        """Ranges with enough confidence to be shown."""
        confident = self.image.valid & (self.image.confidence >= 0.9)
        return np.where(confident, self.image.range_m, np.nan)


def ranged(capture: Capture) -> RangeImage:
    return core.run(capture, "tracking", core.TrackingParameters()).image


@cache
def simulated_building() -> Subject:
    scene, illumination = core.scenes["building"](), Illumination()
    acquisition = illumination.acquisition(scene.acquisition)
    capture = core.simulate(scene, acquisition, illumination.flux, seed=illumination.seed)
    return Subject(capture, ranged(capture), (30, 20))


REGION_AND_PINS = "subject=Region&region=[[20,20],[20,40],[40,40],[40,20]]&pins=[[30,20],[30,21]]"
LINK = f"&source=building&pixel=[30,20]&{REGION_AND_PINS}"
"""Part of the address with which the page is opened."""


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


COUNTS, RATE, STAGES = "Counts, and the two scales", "Rate", "Enhanced"


# -- actions of a user -----------------------------------------------------------------------------


TOOLS = {
    "Rectangle": "BoxSelectTool",
    "Lasso": "LassoSelectTool",
    "Line": "FreehandDrawTool",
    "Zoom": "BoxZoomTool",
}
"""Actions of a drag on the map, and the tools of Bokeh that perform them."""


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


# -- everything is as core computes it -------------------------------------------------------------


def expect_pixel(page: Page, subject: Subject) -> None:
    """Expect all about a pixel: numbers, on screen and saved, candidates and curves."""
    row, col = subject.pixel
    enter(page, "Row", str(row))
    enter(page, "Column", str(col))
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col}")
    capture, tracking = subject.capture, core.TrackingParameters()
    report = inspection.pixel_report(capture, subject.image, row, col, "tracking", tracking)
    for name, found in zip(("Signal S", "Background B", "SBR"), report.flux, strict=True):
        expect(fact(page, name)).to_have_text(text.interval(found))
    counts = re.compile(rf"^{capture.counts[row, col]:,}( \(.* %\))?$")
    expect(fact(page, "Detections")).to_have_text(counts)
    verdict = f"Verdict: {report.verdict.health}. {report.verdict.why}"
    expect(page.get_by_text(verdict)).to_be_visible()
    for title in ("Rank", "Bin", "Score", "Probability"):
        expect(page.get_by_role("columnheader", name=title).filter(visible=True)).to_be_visible()
    ranks = page.get_by_role("rowheader").filter(visible=True)
    expect(ranks).to_have_text([str(n + 1) for n in range(len(report.candidates))])
    signals = core.tracking_signals(capture.cube[row, col], tracking, capture.gated_pulses)
    for title, layer, column, expected in (
        (COUNTS, "raw", "raw", signals.raw),
        (COUNTS, "raw", "small", signals.small),
        (COUNTS, "raw", "large", signals.large),
        (COUNTS, "candidates", "x", [each.bin for each in report.candidates]),
        (STAGES, "residual", "residual", signals.residual),
        (STAGES, "residual", "enhanced", signals.enhanced),
    ):
        seen = drawn(page, title, layer, column)
        np.testing.assert_allclose(seen, expected, rtol=1e-6, err_msg=column)  # as 32-bit floats
    button(page, "Rate").click()
    np.testing.assert_allclose(drawn(page, RATE, "rate", "rate"), report.rate, rtol=1e-6)
    button(page, "Fit").click()
    expect(
        page.get_by_text("Goodness of fit of the pixel: p-value").filter(visible=True)
    ).to_be_visible()
    fit = predictive_of(capture, np.array([row * capture.shape[1] + col]))
    for column, expected in (("deviation", fit.residual), ("fit", fit.expected)):
        seen = drawn(page, "Residuals", "deviation", column)
        np.testing.assert_allclose(seen, expected, rtol=1e-5, atol=1e-6, err_msg=column)
    button(page, "Score").click()


EACH = 17
"""Only every so many-th pixel of a map is compared, since all take the browser a second."""


def is_mapped(page: Page, values: np.ndarray) -> bool:
    """Return whether the map shows these values of pixels."""
    seen = of_picture(
        page,
        "[...found.renderers.find((r) => r.glyph.type === 'Image')"
        f".data_source.get_array('image')[0]].filter((_, at) => at % {EACH} === 0)",
    )
    shown, expected = np.array(seen, float), values.flat[::EACH]
    return shown.shape == expected.shape and np.allclose(
        shown, expected, rtol=1e-5, atol=1e-6, equal_nan=True
    )


def expect_a_steady_frame(page: Page) -> None:
    """Expect that the image keeps its size when its legend needs five lines."""
    legend = page.get_by_text(re.compile("^Blank:")).filter(visible=True)
    frame = picture(page).bounding_box()
    legend.evaluate("each => { each.style.minHeight = '5lh' }")
    assert legend.bounding_box()["height"] > 80
    assert picture(page).bounding_box() == frame
    legend.evaluate("each => { each.style.minHeight = '' }")


READ_OUT = """(values) => {
  const Hover = Bokeh.Models.get("CustomJSHover");
  const source = { data: { image: [values] }, tags: ["m"] };
  const hover = new Hover({ args: { source }, code: CODE });
  return values.map((_, k) => hover.format(0, "value", { image_index: { flat_index: k } }));
}"""
"""Texts under the pointer for some values of a map."""


def expect_maps(page: Page, subject: Subject) -> None:
    """Expect maps of each kind, and that of the estimate saved."""
    capture, image = subject.capture, subject.image
    expected = {
        "Error": subject.visible_m - capture.truth_range_m,
        "Confidence": np.where(image.valid, image.confidence, np.nan),
        "SBR": inspection.maps["SBR"](capture),
        "Goodness of fit": inspection.maps["Goodness of fit"](capture),
        "Estimate": subject.visible_m,
    }
    read = page.evaluate(READ_OUT.replace("CODE", repr(VALUE_READ_OUT)), [12.345678, 3.2e-10, None])
    assert read == ["12.346 m", "3.2 × 10^-10 m", "none shown"]
    expect_a_steady_frame(page)
    for name, values in expected.items():
        choose(page, "Map", name)
        eventually(lambda values=values: is_mapped(page, values))
    _, content = download(page, "map", "csv")
    _, _, range_m, *_ = columns_of(content).values()
    half_step_m = capture.acquisition.bin_length_m / 20  # largest rounding of a range in CSV
    np.testing.assert_allclose(range_m, expected["Estimate"].ravel(), atol=half_step_m)


def expect_report(page: Page, capture: Capture) -> None:
    """Expect the capture's flux, how it was found, and the sum of all histograms."""
    report = inspection.capture_report(capture)
    names = "PPP, all pixels", "Background", "SBR, all pixels"
    for name, found in zip(names, report.flux, strict=True):
        expect(fact(page, name)).to_have_text(text.interval(found))
    method = f"Signal, background and SBR: {report.flux_method}"
    expect(page.get_by_text(method)).to_be_visible()
    counts = drawn(page, "Counts of all pixels", "raw", "raw")
    np.testing.assert_array_equal(counts, report.histogram)


def expect_fewer_pulses(page: Page, capture: Capture) -> None:
    """Reduce the pulses by the slider, and expect the sum of the histograms that are left."""
    slide = slider(page, "Pulses used (of all)").filter(visible=True)
    for _ in range(3):
        slide.press("PageDown")
    share = float(slide.get_attribute("aria-valuetext").split()[0])
    assert 0.001 < share < 0.9
    fewer = core.reductions.share_of_pulses(capture, share)
    expect(fact(page, "Detections")).to_have_text(f"{fewer.counts.mean():.4g}")
    counts = inspection.capture_report(fewer).histogram
    eventually(lambda: np.array_equal(drawn(page, "Counts of all pixels", "raw", "raw"), counts))


# -- the pixel -------------------------------------------------------------------------------------


def note_paints(page: Page) -> None:
    """Note in ``seen`` which plots are painted and when the numbers are written."""
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


def move_the_pixel(page: Page, facade: Subject) -> None:
    """Move the pixel by keys, taps and fields; the zoom stays."""
    row, col = facade.pixel
    eventually(lambda: is_mapped(page, facade.visible_m))  # else its paint would count
    picture(page).press("Shift+ArrowDown")
    expect(fact(page, "Pixel")).to_have_text(f"{row + 8}, {col}")
    note_paints(page)
    page.keyboard.press("ArrowRight")
    expect(fact(page, "Pixel")).to_have_text(f"{row + 8}, {col + 1}")
    *painted, last = page.evaluate("seen")
    assert last == "numbers"
    assert len(painted) == len(set(painted)) == 3  # the picture, and two plots
    (down, across), middle = place_at(page, 0.5, 0.4), within(page, 0.5, 0.4)
    page.mouse.click(*middle)
    expect(fact(page, "Pixel")).to_have_text(f"{down:.0f}, {across:.0f}")
    expect(field(page, "Row")).to_have_value(f"{down:.0f}")  # late, it would replace an entry
    rows, _ = facade.capture.shape
    enter(page, "Row", str(rows))
    refused = page.get_by_role("alert").filter(has_text=f"0 to {rows - 1}")
    expect(refused).to_be_visible()
    enter(page, "Row", str(row))
    expect(fact(page, "Pixel")).to_have_text(re.compile(f"^{row}, "))
    expect(refused).to_be_hidden()

    spans = "[found.x_range, found.y_range].flatMap(({start, end}) => [start, end])"
    whole = of_picture(page, spans)
    page.mouse.wheel(0, -200)
    eventually(lambda: of_picture(page, spans) != whole)
    zoomed = of_picture(page, spans)
    choose(page, "Map", "Confidence")
    enter(page, "Column", str(col + 7))
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col + 7}")
    np.testing.assert_allclose(of_picture(page, spans), zoomed)
    page.mouse.dblclick(*middle)

    def shows_all() -> bool:
        left, right, top, bottom = of_picture(page, spans)
        return min(left, bottom, top) <= -0.5 and min(right, max(top, bottom)) >= rows - 0.5

    eventually(shows_all)


# -- regions and pins ------------------------------------------------------------------------------


DRAGS = {
    "Rectangle": [(0.4, 0.3), (0.5, 0.55)],
    "Lasso": [(0.4, 0.4), (0.7, 0.45), (0.5, 0.6), (0.4, 0.4)],
}


def expect_sum_of_dragged(page: Page, subject: Subject, mode: str) -> None:
    """Drag a region in place of the present one; expect its outline and its summed histogram."""
    before, capture = region_in(page), subject.capture
    dragged = [place_at(page, *each) for each in DRAGS[mode]]
    drag(page, mode, *DRAGS[mode])
    expect(button(page, "Region")).to_have_attribute("aria-pressed", "true")
    eventually(lambda: region_in(page) not in ((), before))
    region = region_in(page)
    inside = inspection.pixels_in(region, capture.shape)
    assert (len(region) == 4) == (mode == "Rectangle")
    for end in (np.min, np.max):  # a pixel of the screen is up to one of the picture
        np.testing.assert_allclose(end(region, axis=0), end(dragged, axis=0), atol=1)
    sum_of_all = capture.cube[inside].sum(axis=0)
    eventually(lambda: np.array_equal(drawn(page, COUNTS, "raw", "raw"), sum_of_all))
    expect(fact(page, "Pixels")).to_have_text(f"{inside.sum():,}")
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


def drag_regions_and_a_line(page: Page, facade: Subject) -> None:
    """Drag on the map."""
    for mode in DRAGS:
        expect_sum_of_dragged(page, facade, mode)
    clear_region(page)
    ends = (0.2, 0.3), (0.8, 0.6)
    names = [", ".join(str(round(at)) for at in place_at(page, *end)) for end in ends]
    drag(page, "Line", *ends)
    expect(page.get_by_text(f"pixels from {names[0]} to {names[1]}, ")).to_be_visible()


def drag_without_the_server(page: Page) -> None:
    page.evaluate("() => { WebSocket.prototype.send = () => {}; }")
    for mode in TOOLS:
        choose_drag(page, mode)


def pin_pixels(page: Page, facade: Subject) -> None:
    """Pin pixels and compare them."""
    row, col = facade.pixel
    picture(page).focus()
    pins = [(row, col + n) for n in range(4)]
    names = [f"{row}, {col}" for row, col in pins]
    for name in names:
        page.keyboard.press("p")
        expect(button(page, f"Remove {name}")).to_be_visible()
        page.keyboard.press("ArrowRight")
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col + 4}")
    page.keyboard.press("p")
    expect(page.get_by_text(TOO_MANY_PINS)).to_be_visible()
    button(page, "Pins").click()
    headers = page.get_by_role("rowheader").filter(visible=True)
    expect(headers).to_have_text(names)
    counts = drawn(page, "Counts of the pinned", "lines", "ys")
    np.testing.assert_array_equal(counts, [facade.capture.cube[pin] for pin in pins])
    listed = ",".join(f"[{row},{col}]" for row, col in pins)
    rests(page, f"pins=[{listed}]", "subject=Pins")
    button(page, "Profile").click()
    expect(page.get_by_text(f"4 pixels from {names[0]} to {names[-1]}")).to_be_visible()
    of_pixels = ("Range along the line", "points")
    assert drawn(page, *of_pixels, "col").tolist() == [col for _, col in pins]
    np.testing.assert_array_equal(
        drawn(page, *of_pixels, "range"), [facade.visible_m[pin] for pin in pins]
    )
    button(page, "Pins").click()
    while names:
        button(page, f"Remove {names.pop()}").press("Enter")
        expect(headers).to_have_text(names)
    expect(page.get_by_text(text.NO_PINS)).to_be_visible()

    button(page, "Pixel").click()
    page.mouse.move(*within(page, 0.5, 0.6, figure=1))
    tip = page.locator(".bk-Tooltip").filter(visible=True)
    for each in ("Large scale", re.compile(r"\d ns"), re.compile(r"\d m")):
        expect(tip).to_contain_text(each)
    page.mouse.move(0, 0)
    expect(tip).to_have_count(0)
    expect(field(page, "Column")).to_have_value(str(col + 4))  # late, it would replace an entry
    enter(page, "Column", str(col))
    expect(fact(page, "Pixel")).to_have_text(f"{row}, {col}")


def show_all_parts_below_each_other(page: Page) -> None:
    """Show the region and the pins of a link on a phone, and remove them."""
    expect(fact(page, "Pixels")).to_have_text("441")
    expect(page.get_by_text("Computing")).to_have_count(0)

    def are_below_each_other(n_plots: int) -> bool:
        plots = page.locator(".bk-Figure").filter(visible=True)
        size = page.get_by_text("64 × 64 pixels, 334 bins")
        boxes = plots.or_(size).evaluate_all("all => all.map((e) => e.getBoundingClientRect())")
        return (
            len(boxes) == n_plots + 1
            and all(0 <= box["left"] < box["right"] <= 390 for box in boxes)
            and all(box["bottom"] <= below["top"] for box, below in pairwise(boxes))
            and page.evaluate(TITLES_FIT)
        )

    for subject, n_plots in (
        ("Region", 3),
        ("Capture", 3),
        ("Pixel", 3),
        ("Pins", 3),
        ("Profile", 2),
    ):
        button(page, subject).click()
        eventually(lambda n_plots=n_plots: are_below_each_other(n_plots))
    button(page, "Pins").click()
    expect(page.get_by_role("rowheader").filter(visible=True)).to_have_text(["30, 20", "30, 21"])
    button(page, "Remove 30, 20").press("Enter")
    button(page, "Region").click()
    clear_region(page)
    rests(page, "pins=[[30,21]]")
    button(page, "Pins").click()
    button(page, "Remove 30, 21").press("Enter")
    button(page, "Pixel").click()


# -- all of it ------------------------------------------------------------------------------------


def inspect_the_building(page: Page) -> None:
    """Show what the link `LINK` names, choose others, and read the report of the building."""
    building = simulated_building()
    expect(button(page, "Inspect")).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Close drawer").click()  # it would cover the page of a phone
    sidebar = page.get_by_role("button", name="Open drawer")
    expect(sidebar).to_be_visible()
    page.set_viewport_size({"width": 390, "height": 844})
    show_all_parts_below_each_other(page)
    page.set_viewport_size({"width": 1440, "height": 900})
    sidebar.click()  # it stays closed in a wider window
    expect_pixel(page, building)
    expect_maps(page, building)
    pin_pixels(page, building)
    move_the_pixel(page, building)
    drag_regions_and_a_line(page, building)
    button(page, "Capture").click()
    expect_report(page, building.capture)
    expect_fewer_pulses(page, building.capture)
    drag_without_the_server(page)
