"""What is taken away from the page is what it shows, under a name that says what it is."""

from __future__ import annotations

import errno
import io
import re
import time
from base64 import b64encode
from csv import DictReader
from dataclasses import replace
from xml.etree import ElementTree

import laspy
import numpy as np
import psutil
import pytest
import tifffile
import trimesh
from PIL import Image
from playwright.sync_api import expect

from app.model.colors import image_of, map_of, shown
from app.model.exports import drawn, facts_file, image_files, shown_table_file, table_file
from app.model.state import MAPS, Illumination, Less
from app.model.store import built_in_sources, inspect
from app.pages.layout import Layout
from app.pages.shared import downloads
from app.pages.shared.downloads import Download, Shown, Subject
from app.theme import RANGE_COLORS
from core import TrackingParameters
from core.studies.outputs import Table
from tests.browser import VIEWS, fact, server_process


@pytest.fixture(scope="module")
def layout():
    return Layout(built_in_sources())


@pytest.fixture
def explore(layout):
    return layout.contents["Explore"]


@pytest.fixture
def session(layout):
    return layout.session


def written(write):
    """The content of a file."""
    file = io.BytesIO()
    write(file)
    return file.getvalue()


def columns_of(content):
    """Columns of a CSV file by name; an empty field is NaN."""
    lines = list(DictReader(io.StringIO(content.decode())))
    return {name: np.array([float(line[name] or "nan") for line in lines]) for name in lines[0]}


# -- names -----------------------------------------------------------------------------------------


def test_a_name_tells_capture_estimator_and_what_is_not_the_default():
    chosen = TrackingParameters(l=0.01, t_n=15)
    subject = Subject("21km_K11_night", "tracking", (Less(), chosen))
    assert subject.file_name("range image", "png") == (
        "21km_K11_night_tracking_l0.01_Tn15_range-image.png"
    )
    lit = Subject(
        "car", "tracking", (Illumination(sbr=0.5, n_pulses=200), TrackingParameters(alpha=2.0))
    )
    assert lit.file_name("histogram row3 col4", "csv") == (
        "car_tracking_SBR0.5_Pulses200_alpha2_histogram-row3-col4.csv"
    )
    assert Subject("car").file_name("cloud", "ply") == "car_cloud.ply"


@pytest.mark.parametrize(
    "capture",
    [
        "../../etc/passwd",
        "a b;rm -rf $(x)`y`|z",
        "q\"'<img src=x>",
        "Größe µ ",
        "名前",
        "x" * 500,
        "..",
        "con\n\r\0",
    ],
)
def test_a_name_harms_no_system_whatever_the_capture_is_called(capture):
    everything = TrackingParameters(0.1, 3.0, 2.0, 1.1, 7.0, 5, "none", "zero", "before T_n")
    subject = Subject(
        capture,
        "log_matched_filter",
        (Illumination(1.0, 1.0, 77, 5), Less(2, 0.1, 0.9), everything),
    )
    name = subject.file_name("enhanced row1000 col1000", "csv")
    assert re.fullmatch(r"[\w.+-]+", name, re.ASCII)
    assert not name.startswith((".", "-"))
    assert ".." not in name
    assert len(name) <= downloads.MOST_LETTERS
    assert name.endswith("_enhanced-row1000-col1000.csv")


def test_a_name_follows_the_page(explore, session):
    subject = downloads.explored(session)
    assert subject.file_name("cloud", "las") == "car_tracking_cloud.las"
    assert "simulated" in subject.about("cloud")
    row, col = session.state.pixel
    shown_now = downloads.pixel_plot(session, explore.signals.histogram.figure, "histogram")
    assert f"row{row} col{col}" in shown_now.what


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({}, ""),
        ({"least_confidence": 0.5}, "_least-confidence0.5"),
        ({"field_of_view_deg": 7.0}, "_field-of-view-deg7"),
    ],
)
def test_names_of_image_and_cloud_tell_how_they_are_seen(explore, session, changed, told):
    before = session.state.viewing
    session.state.viewing = replace(before, **changed)
    try:
        shown = explore.image_shown(), explore.cloud_shown()
    finally:
        session.state.viewing = before
    image, cloud = (each.subject.file_name(each.what, "csv") for each in shown)
    assert image == f"car_tracking{told}_range-image.csv"
    assert cloud == f"car_tracking{told}_cloud.csv"


# -- contents --------------------------------------------------------------------------------------


def test_a_plots_table_holds_its_curves(explore, session):
    signals = inspect(session.answer, *session.state.pixel).signals
    plot = explore.signals.histogram
    found = columns_of(
        written(downloads.pixel_plot(session, plot.figure, "histogram").files["csv"])
    )
    n_bins = signals.raw.size
    np.testing.assert_array_equal(found["Bin"][:n_bins], np.arange(n_bins) + 0.5)
    for column, values in (
        ("raw histogram (counts)", signals.raw),
        ("small scale (counts)", signals.small),
        ("large scale (counts)", signals.large),
    ):
        np.testing.assert_array_equal(
            found[column][:n_bins], values.astype(np.float32).astype(str).astype(float)
        )
        assert np.isnan(found[column][n_bins:]).all()
    acquisition = session.answer.capture.acquisition
    np.testing.assert_allclose(found["Range (m)"], acquisition.bin_to_range_m(found["Bin"]))
    np.testing.assert_allclose(found["Time (ns)"], 280 + found["Bin"])
    (answer,) = np.flatnonzero(found["answer"] == 1)
    at = session.answer.run.image.bin[session.state.pixel]
    np.testing.assert_allclose(found["Bin"][answer], at, rtol=1e-6)


def test_what_is_hidden_or_out_of_view_is_left_out_of_a_plots_table(explore, session):
    plot = explore.signals.histogram
    plot.show("small", False)
    plot.figure.x_range.update(start=20.2, end=30.9)
    try:
        found = drawn(plot.figure)
    finally:
        plot.show("small", True)
        plot.figure.x_range.update(start=0, end=100)
    assert "small scale (counts)" not in found
    assert "large scale (counts)" in found
    bins = found["Bin"]
    assert (bins.min(), bins.max()) == (20.5, 30.5)


@pytest.mark.parametrize("kind", ["Estimate", "Error", "Counts"])
def test_an_images_table_holds_its_pixels(explore, session, kind):
    session.state.image = kind
    try:
        found = columns_of(written(explore.image_shown().files["csv"]))
    finally:
        session.state.image = "Estimate"
    values, look = image_of(session.answer, kind, session.state.viewing.least_confidence)
    row, col, shown_values = (found[name] for name in ("row", "col", look.legend))
    np.testing.assert_array_equal(row * 64 + col, np.arange(64 * 64))
    np.testing.assert_array_equal(shown_values, values.ravel())


def test_an_images_table_holds_the_pixels_in_view(explore, session):
    figure = explore.image.figure
    figure.x_range.update(start=9.7, end=20.2)
    figure.y_range.update(start=30.4, end=5.6)
    try:
        found = columns_of(written(explore.image_shown().files["csv"]))
    finally:
        figure.x_range.update(start=np.nan, end=np.nan)
        figure.y_range.update(start=np.nan, end=np.nan)
    assert (found["col"].min(), found["col"].max()) == (10, 20)
    assert (found["row"].min(), found["row"].max()) == (6, 30)


def test_the_answers_arrays_leave_without_what_is_hidden(explore, session):
    files = explore.image_shown().files
    visible = shown(session.answer, session.state.viewing.least_confidence)
    range_m = np.where(visible, session.answer.run.image.range_m, np.nan)
    arrays = np.load(io.BytesIO(written(files["npz"])))
    np.testing.assert_array_equal(arrays["range_m"], range_m)
    np.testing.assert_array_equal(arrays["valid"], visible)
    assert str(arrays["source"]) == session.answer.capture.source
    pages = tifffile.imread(io.BytesIO(written(files["tif"])))
    np.testing.assert_array_equal(pages[0], range_m.astype(np.float32))


@pytest.mark.parametrize("kind", MAPS)
def test_arrays_and_pages_hold_the_map_that_is_shown(explore, session, kind):
    least = 0.9
    values, look = map_of(session.answer, kind, least)
    files = image_files(session.answer, kind, least, explore.image.figure)
    arrays = np.load(io.BytesIO(written(files["npz"])))
    name = "range_m" if kind == "Estimate" else kind.lower()
    np.testing.assert_array_equal(arrays[name], values)
    with tifffile.TiffFile(io.BytesIO(written(files["tif"]))) as tif:
        first = tif.pages[0]
        np.testing.assert_array_equal(first.asarray(), values.astype(np.float32))
        assert first.description.startswith(f"{name} [{look.unit if look.unit == 'm' else 1}]: ")
        assert look.legend in first.description
        told = [page.description.split(" ")[0] for page in tif.pages]
    assert set(told) == {name, "range_m", "confidence", "counts"}


def points_on_screen(explore):
    """Coordinates and colours of the points as the browser has them."""
    cloud = explore.cloud
    xyz_m = np.frombuffer(cloud.positions, "<f4").reshape(-1, 3)
    rgb = np.frombuffer(cloud.colors, np.uint8).reshape(-1, 3).copy()
    rgb[np.frombuffer(cloud.wrong, bool)] = tuple(bytes.fromhex(cloud.wrong_color[1:]))
    return xyz_m, rgb


@pytest.mark.parametrize("kind", ["Range", "Error", "Counts"])
@pytest.mark.parametrize("least", [0.0, 0.9])
def test_a_clouds_files_hold_the_points_on_screen_in_their_colours(explore, session, kind, least):
    state = session.state
    before = state.viewing
    state.param.update(cloud_color=kind, viewing=replace(before, least_confidence=least))
    try:
        files = {name: written(each) for name, each in explore.cloud_shown().files.items()}
        xyz_m, rgb = points_on_screen(explore)
    finally:
        state.param.update(cloud_color="Range", viewing=before)
    ply = trimesh.load(io.BytesIO(files["ply"]), file_type="ply")
    np.testing.assert_array_equal(ply.vertices.astype(np.float32), xyz_m)
    np.testing.assert_array_equal(ply.colors[:, :3], rgb)
    las = laspy.read(io.BytesIO(files["las"]))
    np.testing.assert_allclose(las.xyz, xyz_m, atol=2e-4)
    np.testing.assert_array_equal(np.stack([las.red, las.green, las.blue], -1) // 256, rgb)
    table = columns_of(files["csv"])
    np.testing.assert_allclose(
        np.stack([table[name] for name in ("x_m", "y_m", "z_m")], -1), xyz_m, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_array_equal(
        np.stack([table[name] for name in ("red", "green", "blue")], -1), rgb
    )


@pytest.mark.parametrize("kind", ["Range", "Error", "Confidence", "3D clouds"])
def test_a_methods_picture_leaves_as_its_answer(layout, kind):
    layout.pages.choice.value = "Compare"
    compare = layout.contents["Compare"]
    limit = time.monotonic() + 60
    while "peak" not in compare._answers():
        assert time.monotonic() < limit
        time.sleep(0.01)
    compare._kind.value = kind
    place = compare._pictured().index("peak")
    found = compare._picture_shown(place)
    layout.pages.choice.value = "Explore"
    image = compare._answers()["peak"].run.image
    assert (found.heading, found.subject.estimator) == ("Peak of the histogram", "peak")
    if kind == "3D clouds":
        points = laspy.read(io.BytesIO(written(found.files["las"])))
        assert len(points.x) == image.valid.sum()
    else:
        arrays = np.load(io.BytesIO(written(found.files["npz"])))
        np.testing.assert_array_equal(arrays["range_m"], image.range_m)
        values = columns_of(written(found.files["csv"]))[found.scale.legend]
        if kind == "Range":
            np.testing.assert_array_equal(values, image.range_m.ravel())


def test_tables_leave_with_every_digit_and_without_units_in_their_cells():
    item = Table("t", "T", ("method", "RD"), (("peak", 1 / 3), ("tracking", float("nan"))))
    assert written(table_file(item)).decode() == (f"method,RD\r\npeak,{1 / 3!r}\r\ntracking,\r\n")
    columns = [("Method", "", 1), ("Right", "", 1), ("Time", "", 1)]
    rows = [
        {
            "name": "peak, or so",
            "note": "",
            "cells": [["98.2 %", 0.982, "97 to 99"], ["1,234.5", 1234.5, ""]],
        },
        {"name": "other", "note": "", "cells": [["–", None, ""], ["2.0", 2.0, ""]]},
        {"name": "failed", "message": "Not computed yet.", "cells": []},
    ]
    assert written(shown_table_file(columns, rows)).decode() == (
        'Method,Right (%),"Right, more",Time,note\r\n'
        '"peak, or so",98.2,97 to 99,1234.5,\r\n'
        "other,,,2.0,\r\n"
        "failed,,,,Not computed yet.\r\n"
    )


# -- on their way, and what may go wrong -----------------------------------------------------------


class Heard(Download):
    """A button whose browser is the test."""

    def __init__(self, session, show, suffix="csv"):
        super().__init__(session, "test", show, [suffix])
        self.messages = []

    def _send_msg(self, data):
        self.messages.append(data)

    def ask(self, **message):
        self._handle_msg(message)
        limit = time.monotonic() + 20
        while not self.messages:
            assert time.monotonic() < limit
            time.sleep(0.002)
        return self.messages.pop(0)


def complaint(layout):
    return layout.alert.text


def offering(write):
    return lambda: Shown(Subject("car"), "test", {"csv": write})


def test_numbers_leave_with_the_ends_of_their_intervals():
    facts = [
        ("Pixel", "129, 131", "Row, and column."),
        ("SBR", "0.732 [0.291, ∞]", "Interval."),
        ("Estimate", "–", ""),
        ("Error", "-0.0123 m", ""),
        ("Detections", "1,234 (12.3 %)", ""),
        ("r small", "1.2e-05", ""),
    ]
    table = list(DictReader(io.StringIO(written(facts_file(facts)).decode())))
    columns = ("quantity", "value", "low", "high", "unit", "more", "meaning")
    assert [tuple(line[name] for name in columns) for line in table] == [
        ("Pixel", "129, 131", "", "", "", "", "Row, and column."),
        ("SBR", "0.732", "0.291", "inf", "", "", "Interval."),
        ("Estimate", "", "", "", "", "", ""),
        ("Error", "-0.0123", "", "", "m", "", ""),
        ("Detections", "1234", "", "", "", "12.3 %", ""),
        ("r small", "1.2e-05", "", "", "", "", ""),
    ]
    with pytest.raises(ValueError, match="nothing is drawn here yet"):
        facts_file([])


def test_a_file_travels_in_pieces_and_is_gone_afterwards(session, monkeypatch):
    monkeypatch.setattr(downloads, "PIECE_BYTES", 1000)
    content = np.random.default_rng(0).bytes(3456)
    button = Heard(session, offering(lambda file: file.write(content)))
    told = button.ask(suffix="csv")
    got = told["piece"]
    while len(got) < told["size"]:
        told = button.ask(**{"from": len(got)})
        assert len(told["piece"]) <= 1000
        got += told["piece"]
    assert got == content
    assert told["name"] == "car_test.csv"
    assert button._file is None


def full(file):
    file.write(b"half of it")
    raise OSError(errno.ENOSPC, "No space left on device")


def broken(file):
    raise RuntimeError("/secret/path in a message")


@pytest.mark.parametrize(
    ("write", "words"),
    [
        (full, "disk for temporary files is full. Make room"),
        (broken, "could not be written (RuntimeError). Try again"),
    ],
)
def test_a_file_that_cannot_be_written_is_told_and_not_given(layout, write, words):
    button = Heard(layout.session, offering(write))
    assert button.ask(suffix="csv") == {"failed": True}
    assert words in complaint(layout)
    assert "secret" not in complaint(layout)
    good = Heard(layout.session, offering(lambda file: file.write(b"all")))
    assert good.ask(suffix="csv")["piece"] == b"all"


def test_a_cloud_without_points_is_told(explore, layout):
    session = layout.session
    before = session.answer
    image = replace(before.run.image, valid=np.zeros((64, 64), bool))
    session.estimate.answer = replace(before, run=replace(before.run, image=image))
    try:
        button = Heard(session, explore.cloud_shown, "ply")
        assert button.ask(suffix="ply") == {"failed": True}
    finally:
        session.estimate.answer = before
    assert "nothing to save: no answer is confident enough" in complaint(layout)


@pytest.mark.parametrize(
    "message", [None, 7, {}, {"suffix": "exe"}, {"suffix": ["csv"]}, {"from": 5}, {"from": -3}]
)
def test_what_no_page_asks_for_does_no_harm(session, message):
    button = Heard(session, offering(lambda file: file.write(b"all")))
    button._handle_msg(message)
    assert all(set(told) == {"failed"} for told in button.messages)
    button.messages.clear()
    assert button.ask(suffix="csv")["piece"] == b"all"


# -- in a browser ----------------------------------------------------------------------------------


def button(page, what):
    named = page.get_by_role("button", name=f"Download: {what}", exact=True)
    return named.filter(visible=True).first


def download(page, what, suffix):
    """Name and content of a file that the page gives."""
    button(page, what).click()
    with page.expect_download(timeout=60_000) as asked:
        page.get_by_role("menuitem", name=suffix.upper()).filter(visible=True).click()
    return asked.value.suggested_filename, asked.value.path().read_bytes()


def size_of(page, what):
    """Width and height in pixels of the plot beside a button."""
    return page.evaluate(
        """what => {"""
        + VIEWS
        + """
          const own = views.find((view) => view.model.data?.what === what);
          const beside = [];
          (function search(view) { beside.push(view); (view.child_views ?? []).forEach(search); })(
            own.parent);
          const {width, height} = beside.find(({model}) => model.type === "Figure").bbox;
          return [Math.round(width), Math.round(height)];
        }""",
        what,
    )


def as_seen(browser, content):
    """A picture as the browser draws it."""
    page = browser.new_page()
    kind = "svg+xml" if content.startswith(b"<svg") else "png"
    data = b64encode(content).decode()
    page.set_content(f'<body style="margin:0"><img src="data:image/{kind};base64,{data}">')
    shot = page.locator("img").screenshot()
    page.close()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), float)


@pytest.mark.browser
@pytest.mark.parametrize(
    ("what", "title"), [("histogram", "Histogram of the pixel"), ("image", "Estimated range")]
)
def test_a_plots_pictures_are_what_is_on_screen(start_page, browser, what, title):
    name, png = download(start_page, what, "png")
    assert name.startswith("car_tracking_")
    picture = Image.open(io.BytesIO(png))
    assert list(picture.size) == size_of(start_page, what)
    assert "simulated, seed 0" in picture.text["Description"]
    svg_name, svg = download(start_page, what, "svg")
    assert svg_name == name.replace(".png", ".svg")
    root = ElementTree.fromstring(svg)
    texts = {each.text for each in root.iter("{http://www.w3.org/2000/svg}text")}
    assert any(text.startswith(title) for text in texts)
    axes = {"histogram": {"Bin", "Counts", "Range (m)", "truth"}, "image": {"Column", "Row", "m"}}
    assert axes[what] <= texts
    one, other = as_seen(browser, png), as_seen(browser, svg)
    assert one.shape == other.shape
    assert np.ptp(one) > 200  # something is drawn
    assert np.abs(one - other).mean() < 6  # letters may be of another font


LOOK_AT = """([start, end]) => {
  const models = [...Bokeh.documents[0]._all_models.values()];
  const figure = models.find(
    ({type, title}) => type === "Figure" && title?.text?.startsWith("Histogram of the pixel"));
  figure.x_range.setv({start, end});
  const legend = figure.center.find(({type}) => type === "Legend");
  const item = legend.items.find(({label}) => label.value === "small scale");
  item.renderers[0].visible = false;
}"""
"""Zoom the histogram and hide a curve by its legend."""


@pytest.mark.browser
def test_a_plot_leaves_as_it_is_zoomed_and_without_what_the_legend_hides(start_page):
    start_page.evaluate(LOOK_AT, [20.2, 30.9])
    _, content = download(start_page, "histogram", "csv")
    found = columns_of(content)
    assert (found["Bin"].min(), found["Bin"].max()) == (20.5, 30.5)
    assert "large scale (counts)" in found
    assert "small scale (counts)" not in found


@pytest.mark.browser
def test_a_cloud_leaves_as_a_picture_and_as_its_points(start_page):
    shown_points = int(start_page.locator(".stage").first.get_attribute("data-points"))
    box = start_page.locator(".stage").first.bounding_box()
    name, png = download(start_page, "3D cloud", "png")
    assert name == "car_tracking_cloud.png"
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    assert picture.width == round(box["width"])
    assert picture.height > box["height"]  # with heading and colour scale
    colors = {f"#{r:02x}{g:02x}{b:02x}" for _, (r, g, b) in picture.getcolors(2**24)}
    assert len(colors & set(RANGE_COLORS)) > 100
    for suffix, count in (
        ("ply", lambda content: len(trimesh.load(io.BytesIO(content), file_type="ply").vertices)),
        ("las", lambda content: len(laspy.read(io.BytesIO(content)).x)),
        ("csv", lambda content: len(columns_of(content)["x_m"])),
    ):
        name, content = download(start_page, "3D cloud", suffix)
        assert name == f"car_tracking_cloud.{suffix}"
        assert count(content) == shown_points


@pytest.mark.browser
def test_the_menu_works_by_keyboard_alone(start_page):
    opener = button(start_page, "residual")
    opener.focus()
    start_page.keyboard.press("Enter")
    items = start_page.get_by_role("menuitem").filter(visible=True)
    expect(items).to_have_count(3)
    expect(items.first).to_be_focused()
    expect(opener).to_have_attribute("aria-expanded", "true")
    start_page.keyboard.press("Escape")
    expect(items).to_have_count(0)
    expect(opener).to_be_focused()
    start_page.keyboard.press("ArrowDown")
    expect(items.first).to_be_focused()
    start_page.keyboard.press("ArrowUp")
    expect(items.last).to_be_focused()
    with start_page.expect_download() as asked:
        start_page.keyboard.press("Enter")
    assert asked.value.suggested_filename.endswith(".csv")


@pytest.mark.browser
def test_a_failure_is_told_and_the_page_goes_on(start_page, troubles):
    alert = start_page.get_by_role("alert").filter(has_text="Nothing was saved")
    server = server_process(start_page.url)
    _, hard = server.rlimit(psutil.RLIMIT_FSIZE)
    server.rlimit(psutil.RLIMIT_FSIZE, (0, hard))  # as if the disk were full
    try:
        button(start_page, "image").click()
        start_page.get_by_role("menuitem", name="NPZ").filter(visible=True).click()
        expect(alert).to_contain_text("temporary files is full. Make room there")
    finally:
        server.rlimit(psutil.RLIMIT_FSIZE, (hard, hard))
    start_page.evaluate("""() => {
      const canvas = HTMLCanvasElement.prototype;
      [window.kept, canvas.toBlob] = [canvas.toBlob, (done) => done(null)];
    }""")
    button(start_page, "residual").click()
    start_page.get_by_role("menuitem", name="PNG").filter(visible=True).click()
    expect(alert).to_contain_text("the picture could not be made (it is too large)")
    start_page.evaluate("() => { HTMLCanvasElement.prototype.toBlob = window.kept; }")
    assert download(start_page, "residual", "png")[1].startswith(b"\x89PNG")
    assert np.load(io.BytesIO(download(start_page, "image", "npz")[1]))["range_m"].shape == (64, 64)


@pytest.mark.browser
def test_every_page_gives_what_it_shows(start_page):
    def go(name):
        start_page.get_by_role("button", name=name, exact=True).click()

    name, table = download(start_page, "numbers", "csv")
    assert name == "car_tracking_numbers-row32-col32.csv"
    for each in ("RMSE", "Confidence"):
        value, unit = fact(start_page, each).inner_text().split()
        assert f"\n{each},{value},,,{unit},".encode() in table
    go("Inspect")
    expect(start_page.get_by_role("rowheader", name="1", exact=True)).to_be_visible()
    for what, suffix, name in (
        ("map", "tif", "car_tracking_map-Estimate.tif"),
        ("numbers", "csv", "car_tracking_numbers-row32-col32.csv"),
        ("counts", "csv", "car_tracking_counts-row32-col32.csv"),
        ("rate", "svg", "car_tracking_rate-row32-col32.svg"),
        ("table", "csv", "car_tracking_candidates-row32-col32.csv"),
    ):
        assert download(start_page, what, suffix)[0] == name
    go("Compare")
    expect(start_page.get_by_text("% sure").nth(1)).to_be_visible()
    name, png = download(start_page, "Peak of the histogram", "png")
    assert name == "car_peak_least-confidence0_range-image.png"
    assert Image.open(io.BytesIO(png)).height > 216  # with heading and colour scale
    name, table = download(start_page, "table", "csv")
    assert name == "car_methods.csv"
    assert b"Physics" in table
    go("Paper")
    assert download(start_page, "curves", "csv")[0] == "paper_figure_1.csv"
