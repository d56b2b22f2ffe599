"""True ranges that a user adds to a capture, from its own file or another one."""

from __future__ import annotations

import runpy
from dataclasses import replace
from functools import partial
from io import BytesIO

import numpy as np
import panel as pn
import pytest

import core
from app.model.script import script_of
from app.model.store import file_source
from app.model.uploads import Bounds, Uploads
from app.pages.shared.truth import UNITS
from app.widgets.cards import Part
from tests.states import link_to
from tests.threads import HeldLayout, control


@pytest.fixture(scope="module")
def known():
    """A capture with its truth."""
    scene = core.scenes["car"]()
    return core.simulate(scene, replace(scene.acquisition, n_pulses=300), core.Flux(sbr=1.0))


@pytest.fixture
def uploads():
    """Room for one file: a truth that does not fit makes room for the next."""
    return Uploads(Bounds(session_files=1))


@pytest.fixture
def layout(known, tmp_path, uploads):
    """The page of the same capture without its truth, with the form open."""
    path = tmp_path / "measured.npz"
    core.save_capture(replace(known, truth_range_m=None, signal=None, background=None), path)
    opened = HeldLayout({"measured": file_source(path)}, uploads=uploads)
    (form,) = opened.page.select(
        lambda each: isinstance(each, Part) and each.title == "Truth from a file"
    )
    form.collapsed = False
    opened.session.choose_pixel(20, 30)
    return opened


def upload(layout, array):
    content = BytesIO()
    np.save(content, array)
    control(layout, "Add a truth").param.update(filename="tape.npy", value=content.getvalue())


def is_refused(layout, why):
    """Whether the form says why a truth is refused."""
    texts = [getattr(each, "text", "") for each in layout.page.select()]
    return any(text.startswith("Not added:") and why in text for text in texts)


def is_shown(layout, label):
    """Whether a button is on screen."""
    columns = [each for each in layout.page.select(pn.Column) if each.visible]
    return any(label == getattr(each, "label", None) for one in columns for each in one.select())


def test_an_added_truth_is_scored_linked_and_in_the_script(
    layout, known, uploads, tmp_path, monkeypatch
):
    session, image = layout.session, layout.session.answer.run.image
    assert session.answer.run.figures == {}
    upload(layout, known.truth_range_m)
    layout.tasks.run_until(lambda: is_refused(layout, "“Unit of the truth” is empty"))
    assert session.answer.capture.truth_range_m is None
    control(layout, "Unit of the truth").value = "m"
    layout.tasks.run_until(lambda: session.answer.run.figures)
    assert not is_refused(layout, "")
    assert session.answer.run.figures == core.run(replace(known, signal=None), "tracking").figures
    np.testing.assert_array_equal(session.answer.run.image.bin, image.bin)
    assert session.state.pixel == (20, 30)
    assert control(layout, "Scene or capture").value == session.state.source
    np.save(tmp_path / "tape.npy", known.truth_range_m)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script.py").write_text(script_of(session.answer, session.state), "utf-8")
    found = runpy.run_path("script.py")
    np.testing.assert_array_equal(found["capture"].truth_range_m, known.truth_range_m)
    link = link_to(session.query())
    again = HeldLayout({"measured": session.sources["measured"]}, link, uploads)
    assert again.session.refused == []
    assert again.session.answer.run.figures == session.answer.run.figures


def test_a_map_of_the_same_file_is_offered(known, tmp_path, monkeypatch):
    path, bins = tmp_path / "both.npz", known.acquisition.range_m_to_bin(known.truth_range_m)
    np.savez(path, counts=known.cube, bin=bins, bin_width_s=known.acquisition.bin_width_s)
    opened = HeldLayout({"both": file_source(path)})
    session, label = opened.session, "Use bin as the truth"
    opened.tasks.run_until(lambda: is_shown(opened, label))
    control(opened, label).clicks += 1
    assert not is_shown(opened, label)
    control(opened, UNITS["bins"]).clicks += 1
    opened.tasks.run_until(lambda: session.answer.run.figures)
    found = session.answer.capture.truth_range_m
    np.testing.assert_allclose(found, session.answer.capture.acquisition.bin_to_range_m(bins))
    opened.settle()
    assert not is_shown(opened, label) and not is_shown(opened, UNITS["bins"])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script.py").write_text(script_of(session.answer, session.state), "utf-8")
    scripted = runpy.run_path("script.py")["capture"]
    np.testing.assert_array_equal(scripted.truth_range_m, found)
    link = link_to(session.query())
    again = HeldLayout({"both": file_source(path)}, link)
    assert again.session.refused == []
    assert again.session.answer.run.figures == session.answer.run.figures


def test_a_truth_that_does_not_fit_changes_nothing(layout, known):
    before = layout.session.query()
    control(layout, "Unit of the truth").value = "m"
    for array, why in (
        (known.truth_range_m[1:], "shape (63, 64)"),
        (np.full((64, 64), 5000.0), "targets within the gate"),
        (np.full((64, 64), "far"), "real numbers"),
    ):
        upload(layout, array)
        layout.tasks.run_until(partial(is_refused, layout, why))
    assert layout.session.query() == before
    assert layout.session.answer.capture.truth_range_m is None
