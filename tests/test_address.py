"""Links restore every state; entries that are not accepted are refused with a sentence."""

from __future__ import annotations

from dataclasses import fields, replace
from urllib.parse import parse_qsl

import numpy as np
import pytest

from app.model import text
from app.model.address import LINK_NAMES, Link, defaults, query_of
from app.model.state import Illumination, ReductionSettings, State, Viewing
from app.model.store import built_in_sources
from app.pages.session import Session
from core import TrackingParameters
from core.io import ReadOptions
from tests.states import OTHERWISE, another, link_to, random_state
from tests.threads import HeldLayout, control


def restored(query: str, **own) -> tuple[dict, list[str]]:
    """All parameters as a link gives them, and the sentences on what was refused."""
    link = Link(dict(parse_qsl(query, keep_blank_values=True)))
    before = defaults() | own
    found = before | link.of(before)
    link.refuse_others()
    return found, link.refused


def chosen(state: State) -> dict:
    return {name: getattr(state, name) for name in defaults()}


@pytest.mark.parametrize("name", defaults())
def test_every_parameter_and_field_is_in_the_link(name):
    for value in another(name):
        state = State(**{name: value})
        query = query_of(state, {})
        assert LINK_NAMES.get(name, name) in query
        assert restored(query) == (chosen(state), [])


def test_the_tests_choose_every_read_option():
    for each in fields(ReadOptions):
        assert any(getattr(reading, each.name) is not None for reading in OTHERWISE["reading"])


@pytest.mark.parametrize("seed", range(5))
def test_a_link_restores_random_states(seed):
    state = random_state(np.random.default_rng(seed))
    assert restored(query_of(state, {})) == (chosen(state), [])


def test_defaults_are_left_out_those_of_the_capture_included():
    own = {"pixel": (3, 4), "source": "path 0"}
    assert query_of(State(), {}) == ""
    assert query_of(State(pixel=(3, 4), source="path 0"), own) == ""
    query = query_of(State(pixel=(31, 24)), own)  # the defaults are not this capture's
    assert restored(query, **own)[0]["pixel"] == (31, 24)
    assert restored(query, **own)[0]["source"] == "car"


@pytest.mark.parametrize(
    ("query", "named"),
    [
        ("light.sbr=-1", "sbr = -1"),
        ("light.sbr=NaN", "sbr = 'NaN'"),
        ("light.sbr=1e999", "sbr = '1e999'"),
        ("light.n_pulses=1.5", "n_pulses = 1.5"),
        ("light.n_pulses=true", "n_pulses = True"),
        ("light.n_pulses=" + "9" * 5000, "light.n_pulses = '999"),
        ("light.sbr=[1]", "sbr = (1,)"),
        ('light.sbr={"a":1}', "sbr = {'a': 1}"),
        ("light.srb=1", "Unknown parameter: light.srb"),
        ("tracking.weight=heavy", "weight = 'heavy'"),
        ("tracking.l=__import__('os')", "tracking.l = \"__import__('os')\""),
        ("viewing.least_confidence=", "viewing.least_confidence = ''"),
        ("reading.bin_width_s=wide", "bin_width_s = 'wide'"),
        ("reading.n_bins=-3", "n_bins = -3"),
        ("reading.detection=some", "detection = 'some'"),
        ("page=../../etc/passwd", "page = '../../etc/passwd'"),
        ("image=<img src=x>", "image = '<img src=x>'"),
        ("pixel=[-1,2]", "pixel = (-1, 2)"),
        ("pixel=7", "pixel = 7"),
        ("pins=[[1,2],[1,2],[1,2],[1,2],[1,2]]", "pins"),
        ("region=[[1,2,3]]", "region"),
        ("region=" + "[" * 10_000, "region"),
        ("region=" + "[" * 30_000, "region is not accepted: it has over"),
        ("pixel=20,12", "pixel = '20,12' is not accepted: give a value such as [31,24]."),
        ("absent=[[1]]", "absent"),
        ("absent=everything", "absent"),
        ("difference=1", "difference"),
        ("comparison.methods=[%22magic%22]", "methods = ('magic',)"),
        ("comparison.methods=[[%22peak%22]]", "methods"),
        ("comparison.false_alarm=0", "false_alarm = 0"),
        ("settings.kde.bandwidth_bins=-1", "bandwidth_bins"),
    ],
)
def test_a_bad_entry_is_refused_and_the_others_are_used(query, named):
    found, refused = restored(f"{query}&light.ppp=0.5&reading.n_pulses=77")
    (sentence,) = refused
    assert named in sentence
    expected = defaults() | {"light": Illumination(ppp=0.5), "reading": ReadOptions(n_pulses=77)}
    assert found == expected


# -- a session that opens on a link ----------------------------------------------------------------


def opened(query: str) -> Session:
    return Session(built_in_sources(), link_to(query))


def test_a_session_opens_on_its_link():
    first = opened("source=building&light.sbr=0.2&less.merge=2&less.pool=2&tracking.l=0.006")
    request = first.answer.request
    assert request.source.title.startswith("Building")
    assert request.light == Illumination(sbr=0.2)
    assert request.tracking == TrackingParameters(l=0.006)
    assert request.reduction == ReductionSettings(merge=2, pool=2)
    first.state.param.update(pixel=(3, 5), viewing=Viewing(0.5, 1.5), image="Counts")
    again = opened(first.query())
    assert again.refused == []
    assert again.query() == first.query()
    assert chosen(again.state) == chosen(first.state)
    assert np.array_equal(again.answer.run.image.range_m, first.answer.run.image.range_m)


def test_the_capture_sets_what_the_link_leaves_open():
    building, chosen_view = opened("source=building"), opened("source=building&pixel=[1,2]")
    assert building.query() == "source=building"
    assert building.state.viewing.field_of_view_deg is None
    assert chosen_view.state.pixel == (1, 2)
    half = opened("viewing.least_confidence=0.5")
    assert half.state.viewing == replace(opened("").state.viewing, least_confidence=0.5)


@pytest.mark.parametrize(
    ("query", "named", "kept"),
    [
        ("source=nowhere&less.merge=2", "'nowhere'", "light.seed=3"),
        ("pixel=[70,900]", "", "pixel=[63,63]&light.seed=3"),
        ("pins=[[70,1],[2,3]]", "64 × 64", "light.seed=3&pins=[[2,3]]"),
        ("less.merge=101", "factor = 101", ""),
        ("source=sample&reading.variable=none", "'none'", "source=sample"),
        ("source=sample&image=Truth", "", "light.seed=3&source=sample"),
        ("tracking.weight=heavy", "'heavy'", "light.seed=3"),
        ("unread=source%3Dcar%26less.merge%3D101", "", "light.seed=3"),
    ],
)
def test_a_session_names_what_it_could_not_restore_and_keeps_the_rest(query, named, kept):
    session = opened(f"{query}&light.seed=3")
    assert named in text.not_restored(session.refused)
    assert bool(named) == bool(session.refused)
    assert dict(parse_qsl(session.query())) == dict(parse_qsl(kept))


# -- the history of a session ----------------------------------------------------------------------


def test_a_session_returns_to_what_it_has_shown():
    layout = HeldLayout(built_in_sources())
    session, state = layout.session, layout.session.state
    visited = []

    def note() -> None:
        layout.tasks.run_until(session.is_settled)
        visited.append((session.query(), chosen(state)))

    note()
    state.param.update(light=Illumination(sbr=0.5), pixel=(3, 5))
    note()
    state.param.update(image="Error", viewing=replace(state.viewing, least_confidence=0.3))
    note()
    control(layout, "Scene or capture").value = "sample"  # without truth, with its own pixel
    note()
    state.param.update(page="Compare", method="coates", pins=((1, 2), (3, 4)))
    state.comparison = replace(state.comparison, methods=("peak", "coates"), kind="Confidence")
    note()
    for query, values in (*reversed(visited), visited[-1]):
        session.recall(query)
        layout.tasks.run_until(session.is_settled)
        assert (session.query(), chosen(state)) == (query, values)
        assert control(layout, "Scene or capture").value == state.source
        assert control(layout, "SBR").value == state.light.sbr
        compared = control(layout, "Methods to compare").value
        assert compared == list(state.comparison.methods) or state.page != "Compare"
    assert compared == ["peak", "coates"]
    layout.settle()
    assert {*layout.heard} == {""}
    before = chosen(state)
    session.recall("source=nowhere&light.sbr=2")
    assert layout.heard[-1] == text.source_is_gone("nowhere", session.sources)
    assert chosen(state) == before
    with pytest.raises(KeyError, match="Nowhere"):
        session.recall("page=Nowhere")
    layout.tasks.run_until(session.is_settled)
