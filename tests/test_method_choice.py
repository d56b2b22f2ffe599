"""The choice of the estimator on Explore and Inspect, without a browser."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import core
from app.model.address import Link
from app.model.colors import image_of
from app.model.state import AUTOMATIC
from app.model.store import built_in_sources, file_source
from core.io import save_capture
from tests.threads import HeldLayout, control


@pytest.fixture(scope="module")
def layout():
    return HeldLayout(built_in_sources())


@pytest.fixture(scope="module")
def counted(tmp_path_factory):
    """A file with all photons of each pulse."""
    scene = core.scenes["car"]()
    capture = core.simulate(scene, scene.acquisition, core.Flux(0.1, 1.0), seed=1)
    path = tmp_path_factory.mktemp("counted") / "counted.npz"
    save_capture(replace(capture, detection="all"), path)
    return path


def choose(layout, method):
    """Choose a method, unless an earlier test has."""
    if control(layout, "Method").value != method:
        control(layout, "Method").value = method
        layout.next_answer()
    return layout.session.answer


@pytest.mark.parametrize("method", [name for name in core.ESTIMATORS if name != "tracking"])
def test_every_method_can_be_explored(layout, method):
    answer = choose(layout, method)
    layout.settle()
    expected = core.estimate(answer.capture, method, answer.settings)  # the layout is shared
    np.testing.assert_array_equal(answer.run.image.range_m, expected.range_m)
    explore = layout.contents["Explore"]
    assert [card.visible for card in explore.cards] == [True, False, False, True]
    row, col = layout.session.state.pixel
    score = core.ESTIMATORS[method].curves(answer.capture, row, col, answer.settings)
    drawn = explore.signals.score.source("enhanced").data["score"]
    np.testing.assert_array_equal(drawn, score.astype(np.float32))
    vertical = explore.signals.score.figure.y_range
    assert vertical.start < score.max() < vertical.end
    shown = explore.image_shown()
    assert shown.subject.estimator == method
    assert f"_{method}_" in shown.subject.file_name(shown.what, "png")
    values, _ = image_of(answer, "Estimate", layout.session.state.viewing)
    assert np.isfinite(values).any() == (answer.run.image.confidence >= 0.9).any()


def test_settings_belong_to_the_method_and_stay_when_it_changes(layout):
    choose(layout, "cfar")
    control(layout, "Guard").value = 5
    answer = layout.next_answer()
    assert answer.settings == core.ESTIMATORS["cfar"].parameters(guard_bins=5)
    assert choose(layout, "peak").settings == core.ESTIMATORS["peak"].parameters()
    assert choose(layout, "cfar").settings.guard_bins == 5
    query = layout.session.query()
    assert "method=cfar" in query
    assert "settings.cfar.guard_bins=5" in query


def test_settings_of_another_method_compute_nothing(layout):
    before = choose(layout, "peak")
    state = layout.session.state
    state.tracking = replace(state.tracking, l=0.0071)
    assert layout.next_answer().run is before.run


def test_the_tracking_differentiator_has_its_own_part_where_it_is_shown(layout):
    state = layout.session.state
    part = layout.page.select(lambda each: getattr(each, "title", "") == "Tracking differentiator")
    choose(layout, "peak")
    assert [each.visible for each in part] == [False]
    state.page = "Compare"
    assert [each.visible for each in part] == [True]
    state.page = "Explore"
    choose(layout, "tracking")
    assert [each.visible for each in part] == [True]
    explore = layout.contents["Explore"]
    layout.settle()
    assert [card.visible for card in explore.cards] == [True, True, True, False]


def test_counted_photons_start_with_the_likelihood_and_say_why(counted):
    layout = HeldLayout({"file": file_source(counted)} | built_in_sources())
    assert layout.session.state.method == AUTOMATIC
    assert layout.session.answer.method == "likelihood"
    note = layout.page.select(lambda each: "all photons" in str(getattr(each, "text", "")))
    assert any("Likelihood, fluxes estimated" in each.text for each in note)
    assert "method" not in layout.session.query()
    control(layout, "Scene or capture").value = "car"
    assert layout.next_answer().method == "tracking"


def test_a_method_that_lacks_data_is_refused_and_the_menu_returns(counted, tmp_path):
    read = core.read_capture(counted)
    blind = replace(read, signal=None, background=None)
    save_capture(blind, tmp_path / "blind.npz")
    layout = HeldLayout({"file": file_source(tmp_path / "blind.npz")})
    before = layout.session.answer
    control(layout, "Method").value = "oracle"
    assert layout.next_answer() is before
    assert "signal" in layout.heard[-1]
    assert control(layout, "Method").value == AUTOMATIC


@pytest.mark.parametrize("beginning", ["settings", "comparison.settings"])
def test_links_of_the_last_release_still_set_a_methods_settings(beginning):
    entries = {"method": "kde", f"{beginning}.kde.bandwidth_bins": "0.7"}
    layout = HeldLayout(built_in_sources(), Link(entries))
    assert layout.session.refused == []
    assert layout.session.answer.settings.bandwidth_bins == 0.7
    cards = layout.contents["Explore"].cards  # built for a method without stages
    assert [card.visible for card in cards] == [True, False, False, True]
