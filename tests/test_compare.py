"""The Compare page: methods side by side, without a browser and in one."""

from __future__ import annotations

import re
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

import core
from app.model.colors import Unseen
from app.model.methods import FIRST_METHODS, METHOD_TITLES, method_style
from app.model.state import CLOUDS, Illumination
from app.model.store import built_in_sources, compute
from app.model.text import COMPUTING
from app.pages.compare import ranking, text
from app.pages.compare.page import MAX_PICTURES, Compare
from app.pages.compare.ranking import Task
from app.pages.session import Session
from app.plots import elements as plots
from app.theme import DARK, LIGHT, RANGE_COLORS
from core import ESTIMATORS
from core.inspection import CONFIDENT
from core.studies import outputs
from tests.browser import choose, eventually, fact
from tests.states import ask
from tests.test_downloads import columns_of, download, written
from tests.threads import HeldTasks, change

# -- what is computed ------------------------------------------------------------------------------


def task_of(method, **options):
    return Task(method, ESTIMATORS[method].parameters(), **options)


def rows_of(answer, methods, reference):
    """Return the rows of the table, the methods being run if there is a reference."""
    tasks = {method: task_of(method) for method in methods}
    ran = {} if reference is None else {t: ranking.run_task(t, answer) for t in tasks.values()}
    styles = {method: method_style(method, LIGHT) for method in tasks}
    return text.rows(answer.capture, tasks, ran, reference, styles)


def test_the_explored_estimate_is_not_computed_again(car):
    assert ranking.run_task(Task("tracking", car.request.tracking), car).answer is car
    other = Task("tracking", car.request.tracking, false_alarm=0.1)
    assert ranking.run_task(other, car).answer.run.image.valid.mean() < 0.7
    by_peak = compute(ask("sample", method="peak"), None)
    assert ranking.run_task(task_of("peak"), by_peak).answer is by_peak
    assert ranking.run_task(task_of("tracking"), by_peak).answer is not by_peak


def test_accuracy_is_that_of_the_metrics(car):
    found = ranking.run_task(task_of("peak"), car).accuracy
    truth_m, bin_m = car.capture.truth_range_m, car.capture.acquisition.bin_length_m
    range_m = core.estimate(car.capture, "peak").range_m
    for tolerance, interval in zip((1, 2, 3), found.within, strict=True):
        degree = core.metrics.restoration_degree(range_m, truth_m, tolerance * bin_m)
        assert interval.low < interval.value == degree < interval.high
    assert found.detection.recall == 1.0
    assert found.detection.precision == pytest.approx(np.isfinite(truth_m).mean())


def test_pixels_without_a_target_count_as_wrong_in_the_reliability(car):
    confidence, correct = ranking.reliability(car)
    assert confidence.size == correct.size > 1
    assert np.all(np.diff(confidence) > 0)
    image, truth_m = car.run.image, car.capture.truth_range_m
    lowest = image.valid & (image.confidence < 0.1)
    near = np.abs(image.range_m - truth_m) <= 3 * car.capture.acquisition.bin_length_m
    assert correct[0] == pytest.approx(near[lowest].mean())


def test_scores_are_scaled_from_their_median_to_their_maximum(car):
    tasks = {method: task_of(method) for method in ESTIMATORS}
    curves = ranking.score_curves(car.capture, tasks, 32, 30)
    assert curves.keys() == ESTIMATORS.keys()
    for curve in curves.values():
        assert curve.shape == (car.capture.acquisition.n_bins,)
        assert (np.median(curve), curve.max()) == pytest.approx((0, 1))


def test_the_limit_is_known_where_truth_and_flux_are(car):
    reference = ranking.reference_of(car.capture)
    assert reference.limit is not None and reference.likelihood is None
    (limit,) = text.rows(car.capture, {}, {}, reference, {})
    assert "off by at most 0.5 percentage points" in [below for _, _, below in limit["cells"]]
    rows = rows_of(car, ("peak", "oracle"), reference)
    n_cells = len(text.columns(car.capture)) - 1
    assert [len(row["cells"]) for row in rows] == [n_cells] * 3


def test_without_truth_there_is_agreement_and_no_limit(sample):
    reference = ranking.reference_of(sample.capture)
    assert reference.limit is None
    assert reference.likelihood.confidence[reference.likelihood.valid].min() >= CONFIDENT
    row, last = rows_of(sample, ["likelihood"], reference)
    titles = [title for title, *_ in text.columns(sample.capture)]
    assert "RMSE (m)" not in titles
    assert row["cells"][titles.index("Agreement, not accuracy") - 1][0] == "100.0 %"
    assert last["message"] == text.LIMIT_UNKNOWN
    facts = {name: value for name, value, _ in text.pixel_facts(sample, reference, 3, 4)}
    assert facts["Limit: found"] == facts["Limit: spread"] == "not known"
    assert "Truth" not in facts


def test_reconstructions_are_marked(car):
    *rows, _ = rows_of(car, ESTIMATORS, None)
    for row, estimator in zip(rows, ESTIMATORS.values(), strict=True):
        assert bool(row["note"]) == bool(estimator.reconstructed)


def test_every_method_has_a_style_of_its_own():
    for colors in (LIGHT, DARK):
        styles = [str(method_style(method, colors)) for method in ESTIMATORS]
        assert len(set(styles)) == len(styles)
        assert len({method_style(m, colors)[0] for m in FIRST_METHODS}) == len(FIRST_METHODS)
        on_paper = dict.fromkeys(ESTIMATORS, np.zeros(1))
        item = outputs.Plot("", "", "", "", np.zeros(1), on_paper)
        assert list(map(str, plots.curve_styles(item, colors).values())) == styles


# -- the page --------------------------------------------------------------------------------------


class Stage:
    """A Compare page whose thread is the test's own."""

    def __init__(self):
        self.tasks = HeldTasks()
        self.session = Session(built_in_sources(), tasks=self.tasks)
        self.page = Compare(self.session)
        self.page.paint(False)
        self.session.estimate.changed.subscribe(self.page.follow)

    def settle(self):
        """Let the page compute and draw everything."""
        self.tasks.run_until(lambda: self.page.is_complete)
        self.drain()

    def drain(self):
        self.tasks.run_until(self.tasks.waiting.empty)

    def stop(self):
        (button,) = self.page.view.main[0].select(
            lambda each: getattr(each, "label", "") in ("Cancel", "Resume")
        )
        button.clicks += 1
        return button

    @property
    def figures(self):
        return {row["name"]: row["cells"] for row in self.page.table.rows if row.get("cells")}

    @property
    def messages(self):
        return {row["name"]: row.get("message", "") for row in self.page.table.rows}


@pytest.fixture
def stage():
    return Stage()


@pytest.fixture
def shown(stage):
    """The page on screen, with all that it begins with."""
    stage.page.show(True)
    stage.settle()
    return stage


def test_nothing_is_computed_before_the_page_is_seen(stage):
    assert stage.tasks.waiting.empty()
    stage.page.show(True)
    stage.settle()
    titles = [ESTIMATORS[m].title for m in ESTIMATORS if m in FIRST_METHODS]
    assert list(stage.figures) == [*titles, "Single-pixel limit"]
    assert stage.page.status.text == "5 methods compared"
    figures = [picture.image.figure for picture in stage.page.pictures]  # share one view
    assert len(figures) == 5
    assert len({(id(figure.x_range), id(figure.y_range)) for figure in figures}) == 1
    assert len(figures[0].x_range.renderers) == 5


def test_plots_are_saved_with_every_digit(shown):
    page, pixel = shown.page, shown.session.state.pixel
    assert page.view.main
    scores, reliability = (
        columns_of(written(page.downloads[each]().files["csv"]))
        for each in ("scores", "reliability")
    )
    curves = ranking.score_curves(shown.session.answer.capture, page.tasks, *pixel)
    n_bins = shown.session.answer.capture.acquisition.n_bins
    for method, answer in page.answers.items():
        title, accuracy = ESTIMATORS[method].title, page.results[page.tasks[method]].accuracy
        np.testing.assert_array_equal(scores[f"{title} (score, scaled)"][:n_bins], curves[method])
        mark = scores[f"{title}, estimate, own lag removed"] == 1
        assert scores["Bin"][mark] == answer.run.image.bin[pixel]
        right = reliability[f"{title} (share right within 3 bins)"]
        known = ~np.isnan(right)
        np.testing.assert_array_equal(reliability["Confidence"][known], accuracy.confidence)
        np.testing.assert_array_equal(right[known], accuracy.correct)


def test_only_what_is_missing_is_computed(shown, monkeypatch):
    ran, run_task, page = [], ranking.run_task, shown.page

    def noted(task, answer):
        ran.append(task.method)
        return run_task(task, answer)

    monkeypatch.setattr("app.pages.compare.page.run_task", noted)
    page.picks.value = [*page.picks.value, "matched_filter"]
    shown.settle()
    assert ran == ["matched_filter"]
    page.panels["likelihood"].controls["depths"].value = "learned"
    shown.tasks.run_until(lambda: len(ran) == 2)
    shown.settle()
    assert ran == ["matched_filter", "likelihood"]
    page.show(False)
    shown.session.state.comparison = replace(shown.session.state.comparison, false_alarm=0.1)
    assert shown.tasks.waiting.empty()
    page.show(True)
    shown.settle()
    assert len(ran) == 2 + 6


def test_captions_have_intervals_where_the_confidence_suffices(car):
    image = car.run.image
    known = image.valid & np.isfinite(car.capture.truth_range_m)
    number = r"[\d,.]+"
    for among, margin in (
        (known & (image.confidence >= CONFIDENT), rf" ± {number} m \(95 %\)"),
        (known & (image.confidence < CONFIDENT), " m"),
    ):
        found = text.caption(car, *np.argwhere(among)[0])
        expected = rf"{number}{margin} \([+−]{number}\), confidence \d+ %"
        assert re.fullmatch(expected, found)


def test_another_capture_makes_everything_outdated(shown):
    before = shown.figures
    change(shown.session, light=Illumination(seed=5))
    shown.settle()
    changed = {name for name in before if shown.figures[name] != before[name]}
    assert changed == before.keys() - {"Single-pixel limit"}  # of the same scene with the same flux


def test_cancel_stops_before_the_next_method_and_resumes(stage):
    stage.page.show(True)
    stage.tasks.run_one()
    button = stage.stop()
    stage.drain()
    stage.tasks.run_until(lambda: stage.page.status.text.startswith("Stopped: "))
    n_done = len(stage.page.results)
    assert 0 < n_done < 5
    assert button.label == "Resume"
    captions = [picture.caption.text for picture in stage.page.pictures]
    assert captions[n_done:] == [text.waiting("peak", None)] * (5 - n_done)
    assert text.waiting("peak", None) not in captions[:n_done]
    stage.stop()
    assert stage.page.pictures[n_done].caption.text == COMPUTING
    stage.settle()
    captions = [picture.caption.text for picture in stage.page.pictures]
    assert all("confidence" in caption for caption in captions)
    assert stage.page.status.text == "5 methods compared"
    assert not button.visible


def test_nothing_is_computed_while_the_page_is_away(stage, monkeypatch):
    tasks = stage.tasks
    monkeypatch.setattr(HeldTasks, "is_away", True)
    monkeypatch.setattr(tasks, "call_later", lambda _wait_ms, act: tasks.queue(act))
    stage.page.show(True)
    for _ in range(3):
        tasks.run_one()
    assert stage.page.results == {}
    monkeypatch.setattr(HeldTasks, "is_away", False)
    stage.settle()
    assert len(stage.page.results) == 5


def test_a_method_that_fails_shows_why_and_the_others_continue(stage, monkeypatch):
    run_task = ranking.run_task

    def fail(task, answer):
        if task.method == "coates":
            raise ValueError("no such luck.")
        return run_task(task, answer)

    monkeypatch.setattr("app.pages.compare.page.run_task", fail)
    stage.page.show(True)
    stage.settle()
    assert stage.messages[ESTIMATORS["coates"].title] == "Not possible here: no such luck."
    assert len(stage.figures) == 5
    assert len(stage.page.pictured) == 4


def show_in_every_way(page):
    for kind in page.kind.options:
        page.kind.value = kind
    assert page.kind.value == CLOUDS
    clouds = [picture.cloud for picture in page.pictures if picture.cloud is not None]
    assert all(cloud.positions for cloud in clouds)
    assert len({tuple(cloud.bounds) for cloud in clouds}) == 1
    page.paint(True)
    assert all(cloud.dark for cloud in clouds)


def test_a_file_has_no_oracle_no_limit_and_no_errors(stage):
    change(stage.session, source="sample")
    stage.page.show(True)
    stage.settle()
    assert "true signal" in stage.messages[ESTIMATORS["oracle"].title]
    assert stage.page.status.text == "4 methods compared, 1 not usable here"
    assert stage.messages["Single-pixel limit"] == text.LIMIT_UNKNOWN
    assert "Error" not in stage.page.kind.options
    assert text.AGREEMENT_ONLY in stage.page.remarks.text
    sentences = stage.page.remarks.text.split(". ")
    assert len(sentences) == len(set(sentences)) > 1
    show_in_every_way(stage.page)


def test_remarks_are_those_of_the_chosen_methods_with_their_settings(car):
    tasks = [task_of(method, false_alarm=0.1) for method in ("peak", "kde", "chi", "unmixing")]
    alone = replace(tasks[1], settings=replace(tasks[1].settings, neighbourhood="1x1"))
    titles = f"{METHOD_TITLES['kde']}, {METHOD_TITLES['chi']}"
    next_to_surfaces = "next to surfaces, a larger share of empty pixels get a range"
    of_all = text.remarks(car.capture, tasks, 4)
    assert f"{titles}: {next_to_surfaces}" in of_all
    assert f"{METHOD_TITLES['unmixing']}: the share of false alarms is not controlled" in of_all
    assert "kept by τ_FA" in of_all
    for others in ([tasks[0], alone], [task_of("kde"), task_of("chi")]):
        assert next_to_surfaces not in text.remarks(car.capture, others, 2)
    assert f"{next_to_surfaces.capitalize()}" in text.remarks(car.capture, tasks[1:2], 1)


def test_all_methods_fit_in_the_table_and_the_first_six_have_pictures(stage):
    stage.page.picks.value = list(ESTIMATORS)
    stage.page.show(True)
    stage.settle()
    assert stage.page.status.text == f"{len(ESTIMATORS)} methods compared"
    assert len(stage.page.pictures) == MAX_PICTURES
    assert f"first {MAX_PICTURES}" in stage.page.remarks.text


def test_the_legend_counts_what_pictures_do_not_show(stage):
    pictures = {"peak": Unseen(n_blank=2, n_outside=1234), "cfar": Unseen(n_blank=3, n_hidden=4)}
    peak, cfar = (METHOD_TITLES[method] for method in pictures)
    assert text.legend(pictures, 0.9) == (
        f"Blank, without a value: 2 ({peak}), 3 ({cfar}). Hidden below confidence 0.9: 4 ({cfar}). "
        f"Grey, beyond the colour scale: 1,234 ({peak})."
    )
    stage.page.show(True)
    stage.settle()
    show_in_every_way(stage.page)
    # The last are clouds: blank pixels have no points.
    assert re.fullmatch(r"Hidden below confidence 0.9: [^.]+\.", stage.page.legend.text)


def test_without_a_method_the_page_asks_for_one(stage):
    stage.page.picks.value = []
    stage.page.show(True)
    stage.settle()
    assert stage.page.status.text == "Choose at least one method"


# -- in a browser ----------------------------------------------------------------------------------


def press(page, name):
    page.get_by_role("button", name=name, exact=True).click()


def pictures(page):
    """The part of the page with the pictures."""
    return page.get_by_role("application", name=re.compile("^Pictures of the methods"))


def colors_of(part):
    picture = np.asarray(Image.open(BytesIO(part.screenshot())).convert("RGB")).reshape(-1, 3)
    return {"#{:02x}{:02x}{:02x}".format(*color) for color in np.unique(picture, axis=0).tolist()}


def first_row(page):
    return page.locator("tbody tr").first.locator("th")


def save_pictures_and_table(here):
    expect(here.get_by_text(re.compile(r", confidence \d+ %")).nth(1)).to_be_visible()
    name, png = download(here, "Peak of the histogram", "png")
    assert name == "car_peak_range-image.png"
    assert Image.open(BytesIO(png)).height > 216  # with heading and colour scale
    name, table = download(here, "table", "csv")
    assert name == "car_methods.csv"
    assert b"Single-pixel limit" in table


def choose_the_pixel_of_all(here):
    """Choose the pixel by a tap and by a key; its curves have the colours of light and dark."""
    before, first = fact(here, "Pixel").inner_text(), pictures(here).locator(".bk-Figure").first
    first.scroll_into_view_if_needed()
    box = first.bounding_box()
    here.mouse.click(box["x"] + 0.4 * box["width"], box["y"] + 0.5 * box["height"])
    expect(fact(here, "Pixel")).not_to_have_text(before)
    row, col = map(int, re.findall(r"\d+", fact(here, "Pixel").inner_text()))
    pictures(here).focus()
    here.keyboard.press("ArrowDown")
    expect(fact(here, "Pixel")).to_have_text(f"row {row + 1}, col {col}")
    curves = here.locator(".bk-Figure").filter(has_text="estimate, own lag removed")
    hues = {method_style(method, LIGHT)[0] for method in FIRST_METHODS}
    eventually(lambda: hues <= colors_of(curves))
    press(here, "Toggle theme")
    eventually(lambda: {method_style("peak", DARK)[0], DARK.paper} <= colors_of(curves))


def turn_all_clouds(here):
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


def sort_by_click_and_by_key(here):
    header = here.get_by_role("button", name="Within 3 bins")
    header.click()
    expect(here.locator("th[aria-sort=descending]")).to_have_text("Within 3 bins")
    expect(first_row(here)).not_to_contain_text("Peak of the histogram")
    expect(header).to_be_focused()
    here.keyboard.press("Enter")
    expect(here.locator("th[aria-sort=ascending]")).to_have_text("Within 3 bins")
    expect(first_row(here)).to_contain_text("Peak of the histogram")
    expect(here.locator("tbody").last).to_contain_text("Single-pixel limit")


def compare_the_methods(here):
    expect(here.get_by_text("5 methods compared")).to_be_visible()
    expect(here.locator("tbody").first.locator("tr")).to_have_count(5)
    expect(here.get_by_role("checkbox")).to_have_count(len(ESTIMATORS))
    eventually(lambda: len(colors_of(pictures(here)) & set(RANGE_COLORS)) > 50)
    save_pictures_and_table(here)
    choose_the_pixel_of_all(here)
    press(here, "Explore")  # is as it was
    expect(fact(here, "RMSE")).to_be_visible()
    press(here, "Compare")
    sort_by_click_and_by_key(here)
    here.get_by_role("checkbox", name="Matched filter", exact=True).check()
    expect(here.get_by_text("6 methods compared")).to_be_visible()
    expect(here.locator("tbody").first.locator("tr")).to_have_count(6)
    choose(here, "Scene or capture", "Sample capture (file)")
    expect(here.get_by_text(text.AGREEMENT_ONLY)).to_be_visible()
    expect(here.get_by_role("button", name="Error", exact=True)).to_have_count(0)
    expect(here.get_by_text(re.compile("^Not possible here: .*true signal"))).to_be_visible()
    expect(here.get_by_text(text.LIMIT_UNKNOWN)).to_be_visible()
    turn_all_clouds(here)
