"""The Trade-off page: what is measured, what is recommended, what a click opens."""

from __future__ import annotations

import re
import threading
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import expect

from app.model.state import Illumination, Less
from app.model.store import built_in_sources
from app.pages.layout import CUSTOM, Layout
from app.pages.session import Session
from app.pages.shared.studies import OnePiece
from app.pages.tradeoff import ablation_text as requires_words
from app.pages.tradeoff import text as trade_words
from app.pages.tradeoff.ablation import Requires
from app.pages.tradeoff.page import Acquisition, Effort, Swept, Ways, show_point, source_of
from app.pages.tradeoff.sensitivity import Trust
from app.plots import elements as plots
from app.theme import DARK, LIGHT
from core import ESTIMATORS
from core.scene import parts_of
from core.studies.sensitivity.sweep import numbers
from core.studies.tradeoff.measure import Cancelled
from core.studies.tradeoff.pareto import best_within, cheapest_reaching, front
from tests.browser import eventually
from tests.threads import control


def unheard(_done, _of):
    """Nobody looks at the progress."""


def never():
    """Nobody cancels."""
    return False


@pytest.fixture(scope="module")
def measured():
    """A small study of the car, and the page's part that asked for it."""
    ways = Ways(Session(built_in_sources()), lambda point, of: None)
    ways._effort = Effort(repetitions=2, repeats=6, merges="none")
    return ways._work()(unheard, never)


@pytest.fixture
def opened():
    return []


@pytest.fixture
def ways(measured, opened):
    page = Ways(Session(built_in_sources()), lambda point, of: opened.append(point))
    page._arrived(measured)
    return page


# -- long work of one piece ------------------------------------------------------------------------


class Slow:
    """Work that waits for leave to end, and tells what became of it."""

    def __init__(self):
        self.leave, self.ended, self.drawn = threading.Event(), [], []
        self.session = Session(built_in_sources())
        self.piece = OnePiece(self.session, lambda: self.work, self.drawn.append, "steps")

    def work(self, progress, cancelled):
        progress(1, 4)
        while not self.leave.wait(0.005):
            if cancelled():
                self.ended.append("cancelled")
                raise Cancelled
        self.ended.append("done")
        return "result"

    @property
    def sentence(self):
        return self.piece.controls[-1].text


@pytest.fixture
def slow():
    made = Slow()
    yield made
    made.leave.set()


def test_work_is_drawn_once_it_is_done(slow):
    slow.piece.start()
    eventually(lambda: slow.sentence == "1 of 4 steps.")
    slow.leave.set()
    eventually(lambda: slow.drawn == ["result"])
    eventually(lambda: slow.sentence == "Done: 4 steps.")


def test_cancelled_work_ends_and_is_not_drawn(slow):
    complaints = []
    slow.session.failures.shown.subscribe(complaints.append)
    slow.piece.start()
    eventually(lambda: slow.sentence == "1 of 4 steps.")
    slow.piece.cancel()
    assert slow.sentence == "Stopped after 1 of 4 steps."
    eventually(lambda: slow.ended == ["cancelled"])
    slow.piece.start()
    slow.leave.set()
    eventually(lambda: slow.drawn == ["result"])
    assert complaints == []


def test_work_that_fails_says_so():
    session, complaints = Session(built_in_sources()), []
    session.failures.shown.subscribe(complaints.append)

    def fail(progress, cancelled):
        raise ValueError("no such luck.")

    piece = OnePiece(session, lambda: fail, print, "steps")
    piece.start()
    eventually(lambda: complaints and complaints[0].startswith("no such luck."))


def test_a_result_that_cannot_be_drawn_is_told(slow):
    complaints = []
    slow.session.failures.shown.subscribe(complaints.append)
    slow.piece = OnePiece(slow.session, lambda: slow.work, lambda _: 1 / 0, "steps")
    slow.leave.set()
    slow.piece.start()
    eventually(lambda: complaints and "ZeroDivisionError" in complaints[0])


# -- ways to range ---------------------------------------------------------------------------------


def test_the_present_scene_is_measured_in_its_light():
    session = Session(built_in_sources())
    session.state.light = Illumination(sbr=0.2, n_pulses=300)
    eventually(lambda: session.answer.request.light.sbr == 0.2)
    simulation = source_of(session.answer)
    assert (simulation.flux.sbr, simulation.acquisition.n_pulses) == (0.2, 300)
    np.testing.assert_array_equal(simulation.capture(0).cube, session.answer.capture.cube)
    session.state.source = "sample"
    eventually(lambda: session.answer.request.source.title.startswith("Sample"))
    assert source_of(session.answer) is session.answer.whole


def test_the_page_shows_what_core_recommends(ways, measured):
    chosen = ways._plot.source("chosen").data
    found = best_within(measured, 10.0), cheapest_reaching(measured, 0.95)
    assert chosen["x"] == [each.point.milliseconds.value for each in found]
    for sentence, each in zip(ways._advice, found, strict=True):
        assert trade_words.name_of(each.point.candidate) in sentence.text
    assert len(ways._plot.source("points").data["x"]) == len(measured) == len(ESTIMATORS)
    np.testing.assert_allclose(
        ways._plot.source("front").data["x"], [p.milliseconds.value for p in front(measured)]
    )


def test_what_is_asked_moves_the_answer(ways):
    ways._wanted_panel.controls["milliseconds"].value = 1e-1
    assert ways._advice[0].text == "Best within 0.1 ms: none of these ways."
    ways._wanted_panel.controls["rd"].value = 1.0
    assert ways._advice[1].text == "Cheapest that reaches 100 %: none of these ways."
    alone = ways._plot.source("points").data["x"]
    ways._wanted_panel.controls["light"].value = "counted in"
    assert (ways._plot.source("points").data["x"] > alone).all()


def test_every_row_opens_its_own_point(ways, measured, opened):
    for row in ways._table.rows:
        ways._table.acted = [row["key"], 1]
        assert trade_words.name_of(opened[-1].candidate) == row["name"]
        assert len(row["cells"]) == len(trade_words.COLUMNS) - 1
    assert len(opened) == len(measured)
    ways._plot.source("points").selected.indices = [3]
    assert opened[-1] == measured[3]
    assert ways._plot.source("points").selected.indices == []


def test_a_point_is_told_apart_by_colour_and_shape():
    ways = Ways(Session(built_in_sources()), print)
    methods = len(LIGHT.methods) * len(plots.MARKERS)
    assert methods >= len(ESTIMATORS)
    for colors in (DARK, LIGHT):
        ways._paint(colors is DARK)
        assert ways._plot.figure.title.text_color == colors.text


def test_another_capture_makes_it_outdated(ways):
    session = ways._session
    assert "compute again" not in ways._subject.text
    session.state.light = Illumination(seed=3)
    eventually(lambda: session.answer.request.light.seed == 3)
    ways._follow(session.answer)
    assert ways._subject.text.endswith("compute again.")


def test_opening_the_papers_method_sets_the_sliders(measured):
    layout = Layout(built_in_sources())
    (point,) = (p for p in measured if p.candidate.method.estimator == "tracking")
    less = replace(point.candidate, reduction=Less(merge=2).reduction(100))
    measured_on = layout.session.answer.request
    changed = Illumination(sbr=1.0)
    layout.session.state.param.update(light=changed, source="staircase", page="Trade-off")
    show_point(layout.session, replace(point, candidate=less), measured_on)
    assert (layout.session.state.source, layout.session.state.light) == ("car", Illumination())
    assert control(layout, "SBR").value == Illumination().sbr
    assert layout.pages.choice.value == "Explore"
    assert layout.session.state.less == Less(merge=2)
    assert layout.session.state.tracking == less.settings
    assert control(layout, "Preset").value == CUSTOM
    assert control(layout, "T_n").value == less.settings.t_n == 10


def test_opening_another_method_picks_it_in_compare(measured):
    layout = Layout(built_in_sources())
    (point,) = (p for p in measured if p.candidate.method.estimator == "cfar")
    settings = replace(point.candidate.settings, guard_bins=9)
    method = replace(point.candidate.method, settings=settings)
    another = replace(point, candidate=replace(point.candidate, method=method))
    show_point(layout.session, another, layout.session.answer.request)
    assert layout.pages.choice.value == "Compare"
    assert "cfar" in layout.contents["Compare"]._picks.value
    assert layout.contents["Compare"]._tasks["cfar"].settings == settings
    assert layout.contents["Compare"]._own["cfar"].controls["guard_bins"].value == 9


# -- how to acquire --------------------------------------------------------------------------------


def test_what_a_file_seems_to_show_is_acquired_in_other_ways():
    session = Session(built_in_sources())
    session.state.source = "sample"
    eventually(lambda: session.answer.request.source is session.sources["sample"])
    section = Acquisition(session)
    section._swept = Swept(repetitions=2)
    section._show(section._work()(unheard, never))
    assert "the capture has no truth" in section._subject.text
    for each in section._cards:
        drawn = {renderer.name for renderer in each.figure.renderers}
        assert {"theory, light known", "likelihood, simulated band"} <= drawn
    section._paint(True)
    assert section._cards[0].figure.title.text_color == DARK.text


def test_acquiring_can_be_cancelled():
    with pytest.raises(Cancelled):
        Acquisition(Session(built_in_sources()))._work()(unheard, lambda: True)


# -- what the model needs --------------------------------------------------------------------------


@pytest.fixture
def worn():
    session = Session(built_in_sources())
    session.state.source = "worn"
    eventually(lambda: session.answer.request.source is session.sources["worn"])
    return session


def test_parts_and_corrections_are_switched_off_and_on(worn):
    section = Requires(worn)
    before = worn.answer.capture
    names = {row["key"] for row in section._table.rows}
    assert names >= {*parts_of(worn.answer.request.source.scene()), "pile_up"}
    for name in ("faulty_pixels", "pile_up"):
        section._table.acted = [name, 1]
        eventually(lambda name=name: name in worn.answer.request.absent)
    section._follow(worn.answer)
    assert worn.answer.capture.detection == "all"
    assert (worn.answer.capture.counts > 0).all()  # none is dead
    assert (before.counts == 0).any()
    rows = {row["key"]: row for row in section._table.rows}
    assert rows["pile_up"]["action"] == "Switch on"
    assert "hot and dead pixels" in section._subject.text
    for name in ("faulty_pixels", "pile_up"):
        section._table.acted = [name, 2]
        eventually(lambda name=name: name not in worn.answer.request.absent)
    np.testing.assert_array_equal(worn.answer.capture.cube, before.cube)


def test_verdicts_are_those_of_the_scene_in_its_light(worn):
    section = Requires(worn)
    section._judged = replace(section._judged, repetitions=2)
    found = section._work()(unheard, never)
    section._arrived(found)
    rows = {row["key"]: row for row in section._table.rows}
    for each in found:
        assert rows[each.part]["cells"][0][0] == each.verdict
        assert each.why in rows[each.part]["note"]
        assert len(rows[each.part]["cells"]) == len(requires_words.COLUMNS) - 1
    worn.state.light = Illumination(sbr=0.5)
    eventually(lambda: worn.answer.request.light.sbr == 0.5)
    section._follow(worn.answer)
    assert all("message" in row for row in section._table.rows)


# -- how far to trust ------------------------------------------------------------------------------


def test_every_setting_of_a_method_is_swept():
    section = Trust(Session(built_in_sources()))
    view = section.view
    view.show(True)
    eventually(lambda: section._study.controls[-1].text == "Done: 6 settings.")
    fields = [field for method, field, *_ in numbers() if method == "tracking"]
    assert [sweep.parameter for sweep in section._found] == fields
    assert all(each.figure for each in section._cards)
    section._panel.controls["method"].value = ESTIMATORS["kde"].title
    eventually(lambda: section._study.controls[-1].text == "Done: 1 setting.")
    assert [sweep.method for sweep in section._found] == ["kde"]
    section._paint(True)
    assert section._cards[0].figure.title.text_color == DARK.text


# -- in a browser ----------------------------------------------------------------------------------


@pytest.mark.browser
def test_what_is_recommended_is_opened_by_a_click(start_page):
    start_page.get_by_role("button", name="Trade-off", exact=True).click()
    for name, text in (("Repetitions", "2"), ("Rounds of timing", "6")):
        field = start_page.get_by_role("textbox", name=name, exact=True)
        field.fill(text)
        field.press("Enter")
    start_page.get_by_role("button", name=re.compile("^Compute")).press("Enter")
    expect(start_page.get_by_text(re.compile("^Best within 10 ms: "))).to_be_visible()
    expect(start_page.get_by_text(re.compile("^Done: "))).to_be_visible()
    rows = start_page.locator("tbody tr")
    expect(rows).to_have_count(3 * len(ESTIMATORS))
    title = ESTIMATORS["tracking"].title
    start_page.get_by_role("button", name=f"Open: {title}, 2 bins merged", exact=True).press(
        "Enter"
    )
    expect(start_page.get_by_text("50 bins of 2 ns")).to_be_visible()
    expect(start_page.get_by_role("textbox", name="T_n", exact=True)).to_have_value("10")
