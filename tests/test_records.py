"""A file that is a sequence in time, stepped through in the app."""

from __future__ import annotations

import numpy as np
import pytest

import core
from app.__main__ import readable
from app.model.capture_defaults import possible_kinds
from app.model.colors import map_of
from app.model.state import Viewing
from app.model.store import Request, built_in_sources, compute, file_source
from app.pages.inspect import text
from app.pages.inspect.results import inspect_pixel
from app.pages.session import Session
from core.io import ReadOptions
from tests.states import link_to
from tests.threads import HeldLayout, control


def labels(holder):
    """The labels of what a column holds."""
    return {getattr(each, "label", None) for each in getattr(holder, "objects", ())}


@pytest.fixture
def log(real_capture):
    return real_capture("tmf8829_log.json.gz")


def test_records_are_stepped_through_and_added_up(log):
    layout = HeldLayout({"log": file_source(log)} | built_in_sources())
    player, everything = control(layout, "Record"), control(layout, "All records")
    added = layout.session.answer.capture.cube
    assert player.end + 1 == layout.session.answer.whole.n_records == 26
    player.value = 3
    answer = layout.next_answer()
    assert answer.request.reading.records == 3
    np.testing.assert_array_equal(answer.whole.cube, core.read_capture(log, records=3).cube)
    assert "reading.records=3" in layout.session.query()
    everything.clicks += 1
    answer = layout.next_answer()
    assert answer.request.reading.records is None
    np.testing.assert_array_equal(answer.whole.cube, added)


def test_files_of_one_pattern_are_stepped_through(tmp_path):
    cube = np.random.default_rng(0).poisson(0.3, (4, 6, 40)).astype(np.uint16)
    for n in range(3):
        np.savez(tmp_path / f"run_{n}.npz", cube=cube + n)
    files = readable([tmp_path / "run_*.npz"], ReadOptions())
    layout = HeldLayout(files)
    assert control(layout, "Record").end == 2
    control(layout, "Record").value = 1
    np.testing.assert_array_equal(layout.next_answer().whole.cube, cube + 1)
    again = Session(files, link_to(layout.session.query()))
    assert again.refused == []
    np.testing.assert_array_equal(again.answer.whole.cube, cube + 1)


def test_the_player_is_shown_for_sequences_alone(log):
    layout = HeldLayout(built_in_sources() | {"log": file_source(log)})

    def is_shown():
        holders = layout.page.select(lambda each: labels(each) & {"Record"})
        return any(each.visible for each in holders)

    assert not is_shown()
    for source, is_sequence in (("log", True), ("sample", False), ("log", True), ("car", False)):
        control(layout, "Scene or capture").value = source
        layout.next_answer()
        assert is_shown() == is_sequence


def test_distances_of_the_sensor_are_shown_beside_the_estimates(log):
    answer = compute(Request(file_source(log)), None)
    assert "Reported" in possible_kinds(answer)["map"]
    values, look = map_of(answer, "Reported", Viewing())
    np.testing.assert_array_equal(values, answer.capture.reported_range_m)
    assert look.legend == "Distance reported by the sensor (m)"
    facts = {name: value for name, value, _ in text.facts(inspect_pixel(answer, 0, 3), "m")}
    assert facts["Reported"].value == values[0, 3]
    difference_m = answer.run.image.range_m[0, 3] - values[0, 3]
    assert facts["Estimate − reported"].value == pytest.approx(difference_m)
    assert abs(difference_m) < answer.capture.acquisition.bin_length_m
    sample = compute(Request(built_in_sources()["sample"]), None)
    assert "Reported" not in possible_kinds(sample)["map"]
