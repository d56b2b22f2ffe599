"""Captures of a folder that are opened as they are written."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest

import core
from app.model.store import built_in_sources
from app.model.watched import MOST_CAPTURES, WatchedFolder
from app.pages.layout import Arrivals
from tests.threads import HeldLayout, control


def capture(counts, seed=0):
    """A small capture whose detections tell it from others."""
    cube = np.random.default_rng(seed).poisson(counts, (6, 7, 40)).astype(np.uint16)
    return core.Capture(cube, core.Acquisition(40, 1e-9, n_pulses=1000))


def write(folder, name, counts=1.0, at_s=0):
    """Write a capture at a time after the others."""
    path = folder / name
    core.save_capture(capture(counts), path, overwrite=True)
    os.utime(path, (at_s, at_s))
    return path


def titles(arrival):
    return [source.title for source in arrival.found.values()]


def test_a_capture_is_found_once_when_it_is_written(tmp_path):
    write(tmp_path, "old.npz", at_s=1)
    write(tmp_path, "newest.npz", at_s=2)
    (tmp_path / "notes.txt").write_text("no capture")
    folder = WatchedFolder(tmp_path)
    assert titles(folder.look()) == ["newest.npz"]
    assert folder.look() is None
    whole = write(tmp_path, "next.npz", at_s=3).read_bytes()
    half = tmp_path / "half.npz"
    half.write_bytes(whole[: len(whole) // 2])
    (tmp_path / ".hidden.npz").write_bytes(whole)
    assert folder.look() is None  # they may still grow
    half.write_bytes(whole[: len(whole) * 2 // 3])
    assert titles(folder.look()) == ["next.npz"]
    arrival = folder.look()  # two thirds of a file cannot be read
    assert (titles(arrival), len(arrival.refused)) == ([], 1)
    assert arrival.refused[0].startswith("half.npz")
    assert folder.look() is None
    half.write_bytes(whole)
    assert folder.look().refused == ()  # what was said of the file no longer holds
    ((key, source),) = folder.look().found.items()
    assert (source.title, source.read().counts.sum()) == ("half.npz", capture(1.0).counts.sum())
    write(tmp_path, "next.npz", counts=2.0, at_s=5)  # the same name, another capture
    folder.look()
    ((other, source),) = folder.look().found.items()
    assert source.title == "next.npz" and other != key
    half.unlink()
    assert folder.look() is None
    half.write_bytes(b"no archive")
    assert folder.look() is None
    assert len(folder.look().refused) == 1
    half.unlink()
    assert (folder.look().refused, folder.look()) == ((), None)


def test_a_capture_of_several_arrays_is_offered_since_the_page_asks_for_one(tmp_path):
    folder = WatchedFolder(tmp_path)
    cube = capture(1.0).cube
    np.savez(tmp_path / "two.npz", day=cube, night=cube)
    assert titles(folder.look() or folder.look()) == ["two.npz"]


def test_a_folder_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"watch = .*nowhere"):
        WatchedFolder(tmp_path / "nowhere")


def test_an_open_page_follows_with_its_settings_unless_it_should_not(tmp_path):
    arrivals, folder = Arrivals(), WatchedFolder(tmp_path)
    served = dict(
        arriving(folder, tmp_path, 0).found
    )  # what a page that is opened later is offered
    layout = HeldLayout(served | built_in_sources(), arrivals=arrivals)
    session, state = layout.session, layout.session.state
    state.param.update(pixel=(2, 5), method="coates", reduction=replace(state.reduction, merge=2))
    layout.tasks.run_until(session.is_settled)

    def arrive(number):
        arrival = arriving(folder, tmp_path, number)
        arrival.update(served)
        arrivals.emit(arrival)
        return arrival.found[arrival.newest]

    second = arrive(1)
    layout.tasks.run_until(lambda: session.answer.request.source is second)
    assert (state.pixel, state.method, state.reduction.merge) == ((2, 5), "coates", 2)
    assert session.answer.capture.cube.shape == (6, 7, 20)
    (tmp_path / "bad.npz").write_bytes(b"no archive")
    arrivals.emit(folder.look() or folder.look())
    layout.settle()
    sentence = layout.alert.text
    assert "watched folder. bad.npz" in sentence and str(tmp_path) not in sentence
    assert session.answer.request.source is second
    assert HeldLayout(served | built_in_sources(), arrivals=arrivals).alert.text == sentence
    session.choose_pixel(0, 0)  # other actions keep the message
    assert layout.alert.text == sentence
    (tmp_path / "bad.npz").unlink()
    arrivals.emit(folder.look())
    layout.settle()
    assert layout.alert.text == ""
    assert session.answer.request.source is second
    control(layout, "Follow new captures").value = False
    shown = state.source
    for number in range(2, MOST_CAPTURES + 3):
        arrive(number)
    layout.settle()
    assert (state.source, layout.alert.text) == (shown, "")
    newest = {f"capture {number}.npz" for number in range(3, MOST_CAPTURES + 3)}
    offered = {*control(layout, "Scene or capture").options}
    assert {title for title in offered if title.startswith("capture")} == newest | {second.title}
    assert {source.title for source in served.values()} == newest


def arriving(folder, path, number):
    """Return the arrival of one more capture that was written to the folder."""
    write(path, f"capture {number}.npz", counts=1.0 + number / 100, at_s=number)
    return folder.look() or folder.look()
