"""What is taken away from the page is what it shows, under a name that says what it is."""

from __future__ import annotations

import errno
import io
import re
import time
from csv import DictReader
from dataclasses import replace

import laspy
import numpy as np
import pytest
import tifffile
import trimesh

from app import downloads
from app.downloads import Download, Shown, Subject
from app.exports import drawn, shown_table_file, table_file
from app.layout import Layout
from app.looks import image_of, shown
from app.state import Less, Light
from app.store import built_in_sources, inspect
from core import TrackingParameters
from core.experiments.items import Table


@pytest.fixture(scope="module")
def layout():
    return Layout(built_in_sources())


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
    lit = Subject("car", "tracking", (Light(sbr=0.5, n_pulses=200), TrackingParameters(alpha=2.0)))
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
        capture, "log_matched_filter", (Light(1.0, 1.0, 77, 5), Less(2, 0.1, 0.9), everything)
    )
    name = subject.file_name("enhanced row1000 col1000", "csv")
    assert re.fullmatch(r"[\w.+-]+", name, re.ASCII)
    assert not name.startswith((".", "-"))
    assert ".." not in name
    assert len(name) <= downloads.MOST_LETTERS
    assert name.endswith("_enhanced-row1000-col1000.csv")


def test_a_name_follows_the_page(session):
    subject = downloads.explored(session)
    assert subject.file_name("cloud", "las") == "car_tracking_cloud.las"
    assert "simulated" in subject.about("cloud")
    row, col = session.state.pixel
    shown_now = downloads.pixel_plot(session, session.signals.histogram.figure, "histogram")
    assert f"row{row} col{col}" in shown_now.what


# -- contents --------------------------------------------------------------------------------------


def test_a_plots_table_holds_its_curves(session):
    signals = inspect(session.answer, *session.state.pixel).signals
    plot = session.signals.histogram
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


def test_what_is_hidden_or_out_of_view_is_left_out_of_a_plots_table(session):
    plot = session.signals.histogram
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
def test_an_images_table_holds_its_pixels(session, kind):
    session.state.image = kind
    try:
        found = columns_of(written(downloads.range_image(session).files["csv"]))
    finally:
        session.state.image = "Estimate"
    values, look = image_of(session.answer, kind, session.state.viewing.least_confidence)
    row, col, shown_values = (found[name] for name in ("row", "col", look.legend))
    np.testing.assert_array_equal(row * 64 + col, np.arange(64 * 64))
    np.testing.assert_array_equal(shown_values, values.ravel())


def test_an_images_table_holds_the_pixels_in_view(session):
    figure = session.image.figure
    figure.x_range.update(start=9.7, end=20.2)
    figure.y_range.update(start=30.4, end=5.6)
    try:
        found = columns_of(written(downloads.range_image(session).files["csv"]))
    finally:
        figure.x_range.update(start=np.nan, end=np.nan)
        figure.y_range.update(start=np.nan, end=np.nan)
    assert (found["col"].min(), found["col"].max()) == (10, 20)
    assert (found["row"].min(), found["row"].max()) == (6, 30)


def test_the_answers_arrays_leave_without_what_is_hidden(session):
    files = downloads.range_image(session).files
    visible = shown(session.answer, session.state.viewing.least_confidence)
    range_m = np.where(visible, session.answer.run.image.range_m, np.nan)
    arrays = np.load(io.BytesIO(written(files["npz"])))
    np.testing.assert_array_equal(arrays["range_m"], range_m)
    np.testing.assert_array_equal(arrays["valid"], visible)
    assert str(arrays["source"]) == session.answer.capture.source
    pages = tifffile.imread(io.BytesIO(written(files["tif"])))
    np.testing.assert_array_equal(pages[0], range_m.astype(np.float32))


def points_on_screen(session):
    """Coordinates and colours of the points as the browser has them."""
    cloud = session.cloud
    xyz_m = np.frombuffer(cloud.positions, "<f4").reshape(-1, 3)
    rgb = np.frombuffer(cloud.colors, np.uint8).reshape(-1, 3).copy()
    rgb[np.frombuffer(cloud.wrong, bool)] = tuple(bytes.fromhex(cloud.wrong_color[1:]))
    return xyz_m, rgb


@pytest.mark.parametrize("kind", ["Range", "Error", "Counts"])
@pytest.mark.parametrize("least", [0.0, 0.9])
def test_a_clouds_files_hold_the_points_on_screen_in_their_colours(session, kind, least):
    state = session.state
    before = state.viewing
    state.param.update(cloud_color=kind, viewing=replace(before, least_confidence=least))
    try:
        files = {
            name: written(each) for name, each in downloads.cloud_on_show(session).files.items()
        }
        xyz_m, rgb = points_on_screen(session)
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
    return layout._alert.text


def offering(write):
    return lambda: Shown(Subject("car"), "test", {"csv": write})


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


def test_a_cloud_without_points_is_told(layout):
    session = layout.session
    before = session.answer
    image = replace(before.run.image, valid=np.zeros((64, 64), bool))
    session.answer = replace(before, run=replace(before.run, image=image))
    try:
        button = Heard(session, lambda: downloads.cloud_on_show(session), "ply")
        assert button.ask(suffix="ply") == {"failed": True}
    finally:
        session.answer = before
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
