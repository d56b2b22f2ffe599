"""Uploaded files are kept while a session uses them, within limits, and deleted afterwards."""

from __future__ import annotations

import gc
import re
import tempfile
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from app.model.script import script_of
from app.model.store import Request, built_in_sources
from app.model.uploads import Bounds, Uploads, safe_name
from core import Acquisition, Capture, save_capture
from core.io import ReadOptions
from tests.states import link_to
from tests.threads import HeldLayout, control


class Session:
    """A user of files."""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The folder for temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def stored(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*/*"))


@pytest.fixture
def content(tmp_path_factory):
    return saved(tmp_path_factory.mktemp("made") / "small.npz").read_bytes()


def saved(path: Path, source: str = "made") -> Path:
    cube = np.random.default_rng(3).poisson(5, (4, 6, 37)).astype(np.uint16)
    save_capture(Capture(cube, Acquisition(37, 2e-9, 1e-6, None, 1e-3), source=source), path)
    return path


def load(source, reading: ReadOptions | None = None) -> Capture:
    return source.load(Request(source, reading=reading or ReadOptions()))


def test_a_file_is_deleted_with_its_last_user_and_loaded_once_for_all(folder, content):
    uploads, first, other = Uploads(), Session(), Session()
    key = uploads.add({"mine.npz": content}, first)
    source = uploads.use(key, other)
    capture = load(source)
    assert (source.title, capture.shape) == ("mine.npz", (4, 6))
    assert load(uploads.use(key, first)) is capture
    assert load(source, ReadOptions(bin_width_s=1e-9)) is not capture
    uploads.leave(first)
    assert stored(folder) == ["mine.npz"]
    uploads.leave(other)
    assert list(folder.iterdir()) == []
    assert uploads.use(key, other) is None


def test_files_that_differ_in_numbers_open_as_one_sequence_and_others_one_by_one(content):
    uploads = Uploads()
    layout = HeldLayout(built_in_sources(), uploads=uploads)
    names = ["run_10_a.npz", "run_2_a.npz", "run_7_a.npz"]
    button = control(layout, "Open a capture file")
    button.param.update(filename=names, value=[content] * 3)
    answer = layout.next_answer()
    single = load(uploads.use(uploads.add({"one.npz": content}, layout), layout))
    assert answer.whole.n_records == 3
    assert np.array_equal(answer.whole.cube, 3 * single.cube)
    assert "run_*_a.npz" in script_of(answer, layout.session.state)
    again = HeldLayout(built_in_sources(), link_to(layout.session.query()), uploads)
    assert again.session.answer.whole.n_records == 3
    button.param.update(filename=["day.npz", "night.npz"], value=[content] * 2)
    assert layout.next_answer().request.source.title == "day.npz"
    titles = [source.title for source in layout.session.sources.values()]
    assert titles[-3:] == ["run_*_a.npz", "day.npz", "night.npz"]


def test_a_file_is_read_or_refused_by_its_content_whatever_its_name(content):
    layout = HeldLayout(built_in_sources(), uploads=Uploads())
    button, before = control(layout, "Open a capture file"), layout.session.answer
    assert not button.accept  # else the browser drops other files without a message
    button.param.update(filename=["notes.txt"], value=[b"nothing of the kind"])
    assert layout.next_answer() is before
    assert "notes.txt" in layout.alert.text
    assert "still shows the last settings" in layout.alert.text
    button.param.update(filename=["capture.dat"], value=[content])
    assert layout.next_answer().request.source.title == "capture.dat"
    assert layout.alert.text == ""


def test_files_that_could_not_be_read_make_room_for_the_next(folder, content):
    layout = HeldLayout(built_in_sources(), uploads=Uploads(Bounds(session_files=2)))
    session, button = layout.session, control(layout, "Open a capture file")
    button.param.update(filename=["first.npz"], value=[content])
    layout.next_answer()
    link = ""
    for name in ("notes.txt", "more.txt"):
        button.param.update(filename=[name], value=[b"nothing of the kind"])
        layout.tasks.run_until(lambda name=name: name in layout.alert.text)
        link = link or session.query()
    assert stored(folder) == ["first.npz", "more.txt"]
    session.recall(link)  # as by Undo
    layout.settle()
    assert session.estimate.refused is None
    button.param.update(filename=["last.npz"], value=[content])
    assert layout.next_answer().request.source.title == "last.npz"
    assert stored(folder) == ["first.npz", "last.npz"]
    offered = control(layout, "Scene or capture").options
    assert {"first.npz", "last.npz"} <= {*offered} and not {"notes.txt", "more.txt"} & {*offered}


def test_a_file_that_could_be_read_is_kept_when_other_options_are_refused(folder, content):
    layout = HeldLayout(built_in_sources(), uploads=Uploads(Bounds(session_files=2)))
    session, button = layout.session, control(layout, "Open a capture file")
    button.param.update(filename=["first.npz"], value=[content])
    layout.next_answer()
    key = session.state.source
    session.go_on_with("wall")
    layout.settle()
    session.recall(f"source={key}&reading.variable=none")
    layout.tasks.run_until(lambda: session.estimate.refused is not None)
    button.param.update(filename=["last.npz"], value=[content])
    assert layout.next_answer().request.source.title == "last.npz"
    assert stored(folder) == ["first.npz", "last.npz"]
    session.go_on_with(key)
    assert layout.next_answer().request.source.title == "first.npz"


def test_an_estimate_that_arrives_after_an_upload_does_not_open_inspect():
    sources, has_begun = built_in_sources(), Event()

    def load(request):
        has_begun.set()
        return wall.load(request)

    wall = sources["wall"]
    layout = HeldLayout(sources | {"wall": replace(wall, load=load)}, uploads=Uploads())
    control(layout, "Scene or capture").value = "wall"
    while not has_begun.wait(0.1):  # else the upload would replace it
        if not layout.tasks.waiting.empty():
            layout.tasks.run_one()
    button = control(layout, "Open a capture file")
    button.param.update(filename=["notes.txt"], value=[b"nothing of the kind"])
    layout.tasks.run_until(lambda: layout.session.estimate.refused)
    assert layout.session.answer.request.source.title == "Oblique wall"
    assert layout.session.state.page == "Explore"


def test_the_question_about_an_upload_is_asked_again_after_a_reload(tmp_path):
    cube = np.ones((4, 6, 37), np.uint8)
    np.savez(tmp_path / "two.npz", spad=cube, rates=cube / 7)
    uploads = Uploads()
    layout = HeldLayout(built_in_sources(), uploads=uploads)
    session, before = layout.session, layout.session.query()
    content = (tmp_path / "two.npz").read_bytes()
    button = control(layout, "Open a capture file")
    button.param.update(filename=["two.npz"], value=[content])
    layout.tasks.run_until(lambda: session.estimate.refused)
    link = session.query()
    again = HeldLayout(built_in_sources(), link_to(link), uploads)
    assert again.alert.text == "Two arrays of two.npz could be the capture. Which?"
    control(again, "spad").clicks += 1
    answer = again.next_answer()
    assert (answer.request.source.title, answer.capture.counts.sum()) == ("two.npz", cube.sum())
    assert (again.session.state.page, again.session.state.unread) == ("Inspect", "")
    session.recall(before)  # as by Undo
    assert (session.query(), layout.alert.text) == (before, "")
    session.recall(link)
    assert session.query() == link and control(layout, "rates")
    for user in (layout, again):
        uploads.leave(user)
    gone = HeldLayout(built_in_sources(), link_to(link), uploads)
    assert "upload the file again" in gone.alert.text


@pytest.mark.parametrize("collected", ["session", "uploads"])
def test_files_are_deleted_with_a_forgotten_session_and_with_the_process(
    folder, content, collected
):
    owners = {"uploads": Uploads(), "session": Session()}
    owners["uploads"].add({"mine.npz": content}, owners["session"])
    del owners[collected]
    gc.collect()
    if "uploads" in owners:
        owners["uploads"].leave(Session())
    assert list(folder.iterdir()) == []


def test_keys_cannot_be_guessed(folder, content):
    uploads, session = Uploads(), Session()
    keys = {uploads.add({"mine.npz": content}, session) for _ in range(5)}
    assert len(keys) == 5
    assert all(re.fullmatch(r"[\w-]{22}", key) for key in keys)
    for guess in ("", "mine.npz", "../mine.npz", "file 1"):
        assert uploads.use(guess, session) is None


@pytest.mark.parametrize(
    ("bounds", "sessions", "named"),
    [
        (Bounds(file_bytes=9), [0], "size of the file"),
        (Bounds(session_files=2), [0, 0, 0], "files of this page = 3"),
        (Bounds(session_bytes=29), [0, 0, 0], "size of the files of this page"),
        (Bounds(all_files=2), [0, 1, 2], "files of all pages = 3"),
        (Bounds(all_bytes=29), [0, 1, 2], "size of the files of all pages"),
    ],
)
def test_a_limit_that_is_exceeded_is_named_until_a_user_leaves(folder, bounds, sessions, named):
    uploads, users = Uploads(bounds), [Session() for _ in range(3)]
    for user in sessions[:-1]:
        uploads.add({"a.npz": bytes(10)}, users[user])
    before = stored(folder)
    with pytest.raises(ValueError, match=named):
        uploads.add({"a.npz": bytes(10)}, users[sessions[-1]])
    assert stored(folder) == before
    if before:
        uploads.leave(users[0])
        uploads.add({"a.npz": bytes(10)}, users[sessions[-1]])


def test_a_full_disk_leaves_nothing_behind(folder, content, monkeypatch):
    def fail(_path, _content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="No space"):
        Uploads().add({"mine.npz": content}, Session())
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("21km_K11_night.mat", "21km_K11_night.mat"),
        ("../../etc/passwd", "passwd"),
        ("..\\..\\boot.ini", "boot.ini"),
        ("..", "upload"),
        ("", "upload"),
        (".npz", "npz"),
        ("<img src=x onerror=alert(1)>.mat", "_img_src_x_onerror_alert_1_.mat"),
        ("a\x00b\nc.npz", "a_b_c.npz"),
        ("x" * 300 + ".npz", "x" * 76 + ".npz"),
    ],
)
def test_a_stored_name_has_harmless_characters_only(name, kept):
    assert safe_name(name) == kept
