"""State across a reload, a lost connection and another tab, in a real browser."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, Page, expect

import core
from app.model.script import script_of
from app.pages.shared.illumination import MORE
from tests.browser import (
    chosen,
    enter,
    eventually,
    fact,
    field,
    launched,
    look,
    open_page,
    pixel_on_show,
    serving,
    slider,
    unfold,
    upload,
    warning,
)
from tests.test_script import opened

pytestmark = pytest.mark.browser

CUT = """
window.sockets = [];
window.WebSocket = class extends WebSocket {
  constructor(...given) { super(...given); window.sockets.push(this); }
};
"""


def here(page: Page) -> str:
    """Return the address; Playwright's own is updated late."""
    found: str = page.evaluate("location.href")
    return found


def rests(page: Page, *texts: str) -> None:
    """Wait until the address contains all texts."""
    eventually(lambda: all(each in here(page) for each in texts))


Pictures = dict[str, np.ndarray]

SMOOTHED = 0.001
"""Share of the pixels of a plot that may differ: a browser smooths the symbols of legends in one of
two ways, by itself and after its graphics were lost. That changes 24 of 142,000 pixels; a curve
covers more than a thousand."""


def expect_pictures(
    page: Page, other: Callable[[], Pictures], *names: str, levels: int = 0, share: float = 0.0
) -> None:
    """Wait until at most a share of each picture's pixels differs by more than some levels."""
    changes = {}

    def change(now: np.ndarray, old: np.ndarray) -> float | str:
        if now.shape != old.shape:
            return f"{old.shape} became {now.shape}"
        return float((np.abs(now.astype(int) - old) > levels).any(axis=2).mean())

    def are_equal() -> bool:
        now, old = look(page), other()
        changes.update({name: change(now[name], old[name]) for name in names or now})
        return all(isinstance(each, float) and each <= share for each in changes.values())

    try:
        eventually(are_equal)
    except AssertionError:
        raise AssertionError(f"pictures differ: {changes}") from None


@pytest.fixture(scope="module")
def building(tmp_path_factory) -> Path:
    """A file of a capture with a truth."""
    path, scene = tmp_path_factory.mktemp("made") / "building.npz", core.scenes["building"]()
    core.save_capture(core.simulate(scene, scene.acquisition, core.Flux(sbr=1.0), seed=1), path)
    return path


# -- a link, a reload and another tab --------------------------------------------------------------


def go_to_explore(page: Page) -> Locator:
    """Change from Inspect, which a new capture opens, to Explore, and return its image."""
    # Until Inspect is open Explore is still selected, and a click has no effect.
    inspect = page.get_by_role("button", name="Inspect", exact=True)
    expect(inspect).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Explore", exact=True).click()
    picture = page.get_by_label("Range image. Arrow keys move")
    expect(picture).to_be_visible()
    return picture


def copied_link(page: Page) -> str:
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    page.get_by_role("button", name="Copy link").click()
    expect(page.get_by_role("status").filter(has_text="Link copied.")).to_be_visible()
    link: str = page.evaluate("navigator.clipboard.readText()")
    assert link == here(page)
    return link


def copied_and_saved_script(page: Page) -> str:
    """Open the dialog with the script, copy and save it there, and close it."""
    opener = page.get_by_role("button", name="Python script")
    opener.click()
    dialog = page.get_by_role("dialog", name="Python script of this view")
    with page.expect_download() as saved:
        dialog.get_by_role("button", name="Download").click()
    assert saved.value.suggested_filename == "firstphoton.py"
    script: str = saved.value.path().read_text("utf-8")
    dialog.get_by_role("button", name="Copy").click()
    expect(dialog.get_by_text("Script copied.")).to_be_visible()
    assert page.evaluate("navigator.clipboard.readText()") == script
    assert dialog.get_by_text("import core").text_content() == script
    page.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    expect(opener).to_be_focused()
    return script


def expect_reported(page: Page) -> None:
    """Expect that invalid entries of the address are named, until the next change."""
    alert = page.get_by_role("alert").filter(has_text="sbr = -1")
    for text in ("no scene or capture '<img", "page = '<img", "Unknown parameter: <img"):
        expect(alert).to_contain_text(text)
    assert page.evaluate("window.trapped") is None
    rests(page, "?light.seed=1&tracking.l=0.006&image=Error")
    slider(page, "Seed").press("ArrowRight")
    rests(page, "?light.seed=2&")
    expect(alert).to_be_hidden()


BACK_AND_FORWARD = """
() => new Promise((resolve) => {
  const visit = () => {
    history.forward();
    addEventListener("popstate", resolve, { once: true });
  };
  addEventListener("popstate", visit, { once: true });
  history.back();
})
"""


def undo_and_redo(page: Page) -> None:
    """Undo and redo that l became 0.01, by the browser's buttons and by keys."""
    last = here(page)
    page.evaluate("window.is_same_page = true")
    for undo, redo in (
        (page.go_back, page.go_forward),
        (partial(page.keyboard.press, "Control+z"), partial(page.keyboard.press, "Control+y")),
    ):
        slider(page, "l").focus()
        undo()
        expect(field(page, "l")).to_have_value("0.006")
        redo()
        expect(field(page, "l")).to_have_value("0.01")
        assert here(page) == last
    # The address of an entry left at once is written late: it must not replace the next entry.
    page.evaluate(BACK_AND_FORWARD)
    assert here(page) == last
    page.go_back()
    expect(field(page, "l")).to_have_value("0.006")
    page.go_forward()
    expect(field(page, "l")).to_have_value("0.01")
    assert here(page) == last
    assert page.evaluate("window.is_same_page")


def test_a_view_and_its_upload_are_restored_by_reload_link_and_script(page, address, building):
    trap, valid = "<img src=x onerror=window.trapped=1>", "light.seed=1&tracking.l=0.006"
    first = page(f"{address}?source={trap}&light.sbr=-1&{valid}&image=Error&page={trap}&{trap}=1")
    expect_reported(first)
    upload(first, building.name, building.read_bytes())
    go_to_explore(first).press("Shift+ArrowRight")
    enter(first, "l", "0.01")
    rests(first, "source=", "pixel=[", "tracking.l=0.01")
    run = core.run(core.read_capture(building), "tracking", core.TrackingParameters(l=0.01))
    rmse = f"{run.figures['rmse_m']:.4g} m"
    expect(fact(first, "RMSE")).to_have_text(rmse)
    place = pixel_on_show(first)

    def expect_all_there(page: Page) -> None:
        expect(fact(page, "RMSE")).to_have_text(rmse)
        expect(chosen(page, "Scene or capture")).to_have_text(building.name)
        assert pixel_on_show(page) == place
        expect(warning(page)).to_be_hidden()

    undo_and_redo(first)
    first.reload()
    expect_all_there(first)
    link = copied_link(first)
    other = page(link)
    expect_all_there(other)
    # A browser may round the edge of a corner by one level.
    expect_pictures(first, partial(look, other), levels=1, share=SMOOTHED)
    slider(other, "l").press("ArrowRight")
    eventually(lambda: here(other) != here(first))
    expect_all_there(first)
    (key,) = parse_qs(urlsplit(link).query)["source"]
    same = opened(urlsplit(link).query, **{key: building})
    assert copied_and_saved_script(first) == script_of(same.answer, same.state)


# -- lost graphics and lost connections ------------------------------------------------------------


CANVASES = """
window.restored = false;
const ask = HTMLCanvasElement.prototype.getContext;
const asked = new WeakSet();
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  if (window.refused === kind && !asked.has(this)) return null;
  asked.add(this);
  this.addEventListener("contextrestored", () => (restored = true));
  return ask.call(this, kind, ...more);
};
"""

LOSE_AND_REFUSE = """(canvas) => {
  const graphics = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
  refused = "webgl2";
  graphics.loseContext();
}"""


def cut(page: Page) -> None:
    """Disconnect the page from its server."""
    # With `set_offline` the browser may never report the end of the socket.
    page.route("**/*", lambda route: route.abort())
    page.evaluate("sockets.at(-1).close()")
    expect(page.get_by_role("alertdialog")).to_contain_text("connection to the server is lost")


def reconnect(page: Page, text: str) -> None:
    """Connect the page again, and expect a text about it."""
    page.unroute("**/*")
    expect(page.get_by_role("status").filter(has_text="The connection is back")).to_contain_text(
        text
    )
    expect(page.get_by_role("alertdialog")).to_have_count(0)


def recover(browser: Browser, page: Page) -> None:
    """Take the graphics from a page, then the connection, and expect both to return."""
    expect_pictures(page, partial(look, page))  # drawn completely
    before = look(page)
    browser.new_browser_cdp_session().send("Browser.crashGpuProcess")
    page.wait_for_function("restored")
    expect_pictures(page, lambda: before, share=SMOOTHED)

    page.locator(".stage canvas").evaluate(LOSE_AND_REFUSE)
    problem = page.get_by_text("The 3D cloud cannot be drawn")
    expect(problem).to_have_text(
        re.compile("offers no WebGL 2. It is tried again at the next change.")
    )
    page.evaluate("refused = undefined")
    unfold(page, MORE)
    slider(page, "Seed").press("ArrowRight")
    expect(problem).to_have_count(0)
    slider(page, "Seed").press("ArrowLeft")
    expect_pictures(page, lambda: before, "cloud")

    cut(page)
    reconnect(page, "everything is as it was")
    expect_pictures(page, lambda: before, "cloud")
    slider(page, "Seed").press("ArrowRight")
    rests(page, "light.seed=1")


def test_a_page_recovers_from_the_loss_of_graphics_and_of_the_connection(browser, address):
    with launched(browser.browser_type, is_still=True) as own:
        recover(own, open_page(own, address, prepare=CANVASES + CUT))


def test_an_expired_session_is_replaced_and_its_file_removed(
    browser, tmp_path, monkeypatch, building
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))

    def held() -> list[Path]:
        return list(tmp_path.glob("firstphoton-*/*"))

    # Long enough for a page to connect for the first time.
    with serving("--linger", "8") as address:
        page = open_page(browser, f"{address}?tracking.l=0.006", prepare=CUT)
        upload(page, f"../{building.name}", building.read_bytes())
        expect(chosen(page, "Scene or capture")).to_have_text(building.name)
        rests(page, "source=")
        assert [path.name for path in held()] == [building.name]
        cut(page)
        eventually(lambda: not held())
        reconnect(page, "the session had expired")
        expect(page.get_by_role("alert").filter(has_text="There is no scene")).to_be_visible()
        rests(page, "?tracking.l=0.006")
        upload(page, "again.npz", building.read_bytes())
        eventually(held)
    eventually(lambda: not list(tmp_path.glob("firstphoton-*")))  # with the server
    page.close()
