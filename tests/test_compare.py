"""The Compare page: methods side by side, without a browser and in one."""

from __future__ import annotations

import re
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

import core
from app.model.state import CLOUDS, FIRST_METHODS, Illumination, Less
from app.model.store import Request, built_in_sources, compute
from app.pages.compare import ranking
from app.pages.compare import text as ranking_words
from app.pages.compare.page import MOST_PICTURES, Compare
from app.pages.compare.ranking import Result, Task
from app.pages.session import Session
from app.theme import DARK, LIGHT, RANGE_COLORS, method_style
from core import ESTIMATORS, TrackingParameters
from core.io import ReadOptions
from tests.browser import eventually, fact
from tests.threads import HeldTasks

# -- what is computed ------------------------------------------------------------------------------


def answer_to(source):
    request = Request(
        built_in_sources()[source], Illumination(), ReadOptions(), TrackingParameters(), Less()
    )
    return compute(request, None)


@pytest.fixture(scope="module")
def car():
    return answer_to("car")


@pytest.fixture(scope="module")
def sample():
    """A file, without truth."""
    return answer_to("sample")


def task_of(method, **options):
    return Task(method, ESTIMATORS[method].parameters(), **options)


def test_the_explored_answer_is_not_computed_again(car):
    assert ranking.run_task(Task("tracking", car.request.tracking), car).answer is car
    other = Task("tracking", car.request.tracking, false_alarm=0.1)
    assert ranking.run_task(other, car).answer.run.image.valid.mean() < 0.7


def test_a_verdict_is_that_of_the_metrics(car):
    found = ranking.run_task(task_of("peak"), car)
    truth_m, bin_m = car.capture.truth_range_m, car.capture.acquisition.bin_length_m
    range_m = core.estimate(car.capture, "peak").range_m
    for tolerance, interval in zip((1, 2, 3), found.verdict.within, strict=True):
        degree = core.metrics.restoration_degree(range_m, truth_m, tolerance * bin_m)
        assert interval.low < interval.value == degree < interval.high
    assert found.verdict.detection.recall == 1.0
    assert found.verdict.detection.precision == pytest.approx(np.isfinite(truth_m).mean())


def test_pixels_without_a_target_count_as_wrong_in_the_reliability(car):
    told, right = ranking.reliability(car)
    assert told.size == right.size > 1
    assert np.all(np.diff(told) > 0)
    image, truth_m = car.run.image, car.capture.truth_range_m
    least_sure = image.valid & (image.confidence < 0.1)
    near = np.abs(image.range_m - truth_m) <= 3 * car.capture.acquisition.bin_length_m
    assert right[0] == pytest.approx(near[least_sure].mean())


def test_curves_run_from_their_median_to_one_at_their_maximum(car):
    tasks = {method: task_of(method) for method in ESTIMATORS}
    curves = ranking.score_curves(car.capture, tasks, 32, 30)
    assert curves.keys() == ESTIMATORS.keys()
    for curve in curves.values():
        assert curve.shape == (car.capture.acquisition.n_bins,)
        assert (np.median(curve), curve.max()) == pytest.approx((0, 1))


def test_the_limit_is_told_where_truth_and_light_are_known(car, sample):
    known, unknown = ranking.yardstick(car.capture), ranking.yardstick(sample.capture)
    assert known.limit is not None
    assert known.likelihood is None
    assert unknown.limit is None
    assert unknown.likelihood is not None
    last = ranking_words.rows(sample.capture, {}, {}, unknown, {})[-1]
    assert last["message"].startswith("Not known")
    facts = {name: value for name, value, _ in ranking_words.pixel_facts(sample, unknown, 3, 4)}
    assert facts["Limit: found"] == facts["Limit: spread"] == "not known"
    assert "Truth" not in facts


def test_without_truth_agreement_is_told_and_called_so(sample):
    measure = ranking.yardstick(sample.capture)
    task = task_of("likelihood")
    found = {task: ranking.run_task(task, sample)}
    style = {"likelihood": method_style(0, LIGHT)}
    row, _ = ranking_words.rows(sample.capture, {"likelihood": task}, found, measure, style)
    titles = [title for title, *_ in ranking_words.columns(sample.capture)]
    assert "RMSE (m)" not in titles
    assert row["cells"][titles.index("Agreement, not accuracy") - 1][0] == "100.0 %"


def test_every_row_has_a_cell_for_every_column(car):
    tasks = {"peak": task_of("peak"), "oracle": task_of("oracle")}
    found = {task: ranking.run_task(task, car) for task in tasks.values()}
    style = {method: method_style(n, LIGHT) for n, method in enumerate(tasks)}
    rows = ranking_words.rows(car.capture, tasks, found, ranking.yardstick(car.capture), style)
    n_cells = len(ranking_words.columns(car.capture)) - 1
    assert [len(row["cells"]) for row in rows] == [n_cells] * 3


def test_reconstructions_are_marked():
    rows = ranking_words.rows(
        answer_to("uniform").capture,
        {method: task_of(method) for method in ESTIMATORS},
        {},
        None,
        {method: method_style(n, LIGHT) for n, method in enumerate(ESTIMATORS)},
    )
    for row, estimator in zip(rows, ESTIMATORS.values(), strict=False):
        assert bool(row["note"]) == bool(estimator.reconstructed)


def test_methods_are_told_apart_by_colour_and_dashes():
    for colors in (LIGHT, DARK):
        styles = [str(method_style(place, colors)) for place in range(len(ESTIMATORS))]
        assert len(set(styles)) == len(styles)


# -- the page --------------------------------------------------------------------------------------


class Stage:
    """A Compare page whose thread is the test's own."""

    def __init__(self):
        self.tasks = HeldTasks()
        self.session = Session(built_in_sources(), tasks=self.tasks)
        self.page = Compare(self.session)
        self.view = self.page.view
        self.view.paint(False)
        self.session.estimate.changed.subscribe(self.view.follow)

    def act(self):
        self.tasks.run_one()

    def change(self, **chosen):
        """Have the session answer another request."""
        before = self.session.answer
        self.session.state.param.update(**chosen)
        while self.session.answer is before:
            self.act()

    def settle(self):
        """Let the page do all that is to be done."""
        while self.page._is_busy or self.page._measure is None:
            self.act()
        while not self.tasks.waiting.empty():
            self.act()

    @property
    def names(self):
        return [row["name"] for row in self.page._table.rows]

    @property
    def figures(self):
        return {row["name"]: row["cells"] for row in self.page._table.rows if row.get("cells")}


@pytest.fixture
def stage():
    return Stage()


def test_nothing_is_computed_before_the_page_is_seen(stage):
    assert stage.tasks.waiting.empty()
    assert not stage.page._is_busy
    stage.view.show(True)
    stage.settle()
    titles = [ESTIMATORS[m].title for m in ESTIMATORS if m in FIRST_METHODS]
    assert stage.names == [*titles, "Physics’ limit"]
    assert list(stage.figures) == stage.names
    assert stage.page._status.text == "5 methods compared"


def test_pictures_share_one_view(stage):
    stage.view.show(True)
    stage.settle()
    figures = [picture.image.figure for picture in stage.page._pictures]
    assert len(figures) == 5
    assert len({id(figure.x_range) for figure in figures}) == 1
    assert len({id(figure.y_range) for figure in figures}) == 1
    assert len(figures[0].x_range.renderers) == 5


def test_only_what_is_missing_is_computed(stage, monkeypatch):
    ran = []
    run_task = ranking.run_task
    monkeypatch.setattr(
        "app.pages.compare.page.run_task",
        lambda task, of: (ran.append(task.method), run_task(task, of))[1],
    )
    stage.view.show(True)
    stage.settle()
    ran.clear()
    stage.page._picks.value = [*stage.page._picks.value, "matched_filter"]
    stage.settle()
    assert ran == ["matched_filter"]
    panel = stage.page._panels["likelihood"]
    panel.collapsed = False
    (depths,) = panel.select(lambda each: getattr(each, "label", "") == "Depths")
    depths.value = "learned"
    stage.settle()
    assert ran == ["matched_filter", "likelihood"]
    stage.view.show(False)
    stage.page._false_alarm.value = 0.1
    assert stage.tasks.waiting.empty()
    stage.view.show(True)
    stage.settle()
    assert len(ran) == 2 + 6


def test_another_capture_makes_all_of_it_outdated(stage):
    stage.view.show(True)
    stage.settle()
    before = stage.figures
    stage.change(light=Illumination(seed=5))
    stage.settle()
    assert stage.figures.keys() == before.keys()
    changed = {name for name in before if stage.figures[name] != before[name]}
    assert changed == before.keys() - {"Physics’ limit"}  # of the same scene in the same light


def test_cancel_stops_before_the_next_method_and_goes_on(stage):
    stage.view.show(True)
    stage.act()
    stage.page._stop_or_go_on()
    while stage.page._is_busy:
        stage.act()
    while not stage.tasks.waiting.empty():
        stage.act()
    done = sum(isinstance(each, Result) for each in stage.page._results.values())
    assert stage.page._status.text == f"Stopped: {done} of 5 done"
    assert done < 5
    assert stage.page._stop.label == "Go on"
    stage.page._stop_or_go_on()
    stage.settle()
    assert stage.page._status.text == "5 methods compared"
    assert not stage.page._stop.visible


def test_a_method_that_fails_says_so_and_the_others_go_on(stage, monkeypatch):
    run_task = ranking.run_task

    def fail(task, of):
        if task.method == "coates":
            raise ValueError("no such luck.")
        return run_task(task, of)

    monkeypatch.setattr("app.pages.compare.page.run_task", fail)
    stage.view.show(True)
    stage.settle()
    coates = ESTIMATORS["coates"].title
    (row,) = (row for row in stage.page._table.rows if row["name"] == coates)
    assert row["message"] == "Not possible here: no such luck."
    assert len(stage.figures) == 5
    assert len(stage.page._pictured()) == 4


def test_a_file_has_no_oracle_no_limit_and_no_errors(stage):
    stage.change(source="sample")
    stage.view.show(True)
    stage.settle()
    messages = {row["name"]: row.get("message", "") for row in stage.page._table.rows}
    assert "true signal" in messages[ESTIMATORS["oracle"].title]
    assert messages["Physics’ limit"].startswith("Not known")
    assert "Error" not in stage.page._kind.options
    assert "agreement, not accuracy" in stage.page._remarks.text
    assert stage.page._no_reliability.visible
    assert not stage.page._reliability.pane.visible


def test_all_methods_fit_in_the_table_and_the_first_six_have_pictures(stage):
    stage.page._picks.value = list(ESTIMATORS)
    stage.view.show(True)
    stage.settle()
    assert stage.page._status.text == f"{len(ESTIMATORS)} methods compared"
    assert len(stage.page._pictures) == MOST_PICTURES
    assert f"first {MOST_PICTURES}" in stage.page._remarks.text
    assert len(stage.page._curves._lines.source.data["title"]) == len(ESTIMATORS)


def test_no_method_at_all_is_asked_for_kindly(stage):
    stage.page._picks.value = []
    stage.view.show(True)
    stage.settle()
    assert stage.page._status.text == "Pick at least one method"


@pytest.mark.parametrize("key", built_in_sources())
def test_every_source_can_be_shown_in_every_way(stage, key):
    stage.view.show(True)
    stage.settle()
    if key != "car":
        stage.change(source=key)
    stage.settle()
    for kind in stage.page._kind.options:
        stage.page._kind.value = kind
    assert stage.page._kind.value == CLOUDS
    clouds = [picture.cloud for picture in stage.page._pictures if picture.cloud is not None]
    assert all(cloud.positions for cloud in clouds)
    assert len({tuple(cloud.bounds) for cloud in clouds}) == 1
    stage.view.paint(True)
    assert all(cloud.dark for cloud in clouds)


# -- in a browser ----------------------------------------------------------------------------------


@pytest.fixture
def here(start_page):
    """The Compare page with five methods of the car."""
    start_page.get_by_role("button", name="Compare", exact=True).click()
    expect(start_page.get_by_text("5 methods compared")).to_be_visible()
    expect(start_page.get_by_role("checkbox")).to_have_count(len(ESTIMATORS))
    start_page.wait_for_function("Bokeh.documents[0].is_idle")
    return start_page


def press(page, name):
    page.get_by_role("button", name=name, exact=True).click()


def open_source(page, title):
    page.get_by_role("combobox", name=re.compile("^Scene or capture")).click()
    page.get_by_role("menuitem", name=title, exact=True).click()


def pictures(page):
    """The part of the page with the pictures."""
    return page.get_by_role("application", name=re.compile("^Pictures of the methods"))


def colors_of(part):
    picture = np.asarray(Image.open(BytesIO(part.screenshot())).convert("RGB")).reshape(-1, 3)
    return {"#{:02x}{:02x}{:02x}".format(*color) for color in np.unique(picture, axis=0).tolist()}


def first_row(page):
    return page.locator("tbody tr").first.locator("th")


@pytest.mark.browser
def test_five_methods_stand_side_by_side(here):
    expect(here.locator("tbody").first.locator("tr")).to_have_count(5)
    eventually(lambda: len(colors_of(pictures(here)) & set(RANGE_COLORS)) > 50)
    another = here.get_by_role("checkbox", name="Matched filter", exact=True)
    another.check()
    expect(here.get_by_text("6 methods compared")).to_be_visible()
    expect(here.locator("tbody").first.locator("tr")).to_have_count(6)
    # Explore is as it was.
    press(here, "Explore")
    expect(fact(here, "RMSE")).to_be_visible()


@pytest.mark.browser
def test_a_tap_and_the_arrow_keys_choose_the_pixel_of_all(here):
    before = fact(here, "Pixel").inner_text()
    box = pictures(here).locator(".bk-Figure").first.bounding_box()
    here.mouse.click(box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"])
    expect(fact(here, "Pixel")).not_to_have_text(before)
    row, col = map(int, re.findall(r"\d+", fact(here, "Pixel").inner_text()))
    pictures(here).focus()
    here.keyboard.press("ArrowDown")
    expect(fact(here, "Pixel")).to_have_text(f"row {row + 1}, col {col}")
    curves = here.locator(".bk-Figure").filter(has_text="answer, own lag removed")
    hues = {method_style(place, LIGHT)[0] for place in range(5)}
    eventually(lambda: hues <= colors_of(curves))


@pytest.mark.browser
def test_the_table_is_sorted_by_click_and_by_keyboard(here):
    header = here.get_by_role("button", name="Within 3 bins")
    header.click()
    expect(here.locator("th[aria-sort=descending]")).to_have_text("Within 3 bins")
    expect(first_row(here)).not_to_contain_text("Peak of the histogram")
    expect(header).to_be_focused()
    here.keyboard.press("Enter")
    expect(here.locator("th[aria-sort=ascending]")).to_have_text("Within 3 bins")
    expect(first_row(here)).to_contain_text("Peak of the histogram")
    expect(here.locator("tbody").last).to_contain_text("Physics’ limit")


@pytest.mark.browser
def test_clouds_turn_together(here):
    press(here, "3D clouds")
    stages = here.locator(".stage").filter(visible=True)
    expect(stages).to_have_count(5)
    for stage in stages.all():
        expect(stage).to_have_attribute("data-camera", re.compile("."))
    before = stages.last.get_attribute("data-camera")
    stages.first.focus()
    here.keyboard.press("ArrowLeft")
    expect(stages.last).not_to_have_attribute("data-camera", before)
    eventually(lambda: len({each.get_attribute("data-camera") for each in stages.all()}) == 1)


@pytest.mark.browser
def test_it_follows_the_page_into_the_dark(here):
    press(here, "Toggle theme")
    curves = here.locator(".bk-Figure").filter(has_text="answer, own lag removed")
    eventually(lambda: {method_style(0, DARK)[0], DARK.paper} <= colors_of(curves))


@pytest.mark.browser
def test_a_file_without_truth_says_what_is_not_known(here):
    open_source(here, "Sample capture (file)")
    expect(here.get_by_text("That is agreement, not accuracy.")).to_be_visible()
    expect(here.get_by_role("button", name="Error", exact=True)).to_have_count(0)
    expect(here.get_by_text(re.compile("^Not possible here: .*true signal"))).to_be_visible()
    expect(here.get_by_text(re.compile("^Not known here"))).to_be_visible()


@pytest.mark.browser
def test_pages_fit_a_phone(page):
    here = page(width=390, height=844)
    expect(here.get_by_role("button", name="Toggle theme")).to_be_in_viewport(ratio=1)
    here.get_by_role("button", name="Compare", exact=True).click()
    expect(here.get_by_text(re.compile(r"^\d+ methods compared$"))).to_be_visible()
    for picture in pictures(here).locator(".bk-Figure").all():
        box = picture.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
    here.get_by_role("button", name="Paper", exact=True).click()
    figure = here.locator(".bk-Figure").filter(has_text="background alone")
    expect(figure).to_be_visible()
    last = here.get_by_role("slider", name="SBR", exact=True).bounding_box()
    assert figure.bounding_box()["y"] >= last["y"] + last["height"]
    here.get_by_role("button", name="Explore", exact=True).click()
    expect(here.get_by_text(re.compile("^simulated, seed 0"))).to_be_visible()
    eventually(lambda: here.evaluate("Bokeh.documents[0].is_idle"))
    expect(here.get_by_role("button", name="Open drawer")).to_be_visible()  # it is not open
