"""The app as it is started with captures and a token, in a browser."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import core
from app.model.large import LIMIT
from app.model.uploads import safe_name
from app.server.access import TOKEN_VARIABLE
from tests.browser import TIMEOUT_MS, choose, chosen, fact, serving, upload
from tests.site import TOKEN
from tests.test_large import write
from tests.test_uploads import saved

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("served")]

SIDE = 512
"""Rows and columns of a capture that is just too large for a preview of every pixel."""

GIVEN = """<img src=x onerror=window.broken=1>"'.. &lt;b&gt;*.npz"""
UPLOADED = """..<svg onload=window.broken=1>"'.npz"""
DESCRIPTION = "<img src=x onerror=window.broken=1>*_made_*"


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Path of a large capture, address of the app, and the capture.

    The app requires a token, and has a second capture of the name `GIVEN`.
    """
    scene = core.scenes["car"]()
    car = core.simulate(scene, scene.acquisition, core.Flux(sbr=1.0), seed=1)
    times = SIDE // car.shape[0]
    tiled = core.Capture(np.tile(car.cube, (times, times, 1)), car.acquisition, car.pulse)
    folder = tmp_path_factory.mktemp("served")
    path, other = write(tiled, folder / "cars.zarr", 128), saved(folder / GIVEN, source=DESCRIPTION)
    with serving(path, other, **{LIMIT: str(2**20), TOKEN_VARIABLE: TOKEN}) as address:
        yield path, address, tiled


def test_the_token_form_admits_to_the_address_that_was_asked_for(browser, served):
    _, address, _ = served
    context = browser.new_context()
    context.set_default_timeout(TIMEOUT_MS)
    page = context.new_page()
    page.goto(f"{address}?unit=ns")
    page.get_by_label("Token").fill("something else")
    page.get_by_role("button", name="Enter").click()
    expect(page.get_by_role("alert")).to_contain_text("Wrong token")
    page.get_by_label("Token").fill(TOKEN)
    with page.expect_navigation(wait_until="commit") as entered:
        page.get_by_role("button", name="Enter").click()
    assert (entered.value.status, page.url) == (200, f"{address}?unit=ns")
    context.close()


def check_harmless(page):
    assert page.evaluate("window.broken") is None
    assert page.locator("img[src=x], [onload], [onerror]").count() == 0
    assert page.title() == "firstphoton"


def show_file_names_as_text(new: Page, folder: Path) -> None:
    """Choose the capture `GIVEN`, visit every page, and upload files of such names."""
    choose(new, "Scene or capture", GIVEN)
    source = chosen(new, "Scene or capture")
    for shown in ("Explore", "Compare", "Trade-off", "Paper", "Inspect"):
        button = new.get_by_role("button", name=shown, exact=True)
        button.click()
        expect(button).to_have_attribute("aria-pressed", "true")
        new.wait_for_function("Bokeh.documents[0].is_idle")
        check_harmless(new)
    expect(new.get_by_text("4 × 6 pixels, 37 bins")).to_contain_text(DESCRIPTION)
    for content, names in (
        ((folder / GIVEN).read_bytes(), source),
        (b"no capture", new.get_by_role("alert")),
    ):
        upload(new, UPLOADED, content)
        expect(names.filter(has_text=safe_name(UPLOADED))).to_be_visible()
        check_harmless(new)


def bounds(page: Page, rows: str, cols: str) -> None:
    for name, text in (("Rows shown", rows), ("Columns shown", cols)):
        page.get_by_label(name, exact=True).fill(text)
        page.get_by_label(name, exact=True).press("Tab")


def shows(page: Page, rows: str, cols: str) -> None:
    for name, text in (("Rows shown", rows), ("Columns shown", cols)):
        expect(page.get_by_label(name, exact=True)).to_have_value(text)


def zoom(page: Page) -> None:
    """Drag a box on the image."""
    box = page.locator("[data-part=image] .bk-Figure").bounding_box()
    left, top = box["x"] + 0.4 * box["width"], box["y"] + 0.4 * box["height"]
    page.mouse.move(left, top)
    page.mouse.down()
    page.mouse.move(left + 40, top + 40, steps=4)
    page.mouse.up()
    for name in ("Rows shown", "Columns shown"):
        expect(page.get_by_label(name, exact=True)).to_have_value(re.compile("^[1-9]"))


@contextmanager
def endless(chunk: Path) -> Iterator[None]:
    """Replace a chunk by one that takes for ever to be read."""
    kept = chunk.read_bytes()
    chunk.unlink()
    os.mkfifo(chunk)
    try:
        yield
    finally:
        # Readers see the end of the file; without any, `O_WRONLY` would wait for one for ever.
        os.close(os.open(chunk, os.O_RDWR))
        chunk.unlink()
        chunk.write_bytes(kept)


def test_a_large_capture_is_looked_at_closer_and_file_names_are_shown_as_text(page, served):
    path, address, capture = served
    opened = page(f"{address}?{urlencode({'token': TOKEN})}")
    closer = opened.get_by_role("button", name="Read window")
    cancel = opened.get_by_role("button", name="Cancel").filter(visible=True)
    preview = opened.get_by_text(f"Preview of {SIDE} × {SIDE} pixels, 1 of each 2 × 2")
    expect(preview).to_be_visible()
    expect(cancel).to_be_disabled()  # all of the preview has been read
    shows(opened, "0 to 511", "0 to 511")
    zoom(opened)
    closer.click()
    line = opened.get_by_text(re.compile("^Shown: rows"))
    expect(line).to_be_visible()
    seen = re.fullmatch(r"Shown: rows (.*), columns (.*), of 512 × 512 pixels\.", line.inner_text())
    shows(opened, *seen.groups())
    first, last = map(int, seen[1].split(" to "))
    assert 0 < first < last < SIDE - 1
    # While something is read, the page can be used; and the reading can be cancelled.
    chunk = path / "counts" / "c" / "0" / "0" / "0"
    with endless(chunk):
        bounds(opened, "0 to 63", "0 to 63")
        closer.click()
        expect(cancel).to_be_enabled()
        before = fact(opened, "Pixel").inner_text()
        opened.locator("[data-part=image]").focus()
        opened.keyboard.press("ArrowLeft")
        expect(fact(opened, "Pixel")).not_to_have_text(before)
        row, col = map(int, re.findall(r"\d+", fact(opened, "Pixel").inner_text()))
        expect(fact(opened, "Detections")).to_have_text(
            re.compile(f"^{capture.counts[row, col]:,} ")
        )
        opened.mouse.move(0, 0)
        closer.hover()
        expect(opened.get_by_role("tooltip")).to_be_visible()
        cancel.click()  # the help of its neighbour lies above it
        expect(cancel).to_be_disabled()
        expect(line).to_have_text(seen[0])
    kept = chunk.read_bytes()
    chunk.write_bytes(kept[:-9])
    closer.click()
    expect(opened.get_by_role("alert").filter(has_text="is damaged")).to_be_visible()
    expect(line).to_have_text(seen[0])
    chunk.write_bytes(kept)
    closer.click()
    expect(line).to_have_text("Shown: rows 0 to 63, columns 0 to 63, of 512 × 512 pixels.")
    opened.get_by_role("button", name="Show all").click()
    expect(preview).to_be_visible()
    shows(opened, "0 to 511", "0 to 511")
    show_file_names_as_text(opened, path.parent)
