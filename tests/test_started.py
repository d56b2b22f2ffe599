"""Files and reading options with which the app is started."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import csc_array

from app.__main__ import main, parser_of_arguments, readable
from app.model.reading import options_in_use
from app.model.script import script_of
from app.model.store import built_in_sources
from app.model.truth import with_chosen_truth
from app.pages.session import Session
from core.io import ReadOptions
from tests.browser import eventually
from tests.states import link_to
from tests.threads import HeldLayout, control

CUBE = np.random.default_rng(2).poisson(0.3, (4, 6, 40))


@pytest.fixture
def paths(tmp_path):
    """A file that is no capture, one that does not exist, and a capture."""
    (tmp_path / "broken.npz").write_bytes(b"no capture")
    np.savez(tmp_path / "day.npz", day=CUBE, night=CUBE)
    return [tmp_path / name for name in ("broken.npz", "absent.mat", "day.npz")]


def test_files_that_cannot_be_read_are_reported_and_the_others_are_served(paths, capsys):
    files = readable(paths, ReadOptions(variable="day", bin_width_s=64e-12))
    assert [source.title for source in files.values()] == ["day.npz"]
    said = capsys.readouterr()
    assert "variable day" in said.out
    assert [line.partition(": ")[0] for line in said.err.splitlines()] == ["Not opened"] * 2
    assert "broken.npz" in said.err and "absent.mat" in said.err


def test_options_hold_until_others_are_chosen(paths):
    files = readable(paths, ReadOptions(variable="day", bin_width_s=64e-12))
    session = Session(files | {"car": built_in_sources()["car"]})
    assert session.answer.capture.acquisition.bin_width_s == 64e-12
    assert session.state.reading == ReadOptions()
    used = options_in_use(session.answer)
    assert (used["bin_width_s"], used["axes"]) == ("64 ps", "row col bin")
    assert used["variable"] == "day"
    pulse = session.answer.capture.pulse
    assert float(used["pulse"].split()[0]) * 1e-12 == pytest.approx(pulse.sigma_s, rel=1e-3)
    assert 'variable="day")' in script_of(session.answer, session.state)
    session.state.reading = ReadOptions(bin_width_s=1e-9)
    eventually(lambda: session.answer.capture.acquisition.bin_width_s == 1e-9)
    assert "variable day" in session.answer.capture.source


def test_a_file_of_several_arrays_is_served_and_the_page_asks_for_one(tmp_path, capsys):
    path = tmp_path / "two.mat"
    sparse = csc_array(CUBE.reshape(24, 40).astype(float))
    savemat(path, {"spad": sparse, "rates": CUBE / 7.0})
    files = readable([path], ReadOptions())
    said = capsys.readouterr().err
    assert "The page asks: two.mat: --variable is missing: give spad or rates" in said
    layout = HeldLayout(files | built_in_sources())
    assert layout.session.answer.request.source.title == "Car at 50 m"
    assert layout.alert.text == "Two arrays of two.mat could be the capture. Which?"
    layout = HeldLayout(files | built_in_sources(), link_to(layout.session.query()))
    assert "Two arrays of two.mat" in layout.alert.text  # a reload asks again
    control(layout, "rates").clicks += 1
    layout.tasks.run_until(lambda: "give whole counts" in layout.alert.text)
    control(layout, "spad").clicks += 1  # the question stays
    answer = layout.next_answer()
    assert answer.request.source.title == "two.mat"
    assert answer.capture.counts.sum() == CUBE.sum()
    assert layout.session.state.page == "Inspect"
    again = Session(files | built_in_sources(), link_to(layout.session.query()))
    assert again.answer.request.source.title == "two.mat"
    assert again.refused == [] and again.estimate.refused is None


def test_the_page_asks_whether_an_array_holds_raw_frames(tmp_path):
    rng, path = np.random.default_rng(4), tmp_path / "frames.npy"
    bins = np.where(rng.random((200, 16, 16)) < 0.5, 30, rng.integers(1, 60, (200, 16, 16)))
    fired = rng.random(bins.shape) < 0.3
    np.save(path, np.where(fired, bins, 0).astype(np.uint8))
    layout = HeldLayout(readable([path], ReadOptions()) | built_in_sources())
    assert layout.alert.text.startswith("frames.npy seems to hold raw frames (pulse, row, col)")
    assert control(layout, "Counts").visible
    control(layout, "Raw frames").clicks += 1
    answer = layout.next_answer()
    assert answer.capture.counts.sum() == fired.sum()
    assert answer.capture.acquisition.n_pulses == 200
    assert options_in_use(answer)["axes"] == "pulse row col"


def test_without_a_readable_file_each_is_reported_and_nothing_is_served(paths, capsys):
    with pytest.raises(SystemExit, match="2"):
        main([*map(str, paths), "--bins", "41", "--variable", "day"])
    said = capsys.readouterr().err
    assert all(path.name in said for path in paths)
    assert "--bins = 41" in said


def test_a_truth_is_added_to_each_capture_that_it_fits(paths, tmp_path, capsys):
    truth_m, small = np.full((4, 6), 3.0), tmp_path / "small.npz"
    np.savez(paths[2], day=CUBE, depth_m=truth_m)
    np.savez(small, day=CUBE[1:])
    np.save(tmp_path / "tape.npy", truth_m)
    options = ReadOptions(variable="day", bin_width_s=1e-9)
    for given, title, origin in (
        (["--truth", str(tmp_path / "tape.npy"), "--truth-unit", "m"], "tape.npy", "tape.npy"),
        (["--truth-variable", "depth_m"], "depth_m", "day.npz, variable depth_m"),
    ):
        chosen = parser_of_arguments().parse_args(given)
        files = readable([paths[2], small], options, partial(with_chosen_truth, chosen))
        (source,) = files.values()
        assert source.title == f"day.npz with {title}"
        assert f"truth: {origin}, in m" in source.read().source
        np.testing.assert_array_equal(source.read().truth_range_m, truth_m)
        assert capsys.readouterr().err.startswith("Not opened: ")


def test_a_truth_without_a_capture_is_refused(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["--truth", "tape.npy"])
    assert "a scene has its own truth" in capsys.readouterr().err


def test_a_link_opens_the_same_file_or_none(paths, tmp_path):
    options = ReadOptions(variable="day")
    linked = Session(readable(paths[2:], options) | built_in_sources()).query()
    assert linked.startswith("source=day.npz")
    (tmp_path / "moved").mkdir()
    np.savez(tmp_path / "moved" / "first.npz", day=CUBE[:2])
    same = shutil.copy(paths[2], tmp_path / "moved")
    files = readable([tmp_path / "moved" / "first.npz", Path(same)], options) | built_in_sources()
    again = Session(files, link_to(linked))
    assert again.refused == []
    assert again.answer.request.source.title == "day.npz"
    np.savez(same, day=CUBE + 1)
    files = readable([Path(same)], options) | built_in_sources()
    (refused,) = Session(files, link_to(linked)).refused
    assert "to another 'day.npz' than the one here" in refused
