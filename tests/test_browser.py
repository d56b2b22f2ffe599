"""The app in a real browser: what a user does and sees."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from functools import cache
from io import BytesIO
from itertools import cycle

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import core
from app.model.mesh import point_cloud
from app.model.state import Illumination
from app.model.store import built_in_sources
from app.theme import DARK, LIGHT, RANGE_COLORS, WRONG_COLOR
from core import PRESETS, TrackingParameters
from core.io.readers.npz import FORMAT
from tests.browser import (
    choose,
    chosen,
    enter,
    eventually,
    fact,
    field,
    image,
    look,
    parts,
    pixel_on_show,
    pixels,
    serving,
    slider,
    stage,
    upload,
    warning,
)

pytestmark = pytest.mark.browser


# -- pictures --------------------------------------------------------------------------------------


def colors(picture: np.ndarray) -> Counter[str]:
    """Return the number of pixels of each colour, by its #rrggbb."""
    values, counts = np.unique(picture @ [1 << 16, 1 << 8, 1], return_counts=True)
    names = (f"#{value:06x}" for value in values.tolist())
    return Counter(dict(zip(names, counts.tolist(), strict=True)))


def count_near(picture: np.ndarray, color: str) -> int:
    """Number of pixels close to a colour: a thin line may be blended over two of them."""
    rgb = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return int((np.linalg.norm(picture.astype(float) - rgb, axis=2) < 110).sum())


def n_ranges(picture: np.ndarray) -> int:
    """Number of colours of the range scale that occur."""
    return len(colors(picture).keys() & set(RANGE_COLORS))


def changed(page: Page, before: dict[str, np.ndarray], *names: str) -> Callable[[], bool]:
    """Whether these pictures, or all of them, differ from before."""

    def compare() -> bool:
        now = look(page)
        return not any(np.array_equal(now[name], before[name]) for name in names or now)

    return compare


# -- expected values, computed by core alone -------------------------------------------------------


@cache
def car(light: Illumination | None = None, tracking: TrackingParameters | None = None) -> core.Run:
    light, scene = light or Illumination(), core.scenes["car"]()
    acquisition = light.acquisition(scene.acquisition)
    capture = core.simulate(scene, acquisition, light.flux, seed=light.seed)
    return core.run(capture, "tracking", tracking or TrackingParameters())


def expect_rmse(page: Page, run: core.Run) -> None:
    expect(fact(page, "RMSE")).to_have_text(f"{run.figures['rmse_m']:.4g} m")


# -- the page --------------------------------------------------------------------------------------


def test_every_part_of_the_page_is_drawn(start_page):
    expect_rmse(start_page, car())
    eventually(lambda: n_ranges(look(start_page)["image"]) > 50)
    shown = look(start_page)
    for plot, lines in (
        ("histogram", ("raw", "small", "large", "truth", "estimate")),
        ("residual", ("residual", "truth", "estimate")),
        ("enhanced", ("enhanced", "truth", "estimate")),
    ):
        # A line in the legend alone has some sixty pixels.
        assert [x for x in lines if count_near(shown[plot], getattr(LIGHT, x)) < 100] == []
    assert n_ranges(shown["cloud"]) > 15  # fewer than on the image: points have darker rims
    assert count_near(shown["cloud"], WRONG_COLOR) > 10  # a few crosses
    expect(stage(start_page)).to_have_attribute("data-points", re.compile(r"^\d{4}$"))


UNNAMED = """() => {
  const found = [];
  const name = (node, root) => {
    const by = node.getAttribute("aria-labelledby");
    const labels = by ? by.split(" ").map((id) => root.getElementById(id)) : node.labels ?? [];
    const text = [...labels].map((label) => label?.textContent ?? "").join("");
    return node.getAttribute("aria-label") || text || node.textContent || node.title;
  };
  const look = (root) => {
    for (const node of root.querySelectorAll("*")) {
      if (node.shadowRoot) look(node.shadowRoot);
      const isControl = node.matches(
        "button, input, select, [role=button], [role=combobox], [role=application], [role=img]",
      );
      const isShown = node.getClientRects().length > 0 && !node.closest("[aria-hidden=true]");
      if (isControl && isShown && !name(node, root).trim()) found.push(node.outerHTML);
    }
  };
  look(document);
  return found;
}"""


def test_every_control_has_a_name_and_the_keyboard_reaches_the_pictures(start_page):
    assert start_page.evaluate(UNNAMED) == []
    for part in (image(start_page), stage(start_page)):
        part.focus()
        expect(part).to_be_focused()


def test_a_part_of_the_sidebar_folds_by_its_title_and_by_key(start_page):
    view = start_page.get_by_role("button", name="View", exact=True)
    title = start_page.locator(".MuiCardHeader-root", has_text=re.compile("^View$"))
    expect(view).to_have_attribute("aria-expanded", "true")
    title.click(position={"x": 20, "y": 20})
    expect(view).to_have_attribute("aria-expanded", "false")
    view.press("Enter")
    expect(view).to_have_attribute("aria-expanded", "true")


# -- pixels ----------------------------------------------------------------------------------------


def tap(page: Page) -> np.ndarray:
    """Tap on the image, left of its middle; return the place in the picture as (y, x)."""
    box = image(page).bounding_box()
    place = np.array([0.45 * box["height"], 0.35 * box["width"]])
    page.mouse.click(box["x"] + place[1], box["y"] + place[0])
    return place


def marks(page: Page, before: dict[str, np.ndarray]) -> np.ndarray:
    """Return changed pixels as (y, x): the old and the new frame around the selected pixel."""
    differs = np.any(look(page)["image"] != before["image"], axis=-1)
    differs[:4] = differs[-4:] = differs[:, :4] = differs[:, -4:] = False  # outline of the focus
    return np.argwhere(differs)


def test_a_tap_on_the_image_selects_the_pixel(start_page):
    run, before, start = car(), look(start_page), fact(start_page, "Pixel").inner_text()
    place = tap(start_page)
    expect(fact(start_page, "Pixel")).not_to_have_text(start)
    at = pixel_on_show(start_page)
    for name, text in (
        ("Truth", f"{run.capture.truth_range_m[at]:.4g} m"),
        ("Estimate", f"{run.image.range_m[at]:.4g} m"),
        ("Detections", f"{run.capture.counts[at]}"),
    ):
        expect(fact(start_page, name)).to_have_text(text)
    eventually(changed(start_page, before))
    away = np.abs(marks(start_page, before) - place).max(axis=1)
    assert (away < 12).sum() > 20


def test_arrow_keys_on_the_image_move_the_pixel(start_page):
    place = tap(start_page)
    eventually(lambda: "row 32, col 32" not in fact(start_page, "Pixel").inner_text())
    (row, col), before = pixel_on_show(start_page), look(start_page)
    image(start_page).focus()
    for key, down, right in (
        ("ArrowRight", 0, 1),
        ("ArrowDown", 1, 0),
        ("Shift+ArrowRight", 0, 8),
        ("Shift+ArrowDown", 8, 0),
    ):
        start_page.keyboard.press(key)
        row, col = row + down, col + right
        expect(fact(start_page, "Pixel")).to_have_text(f"row {row}, col {col}")
    eventually(changed(start_page, before))
    # Down and to the right, by more than the frame's own size.
    moved = marks(start_page, before) - place
    assert np.all(moved.min(axis=0) > -12)
    assert np.all(moved.max(axis=0) > 24)
    for _ in range(9):
        start_page.keyboard.press("Shift+ArrowLeft")
    expect(fact(start_page, "Pixel")).to_have_text(f"row {row}, col 0")


# -- the cloud -------------------------------------------------------------------------------------


def on_stage(page: Page, point: np.ndarray) -> np.ndarray:
    """Return the position of a point on the page, in pixels, with the present camera."""
    camera = np.array(stage(page).get_attribute("data-camera").split(), float)
    eye, focal, box = camera[:3], camera[3:], stage(page).bounding_box()
    forward = (focal - eye) / np.linalg.norm(focal - eye)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    scale = box["height"] / 2 / np.tan(np.radians(10)) / ((point - eye) @ forward)
    shift = scale * np.array([(point - eye) @ right, -(point - eye) @ up])
    return np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2]) + shift


def test_a_click_on_a_point_of_the_cloud_selects_its_pixel(start_page):
    run = car()
    cloud = point_cloud(run.image.range_m, run.capture.acquisition.pixel_angle_rad)
    points = {(r, c): p for r, c, p in zip(cloud["row"], cloud["col"], cloud.points, strict=True)}
    start = fact(start_page, "Pixel").inner_text()
    click = on_stage(start_page, points[36, 14]) + 1  # on the bonnet: close points
    start_page.mouse.click(*click)
    expect(fact(start_page, "Pixel")).not_to_have_text(start)
    found = on_stage(start_page, points[pixel_on_show(start_page)])
    assert np.hypot(*(found - click)) < 12


def test_the_camera_stays_while_a_slider_moves_and_goes_home_by_key_and_button(start_page):
    view = stage(start_page)
    for key in ("ArrowLeft", "+"):
        before = view.get_attribute("data-camera")
        view.press(key)
        expect(view).not_to_have_attribute("data-camera", before)
    rotated, before = view.get_attribute("data-camera"), look(start_page)
    slider(start_page, "Seed").press("ArrowRight")
    eventually(changed(start_page, before, "cloud"))
    expect(view).to_have_attribute("data-camera", rotated)
    view.press("0")
    expect(view).not_to_have_attribute("data-camera", rotated)
    home = view.get_attribute("data-camera")
    view.press("ArrowLeft")
    expect(view).not_to_have_attribute("data-camera", home)
    start_page.get_by_role("button", name="Home view (0)").click()
    expect(view).to_have_attribute("data-camera", home)


# -- sliders and other controls --------------------------------------------------------------------


def test_a_slider_moved_by_keys_changes_everything(start_page):
    expect_rmse(start_page, car())
    before = look(start_page)
    for _ in range(5):
        slider(start_page, "SBR").press("ArrowRight")
    sbr = float(field(start_page, "SBR").input_value())
    assert sbr > 0.06
    expect_rmse(start_page, car(Illumination(sbr=sbr)))
    eventually(changed(start_page, before))
    before = look(start_page)
    slider(start_page, "m").press("ArrowRight")
    settings = TrackingParameters(m=float(field(start_page, "m").input_value()))
    assert settings != TrackingParameters()
    expect_rmse(start_page, car(Illumination(sbr=sbr), settings))
    eventually(changed(start_page, before))


COUNT_UPDATES = """list => {
  window.updates = 0;
  new MutationObserver(() => updates++).observe(list, { childList: true });
}"""


def test_a_drag_is_followed_leaves_no_queue_and_ends_at_the_last_value(start_page):
    track = slider(start_page, "SBR").bounding_box()
    places = cycle((0.32, 0.35))

    def move(share: float) -> None:
        middle = track["y"] + track["height"] / 2
        start_page.mouse.move(track["x"] + share * track["width"], middle)

    def is_followed() -> bool:
        move(next(places))
        return start_page.evaluate("updates") > 2

    start_page.locator("dl.timed").evaluate(COUNT_UPDATES)
    move(0.39)
    start_page.mouse.down()
    eventually(is_followed)
    for step in range(60):
        move(0.4 + step / 130)
    before_release = start_page.evaluate("updates")
    start_page.mouse.up()
    sbr = float(field(start_page, "SBR").input_value())
    assert sbr > 1
    expect_rmse(start_page, car(Illumination(sbr=sbr)))
    # A few were under way at release, more on a busy machine; a queue would hold most of the 60.
    assert start_page.evaluate("updates") - before_release <= 12


MOVE_AT_ONCE = """track => {
  const send = WebSocket.prototype.send;
  window.values = 0;
  WebSocket.prototype.send = function (data) {
    if (String(data).includes('"attr":"value"')) values++;
    return send.call(this, data);
  };
  for (const position of Array(200).keys()) {
    track.value = 100 + position;
    track.dispatchEvent(new Event("input"));
  }
}"""


def test_intermediate_values_of_a_fast_move_are_not_sent(start_page):
    slider(start_page, "SBR").evaluate(MOVE_AT_ONCE)
    sbr = float(field(start_page, "SBR").input_value())
    assert sbr != Illumination().sbr
    expect_rmse(start_page, car(Illumination(sbr=sbr)))
    # The first and the last; the first is overtaken, too, where a message was still under way.
    assert start_page.evaluate("values") in (1, 2)


COUNT_LOOKUPS = """() => {
  window.lookups = { same: 0, other: 0, ofPlots: 0 };
  const text = Object.getOwnPropertyDescriptor(Node.prototype, "textContent");
  Object.defineProperty(Node.prototype, "textContent", {
    ...text,
    set(value) {
      const isSheet = this.localName === "style";
      if (isSheet) lookups[text.get.call(this) === value ? "same" : "other"]++;
      text.set.call(this, value);
    },
  });
  const look = CSSStyleDeclaration.prototype.getPropertyValue;
  CSSStyleDeclaration.prototype.getPropertyValue = function (name) {
    if (name.startsWith("--bk-")) lookups.ofPlots++;
    return look.call(this, name);
  };
}"""


def test_a_move_makes_the_browser_recompute_no_style_and_rebuild_no_legend(start_page):
    items = start_page.locator(".bk-Legend .bk-item")
    first = items.first
    assert items.evaluate_all("(all) => all.map((each) => (each.dataset.seen = 'yes')).length") > 1
    before = look(start_page)
    start_page.evaluate(COUNT_LOOKUPS)
    slider(start_page, "SBR").press("ArrowRight")
    eventually(changed(start_page, before))
    lookups = start_page.evaluate("lookups")
    assert lookups["same"] == lookups["ofPlots"] == 0
    assert items.evaluate_all("(all) => all.every((each) => each.dataset.seen)")
    first.click()
    expect(first).to_have_class(re.compile("bk-inactive"))
    first.click()
    expect(first).not_to_have_class(re.compile("bk-inactive"))


NOTE_SIZES = """
window.sizes = new Map();
const stroke = CanvasRenderingContext2D.prototype.stroke;
CanvasRenderingContext2D.prototype.stroke = function (...values) {
  const { width, height } = this.canvas;
  if (width > 100) {
    if (!sizes.has(this.canvas)) sizes.set(this.canvas, new Set());
    sizes.get(this.canvas).add(`${width} x ${height}`);
  }
  return stroke.apply(this, values);
};
"""


@pytest.mark.parametrize("name", ["Explore", "Inspect"])
def test_plots_keep_the_size_at_which_they_are_first_painted(page, name):
    new = page(prepare=NOTE_SIZES)
    if name != "Explore":
        new.evaluate("sizes.clear()")
        new.get_by_role("button", name=name, exact=True).click()
        expect(new.get_by_role("button", name="Pins", exact=True)).to_be_visible()
    eventually(lambda: new.evaluate("sizes.size") >= 4)
    eventually(lambda: new.screenshot() == new.screenshot())  # all is painted
    sizes = new.evaluate("[...sizes.values()].map((each) => [...each])")
    assert all(len(each) == 1 for each in sizes), sizes


CHANGE_QUICKLY = """async () => {
  const models = [...Bokeh.documents[0]._all_models.values()];
  const { data } = models.find(({ class_name: name }) => name === "Select");
  const wait = (ms) => new Promise((resolve) => setTimeout(resolve, ms));
  const shown = [];
  for (let pause_ms = 0; pause_ms < 20; pause_ms++) {
    for (const text of ["once", `${pause_ms}`]) {
      data.setv({ label: text }, { sync: false });  // as for a message of the server
      await wait(text === "once" ? pause_ms : 100);
    }
    shown.push(Number(data.label));
  }
  return shown;
}"""


def test_of_two_quick_changes_by_the_server_the_last_one_stays(start_page):
    assert start_page.evaluate(CHANGE_QUICKLY) == list(range(20))


def test_typed_values_are_accepted_or_refused_with_a_sentence(start_page):
    enter(start_page, "SBR", "99")
    refusal = start_page.get_by_role("alert").filter(has_text="“99” is not accepted")
    expect(refusal).to_contain_text("from 0.01 to 10")
    expect(field(start_page, "SBR")).to_have_attribute("aria-invalid", "true")
    expect_rmse(start_page, car())
    enter(start_page, "SBR", "0,5")
    expect(refusal).to_be_hidden()
    expect_rmse(start_page, car(Illumination(sbr=0.5)))
    enter(start_page, "Pulses", "12.5")
    expect(start_page.get_by_text("“12.5” is not accepted: enter a whole number")).to_be_visible()
    field(start_page, "Pulses").press("Escape")
    expect(field(start_page, "Pulses")).to_have_value("1000")
    start_page.get_by_role("button", name="Reset SBR to 0.06").click()
    expect(field(start_page, "SBR")).to_have_value("0.06")
    expect_rmse(start_page, car())


def test_presets_set_all_controls(start_page):
    printed = PRESETS["as printed"]
    choose(start_page, "Preset", "as printed")
    expect_rmse(start_page, car(tracking=printed))
    for name, value in (("l", printed.l), ("n", printed.n), ("m", printed.m), ("α", printed.alpha)):
        expect(field(start_page, name)).to_have_value(f"{value:g}")
    expect(chosen(start_page, "Weight")).to_have_text(printed.weight)
    expect(chosen(start_page, "Start")).to_have_text(printed.start)
    choose(start_page, "Weight", "none")
    expect(chosen(start_page, "Preset")).to_have_text("custom")


# -- scenes and files ------------------------------------------------------------------------------


def test_every_scene_and_every_kind_of_picture_is_drawn(start_page):
    for source in reversed(built_in_sources().values()):
        before = look(start_page)
        choose(start_page, "Scene or capture", source.title)
        eventually(changed(start_page, before, "image", "cloud"))
        assert n_ranges(look(start_page)["image"]) > 50
    for of_image, of_cloud in (("Error", "Error"), ("Counts", "Counts"), ("Truth", "Range")):
        before = look(start_page)
        start_page.get_by_role("button", name=of_image, exact=True).first.click()
        start_page.get_by_role("button", name=of_cloud, exact=True).last.click()
        eventually(changed(start_page, before, "image", "cloud"))
    expect(warning(start_page)).to_be_hidden()


def expect_the_building_at_21_km(page: Page) -> None:
    """Expect its estimate and what was guessed, and nothing that requires a truth."""
    expect(page.get_by_text("21km_K11_night.mat, variable Ts_gated; guessed:")).to_be_visible()
    expect(page.get_by_text("256 × 256 pixels, 200 bins of 1 ns")).to_be_visible()
    for name in ("RMSE", "Within 1 bin", "Within 3 bins", "Truth", "Error"):
        expect(fact(page, name)).to_have_count(0)
    expect(page.get_by_role("button", name="Truth", exact=True)).to_have_count(0)
    expect(slider(page, "SBR")).to_be_hidden()
    assert re.match(r"6[6-9]\d\.\d m", fact(page, "Estimate").inner_text())
    eventually(lambda: n_ranges(look(page)["image"]) > 50)


def test_a_real_capture_is_ranged_and_its_reading_can_be_changed(page, real_capture):
    new, path = page(), real_capture("21km_K11_night.mat")
    upload(new, path.name, path.read_bytes())
    inspect = new.get_by_role("button", name="Inspect", exact=True)
    expect(inspect).to_have_attribute("aria-pressed", "true")
    new.get_by_role("button", name="Explore", exact=True).click()
    expect_the_building_at_21_km(new)
    new.get_by_role("button", name="Reading options").click()
    bin_width = new.get_by_role("textbox", name="Bin width (s)")  # its help is part of the name
    bin_width.fill("2e-9")
    new.get_by_role("button", name="Read again").click()
    expect(new.get_by_text("256 × 256 pixels, 100 bins of 2 ns")).to_be_visible()
    bin_width.fill("wide")
    new.get_by_role("button", name="Read again").click()
    expect(new.get_by_role("alert").filter(has_text="bin_width_s = 'wide'")).to_be_visible()
    # The number of pulses is unknown, and so is the share of them that survives.
    choose(new, "Weight", "survival")
    expect(warning(new)).to_contain_text("needs the number of pulses")
    choose(new, "Weight", "exponential")
    expect(warning(new)).to_be_hidden()
    choose(new, "Scene or capture", "Car at 50 m")
    expect_rmse(new, car())
    expect(slider(new, "SBR")).to_be_visible()


def test_a_capture_of_the_command_line_is_opened_first(page, real_capture):
    with serving(real_capture("21km_K11_night.mat")) as address:
        new = page(f"{address}?page=Explore")
        expect_the_building_at_21_km(new)
        new.close()  # before it loses its server


def test_a_file_that_is_no_capture_is_refused_and_the_page_continues(page):
    new = page()
    upload(new, "holiday.npz", b"nothing of the kind")
    expect(warning(new)).to_contain_text("holiday.npz")
    expect(warning(new)).to_contain_text("copy or save it again")
    expect(chosen(new, "Scene or capture")).to_have_text("Car at 50 m")
    slider(new, "Seed").press("ArrowRight")
    expect_rmse(new, car(Illumination(seed=1)))
    expect(warning(new)).to_be_hidden()


def test_text_of_a_file_is_never_interpreted_as_html(page):
    new = page()
    trap, content = "<img src='x' onerror='window.trapped = 1'>*", BytesIO()
    cube = np.ones((3, 3, 40), np.uint16)
    np.savez(content, **{trap: cube, "other": cube})
    upload(new, "two.npz", content.getvalue())
    expect(warning(new)).to_contain_text(trap)
    content = BytesIO()
    np.savez(content, format=FORMAT, cube=cube, source=trap)
    upload(new, "one.npz", content.getvalue())
    expect(new.get_by_text("3 × 3 pixels, 40 bins")).to_contain_text(trap)
    assert new.evaluate("window.trapped") is None


# -- the page as a whole ---------------------------------------------------------------------------


def test_two_sessions_are_independent(page):
    one, other = page(), page()
    enter(one, "SBR", "0.5")
    expect_rmse(one, car(Illumination(sbr=0.5)))
    content = BytesIO()
    np.save(content, np.ones((3, 3, 40), np.uint16))
    upload(one, "mine.npy", content.getvalue())
    expect(chosen(one, "Scene or capture")).to_have_text("mine.npy")
    expect(field(other, "SBR")).to_have_value("0.06")
    slider(other, "Seed").press("ArrowRight")
    expect_rmse(other, car(Illumination(seed=1)))
    chosen(other, "Scene or capture").click()
    titles = [source.title for source in built_in_sources().values()]
    expect(other.get_by_role("menuitem")).to_have_text(titles)


NOTE_SENT = """
window.sent = [];
const send = WebSocket.prototype.send;
WebSocket.prototype.send = function (part) {
  sent.push(part);
  send.call(this, part);
};
"""


def test_plots_and_cloud_follow_the_theme(page):
    new = page(prepare=NOTE_SENT)
    new.evaluate("sent.length = 0")

    def all_drawn_in(palette) -> bool:
        drawn = [colors(picture) for picture in look(new).values()]
        return all(each[palette.paper] > each.total() / 4 and each[palette.text] for each in drawn)

    eventually(lambda: all_drawn_in(LIGHT))
    for palette in (DARK, LIGHT):
        new.get_by_role("button", name="Toggle theme").click()
        eventually(lambda palette=palette: all_drawn_in(palette))
        assert (pixels(new.screenshot()).mean() < 60) == (palette is DARK)
    sent = [event for part in new.evaluate("sent") for event in json.loads(part).get("events", ())]
    # The server paints the plots: the browser need not report the colour of each line.
    assert {event["attr"] for event in sent} == {"dark_theme"}


COVERED = """
const look = () => {
  const seek = (root) => [...root.querySelectorAll("*")].some(
    (each) => each.matches(".MuiBackdrop-root") || (each.shadowRoot && seek(each.shadowRoot)),
  );
  window.was_covered ||= seek(document);
  requestAnimationFrame(look);
};
look();
"""


def test_a_phone_shows_everything_stacked(page):
    new = page(width=390, height=844, prepare=COVERED)
    assert not new.evaluate("was_covered")
    assert new.evaluate("document.documentElement.scrollWidth") <= 390
    expect(slider(new, "SBR")).not_to_be_in_viewport()
    bottom = 0
    for part in parts(new).values():
        box = part.bounding_box()
        assert 0 <= box["x"] < box["x"] + box["width"] <= 390
        assert box["y"] >= bottom
        bottom = box["y"] + box["height"]
    for part in parts(new).values():
        assert len(colors(pixels(part.screenshot()))) > 20
    new.get_by_role("button", name="Open drawer").click()
    expect(slider(new, "SBR")).to_be_in_viewport()
