"""Downloaded files hold what the page shows, under names that say what it is."""

from __future__ import annotations

import errno
import html
import io
import json
import math
import re
import subprocess
import sys
import tempfile
from base64 import b64encode
from csv import DictReader
from dataclasses import asdict, replace
from xml.etree import ElementTree

import laspy
import numpy as np
import psutil
import pytest
import tifffile
import trimesh
from bokeh.models import Range1d
from PIL import Image
from playwright.sync_api import expect

import core
from app.model.colors import image_of, map_of, shown
from app.model.download_text import NO_INTERVALS
from app.model.exports import (
    Curve,
    band,
    cloud_files,
    facts_file,
    image_files,
    plot_file,
    shown_table_file,
    table_file,
)
from app.model.script import script_of
from app.model.state import (
    MAPS,
    REGION,
    VELOCITY,
    Crop,
    Illumination,
    ReductionSettings,
    Viewing,
)
from app.model.store import built_in_sources, inspect
from app.pages.inspect.views import rectangle
from app.pages.layout import Layout
from app.pages.shared import downloads
from app.pages.shared.downloads import Download, Shown, Subject
from app.theme import RANGE_COLORS
from app.units import count, interval, number, share, with_margin
from core import Acquisition, TrackingParameters
from core.cli import main
from core.inference import range_intervals
from core.inspection import pixels_in
from core.io import MOST_LETTERS
from core.metrics import Interval
from core.studies.outputs import Table
from core.tests.test_export import drawn_pixels
from tests.browser import VIEWS, eventually, fact, server_process

BIN_M = Acquisition().bin_length_m
"""Length of a bin of 1 ns; ranges in CSV are rounded to at most a tenth of it."""


@pytest.fixture(scope="module")
def layout():
    return Layout(built_in_sources())


@pytest.fixture
def session(layout):
    """The session, whose viewing settings are restored afterwards."""
    names = ("image", "cloud_color", "pixel", "viewing", "crop", "region")
    before = {name: getattr(layout.session.state, name) for name in names}
    yield layout.session
    layout.session.state.param.update(before)


@pytest.fixture
def explore(layout):
    return layout.contents["Explore"]


def written(write):
    """Return the content of a file."""
    file = io.BytesIO()
    write(file)
    return file.getvalue()


def rows_of(content):
    """Return the rows of a CSV file, without the lines that describe it."""
    lines = content.decode().splitlines()
    return list(DictReader(line for line in lines if not line.startswith("# ")))


def columns_of(content):
    """Return the columns of a CSV file by name; an empty field is NaN."""
    rows = rows_of(content)
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("subject", "what", "name"),
    [
        (Subject("car"), "cloud.ply", "car_cloud.ply"),
        (
            Subject(
                "21km_K11_night",
                "tracking",
                (ReductionSettings(), TrackingParameters(l=0.01, t_n=15)),
            ),
            "range image.png",
            "21km_K11_night_tracking_l0.01_Tn15_range-image.png",
        ),
        (
            Subject("car", "tracking", (Illumination(sbr=0.5, n_pulses=200),)),
            "histogram row3 col4.csv",
            "car_tracking_SBR0.5_Pulses200_histogram-row3-col4.csv",
        ),
    ],
)
def test_a_name_lists_capture_estimator_and_settings_that_are_not_the_default(subject, what, name):
    assert subject.file_name(*what.split(".")) == name


@pytest.mark.parametrize(
    "capture",
    [
        "../../etc/passwd",
        "a b;rm -rf $(x)`y`",
        "q\"'<img src=x>",
        "Größe µ ",
        "名前",
        "x" * 500,
        "..",
    ],
)
def test_a_name_is_safe_for_every_system_whatever_the_capture_is_called(capture):
    everything = TrackingParameters(0.1, 3.0, 2.0, 1.1, 7.0, 5, "none", "zero", "before T_n")
    settings = (Illumination(1.0, 1.0, 77, 5), ReductionSettings(2, 0.1, 0.9), everything)
    subject = Subject(capture, "log_matched_filter", settings)
    name = subject.file_name("enhanced row1000 col1000", "csv")
    assert re.fullmatch(r"[\w+][\w.+-]+", name, re.ASCII)
    assert ".." not in name
    assert len(name) <= MOST_LETTERS
    assert name.endswith("_enhanced-row1000-col1000.csv")


@pytest.mark.parametrize(
    ("changed", "suffix"),
    [
        ({}, ""),
        ({"least_confidence": 0.5}, "_least-confidence0.5"),
        ({"field_of_view_deg": 7.0}, "_field-of-view-deg7"),
        ({"color_to_m": 51.5}, "_color-to-m51.5"),
    ],
)
def test_names_of_image_and_cloud_follow_the_view(explore, session, changed, suffix):
    session.state.viewing = replace(session.state.viewing, **changed)
    image, cloud = explore.image_shown(), explore.cloud_shown()
    for each, what in ((image, "range-image"), (cloud, "cloud")):
        assert each.subject.file_name(each.what, "csv") == f"car_tracking{suffix}_{what}.csv"
    assert "simulated" in image.subject.about("image")


# -- contents --------------------------------------------------------------------------------------


def test_files_are_written_without_the_library_that_draws():
    code = "import sys, app.model.exports; sys.exit('bokeh' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_plots_table_holds_its_curves(explore, session):
    pixel = inspect(session.answer, *session.state.pixel)
    signals = pixel.signals
    shown_plot = downloads.pixel_plot(session, explore.signals.histogram, "histogram")
    found, n_bins = columns_of(written(shown_plot.files["csv"])), signals.raw.size
    np.testing.assert_array_equal(found["Bin"][:n_bins], np.arange(n_bins) + 0.5)
    for column, values in (
        ("raw histogram (counts)", signals.raw),
        ("small scale (counts)", signals.small),
        ("large scale (counts)", signals.large),
        ("expected (counts)", pixel.expected),
    ):
        np.testing.assert_array_equal(found[column][:n_bins], values)
        assert np.isnan(found[column][n_bins:]).all()
    acquisition = session.answer.capture.acquisition
    np.testing.assert_allclose(found["Range (m)"], acquisition.bin_to_range_m(found["Bin"]))
    np.testing.assert_allclose(found["Time (ns)"], 280 + found["Bin"])
    (estimate,) = np.flatnonzero(found["estimate"] == 1)
    at = session.answer.run.image.bin[session.state.pixel]
    assert found["Bin"][estimate] == at


def test_stages_of_a_pixel_are_saved_with_every_digit_and_the_weight_not_scaled(explore, session):
    signals, n_bins = inspect(session.answer, *session.state.pixel).signals, 100
    residual, enhanced = (
        columns_of(written(downloads.pixel_plot(session, plot, "p").files["csv"]))
        for plot in (explore.signals.residual, explore.signals.enhanced)
    )
    assert "first difference of the raw histogram (counts)" not in residual  # switched off
    for found, column, values in (
        (residual, "residual (counts)", signals.residual),
        (enhanced, "enhanced (counts × weight)", signals.enhanced),
        (enhanced, "weight", signals.weight),
    ):
        np.testing.assert_array_equal(found[column][:n_bins], values)


def test_a_table_has_rows_for_each_set_of_positions_in_view():
    x = [1.0, 2.0, 3.0]
    curves = [
        Curve("a", "a", x, [0.1, 0.2, 1 / 3], "m"),
        *band("b", "b", x, [4, 5, 6], [7, 8, np.nan], ""),
        Curve("c", "c", [2.0, 9.0]),
        Curve("d", "d", np.nan),
    ]
    content = written(plot_file(curves, "Pulses", Range1d(1.5, 3)))
    assert content.decode().splitlines() == [
        'Pulses,a (m),"b, lowest","b, highest",c,d',
        "2.0,0.2,5.0,8.0,,",
        f"3.0,{1 / 3!r},6.0,,,",
        "2.0,,,,1.0,",
    ]
    with pytest.raises(ValueError, match="nothing is drawn here yet"):
        plot_file(curves, "Pulses", Range1d(20, 30))


def test_a_plots_table_omits_what_is_hidden_or_out_of_view(explore):
    plot = explore.signals.histogram
    plot.show("small", False)
    plot.figure.x_range.update(start=20.2, end=30.9)
    try:
        found = columns_of(written(plot.csv()))
    finally:
        plot.show("small", True)
        plot.figure.x_range.update(start=0, end=100)
    assert "small scale (counts)" not in found
    assert "large scale (counts)" in found
    assert (found["Bin"].min(), found["Bin"].max()) == (20.5, 30.5)


@pytest.mark.parametrize("kind", ["Estimate", "Error", "Counts"])
def test_an_images_table_holds_its_pixels(explore, session, kind):
    session.state.image = kind
    found = columns_of(written(explore.image_shown().files["csv"]))
    values, look = image_of(session.answer, kind, session.state.viewing)
    np.testing.assert_array_equal(found["row"] * 64 + found["col"], np.arange(64 * 64))
    half_step = BIN_M / 20 if look.unit == "m" else 0.0
    np.testing.assert_allclose(found[look.legend], values.ravel(), rtol=0, atol=half_step)
    assert ("range_low_68_m" in found) == (kind == "Estimate")


def test_an_images_table_and_picture_hold_the_pixels_in_view(explore):
    figure = explore.image.figure
    figure.x_range.update(start=9.7, end=20.2)
    figure.y_range.update(start=30.4, end=5.6)
    try:
        files = explore.image_shown().files
        found = columns_of(written(files["csv"]))
        picture = written(files["svg"])
    finally:
        for each in (figure.x_range, figure.y_range):
            each.update(start=np.nan, end=np.nan)
    assert (found["col"].min(), found["col"].max()) == (10, 20)
    assert (found["row"].min(), found["row"].max()) == (6, 30)
    assert drawn_pixels(io.BytesIO(picture), (25, 11)).shape == (25, 11, 4)


@pytest.mark.parametrize("kind", ["Estimate", "Counts"])
def test_a_picture_of_an_image_is_that_of_the_command_line(explore, session, kind, tmp_path):
    colors = {"color_from_m": 48.0, "color_to_m": 50.5, "color_map": "viridis"}
    viewing = replace(session.state.viewing, **colors)
    session.state.param.update(image=kind, viewing=viewing)
    files = explore.image_shown().files
    picture = Image.open(io.BytesIO(written(files["png"])))
    assert picture.width >= 1200
    values, look = image_of(session.answer, kind, viewing)
    known = np.isfinite(values)
    drawn = drawn_pixels(io.BytesIO(written(files["svg"])), values.shape)
    np.testing.assert_array_equal(drawn[known][:, :3], look.rgb(values[known]))
    assert (drawn[~known] == 255).all()
    if kind == "Estimate":
        path = tmp_path / "picture.png"
        options = "--scene car --least-confidence 0.9 --color-from 48 --color-to 50.5"
        assert not main(
            ["estimate", "tracking", *options.split(), "--color-map=viridis", "--out", str(path)]
        )
        np.testing.assert_array_equal(np.asarray(picture), np.asarray(Image.open(path)))


def test_arrays_of_the_estimate_omit_hidden_pixels(explore, session):
    files = explore.image_shown().files
    visible = shown(session.answer, session.state.viewing.least_confidence)
    range_m = np.where(visible, session.answer.run.image.range_m, np.nan)
    arrays = np.load(io.BytesIO(written(files["npz"])))
    np.testing.assert_array_equal(arrays["range_m"], range_m)
    np.testing.assert_array_equal(arrays["valid"], visible)
    assert str(arrays["source"]) == session.answer.capture.source
    assert (str(arrays["method"]), float(arrays["least_confidence"])) == ("tracking", 0.9)
    assert json.loads(str(arrays["settings"])) == asdict(session.answer.request.tracking)


def test_a_report_shows_the_pixel_and_the_script_on_screen(explore, session):
    session.choose_pixel(20, 30)
    source = written(explore.image_shown().files["html"]).decode()
    assert "<h1>Car at 50 m</h1>" in source
    assert "<h2>Pixel in row 20, column 30</h2>" in source
    script = re.search("<code>(.*)</code>", source, re.DOTALL)[1]
    assert html.unescape(script) == script_of(session.answer, session.state)


def test_descriptions_state_version_method_all_settings_and_source(explore, session):
    found = explore.image_shown()
    version, method, *settings, source = found.subject.lines(found.what)
    assert version == f"firstphoton {core.__version__}: range image"
    assert (method, source) == ("method: tracking", f"source: {session.answer.capture.source}")
    assert f"settings: {session.answer.request.tracking}" in settings
    width_deg = session.answer.own_field_of_view_deg
    viewing = replace(session.state.viewing, field_of_view_deg=width_deg)
    assert f"settings: {viewing}" in settings


LEAST = 1 - 1e-9


@pytest.fixture(scope="module")
def intervals(layout):
    """The range intervals of the estimates of at least this confidence."""
    answer = layout.session.answer
    return range_intervals(answer.capture, answer.run.image.confident(LEAST))


@pytest.mark.parametrize("kind", [kind for kind in MAPS if kind != VELOCITY])
def test_arrays_and_pages_hold_the_map_that_is_shown(explore, session, intervals, kind):
    viewing = Viewing(least_confidence=LEAST)
    values, look = map_of(session.answer, kind, viewing)
    files = image_files(session.answer, kind, viewing, explore.image.figure)
    name = {"Estimate": "range_m", "Goodness of fit": "fit_p_value"}.get(kind, kind.lower())
    arrays = np.load(io.BytesIO(written(files["npz"])))
    np.testing.assert_array_equal(arrays[name], values)
    limits = {}
    inner, outer = intervals
    for level, ends in (("68_", inner), ("", outer)):
        limits |= {f"range_low_{level}m": ends.low_m, f"range_high_{level}m": ends.high_m}
    for limit, expected in limits.items():
        np.testing.assert_array_equal(arrays[limit], expected)
    with tifffile.TiffFile(io.BytesIO(written(files["tif"]))) as tif:
        first = tif.pages[0]
        np.testing.assert_array_equal(first.asarray(), values.astype(np.float32))
        assert first.description.startswith(f"{name} [{look.unit if look.unit == 'm' else 1}]: ")
        assert look.legend in first.description
        names = {page.description.split(" ")[0] for page in tif.pages}
    assert names == {name, "range_m", "confidence", "counts", *limits}


def test_intervals_that_would_take_too_long_are_left_out_and_the_file_says_so(
    explore, session, monkeypatch
):
    monkeypatch.setattr("app.model.budget.REQUEST_S", 1e-9)
    files = image_files(session.answer, "Counts", Viewing(), explore.image.figure)
    arrays = np.load(io.BytesIO(written(files["npz"])))
    assert "range_low_m" not in arrays
    assert str(arrays["remark"]) == NO_INTERVALS


@pytest.mark.parametrize(("kind", "least"), [("Range", 0.0), ("Error", 0.9), ("Counts", 0.9)])
def test_a_clouds_files_hold_the_points_on_screen_in_their_colours(explore, session, kind, least):
    viewing = replace(session.state.viewing, least_confidence=least)
    session.state.param.update(cloud_color=kind, viewing=viewing)
    files = {name: written(each) for name, each in explore.cloud_shown().files.items()}
    cloud = explore.cloud
    xyz_m = np.frombuffer(cloud.positions, "<f4").reshape(-1, 3)
    rgb = np.frombuffer(cloud.colors, np.uint8).reshape(-1, 3).copy()
    rgb[np.frombuffer(cloud.wrong, bool)] = tuple(bytes.fromhex(cloud.wrong_color[1:]))
    ply = trimesh.load(io.BytesIO(files["ply"]), file_type="ply")
    las = laspy.read(io.BytesIO(files["las"]))
    laz = laspy.read(io.BytesIO(files["laz"]))
    assert len(files["laz"]) < len(files["las"])
    np.testing.assert_array_equal(laz.xyz, las.xyz)
    table = columns_of(files["csv"])
    for points, colors in (
        (ply.vertices, ply.colors[:, :3]),
        (las.xyz, np.stack([las.red, las.green, las.blue], -1) // 256),
    ):
        np.testing.assert_allclose(points, xyz_m, atol=2e-4)
        np.testing.assert_array_equal(colors, rgb)
    np.testing.assert_array_equal(ply.vertices.astype(np.float32), xyz_m)
    points = np.stack([table[name] for name in ("x_m", "y_m", "z_m")], -1)
    np.testing.assert_allclose(points, xyz_m, atol=BIN_M / 20)
    np.testing.assert_array_equal(
        np.stack([table[name] for name in ("red", "green", "blue")], -1), rgb
    )


def test_a_cropped_cloud_and_its_files_hold_what_is_inside_and_state_the_box(explore, session):
    whole = explore.cloud.caption
    session.state.region = rectangle((20, 40), (10, 30))
    assert explore.cloud.caption == whole  # a region alone crops nothing
    middle_m = float(np.nanmedian(session.answer.run.image.range_m))
    session.state.crop = Crop(REGION, to_m=middle_m)
    image, box = session.answer.run.image, session.state.box
    inside = image.valid & (image.confidence >= 0.9) & (image.range_m <= middle_m)
    inside &= pixels_in(box.polygon, image.valid.shape)
    np.testing.assert_array_equal(
        np.frombuffer(explore.cloud.pixels, "<i4"), np.flatnonzero(inside)
    )
    of = f"{inside.sum():,} of {image.valid.sum():,} estimates"
    assert f"{of} shown in the box" in explore.cloud.caption
    found = explore.cloud_shown()
    name = found.subject.file_name(found.what, "laz")
    assert name == f"car_rows20-40_cols10-30_tracking_to-m{middle_m:.6g}_cloud.laz"
    assert f"box: {box}" in found.subject.lines(found.what)
    files = {suffix: written(write) for suffix, write in found.files.items()}
    assert f"comment box: {box}".encode() in files["ply"]
    for suffix in ("las", "laz"):
        las = laspy.read(io.BytesIO(files[suffix]))
        assert len(las.x) == inside.sum()
        assert f"box: {box}\n".encode() in las.vlrs.get_by_id("firstphoton")[0].record_data
    assert columns_of(files["csv"])["range_m"].size == inside.sum()
    session.state.crop = Crop(to_m=1.0)
    with pytest.raises(ValueError, match="no estimate that is shown lies inside the box"):
        explore.cloud_shown()


def test_a_clouds_files_hold_the_columns_of_the_command_lines(explore, session, tmp_path):
    files = explore.cloud_shown().files
    path = tmp_path / "cloud.laz"
    options = ["--least-confidence", "0.9", "--intervals", "--out", str(path)]
    assert not main(["estimate", "tracking", "--scene", "car", *options])
    one, other = laspy.read(path), laspy.read(io.BytesIO(written(files["laz"])))
    names = list(one.point_format.extra_dimension_names)
    assert names == list(other.point_format.extra_dimension_names)
    for name in names:
        np.testing.assert_array_equal(one[name], other[name])
    table = columns_of(written(files["csv"]))
    assert set(names) < set(table)
    np.testing.assert_allclose(table["range_sd_m"], one["range_sd_m"], atol=BIN_M / 20)


@pytest.mark.parametrize("angle_rad", [None, 1e-3])
def test_a_cloud_states_that_its_field_of_view_is_a_guess(session, angle_rad):
    run = session.answer.run
    acquisition = replace(run.capture.acquisition, pixel_angle_rad=angle_rad)
    run = replace(run, capture=replace(run.capture, acquisition=acquisition))
    answer = replace(session.answer, run=run)
    files = cloud_files(answer, "Range", session.state.viewing)
    header = written(files["ply"]).partition(b"end_header")[0].decode()
    assert ("rests on a guess: a field of view of" in header) == (angle_rad is None)


@pytest.mark.parametrize("kind", ["Range", "Confidence", "3D clouds"])
def test_a_methods_picture_is_saved_as_its_estimate(layout, kind):
    layout.pages.choice.value = "Compare"
    compare = layout.contents["Compare"]
    eventually(lambda: "peak" in compare.answers)
    compare.kind.value = kind
    found = compare.picture_shown(compare.pictured.index("peak"))
    described = compare.about().lines("methods")
    assert f"source: {layout.session.answer.capture.source}" in described
    for method, task in compare.tasks.items():
        assert f"method: {method}; settings: {task.settings}, false alarms 1" in described
    layout.pages.choice.value = "Explore"
    shown = layout.session.state.comparison.viewing.least_confidence
    image = compare.answers["peak"].run.image.confident(shown)
    assert (found.heading, found.subject.estimator) == ("Peak of the histogram", "peak")
    if kind == "3D clouds":
        points = laspy.read(io.BytesIO(written(found.files["las"])))
        assert len(points.x) == image.valid.sum()
        return
    arrays = np.load(io.BytesIO(written(found.files["npz"])))
    np.testing.assert_array_equal(arrays["range_m"], image.range_m)
    values = columns_of(written(found.files["csv"]))[found.scale.legend]
    if kind == "Range":
        np.testing.assert_allclose(values, image.range_m.ravel(), atol=BIN_M / 20)


def test_tables_hold_every_digit_and_no_units_in_their_cells():
    item = Table("t", "T", ("method", "RD"), (("peak", 1 / 3), ("tracking", float("nan"))))
    assert written(table_file(item)).decode() == f"method,RD\r\npeak,{1 / 3!r}\r\ntracking,\r\n"
    columns = [("Method", "", 1), ("Right", "", 1), ("Time", "", 1)]
    cells = [[share(0.9825), 0.9825, "97 to 99"], ["1,234.5", 1234.5, ""]]
    rows = [
        {"name": "peak, or so", "note": "", "cells": cells},
        {"name": "other", "note": "", "cells": [["–", None, ""], ["2.0", 2.0, ""]]},
        {"name": "failed", "message": "Not computed yet.", "cells": []},
    ]
    assert written(shown_table_file(columns, rows)).decode() == (
        'Method,Right (%),"Right, more",Time,note\r\n'
        '"peak, or so",98.25,97 to 99,1234.5,\r\n'
        "other,,,2.0,\r\n"
        "failed,,,,Not computed yet.\r\n"
    )


def test_facts_hold_the_ends_of_their_intervals():
    facts = [
        ("Pixel", "129, 131", "Row, and column."),
        ("SBR", interval(0.7321, 0.2914, math.inf), "Interval."),
        ("Estimate", number(math.nan, "m"), ""),
        ("Truth", "–", ""),
        ("Error", number(-0.0123, "m", sign=True), ""),
        ("Range", with_margin(Interval(50.12345, 50.1, 50.14), "m"), ""),
        ("Detections", count(1234, "12.3 %"), ""),
        ("Confidence", share(0.125), ""),
    ]
    assert written(facts_file(facts)).decode().splitlines() == [
        "quantity,value,low,high,unit,more,meaning",
        'Pixel,"129, 131",,,,,"Row, and column."',
        "SBR,0.7321,0.2914,inf,,,Interval.",
        "Estimate,,,,m,,",
        "Truth,,,,,,",
        "Error,-0.0123,,,m,,",
        "Range,50.123,50.1,50.14,m,,",
        "Detections,1234,,,,12.3 %,",
        "Confidence,12.5,,,%,,",
    ]
    with pytest.raises(ValueError, match="nothing is drawn here yet"):
        facts_file([])


# -- transfer and failures -------------------------------------------------------------------------


class Receiver(Download):
    """A button that keeps its messages in place of a browser."""

    def __init__(self, session, show, suffix="csv"):
        super().__init__(session, "test", show, [suffix])
        self.messages = []

    def _send_msg(self, data):
        self.messages.append(data)

    def ask(self, **message):
        self._handle_msg(message)
        eventually(lambda: self.messages)
        return self.messages.pop(0)


def offering(write):
    return lambda: Shown(Subject("car"), "test", {"csv": write})


def test_a_file_is_sent_in_pieces_and_then_deleted(session, monkeypatch, tmp_path):
    monkeypatch.setattr(downloads, "PIECE_BYTES", 1000)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    content = np.random.default_rng(0).bytes(3456)
    button = Receiver(session, offering(lambda file: file.write(content)))
    message = button.ask(suffix="csv")
    assert message["name"] == "car_test.csv"
    received = message["piece"]
    while len(received) < message["size"]:
        assert len(list(tmp_path.iterdir())) == 1
        message = button.ask(**{"from": len(received)})
        assert len(message["piece"]) <= 1000
        received += message["piece"]
    assert received.startswith(f"# firstphoton {core.__version__}: test\r\n".encode())
    assert received.endswith(content)
    assert list(tmp_path.iterdir()) == []


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
def test_a_file_that_cannot_be_written_is_reported_and_the_next_one_is_sent(layout, write, words):
    assert Receiver(layout.session, offering(write)).ask(suffix="csv") == {"failed": True}
    assert words in layout.alert.text
    assert "secret" not in layout.alert.text
    good = Receiver(layout.session, offering(lambda file: file.write(b"all")))
    assert good.ask(suffix="csv")["piece"].endswith(b"\r\nall")


def test_a_cloud_without_points_is_reported(explore, layout):
    session = layout.session
    before = session.answer
    image = replace(before.run.image, valid=np.zeros((64, 64), bool))
    session.estimate.answer = replace(before, run=replace(before.run, image=image))
    try:
        button = Receiver(session, explore.cloud_shown, "ply")
        assert button.ask(suffix="ply") == {"failed": True}
    finally:
        session.estimate.answer = before
    assert "nothing to save: no estimate is confident enough" in layout.alert.text


@pytest.mark.parametrize(
    "message", [None, 7, {}, {"suffix": "exe"}, {"suffix": ["csv"]}, {"from": 5}, {"from": -3}]
)
def test_malformed_messages_do_no_harm(session, message):
    button = Receiver(session, offering(lambda file: file.write(b"all")))
    button._handle_msg(message)
    assert all(set(each) == {"failed"} for each in button.messages)
    button.messages.clear()
    assert button.ask(suffix="csv")["piece"].endswith(b"\r\nall")


# -- in a browser ----------------------------------------------------------------------------------


def button(page, what):
    named = page.get_by_role("button", name=f"Download: {what}", exact=True)
    return named.filter(visible=True).first


def download(page, what, suffix):
    """Download a file; return its name and content."""
    page.wait_for_function("Bokeh.documents[0].is_idle")  # a card being filled closes its menu
    button(page, what).click()
    with page.expect_download(timeout=60_000) as asked:
        page.get_by_role("menuitem", name=suffix.upper()).filter(visible=True).click()
    return asked.value.suggested_filename, asked.value.path().read_bytes()


def size_of(page, what):
    """Return width and height in pixels of the plot beside a button."""
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


def as_seen(browser, content, width):
    """Return a picture as the browser draws it in this width."""
    page = browser.new_page()
    kind = "svg+xml" if content.startswith(b"<svg") else "png"
    data = b64encode(content).decode()
    page.set_content(
        f'<body style="margin:0"><img width={width} src="data:image/{kind};base64,{data}">'
    )
    shot = page.locator("img").screenshot()
    page.close()
    return np.asarray(Image.open(io.BytesIO(shot)).convert("RGB"), float)


def save_a_plot_as_a_picture(here, browser, what, title):
    name, png = download(here, what, "png")
    assert name.startswith("car_tracking_")
    picture = Image.open(io.BytesIO(png))
    assert "simulated, seed 0, SBR" in picture.text["Description"]
    svg_name, svg = download(here, what, "svg")
    assert svg_name == name.replace(".png", ".svg")
    root = ElementTree.fromstring(svg)
    texts = {each.text for each in root.iter("{http://www.w3.org/2000/svg}text")}
    assert any(text.startswith(title) for text in texts)
    axes = {
        "histogram": {"Bin", "Counts", "Range (m)", "truth"},
        "image": {"Column (px)", "Row (px)", "Estimated range (m)"},
    }
    assert axes[what] <= texts
    if what == "image":  # drawn by the server, as the command line does
        assert picture.width >= 1200
        return
    width, height = size_of(here, what)
    assert picture.width == 1200  # the plot is narrower
    assert picture.height == pytest.approx(1200 * height / width, abs=2)
    one, other = (as_seen(browser, each, width) for each in (png, svg))
    assert one.shape == other.shape
    assert np.ptp(one) > 200  # something is drawn
    assert np.abs(one - other).mean() < 6  # letters may be of another font


LOOK_AT = (
    f"([start, end]) => {{ {VIEWS}"
    + """
  const { model: figure } = views.find(({ model: { type, title } }) =>
    type === "Figure" && title?.text?.startsWith("Histogram and both scales"));
  figure.x_range.setv({start, end});
  const legend = figure.center.find(({type}) => type === "Legend");
  const item = legend.items.find(({label}) => label.value === "small scale");
  item.renderers[0].visible = false;
}"""
)
"""Zoom the histogram and hide a curve by its legend."""


def save_the_visible_part_of_a_plot(here):
    here.evaluate(LOOK_AT, [20.2, 30.9])
    _, content = download(here, "histogram", "csv")
    found = columns_of(content)
    assert (found["Bin"].min(), found["Bin"].max()) == (20.5, 30.5)
    assert "large scale (counts)" in found
    assert "small scale (counts)" not in found


def save_a_cloud_as_picture_and_points(here):
    stage = here.locator(".stage").first
    shown_points, box = int(stage.get_attribute("data-points")), stage.bounding_box()
    caption = here.locator(".caption").first.bounding_box()
    assert caption["y"] >= box["y"] + box["height"] - 1  # below the axes
    name, png = download(here, "3D cloud", "png")
    assert name == "car_tracking_cloud.png"
    picture = Image.open(io.BytesIO(png)).convert("RGB")
    assert picture.width == 1200  # the card is narrower
    # With heading and colour scale.
    assert picture.height > 1200 * box["height"] / box["width"]
    colors = {f"#{r:02x}{g:02x}{b:02x}" for _, (r, g, b) in picture.getcolors(2**24)}
    assert len(colors & set(RANGE_COLORS)) > 100
    name, content = download(here, "3D cloud", "laz")
    assert name == "car_tracking_cloud.laz"
    assert len(laspy.read(io.BytesIO(content)).x) == shown_points


def save_by_keyboard_alone(here):
    opener = button(here, "residual")
    opener.focus()
    here.keyboard.press("Enter")
    items = here.get_by_role("menuitem").filter(visible=True)
    expect(items).to_have_count(3)
    expect(items.first).to_be_focused()
    expect(opener).to_have_attribute("aria-expanded", "true")
    here.keyboard.press("Escape")
    expect(items).to_have_count(0)
    expect(opener).to_be_focused()
    here.keyboard.press("ArrowDown")
    expect(items.first).to_be_focused()
    here.keyboard.press("ArrowUp")
    expect(items.last).to_be_focused()
    with here.expect_download() as asked:
        here.keyboard.press("Enter")
    assert asked.value.suggested_filename.endswith(".csv")


def save_numbers_as_shown(here):
    name, table = download(here, "numbers", "csv")
    assert name == "car_tracking_numbers-row32-col32.csv"
    lines = {line["quantity"]: line for line in rows_of(table)}
    for each in ("RMSE", "Confidence"):
        value, unit = fact(here, each).inner_text().split()
        assert float(lines[each]["value"]) == pytest.approx(float(value), rel=1e-3)
        assert lines[each]["unit"] == unit


def save_all_of_inspect(here):
    here.get_by_role("button", name="Inspect", exact=True).click()
    expect(here.get_by_role("rowheader", name="1", exact=True)).to_be_visible()
    for what, suffix, name in (
        ("map", "tif", "car_tracking_map-Estimate.tif"),
        ("counts", "svg", "car_tracking_counts-row32-col32.svg"),
        ("table", "csv", "car_tracking_candidates-row32-col32.csv"),
    ):
        assert download(here, what, suffix)[0] == name


IS_DRAWN = """canvas =>
  canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data.some(Boolean)"""


def save_a_report_and_turn_its_cloud(here, browser):
    name, content = download(here, "map", "html")
    assert name == "car_tracking_report.html"
    report, problems = browser.new_page(viewport={"width": 390, "height": 844}), []
    report.on("pageerror", lambda error: problems.append(error.message))
    report.on("console", lambda found: problems.append(found.text))  # what the policy refuses
    report.route("**/*", lambda route: problems.append(route.request.url))
    report.set_content(content.decode())
    assert report.evaluate("document.documentElement.scrollWidth") == 390
    cloud = report.locator("canvas")
    cloud.scroll_into_view_if_needed()
    eventually(lambda: cloud.evaluate(IS_DRAWN))

    def picture():
        return cloud.evaluate("canvas => canvas.toDataURL()")

    first, box = picture(), cloud.bounding_box()
    report.mouse.move(box["x"] + 100, box["y"] + 100)
    report.mouse.down()
    report.mouse.move(box["x"] + 200, box["y"] + 120)
    report.mouse.up()
    eventually(lambda: picture() != first)
    cloud.press("0")
    eventually(lambda: picture() == first)
    report.close()
    assert problems == []


def colour_the_map_between_chosen_limits(here):
    here.get_by_role("button", name="View", exact=True).filter(visible=True).click()
    low = here.get_by_role("textbox", name="Colours from").filter(visible=True)
    expect(low).to_have_attribute("placeholder", "automatic")
    low.fill("50")
    low.press("Enter")
    expect(here).to_have_url(re.compile(r"viewing\.color_from_m=50\b"))
    assert download(here, "map", "png")[0] == "car_tracking_color-from-m50_map-Estimate.png"
    low.fill("")
    low.press("Enter")
    expect(here).not_to_have_url(re.compile(r"color_from_m"))


def fail_and_continue(here):
    alert = here.get_by_role("alert").filter(has_text="Nothing was saved")
    server = server_process(here.url)
    _, hard = server.rlimit(psutil.RLIMIT_FSIZE)
    server.rlimit(psutil.RLIMIT_FSIZE, (0, hard))  # as if the disk were full
    try:
        button(here, "image").click()
        here.get_by_role("menuitem", name="NPZ").filter(visible=True).click()
        expect(alert).to_contain_text("temporary files is full. Make room there")
    finally:
        server.rlimit(psutil.RLIMIT_FSIZE, (hard, hard))
    here.evaluate("""() => {
      const canvas = HTMLCanvasElement.prototype;
      [window.kept, canvas.toBlob] = [canvas.toBlob, (done) => done(null)];
    }""")
    button(here, "residual").click()
    here.get_by_role("menuitem", name="PNG").filter(visible=True).click()
    expect(alert).to_contain_text("the picture could not be made (it is too large)")
    here.evaluate("() => { HTMLCanvasElement.prototype.toBlob = window.kept; }")
    assert download(here, "residual", "png")[1].startswith(b"\x89PNG")
    assert np.load(io.BytesIO(download(here, "image", "npz")[1]))["range_m"].shape == (64, 64)


@pytest.mark.browser
def test_what_is_on_screen_is_saved(start_page, browser):
    fail_and_continue(start_page)  # on a disk that is full from the beginning
    for what, title in (("histogram", "Histogram and both scales"), ("image", "Estimated range")):
        save_a_plot_as_a_picture(start_page, browser, what, title)
    save_the_visible_part_of_a_plot(start_page)
    save_a_cloud_as_picture_and_points(start_page)
    save_by_keyboard_alone(start_page)
    save_numbers_as_shown(start_page)
    save_all_of_inspect(start_page)
    save_a_report_and_turn_its_cloud(start_page, browser)
    colour_the_map_between_chosen_limits(start_page)
