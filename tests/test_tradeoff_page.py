"""The Trade-off page: its studies, what they recommend, and what a point opens."""

from __future__ import annotations

import math
import re
import threading
from dataclasses import replace

import numpy as np
import pytest
from playwright.sync_api import expect

from app.model.state import Illumination, ReductionSettings
from app.model.store import built_in_sources, scene_source
from app.pages.layout import CUSTOM, Layout
from app.pages.session import Session
from app.pages.shared.downloads import looked_at
from app.pages.shared.outputs import table_of
from app.pages.shared.section import Repetitions
from app.pages.shared.studies import OnePiece
from app.pages.tradeoff import ablation_text, text
from app.pages.tradeoff.ablation import AblationSection, Verdicts
from app.pages.tradeoff.acquisition import AcquisitionSection
from app.pages.tradeoff.sensitivity import SensitivitySection
from app.pages.tradeoff.speed import Effort, SpeedSection, show_point, source_of
from app.plots import elements as plots
from app.tasks.scheduler import Cancelled
from app.theme import DARK, LIGHT
from core import ESTIMATORS
from core.scene import parts_of
from core.studies.ablation import Requirement
from core.studies.outputs import Table
from core.studies.sensitivity import numbers
from core.studies.tradeoff import best_within, cheapest_reaching, pareto_front
from core.studies.trials import default_methods
from tests.browser import chosen, eventually
from tests.threads import HeldTasks, change, control


def ignored(_done, _of):
    """Progress that nobody reads."""


def cancelled(_done, _of):
    """Progress of work that has been cancelled."""
    raise Cancelled


def small_sources():
    """Built-in scenes and captures after one of few pixels, which is studied in less time."""
    return {"small": scene_source("Few pixels", "staircase", size=24)} | built_in_sources()


@pytest.fixture
def session():
    """A session on few pixels, its page's thread in the hands of the test."""
    return Session(small_sources(), tasks=HeldTasks())


@pytest.fixture(scope="module")
def found():
    """A small study of few pixels, after its request and its effort.

    Its times are 1, 2, ... ms: measured ones depend on what else the machine does.
    """
    section = SpeedSection(Session(small_sources()))
    section.change(Effort(repetitions=2, repeats=6, merges="none"))
    *asked, points = section.work()(ignored)
    timed = [
        replace(point, seconds=(n * 1e-3,) * len(point.seconds))
        for n, point in enumerate(points, 1)
    ]
    return *asked, timed


@pytest.fixture
def measured(found):
    return found[-1]


@pytest.fixture
def section(found, session):
    made = SpeedSection(session)
    made.draw((session.answer.request, *found[1:]))
    return made


# -- long work of one piece ------------------------------------------------------------------------


class Piece:
    """Work that waits for leave to end, and notes what became of it."""

    def __init__(self, draw=None):
        self.leave, self.drawn, self.shown = threading.Event(), [], []
        session = Session(small_sources())
        session.failures.shown.subscribe(self.shown.append)
        self.piece = OnePiece(session, lambda: self.work, draw or self.drawn.append, "steps")

    def work(self, progress):
        progress(1, 4)
        while not self.leave.wait(0.005):
            progress(1, 4)
        return "result"

    @property
    def sentence(self):
        return self.piece.controls[-1].text


def test_cancelled_work_is_not_drawn_and_the_next_is():
    work = Piece()
    work.piece.start()
    eventually(lambda: work.sentence == "1 of 4 steps.")
    _, bar, _ = work.piece.controls
    assert bar.value == 25
    work.piece.cancel()
    assert work.sentence == "Stopped after 1 of 4 steps."
    work.piece.start()
    work.leave.set()
    eventually(lambda: work.sentence == "Done: 4 steps.")
    assert bar.value == 100
    assert work.drawn == ["result"]
    assert work.shown == []


def test_a_result_that_cannot_be_drawn_is_reported():
    work = Piece(draw=lambda _: 1 / 0)
    work.leave.set()
    work.piece.start()
    eventually(lambda: work.shown and "ZeroDivisionError" in work.shown[-1])


@pytest.mark.parametrize(
    ("section_of", "study", "not_begun", "counted"),
    [
        (SpeedSection, "speed.study", text.NOT_MEASURED, "images"),
        (AcquisitionSection, "acquisition.acquisition_sweeps", text.NOT_SIMULATED, "captures"),
    ],
)
def test_a_failed_study_says_so_and_starts_on_another_capture(
    session, monkeypatch, section_of, study, not_begun, counted
):
    def fail(*_, **__):
        raise ValueError("Not today.")

    with monkeypatch.context() as failing:
        failing.setattr(f"app.pages.tradeoff.{study}", fail)
        section = section_of(session)
        session.estimate.changed.subscribe(section.follow)
        section.show(True)
        assert section.subject.text == not_begun
        session.tasks.run_until(lambda: section.study.has_failed)
        assert section.subject.text == text.FAILED
        change(session, method="peak")  # on the same capture
        assert section.subject.text == text.FAILED
    change(session, source="wall")
    assert section.subject.text == not_begun
    session.tasks.run_until(lambda: counted in section.study.sentence.text)
    section.study.cancel()


# -- speed and accuracy ----------------------------------------------------------------------------


def test_the_present_scene_is_measured_with_its_flux(session):
    change(session, light=Illumination(sbr=0.2, n_pulses=300))
    simulation = source_of(session.answer)
    assert (simulation.flux.sbr, simulation.acquisition.n_pulses) == (0.2, 300)
    np.testing.assert_array_equal(simulation.capture(0).cube, session.answer.capture.cube)
    change(session, source="sample")
    assert source_of(session.answer) is session.answer.whole


def test_the_page_shows_what_core_recommends(section, measured):
    recommended = best_within(measured, 10.0), cheapest_reaching(measured, 0.95)
    chosen = [each.point.milliseconds.value for each in recommended]
    assert section.plot.source("chosen").data["x"] == chosen
    for sentence, each in zip(section.advice, recommended, strict=True):
        assert text.name_of(each.point.candidate) in sentence.text
    assert len(section.plot.source("points").data["x"]) == len(measured) == len(default_methods())
    pareto = [point.milliseconds.value for point in pareto_front(measured)]
    np.testing.assert_allclose(section.plot.source("front").data["x"], pareto)


def test_progress_is_on_the_page_until_there_are_results(session):
    section = SpeedSection(session)
    (_, progress, *_), _ = section.layout()
    section.study.sentence.text = "1 of 9 images."
    assert (progress.text, progress.visible) == ("1 of 9 images.", True)


def test_the_goal_changes_the_recommendation(section):
    goal = section.goal.controls
    goal["milliseconds"].value = 1e-1
    assert section.advice[0].text == "Most accurate within 0.1 ms: no configuration."
    goal["rd"].value = 1.0
    assert section.advice[1].text.startswith("Fastest with 100 % within 3 bins: Image posterior,")
    excluded = section.plot.source("points").data["x"]
    goal["flux"].value = "included"
    assert (section.plot.source("points").data["x"] > excluded).all()


def test_every_row_and_point_opens_its_configuration(section, measured, session):
    for row in section.table.rows:
        section.table.acted = [row["key"], 1]
        candidate = measured[row["key"]].candidate
        assert text.name_of(candidate) == row["name"]
        assert len(row["cells"]) == len(text.COLUMNS) - 1
        assert session.state.page == "Explore"
        assert session.state.method == candidate.method.estimator
    session.state.page = "Trade-off"
    section.plot.source("points").selected.indices = [3]
    assert session.state.page != "Trade-off"
    assert section.plot.source("points").selected.indices == []


def test_every_method_has_a_colour_and_a_shape_of_its_own(section):
    assert len(LIGHT.methods) * len(plots.MARKERS) >= len(ESTIMATORS)
    for colors in (DARK, LIGHT):
        section.paint(colors is DARK)
        data = section.plot.source("points").data
        assert len({*zip(data["color"], data["marker"], strict=True)}) == len(default_methods())
        assert section.plot.figure.title.text_color == colors.text


def test_another_capture_makes_the_study_outdated(section, session):
    section.follow(session.answer)
    assert "has changed" not in section.subject.text
    change(session, light=Illumination(seed=3))
    section.follow(session.answer)
    assert "has changed" in section.subject.text


def test_opening_the_papers_method_sets_the_sliders(measured):
    layout = Layout(small_sources())
    (point,) = (p for p in measured if p.candidate.method.estimator == "tracking")
    merged = replace(point.candidate, reduction=ReductionSettings(merge=2).in_bins(100))
    measured_on = layout.session.answer.request
    changed = Illumination(sbr=1.0)
    layout.session.state.param.update(light=changed, source="staircase", page="Trade-off")
    show_point(layout.session, replace(point, candidate=merged), measured_on)
    state = layout.session.state
    assert (state.source, state.light) == ("small", Illumination())
    assert (state.reduction, state.tracking) == (ReductionSettings(merge=2), merged.settings)
    assert layout.pages.choice.value == "Explore"
    assert control(layout, "SBR").value == Illumination().sbr
    assert control(layout, "Preset").value == CUSTOM
    assert control(layout, "T_n").value == merged.settings.t_n == 10


def test_any_method_is_shown_on_explore(measured):
    layout = Layout(small_sources())
    (point,) = (p for p in measured if p.candidate.method.estimator == "cfar")
    settings = replace(point.candidate.settings, guard_bins=9)
    method = replace(point.candidate.method, settings=settings)
    another = replace(point, candidate=replace(point.candidate, method=method))
    show_point(layout.session, another, layout.session.answer.request)
    assert layout.pages.choice.value == "Explore"
    answer = layout.session.answer
    assert (answer.method, answer.settings) == ("cfar", settings)
    assert control(layout, "Method").value == "cfar"
    assert control(layout, "Guard").value == 9


# -- acquisition -----------------------------------------------------------------------------------


def test_a_simulation_like_a_file_is_acquired_in_other_ways(session):
    change(session, source="sample")
    section = AcquisitionSection(session)
    section.draw(section.work()(ignored))
    assert "the capture has no truth" in section.subject.text
    change(session, method="peak")
    section.follow(session.answer)
    assert text.OUTDATED not in section.subject.text
    change(session, source="small")
    section.follow(session.answer)
    assert section.subject.text.endswith(text.OUTDATED)
    for each in section.cards:
        drawn = {renderer.name for renderer in each.figure.renderers}
        assert {"theory, flux known", "likelihood, simulated band"} <= drawn
    section.paint(True)
    assert section.cards[0].figure.title.text_color == DARK.text


def test_the_simulation_can_be_cancelled(session):
    with pytest.raises(Cancelled):
        AcquisitionSection(session).work()(cancelled)


# -- ablation --------------------------------------------------------------------------------------


@pytest.fixture
def ablation(session):
    section = AblationSection(session)
    section.change(Repetitions())
    session.estimate.changed.subscribe(section.follow)
    return section


def rows_of(section):
    return {row["key"]: row for row in section.table.rows}


def test_parts_and_corrections_are_switched_off_and_on(ablation, session):
    change(session, source="worn")  # a car seen by a worn instrument
    names, before = ("faulty_pixels", "pile_up"), session.answer.capture
    assert rows_of(ablation).keys() >= {*parts_of(session.answer.request.source.scene()), *names}
    for name in names:
        ablation.table.acted = [name, 1]
        session.tasks.run_until(lambda name=name: name in session.answer.request.absent)
    assert session.answer.capture.detection == "all"
    assert (session.answer.capture.counts > 0).all()  # no dead pixels
    assert (before.counts == 0).any()
    assert rows_of(ablation)["pile_up"]["action"] == "Switch on"
    assert "hot and dead pixels" in ablation.subject.text
    for name in names:
        ablation.table.acted = [name, 2]
        session.tasks.run_until(lambda name=name: name not in session.answer.request.absent)
    np.testing.assert_array_equal(session.answer.capture.cube, before.cube)


def test_verdicts_are_those_of_the_scene_with_its_flux(ablation, session):
    verdicts = ablation.work()(ignored)
    ablation.draw(verdicts)
    rows = rows_of(ablation)
    for each in verdicts.found:
        assert rows[each.part]["cells"][0][0] == each.verdict
        assert each.why in rows[each.part]["note"]
        assert len(rows[each.part]["cells"]) == len(ablation_text.COLUMNS) - 1
    assert "has changed" not in ablation.subject.text


def test_verdicts_of_another_scene_or_flux_are_outdated(ablation, session):
    before = session.answer.request
    seen = Requirement("pile_up", "needed", "why", effect=0.5, smallest_effect=0.1, p_value=1e-3)
    verdicts = Verdicts(before, 2, (seen,))
    ablation.draw(verdicts)
    for changed in ({"light": Illumination(sbr=0.5)}, {"source": "worn"}):
        change(session, **changed)
        ablation.draw(verdicts)  # of the scene before: it ends late
        assert rows_of(ablation)["pile_up"]["cells"][0][0] == "needed"
        of_before = f"Few pixels, SBR 0.06, 2 repetitions. {text.OUTDATED}"
        assert ablation.subject.text == of_before
        assert ablation.about().source == looked_at(session, before).source
    assert rows_of(ablation)["jitter"]["message"] == "Not studied yet."
    change(session, source=session.key(before.source), light=before.light)
    assert ablation.subject.text == "Few pixels, SBR 0.06, 2 repetitions."


def test_a_row_of_a_capture_shows_the_effect_and_the_smallest_that_is_seen():
    seen = Requirement("jitter", "needed", "why", effect=0.5, smallest_effect=0.1, p_value=1e-3)
    missed = replace(seen, verdict="cannot tell", smallest_effect=math.inf)
    rows = [ablation_text.row("jitter", each, False, False) for each in (seen, missed)]
    assert [[cell[0] for cell in row["cells"][1:3]] for row in rows] == [
        ["50.0 %", "10.0 %"],
        ["50.0 %", "–"],
    ]


# -- sensitivity -----------------------------------------------------------------------------------


def test_every_setting_of_a_method_is_swept(session):
    section = SensitivitySection(session)
    section.show(True)
    sentence = section.study.controls[-1]
    session.tasks.run_until(lambda: sentence.text == "Done: 6 settings.")
    fields = [field for method, field, *_ in numbers() if method == "tracking"]
    assert [sweep.parameter for sweep in section.found] == fields
    assert all(each.figure for each in section.cards)
    section.panel.controls["method"].value = ESTIMATORS["kde"].title
    session.tasks.run_until(lambda: sentence.text == "Done: 1 setting.")
    assert [sweep.method for sweep in section.found] == ["kde"]
    section.paint(True)
    assert section.cards[0].figure.title.text_color == DARK.text


# -- in a browser ----------------------------------------------------------------------------------


def open_a_configuration(here):
    """Open a configuration of the study with which the page starts."""
    # On the page and in the sidebar.
    done = here.get_by_text(re.compile("^Done: ")).first
    expect(done).to_be_visible(timeout=300_000)  # 120 images, on a machine that may be busy
    expect(here.get_by_text("2 repetitions, 6 timing rounds")).to_be_visible()
    expect(here.get_by_text(re.compile("^Most accurate within 10 ms: "))).to_be_visible()
    expect(here.locator("tbody tr")).to_have_count(len(default_methods()))
    open_other = f"Open: {ESTIMATORS['cfar'].title}"
    here.get_by_role("button", name=open_other, exact=True).press("Enter")
    expect(chosen(here, "Method")).to_have_text(ESTIMATORS["cfar"].title)


def test_a_table_of_settings_has_their_symbols():
    rows = (("tracking", "alpha"), ("tracking", "t_n"), ("likelihood", "steps_per_bin"))
    _, shown = table_of(Table("ranges", "Ranges", ("method", "parameter"), rows))
    assert [row["cells"][0][0] for row in shown] == ["α", "T_n", "Steps per bin"]
