"""Captures larger than memory: a preview, and windows that are read in full."""

from __future__ import annotations

import shutil
from itertools import pairwise

import numpy as np
import pytest

import core
from app.__main__ import main
from app.model import large
from app.model.address import Link
from app.model.colors import image_of
from app.model.large import LIMIT, Grid, most_whole_bytes
from app.model.state import ReductionSettings, Viewing
from app.model.store import Request, built_in_sources, compute, file_source
from app.pages.shared import downloads
from app.pages.shared.large_view import bounds_of
from app.tasks.scheduler import Cancelled
from core import Window
from core.inference.flux import flux_prior_of
from core.io import ReadOptions
from core.io.readers.labelled import dataset
from tests.browser import ROOT
from tests.states import ask
from tests.test_app import alert_of, values_of
from tests.test_downloads import columns_of, written
from tests.threads import HeldLayout, control

ROWS, COLS, CHUNK = 96, 128, 32
PIECES = ROWS * COLS // CHUNK**2
BINS = core.scenes["staircase"]().acquisition.n_bins


@pytest.fixture(scope="module")
def whole():
    """A staircase small enough for a test; its gate is short."""
    scene = core.scenes["staircase"](COLS)
    scene = core.Scene(scene.range_m[:ROWS])
    acquisition = core.scenes["staircase"](COLS).acquisition
    return core.simulate(scene, acquisition, core.Flux(sbr=0.5))


def write(capture, path, chunk):
    counts = dataset(capture)[["counts"]].chunk(row=chunk, col=chunk)
    counts.to_zarr(path, consolidated=False)
    return path


@pytest.fixture
def small(monkeypatch):
    """Limits as small as the captures of these tests."""
    monkeypatch.setenv(LIMIT, "100000")
    monkeypatch.setattr(large, "PREVIEW_COUNTS", 24 * 32 * BINS)
    monkeypatch.setattr(large, "WINDOW_COUNTS", 48 * 64 * BINS)
    monkeypatch.setattr("core.io.readers.labelled.BLOCK_BYTES", 2 * CHUNK**2 * BINS)
    monkeypatch.setattr("core.io.readers.sample.SAMPLE_COUNTS", 2 * 32 * 32 * BINS)


@pytest.fixture
def path(whole, small, tmp_path):
    return write(whole, tmp_path / "b.zarr", CHUNK)


@pytest.fixture
def slow(monkeypatch):
    """Read only the first few pieces before a preview is shown; return the windows read."""
    monkeypatch.setattr(large, "FIRST_READ_S", 0.0)
    read_some = core.out_of_core.windows.WindowReader.read_some
    steps = []

    def counted(reader):
        steps.append(reader.window)
        read_some(reader)

    monkeypatch.setattr(core.out_of_core.windows.WindowReader, "read_some", counted)
    return steps


def cancelled(_done, _of):
    """Progress of work that has been cancelled."""
    raise Cancelled


# -- limits ----------------------------------------------------------------------------------------


def test_captures_up_to_the_limit_are_held_in_memory(path, whole, monkeypatch):
    reading = ReadOptions()
    assert file_source(path).large(reading) is not None
    monkeypatch.setenv(LIMIT, str(whole.cube.nbytes))
    source = file_source(path)
    assert source.large(reading) is None
    np.testing.assert_array_equal(source.load(Request(source)).cube, whole.cube)
    monkeypatch.delenv(LIMIT)
    assert 0 < most_whole_bytes() <= large.WHOLE_BYTES


def test_a_format_without_windows_is_refused_with_a_remedy_that_works(whole, small, tmp_path):
    core.save_capture(whole, tmp_path / "b.npz")
    source = file_source(tmp_path / "b.npz")
    with pytest.raises(ValueError, match=r"python -m core export b\.npz b\.zarr") as refused:
        source.load(Request(source))
    assert f"= {whole.cube.nbytes} " in str(refused.value)
    core.save_capture(core.read_capture(tmp_path / "b.npz"), tmp_path / "b.zarr")
    assert file_source(tmp_path / "b.zarr").large(ReadOptions()) is not None


# -- the preview -----------------------------------------------------------------------------------


def test_a_preview_is_read_once_in_growing_parts(path, whole, slow):
    source = file_source(path)
    answers = [compute(ask(source), None)]
    file = answers[0].cutout.file
    progress = []
    while not file.read_on(lambda *done: progress.append(done)):
        answers.append(compute(ask(source), answers[-1]))
    answers.append(compute(ask(source), answers[-1]))
    shares = [answer.cutout.read for answer in answers]
    assert shares[0] == pytest.approx(4 / PIECES) and shares[-1] == 1.0
    assert all(after <= 2.2 * before for before, after in pairwise(shares))
    assert progress[-1] == (PIECES, PIECES + 1)
    assert len(slow) == PIECES / 4  # each once
    rows, cols = answers[-1].cutout.window.picked
    np.testing.assert_array_equal(answers[-1].capture.cube, whole.cube[np.ix_(rows, cols)])
    assert compute(ask(source), answers[-1]).capture is answers[-1].capture


def test_unread_pixels_are_blank(path, slow):
    answer = compute(ask(file_source(path)), None)
    for kind in ("Counts", "Estimate", "Confidence"):
        image, _ = image_of(answer, kind, Viewing(0.0))
        assert np.isfinite(image).sum() <= image.size * 4 / PIECES


def test_reading_ends_when_it_is_cancelled(path, slow):
    file = file_source(path).large(ReadOptions())
    first = file.preview
    with pytest.raises(Cancelled):
        file.read_on(cancelled)
    with pytest.raises(Cancelled):
        file.cutout(Window((0, 20), (0, 20)), cancelled)
    assert len(slow) == 1 and file.preview is first


# -- windows ---------------------------------------------------------------------------------------


def test_a_window_is_read_once_and_has_the_flux_of_the_whole(path, whole, slow):
    source, window = file_source(path), Window((40, 70), (30, 62))
    answer = compute(ask(source, window=window), None)
    assert set(slow) == {window}
    np.testing.assert_array_equal(answer.capture.cube, whole.cube[40:70, 30:62])
    light = core.sampled_flux_prior(core.open_capture(path))
    np.testing.assert_array_equal(flux_prior_of(answer.capture).depth, light.depth)
    slow.clear()
    other = compute(ask(source, window=window, tracking=core.PRESETS["literal"]), answer)
    assert other.capture is answer.capture and slow == []


def test_a_window_beyond_its_limits_is_refused(path):
    file = file_source(path).large(ReadOptions())
    with pytest.raises(ValueError, match=r"pixels of a window = 12288 .* at most 3,072"):
        file.cutout(Window((0, ROWS), (0, COLS)))
    with pytest.raises(ValueError, match=r"rows = \(90, 97\) .*some of 0 to 96"):
        file.cutout(Window((90, 97), (0, 9)))
    assert file.fitting((0, ROWS), (0, COLS)).step == 2


def test_only_one_window_is_kept(path):
    file = file_source(path).large(ReadOptions())
    one, other = (file.cutout(Window((0, 9), (0, end))) for end in (9, 10))
    assert file.cutout(other.window) is other
    assert file.cutout(one.window) is not one


@pytest.mark.parametrize(
    "reduction",
    [
        ReductionSettings(),
        ReductionSettings(skip=2),
        ReductionSettings(pool=3),
        ReductionSettings(skip=3, pool=2),
    ],
)
def test_pixels_know_their_places_in_the_file(path, reduction):
    window = Window((8, 90), (5, 120), 3)
    answer = compute(ask(file_source(path), window=window, reduction=reduction), None)
    rows, cols = np.meshgrid(*window.picked, indexing="ij")
    images = np.stack([rows, cols], axis=2).astype(np.uint32)
    places = core.Capture(images, core.Acquisition(2), detection="all")
    found = reduction.in_bins(2).of(places).cube / reduction.pool**2
    for row, col in ((0, 0), (2, 3)):
        place = answer.grid.place(row, col)
        np.testing.assert_allclose(place, found[row, col], atol=window.step)  # the middle of some
        assert answer.grid.pixel(*place) == (row, col)


def test_a_capture_in_memory_has_its_own_rows_and_columns():
    assert compute(ask("sample"), None).grid == Grid()


def test_a_file_that_is_too_large_is_refused_before_the_server_starts(monkeypatch, capsys):
    monkeypatch.setenv(LIMIT, "1000")
    with pytest.raises(SystemExit):
        main([str(ROOT / "assets" / "sample_capture.npz")])
    said = capsys.readouterr().err
    assert "bytes of counts of sample_capture.npz" in said
    assert "python -m core export sample_capture.npz sample_capture.zarr" in said


# -- typed bounds ----------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["3 to 9", " 3 - 9 ", "3–9", "3:9"])
def test_bounds_are_typed_first_to_last(text):
    assert bounds_of("rows", text, 96) == (3, 10)


@pytest.mark.parametrize("text", ["", "9", "9 to 3", "0 to 96", "-1 to 4", "a to b", "1.5 to 3"])
def test_other_bounds_are_refused(text):
    with pytest.raises(ValueError, match=r"^rows = .*first to last, of 0 to 95"):
        bounds_of("rows", text, 96)


# -- the page, without a browser -------------------------------------------------------------------


@pytest.fixture
def app(path):
    """The app on a large file, its page's thread in the hands of the test."""
    return HeldLayout({"file": file_source(path)} | built_in_sources(), Link({"page": "Explore"}))


def saved_window(app):
    """Return first and last row and column of the image's table, and its number of pixels."""
    table = app.contents["Explore"].image_shown().files["csv"]
    rows, cols, shown, *_ = columns_of(written(table)).values()
    session = app.session
    values, _ = image_of(session.answer, "Estimate", session.state.viewing)
    at = [session.answer.grid.pixel(*each) for each in zip(rows, cols, strict=True)]
    step_m = session.answer.capture.acquisition.bin_length_m / 10  # largest step of a range in CSV
    np.testing.assert_allclose(shown, [values[each] for each in at], atol=step_m / 2)
    return (rows.min(), rows.max()), (cols.min(), cols.max()), rows.size


def test_the_table_of_a_preview_holds_the_pixels_in_view(app):
    session, explore = app.session, app.contents["Explore"]
    app.tasks.run_until(lambda: session.answer.cutout.is_final)
    step = session.answer.grid.step
    assert step > 1
    explore.image.figure.x_range.update(start=60.2, end=90.1)
    _, (first, last), _ = saved_window(app)
    assert 60.2 - step / 2 < first <= 60.2 + step / 2
    assert 90.1 - step / 2 <= last < 90.1 + step / 2


def read_window(app, rows, cols):
    control(app, "Rows shown").value, control(app, "Columns shown").value = rows, cols
    control(app, "Read window").clicks += 1


def test_a_page_reads_on_until_the_preview_is_whole_and_refuses_wrong_bounds(app):
    app.tasks.run_until(lambda: app.session.answer.cutout.is_final)
    assert app.session.answer.cutout.read == 1.0
    assert control(app, "Rows shown").value == f"0 to {ROWS - 1}"
    assert control(app, "Columns shown").value == f"0 to {COLS - 1}"
    cancel = control(app, "Cancel")
    app.tasks.run_until(lambda: cancel.disabled)
    control(app, "Rows shown").value = "90 to 200"
    with pytest.raises(ValueError, match=r"rows = '90 to 200'"):  # Panel hands it to the page
        control(app, "Read window").clicks += 1
    assert app.session.state.window is None


def test_a_window_keeps_the_pixel_and_shows_its_place_in_the_file(app):
    session, explore, cancel = app.session, app.contents["Explore"], control(app, "Cancel")
    app.tasks.run_until(lambda: session.answer.cutout.is_final and cancel.disabled)
    session.choose_pixel(10, 12)
    app.settle()
    place = session.answer.grid.place(10, 12)
    histogram = session.answer.capture.cube[10, 12]
    read_window(app, "30 to 69", "20 to 79")
    assert not cancel.disabled
    app.tasks.run_until(lambda: not session.answer.cutout.is_preview)
    assert session.state.window == session.answer.cutout.window == Window((30, 70), (20, 80))
    assert session.answer.grid.place(*session.state.pixel) == place
    np.testing.assert_array_equal(session.answer.capture.cube[session.state.pixel], histogram)
    assert values_of(explore.numbers)["Pixel"] == "row {}, col {}".format(*place)
    (picture,) = (r for r in explore.image.figure.renderers if "image" in r.data_source.data)
    assert [picture.data_source.data[name][0] for name in ("x", "dw")] == [19.5, 60]
    assert saved_window(app) == ((30, 69), (20, 79), 40 * 60)
    name = downloads.explored(session).file_name("range image", "csv")
    assert "_rows30-69_cols20-79_" in name
    at = "row{} col{}".format(*place)
    assert downloads.pixel_plot(session, explore.signals.histogram, "h").what == f"h {at}"
    control(app, "Show all").clicks += 1
    app.tasks.run_until(lambda: session.answer.cutout.is_preview)
    assert session.state.window is None


def test_reading_ends_when_another_source_is_chosen(app):
    session = app.session
    control(app, "Read window").clicks += 1
    session.state.param.update(source="car")
    app.tasks.run_until(lambda: session.answer.request.source.is_scene)
    app.tasks.run_until(lambda: control(app, "Cancel").disabled)
    app.settle()
    assert session.state.source == "car" and session.state.window is None


def test_a_damaged_part_is_reported_and_the_page_continues(app, path):
    session, cancel = app.session, control(app, "Cancel")
    app.tasks.run_until(lambda: session.answer.cutout.is_final and cancel.disabled)
    before = session.answer
    chunk = path / "counts" / "c" / "0" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-9])
    read_window(app, "0 to 9", "0 to 9")
    app.tasks.run_until(lambda: alert_of(app))
    assert "counts cannot be read" in alert_of(app)
    assert str(path.parent) not in alert_of(app)
    assert session.answer is before and session.state.window is None
    shutil.rmtree(path)
    control(app, "Read window").clicks += 1
    app.tasks.run_until(lambda: "has not gone" in alert_of(app))
    control(app, "l").value = 0.01
    app.tasks.run_until(lambda: session.answer is not before)
    assert session.answer.request.tracking.l == 0.01
