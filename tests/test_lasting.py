"""State across a reload, a lost connection and another tab, in a real browser."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.browser import (
    ROOT,
    chosen,
    eventually,
    fact,
    image,
    launch,
    look,
    open_page,
    pixel_on_show,
    serving,
    slider,
    upload,
    warning,
)

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


def share_changed(page: Page, before: dict[str, np.ndarray], *names: str, levels: int = 0) -> float:
    """Share of a picture's pixels that changed by more than some levels, of the worst picture."""
    now = look(page)
    if any(now[name].shape != before[name].shape for name in now):
        return 1.0
    return max(
        float((np.abs(now[name].astype(int) - before[name]) > levels).any(axis=2).mean())
        for name in names or now
    )


def test_the_view_is_restored_after_a_reload_and_in_another_tab(page, address):
    first = page(f"{address}?source=building&tracking.l=0.006&less.merge=2&image=Error")
    expect(chosen(first, "Scene or capture")).to_have_text("Building at 830–860 m")
    image(first).press("Shift+ArrowRight")
    before = fact(first, "RMSE").inner_text()
    slider(first, "SBR").press("ArrowRight")
    expect(fact(first, "RMSE")).not_to_have_text(before)
    rests(first, "pixel=[", "light.sbr=")
    length, rmse = first.evaluate("history.length"), fact(first, "RMSE").inner_text()
    place = pixel_on_show(first)
    first.reload()
    expect(fact(first, "RMSE")).to_have_text(rmse)
    assert pixel_on_show(first) == place
    assert first.evaluate("history.length") == length
    other = page(here(first))
    expect(fact(other, "RMSE")).to_have_text(rmse)
    # A browser may round the edge of a corner by one level.
    eventually(lambda: share_changed(first, look(other), levels=1) == 0)
    slider(other, "SBR").press("ArrowRight")
    eventually(lambda: here(other) != here(first))
    expect(fact(first, "RMSE")).to_have_text(rmse)
    assert pixel_on_show(first) == place
    expect(warning(first)).to_be_hidden()


def test_a_result_that_comes_before_the_page_is_drawn_is_shown(page, address):
    region = "[[20,20],[20,40],[40,40],[40,20]]"
    for _ in range(2):  # the second time nothing is left to compile
        new = page(f"{address}?source=building&page=Inspect&subject=Region&region={region}")
        expect(fact(new, "Pixels")).to_have_text("441")
        expect(new.get_by_text("Computing")).to_have_count(0)


def test_invalid_settings_in_an_address_are_reported_and_the_others_restored(page, address):
    trap = "<img src=x onerror=window.trapped=1>"
    new = page(f"{address}?source={trap}&light.sbr=-1&light.seed=1&page={trap}&{trap}=1")
    alert = new.get_by_role("alert").filter(has_text="sbr = -1")
    for text in ("no scene or capture '<img", "page = '<img", "Unknown parameter: <img"):
        expect(alert).to_contain_text(text)
    assert new.evaluate("window.trapped") is None
    rests(new, "?light.seed=1")
    slider(new, "Seed").press("ArrowRight")
    rests(new, "?light.seed=2")
    expect(alert).to_be_hidden()


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


def test_plots_and_cloud_recover_from_the_loss_of_graphics(browser, address):
    own = launch(browser.browser_type)
    page = open_page(own, address, prepare=CANVASES)
    eventually(lambda: share_changed(page, look(page)) == 0)
    before = look(page)
    own.new_browser_cdp_session().send("Browser.crashGpuProcess")
    page.wait_for_function("restored")
    # The symbols of legends are smoothed another way: 24 of 142,000 pixels of a plot.
    eventually(lambda: share_changed(page, before) < 0.001)

    page.locator(".stage canvas").evaluate(LOSE_AND_REFUSE)
    problem = page.get_by_text("The 3D cloud cannot be drawn")
    expect(problem).to_have_text(
        re.compile("offers no WebGL 2. It is tried again at the next change.")
    )
    page.evaluate("refused = undefined")
    slider(page, "Seed").press("ArrowRight")
    expect(problem).to_have_count(0)
    slider(page, "Seed").press("ArrowLeft")
    eventually(lambda: share_changed(page, before, "cloud") == 0)
    own.close()


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


def test_an_uploaded_capture_survives_reload_and_lost_connection(browser, address, real_capture):
    path = real_capture("21km_K11_night.mat")
    page = open_page(browser, address, prepare=CUT)
    upload(page, path.name, path.read_bytes())
    read = page.get_by_text("256 × 256 pixels, 200 bins of 1 ns")
    expect(read).to_be_visible()
    # A new capture opens Inspect; until then Explore is still selected, and a click has no effect.
    inspect = page.get_by_role("button", name="Inspect", exact=True)
    expect(inspect).to_have_attribute("aria-pressed", "true")
    page.get_by_role("button", name="Explore", exact=True).click()
    eventually(lambda: "page=" not in here(page))
    picture = page.get_by_label("Range image. Arrow keys move")
    expect(picture).to_be_visible()
    picture.press("Shift+ArrowDown")
    rests(page, "source=", "pixel=[")
    estimate, place = fact(page, "Estimate").inner_text(), pixel_on_show(page)

    def expect_all_there(page: Page) -> None:
        expect(fact(page, "Estimate")).to_have_text(estimate)
        expect(chosen(page, "Scene or capture")).to_have_text(path.name)
        expect(read).to_be_visible()
        assert pixel_on_show(page) == place

    page.reload()
    expect_all_there(page)
    with page.context.expect_page() as opened:
        page.evaluate("window.open(location.href, '_blank', 'noopener')")
    expect_all_there(opened.value)
    opened.value.close()
    cut(page)
    reconnect(page, "everything is as it was")
    expect_all_there(page)
    slider(page, "l").press("ArrowRight")
    rests(page, "tracking.l=")
    page.close()


def test_an_expired_session_is_replaced_and_its_file_removed(
    browser, tmp_path, monkeypatch, real_capture
):
    monkeypatch.setenv("TMPDIR", str(tmp_path))

    def held() -> list[Path]:
        return list(tmp_path.glob("firstphoton-*/*"))

    # Long enough for a page to connect for the first time.
    with serving("--linger", "8") as address:
        page = open_page(browser, f"{address}?tracking.l=0.006", prepare=CUT)
        upload(page, "../21km.mat", real_capture("21km_K11_night.mat").read_bytes())
        expect(chosen(page, "Scene or capture")).to_have_text("21km.mat")
        expect(page.get_by_text("21km.mat, variable")).to_be_visible()
        rests(page, "source=")
        assert [path.name for path in held()] == ["21km.mat"]
        cut(page)
        eventually(lambda: not held())
        reconnect(page, "the session had expired")
        expect(page.get_by_role("alert").filter(has_text="There is no scene")).to_be_visible()
        rests(page, "?tracking.l=0.006")
        upload(page, "again.mat", real_capture("21km_K11_night.mat").read_bytes())
        eventually(held)
    eventually(lambda: not list(tmp_path.glob("firstphoton-*")))  # with the server
    page.close()


def test_the_script_and_the_link_can_be_copied_and_saved(page, address, tmp_path):
    new = page(f"{address}?source=building&light.seed=3&tracking.l=0.006&less.pool=2")
    new.context.grant_permissions(["clipboard-read", "clipboard-write"])
    new.get_by_role("button", name="Copy link").click()
    expect(new.get_by_role("status").filter(has_text="Link copied.")).to_be_visible()
    assert new.evaluate("navigator.clipboard.readText()") == here(new)
    opener = new.get_by_role("button", name="Python script")
    opener.click()
    dialog = new.get_by_role("dialog", name="Python script of this view")
    with new.expect_download() as saved:
        dialog.get_by_role("button", name="Download").click()
    assert saved.value.suggested_filename == "firstphoton.py"
    script = saved.value.path().read_text("utf-8")
    dialog.get_by_role("button", name="Copy").click()
    expect(dialog.get_by_text("Script copied.")).to_be_visible()
    assert new.evaluate("navigator.clipboard.readText()") == script
    assert dialog.get_by_text("import core").text_content() == script
    new.keyboard.press("Escape")
    expect(dialog).to_have_count(0)
    expect(opener).to_be_focused()
    more = "print(f'{core.metrics.rmse_m(image.range_m, capture.truth_range_m):.4g} m')"
    done = subprocess.run(
        [sys.executable, "-c", script + more],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == fact(new, "RMSE").inner_text()
    assert (tmp_path / "range.png").exists()
