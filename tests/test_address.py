"""The address of a page: all that is chosen, and back; nonsense is refused in words."""

from __future__ import annotations

from dataclasses import fields, replace
from urllib.parse import parse_qsl

import numpy as np
import pytest

from app.model import text as words
from app.model.address import Wanted, defaults, query_of
from app.model.state import Illumination, Less, State, Viewing
from app.model.store import built_in_sources
from app.pages.session import Session
from core import TrackingParameters
from core.io import ReadOptions
from tests.states import OTHERWISE, another, random_state

# -- every parameter -------------------------------------------------------------------------------


def restored(query: str, **own) -> tuple[dict, list[str]]:
    """All parameters, as the query of an address gives them, and what was refused."""
    wanted = Wanted(dict(parse_qsl(query, keep_blank_values=True)))
    before = defaults() | own
    found = before | wanted.of(before)
    wanted.refuse_others()
    return found, wanted.refused


def chosen(state: State) -> dict:
    return {name: getattr(state, name) for name in defaults()}


def test_a_page_on_which_nothing_is_chosen_has_a_bare_address():
    assert query_of(State(), {}) == ""


@pytest.mark.parametrize("name", defaults())
def test_every_parameter_has_its_place_in_the_address(name):
    """Fails for a new parameter, or a new field of one, that an address cannot hold."""
    for value in another(name):
        state = State(**{name: value})
        query = query_of(state, {})
        assert name in query
        assert restored(query) == (chosen(state), [])


def test_every_word_on_a_file_is_among_what_the_tests_choose():
    for each in fields(ReadOptions):
        assert any(getattr(reading, each.name) is not None for reading in OTHERWISE["reading"])


@pytest.mark.parametrize("seed", range(20))
def test_an_address_gives_any_state_again(seed):
    state = random_state(np.random.default_rng(seed))
    assert restored(query_of(state, {})) == (chosen(state), [])


def test_what_the_capture_brings_is_not_told():
    own = {"pixel": (3, 4), "source": "path 0"}
    assert query_of(State(pixel=(3, 4), source="path 0"), own) == ""
    query = query_of(State(pixel=(31, 24)), own)  # the defaults are not this capture's
    assert restored(query, **own)[0]["pixel"] == (31, 24)
    assert restored(query, **own)[0]["source"] == "car"


# -- what comes from outside -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("query", "named"),
    [
        ("light.sbr=-1", "sbr = -1"),
        ("light.sbr=nan", "light.sbr = 'nan'"),
        ("light.sbr=NaN", "sbr = 'NaN'"),
        ("light.sbr=1e999", "sbr = '1e999'"),
        ("light.n_pulses=1.5", "n_pulses = 1.5"),
        ("light.n_pulses=true", "n_pulses = True"),
        ("light.n_pulses=" + "9" * 5000, "light.n_pulses = '999"),
        ("light.sbr=[1]", "sbr = (1,)"),
        ('light.sbr={"a":1}', "sbr = {'a': 1}"),
        ("light.srb=1", "nothing called light.srb"),
        ("sauce=car", "nothing called sauce"),
        ("tracking.weight=heavy", "weight = 'heavy'"),
        ("tracking.l=__import__('os')", "tracking.l = \"__import__('os')\""),
        ("less.merge=0", "merge = 0"),
        ("viewing.least_confidence=", "viewing.least_confidence = ''"),
        ("reading.bin_width_s=wide", "bin_width_s = 'wide'"),
        ("reading.n_bins=-3", "n_bins = -3"),
        ("reading.detection=some", "detection = 'some'"),
        ("page=../../etc/passwd", "page = '../../etc/passwd'"),
        ("image=<img src=x>", "image = '<img src=x>'"),
        ("pixel=[1.5,2]", "pixel = (1.5, 2)"),
        ("pixel=[-1,2]", "pixel = (-1, 2)"),
        ("pixel=7", "pixel = 7"),
        ("pins=[[1,2],[1,2],[1,2],[1,2],[1,2]]", "pins"),
        ("region=[[1,2,3]]", "region"),
        ("region=" + "[" * 10_000, "region"),
        ("region=" + "[" * 30_000, "region is not accepted: it has over"),
        ("absent=[1]", "absent"),
        ("absent=[[1]]", "absent"),
        ("absent=everything", "absent"),
        ("difference=maybe", "difference"),
        ("difference=1", "difference"),
        ("comparison.methods=[%22magic%22]", "methods = ('magic',)"),
        ("comparison.methods=[[%22peak%22]]", "methods"),
        ("comparison.false_alarm=0", "false_alarm = 0"),
        ("comparison.settings.kde.bandwidth_bins=-1", "bandwidth_bins"),
    ],
)
def test_what_is_out_of_range_or_nonsense_is_refused_and_the_rest_kept(query, named):
    found, refused = restored(f"{query}&light.ppp=0.5&reading.n_pulses=77")
    (sentence,) = refused
    assert named in sentence
    expected = defaults() | {"light": Illumination(ppp=0.5), "reading": ReadOptions(n_pulses=77)}
    assert found == expected


# -- a session that opens on an address ------------------------------------------------------------


def opened(query: str) -> Session:
    return Session(built_in_sources(), Wanted(dict(parse_qsl(query))))


def test_a_session_opens_on_what_its_address_asks_for():
    first = opened("source=building&light.sbr=0.2&less.merge=2&less.pool=2&tracking.l=0.006")
    assert first.answer.request.source.title.startswith("Building")
    assert first.answer.request.light == Illumination(sbr=0.2)
    assert first.answer.request.tracking == TrackingParameters(l=0.006)
    assert first.answer.request.less == Less(merge=2, pool=2)
    first.state.param.update(pixel=(3, 5), viewing=Viewing(0.5, 1.5), image="Counts")
    again = opened(first.query())
    assert again.refused == []
    assert again.query() == first.query()
    assert chosen(again.state) == chosen(first.state)
    assert np.array_equal(again.answer.run.image.range_m, first.answer.run.image.range_m)


def test_what_a_capture_brings_is_left_to_it_unless_it_is_chosen():
    building, chosen_view = opened("source=building"), opened("source=building&pixel=[1,2]")
    assert building.query() == "source=building"
    assert building.state.viewing.field_of_view_deg == building.own_field_of_view_deg != 5.0
    assert chosen_view.state.pixel == (1, 2)
    half = opened("viewing.least_confidence=0.5")
    assert half.state.viewing == replace(opened("").state.viewing, least_confidence=0.5)


@pytest.mark.parametrize(
    ("query", "told", "kept"),
    [
        ("source=nowhere&less.merge=2", "no scene or capture 'nowhere'", "light.seed=3"),
        ("pixel=[70,900]", "", "pixel=[63,63]&light.seed=3"),
        ("pins=[[70,1],[2,3]]", "pins outside", "light.seed=3&pins=[[2,3]]"),
        ("less.merge=101", "factor = 101", ""),
        ("source=sample&reading.variable=none", "'none'", "source=sample"),
        ("source=sample&image=Truth", "", "light.seed=3&source=sample"),
        ("tracking.weight=heavy", "'heavy'", "light.seed=3"),
    ],
)
def test_what_cannot_be_had_is_told_and_the_rest_is_there(query, told, kept):
    session = opened(f"{query}&light.seed=3")
    assert told in words.not_restored(session.refused)
    assert bool(told) == bool(session.refused)
    assert dict(parse_qsl(session.query())) == dict(parse_qsl(kept))
