"""Failures are shown as sentences, and the next action works."""

from __future__ import annotations

import asyncio
import os
import re
import signal
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from functools import partial
from itertools import cycle
from pkgutil import resolve_name
from types import SimpleNamespace

import numpy as np
import panel as pn
import pytest

from app import __main__ as started
from app.model import download_text
from app.model import text as model_text
from app.model.address import Link
from app.model.state import Illumination
from app.model.store import built_in_sources, file_source, scene_source
from app.model.uploads import Uploads
from app.pages.compare import text as compare_text
from app.pages.compare.page import Compare
from app.pages.inspect.capture import CaptureSection
from app.pages.inspect.page import Inspect
from app.pages.inspect.pins import PinsSection
from app.pages.inspect.pixel import PixelSection
from app.pages.inspect.views import rectangle
from app.pages.layout import Template
from app.pages.navigation import Pages, View
from app.pages.paper.page import Jump, LiveFigures, RangeImages, RepeatedTable, jump
from app.pages.session import Session
from app.pages.shared.failures import FailureLog
from app.pages.shared.section import Repetitions
from app.pages.tradeoff.ablation import AblationSection
from app.pages.tradeoff.acquisition import AcquisitionSection
from app.pages.tradeoff.sensitivity import SensitivitySection, Swept
from app.pages.tradeoff.speed import Effort, SpeedSection
from core import ESTIMATORS, CaptureError
from core.io import ReadOptions, reading_options
from core.studies.paper import figures as paper
from core.studies.trials import Condition
from tests.broken import AT_SEED, WHEN_DRAWN, WHEN_INSPECTED, WHEN_TAPPED
from tests.browser import ROOT, serving
from tests.load import opened as opened_wire
from tests.test_app import opened
from tests.threads import HeldLayout, HeldTasks, control

# -- a served app whose parts fail -----------------------------------------------------------------


def moving(kind, attribute, value, **attributes):
    async def move(wire):
        await wire.set(wire.find(kind, **attributes), attribute, value)

    return move


def seeding(seed):
    return moving("Knob", "value", seed, label="Seed")


async def tap(wire):
    """Tap on the image: a callback of Bokeh."""
    image = next(
        key
        for key, model in wire.models.items()
        if model["name"] == "Figure"
        and model["attributes"]["title"]["attributes"]["text"].startswith("Estimated")
    )
    row, col = WHEN_TAPPED
    await wire.emit("tap", image, {"x": col, "y": row, "sx": 1, "sy": 1})


FAILING = {
    **{f"seed {seed}": seeding(seed) for seed in (*AT_SEED, WHEN_DRAWN)},
    "an inspected pixel": moving("PixelKeys", "pixel", [*WHEN_INSPECTED]),
    "a chosen pixel": moving("PixelKeys", "pixel", [*WHEN_TAPPED]),
    "a tap": tap,
}


def test_what_fails_on_the_server_is_reported_and_the_next_move_works():
    async def session(address):
        # A seed in the link unfolds the section with its slider.
        wire, _ = await opened_wire(f"{address}?light.seed=50", seed=0)
        alert = wire.find("Sentence", warning=True), "text"
        said = {}
        for number, (name, fail) in enumerate(FAILING.items()):
            for act, is_over in ((fail, bool), (seeding(99 - number), lambda text: not text)):
                await act(wire)
                async with asyncio.timeout(60), wire.news:
                    await wire.news.wait_for(
                        lambda is_over=is_over: is_over(wire.values.get(alert, ""))
                    )
                said.setdefault(name, wire.values[alert])
        wire.close()
        return said, wire.troubles

    with serving(module="tests.broken") as address:
        said, troubles = asyncio.run(session(address))
    assert all("The page still shows" in said[f"seed {seed}"] for seed in (*AT_SEED, WHEN_DRAWN))
    assert all("KeyError" in said[name] for name in FAILING if not name.startswith("seed"))
    assert not [text for text in said.values() if str(ROOT) in text or "Traceback" in text]
    (error,) = troubles  # of Bokeh's own callback
    assert "The error is shown in the app." in error
    assert str(ROOT) not in error


# -- sections of the pages, without a browser ------------------------------------------------------

FOLDER = "/srv/data/secret"

ERRORS = (
    CaptureError(f"face.mat: cannot be read (OSError: [Errno 5] '{FOLDER}/face.mat'): copy it."),
    OSError(28, "No space left on device", f"{FOLDER}/x"),
    MemoryError(),
    BrokenExecutor("a worker has died"),
)


def breaking(monkeypatch, where):
    """Replace a function by one that raises what is in the returned list, if anything."""
    works, raised = resolve_name(where), []

    def work(*arguments, **options):
        if raised:
            raise raised[0]
        return works(*arguments, **options)

    monkeypatch.setattr(where, work)
    return raised


def check_sentence(sentence, error):
    assert FOLDER not in sentence and "Traceback" not in sentence
    expected = "cannot be read (OSError: [Errno 5] 'face.mat')", type(error).__name__
    assert any(each in sentence for each in expected)


# Each returns what starts the work, and whether it has succeeded.


def by_compute(section, settings=None):
    """Work that the button Compute starts."""
    if settings is not None:
        section.change(settings)
    is_running = re.compile(r"Done|[1-9]\d* of")
    return section.study.start, lambda: is_running.match(section.study.controls[-1].text)


def live(session):
    section = LiveFigures(session, Jump(), "", jump, count=2)
    places = iter(range(20, 99))
    return lambda: section.change(Jump(onset_bin=next(places))), lambda: section.shown


def repeated(session):
    plan, table = {Condition("car", 0.06): paper.COMPARED[:1]}, paper.arithmetic()
    settings = Repetitions()
    return by_compute(
        RepeatedTable(session, settings, "", lambda _: plan, lambda *_: table), settings
    )


def ablation(session):
    return by_compute(AblationSection(session), Repetitions())


def speed(session):
    return by_compute(SpeedSection(session), Effort(repetitions=2, repeats=6, merges="none"))


def sensitivity(session):
    return by_compute(SensitivitySection(session), Swept(ESTIMATORS["kde"].title))


def maps(session):
    page, kinds = Inspect(session), cycle(["Peak", "Counts"])
    blank = page.navigator.figure.title.text
    page.show(True)
    return (
        lambda: session.state.param.update(map=next(kinds)),
        lambda: page.navigator.figure.title.text != blank,
    )


def pins(session):
    section, places = PinsSection(session), cycle([(0, 0), (1, 1)])
    section.show(True)
    return lambda: session.state.param.update(pins=(next(places),)), lambda: section.found


def region(session):
    section, rows = PixelSection(session, "region"), cycle([1, 2])
    section.show(True)
    regions = (rectangle((0, row), (0, 1)) for row in rows)
    return lambda: session.state.param.update(region=next(regions)), lambda: section.found


def report(session):
    section = CaptureSection(session)
    section.show(True)
    return section.refresh, lambda: section.report


SECTIONS = {
    "app.pages.inspect.page.map_of": maps,
    "app.pages.inspect.pins.inspect_pixel_with_flux": pins,
    "core.inspection.region_report": region,
    "core.inspection.capture_report": report,
    "core.inspection.accuracy_over_pulses": lambda session: by_compute(CaptureSection(session)),
    "core.studies.paper.figures.figure_1": live,
    "app.pages.paper.page.trials": repeated,
    "core.studies.paper.figures.figure_8": lambda session: by_compute(RangeImages(session)),
    "app.pages.tradeoff.speed.study": speed,
    "app.pages.tradeoff.acquisition.acquisition_sweeps": lambda session: by_compute(
        AcquisitionSection(session)
    ),
    "app.pages.tradeoff.ablation.requirements": ablation,
    "app.pages.tradeoff.sensitivity.setting_sweep": sensitivity,
}

REFUSING = ("core.inspection.region_report",)
"""Functions that may refuse their input: the sentence of a ``ValueError`` replaces the plots."""


def few_pixels():
    return {"uniform": scene_source("Few pixels", "uniform", size=8)}


@pytest.fixture
def session():
    """A session whose page's thread is that of the test."""
    return Session(few_pixels(), tasks=HeldTasks())


@pytest.fixture
def shown(session):
    """The sentences on failures that the page has shown."""
    sentences = []
    session.failures.shown.subscribe(sentences.append)
    return sentences


@pytest.mark.parametrize("where", SECTIONS)
def test_work_of_a_section_that_fails_is_reported_and_the_next_works(
    where, monkeypatch, session, shown
):
    raised = breaking(monkeypatch, where)
    errors = ERRORS[1:] if where in REFUSING else ERRORS
    raised[:] = errors[:1]
    act, has_succeeded = SECTIONS[where](session)
    for error in errors:
        raised[:], before = [error], len(shown)
        act()
        session.tasks.run_until(lambda before=before: len(shown) > before and shown[-1])
        check_sentence(shown[-1], error)
        assert "Compute" in shown[-1] or "still shows" in shown[-1]
        assert not has_succeeded()
    raised.clear()
    act()
    session.tasks.run_until(has_succeeded)
    session.tasks.run_until(lambda: shown[-1] == "")


def test_a_failure_is_shown_until_its_own_part_works_again():
    failures, shown = FailureLog(), []
    failures.shown.subscribe(shown.append)
    map_, pins = object(), object()
    failures.report(MemoryError(), part=map_)
    failures.report(OSError(28, "full"), part=pins)
    of_map, of_pins = shown
    failures.resolve(failures)
    failures.resolve(map_)  # the latest has been shown all along
    assert shown[-1] == of_pins
    failures.report(MemoryError(), part=map_)
    failures.resolve(map_)
    assert shown[2:] == [of_pins, of_map, of_pins]
    failures.resolve(pins)
    assert shown[-1] == ""
    failures.show("Not saved.")
    failures.remark("")
    failures.report(MemoryError(), part=map_)
    failures.resolve(map_)
    assert shown[-1] == "Not saved."
    failures.clear()
    assert shown[-1] == ""


def test_another_pixel_does_not_hide_that_a_map_failed(monkeypatch, session, shown):
    raised = breaking(monkeypatch, "app.pages.inspect.page.map_of")
    raised.append(MemoryError())
    section = PixelSection(session, "pixel")
    section.show(True)
    change_map, _ = maps(session)
    change_map()
    session.tasks.run_until(lambda: shown)
    session.choose_pixel(1, 1)
    session.tasks.run_until(
        lambda: dict(each[:2] for each in section.facts.facts)["Pixel"] == "1, 1"
    )
    assert shown[-1]


@pytest.fixture
def compare(session):
    """The Compare page with one method, not yet on screen."""
    session.state.comparison = replace(session.state.comparison, methods=("peak",))
    page = Compare(session)
    session.estimate.changed.subscribe(page.follow)
    return page


def messages(page):
    return {row["name"]: row.get("message", "") for row in page.table.rows}


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: type(error).__name__)
def test_a_method_that_fails_is_reported_and_runs_when_selected_again(
    error, monkeypatch, session, compare
):
    raised, name = (
        breaking(monkeypatch, "app.pages.compare.page.run_task"),
        ESTIMATORS["peak"].title,
    )
    raised[:] = [error]
    compare.show(True)
    session.tasks.run_until(lambda: messages(compare)[name] != model_text.NOT_COMPUTED)
    check_sentence(messages(compare)[name], error)
    raised.clear()
    compare.picks.value = []
    compare.picks.value = ["peak"]
    session.tasks.run_until(lambda: messages(compare)[name] == "")


def test_a_limit_that_fails_is_reported_and_not_called_unknown(monkeypatch, session, compare):
    raised = breaking(monkeypatch, "app.pages.compare.page.reference_of")
    raised[:] = ERRORS[2:]
    compare.show(True)
    limit = "Single-pixel limit"
    session.tasks.run_until(lambda: messages(compare)[limit] not in ("", model_text.NOT_COMPUTED))
    check_sentence(messages(compare)[limit], raised[0])
    raised.clear()
    session.state.light = Illumination(seed=1)
    session.tasks.run_until(lambda: messages(compare)[limit] == "")


def test_scores_that_fail_are_reported_and_those_of_the_next_pixel_are_drawn(
    monkeypatch, session, compare, shown
):
    raised = breaking(monkeypatch, "app.pages.compare.page.score_curves")
    compare.show(True)
    session.tasks.run_until(lambda: compare.is_complete)
    for error in ERRORS:
        raised[:], before = [error], len(shown)
        compare.request_curves()
        session.tasks.run_until(lambda before=before: len(shown) > before and shown[-1])
        check_sentence(shown[-1], error)
    raised.clear()
    session.choose_pixel(1, 2)
    session.tasks.run_until(lambda: shown[-1] == "")


def test_a_refused_reading_option_is_reported_and_the_next_reading_works():
    layout = HeldLayout({"sample": built_in_sources()["sample"]})
    opened(layout, "Reading options")
    width, alert, again = (
        control(layout, "Bin width"),
        layout.alert,
        control(layout, "Read again"),
    )
    for typed, sentence in (
        ("<b>wide</b>", "“Bin width” = '<b>wide</b>' is not accepted: give"),
        ("-2e-9", "“Bin width” = -2e-09"),
    ):
        width.value = typed
        again.clicks += 1
        layout.tasks.run_until(lambda sentence=sentence: sentence in alert.text)
    width.value = "2e-9"
    again.clicks += 1
    layout.tasks.run_until(lambda: alert.text == "")
    assert layout.session.answer.capture.acquisition.bin_width_s == 2e-9


def test_a_value_that_arrives_after_its_answer_does_not_replace_what_is_in_use():
    """Enter arrives before the value that it completes, and a small file is read before that."""
    layout = HeldLayout({"sample": built_in_sources()["sample"]})
    opened(layout, "Reading options")
    width = control(layout, "Bin width")
    width.value_input = "2000 ps"
    control(layout, "Read again").clicks += 1
    layout.tasks.run_until(lambda: width.value == "2 ns")
    width.value = "2000 ps"
    assert width.value == "2 ns"
    width.value = "3000 ps"
    assert width.value == "3000 ps"


def test_the_form_stays_open_for_a_file_that_is_refused(tmp_path):
    np.savez(
        tmp_path / "two.npz", day=np.ones((4, 5, 30), int), night=np.eye(30)[:20].reshape(4, 5, 30)
    )
    sources = built_in_sources()
    kept = {"sample": sources["sample"], "two": file_source(tmp_path / "two.npz")}
    layout = HeldLayout(kept | {"car": sources["car"]})
    session, form = layout.session, opened(layout, "Reading options")
    for first in ("sample", "car"):
        session.state.source = first
        layout.tasks.run_until(lambda first=first: form.visible == (first == "sample"))
        layout.tasks.run_until(lambda: layout.alert.text == "")
        session.state.source = "two"
        layout.tasks.run_until(lambda: layout.alert.text.startswith("Two arrays of two.npz"))
        assert session.state.source == first
        assert form.visible and not form.collapsed
        assert control(layout, "Bin width").value == ""
    control(layout, "Variable").value = "night"
    control(layout, "Bin width").value = "64 ps"
    control(layout, "Read again").clicks += 1
    layout.tasks.run_until(lambda: layout.alert.text == "")
    assert session.state.source == "two"
    assert session.answer.capture.acquisition.bin_width_s == 64e-12
    # What is on screen is a guess until it is changed.
    shown = {name: control(layout, name).value for name in ("Variable", "Bins", "Gate opens after")}
    assert shown == {"Variable": "night", "Bins": "30", "Gate opens after": "0 s"}
    assert session.state.reading == ReadOptions(variable="night", bin_width_s=64e-12)
    control(layout, "Variable").value = "day"
    control(layout, "Read again").clicks += 1
    layout.tasks.run_until(lambda: session.answer.request.reading.variable == "day")
    assert session.state.reading == ReadOptions(variable="day", bin_width_s=64e-12)


def test_the_form_is_open_for_a_file_that_a_link_names_and_that_is_refused(tmp_path):
    frames = np.full((50, 4, 5), 65535, np.uint16)
    frames[::5] = 7
    np.save(tmp_path / "frames.npy", frames)
    sources = {**few_pixels(), "frames": file_source(tmp_path / "frames.npy")}
    layout = HeldLayout(sources, Link({"source": "frames", "reading.bin_width_s": "64 ps"}))
    form = opened(layout, "Reading options")
    assert form.visible and layout.session.state.source == next(iter(sources))
    question = "in which 65535 marks no trigger. What does it hold?"
    assert layout.alert.text.count(question) == 1
    assert control(layout, "Bin width").value == "64 ps"
    control(layout, reading_options()["no_trigger"].label).value = "65535"
    control(layout, "Read again").clicks += 1
    layout.tasks.run_until(lambda: layout.session.state.source == "frames")
    assert layout.next_answer().request.reading == ReadOptions(no_trigger=65535, bin_width_s=64e-12)
    link = {"source": "frames", "reading.no_trigger": "65535", "reading.bin_width_s": "64 ps"}
    link |= {"page": "Explore", "unread": "source=frames"}
    again = HeldLayout(sources, Link(link))
    assert question in again.alert.text
    assert again.session.state.page == "Explore"
    # Back and Forward show the reason again, also where the page was reloaded in between.
    refused, read = again.session.query(), layout.session.query()
    for each in (again, HeldLayout(sources)):
        for query, has_reason in ((read, False), (refused, True), (read, False), (refused, True)):
            each.session.recall(query)
            each.tasks.run_until(each.session.is_settled)
            assert (question in each.alert.text) == has_reason
            assert each.session.query() == query


def test_a_link_to_an_unreadable_file_shows_no_folder(monkeypatch):
    raised, link = breaking(monkeypatch, "app.model.restore.first_answer"), Link({"seed": "3"})
    for error in ERRORS:
        raised[:] = [error]
        with pytest.raises(type(error)):
            Session(few_pixels(), link)
        check_sentence(link.refused.pop(), error)


# -- a page that cannot be built -------------------------------------------------------------------


def test_a_page_that_cannot_be_built_shows_that_and_the_log_says_why(monkeypatch, caplog):
    raised = breaking(monkeypatch, "app.__main__.build_page")
    for error in ERRORS:
        raised[:] = [error]
        page = started.page_for(few_pixels(), Uploads())
        assert (page.text, page.warning) == (model_text.NO_PAGE, True)
        assert caplog.records[-1].exc_info[1] is error
    raised.clear()
    assert isinstance(started.page_for(few_pixels(), Uploads()), Template)


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/srv/data/secret/face.mat", "face.mat"),
        ("'/srv/my data/fa ce.mat'", "'fa ce.mat'"),
        ('"/srv/a/b.npz"', '"b.npz"'),
    ],
)
def test_messages_name_files_without_folders(path, name):
    message = f"it.mat: cannot be read ({path}: 3.5 counts/s, 1/2/3, m/s): give another"
    assert model_text.without_folders(message) == message.replace(path, name)
    for describe in (
        model_text.failure,
        model_text.reason,
        partial(model_text.unfinished, button="Compute"),
        compare_text.failure,
        compare_text.no_reference,
        download_text.not_saved,
    ):
        assert "/srv" not in describe(CaptureError(message))
        assert "/srv" not in describe(OSError(message))


def test_a_page_that_cannot_be_built_leaves_the_open_one():
    broken = True

    def build(session):
        if broken:
            raise OSError(28, "No space left on device")
        return SimpleNamespace(view=View(pn.pane.Str("there"), []))

    first = SimpleNamespace(view=View([], []))
    pages = Pages(None, {"first": lambda session: first, "second": build})
    for is_open in (False, True):
        broken = not is_open
        if broken:
            with pytest.raises(OSError, match="No space"):
                pages.choice.value = "second"
        else:
            pages.choice.value = "second"
        assert pages.choice.value == ("second" if is_open else "first")
        assert [pages.mains[name].visible for name in ("first", "second")] == [not is_open, is_open]
    assert len(pages.mains["second"]) == 1


def killed(_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_process_is_reported_and_the_next_works(monkeypatch, session, shown):
    start, has_succeeded = speed(session)
    with monkeypatch.context() as patched:
        patched.setattr("core.studies.tradeoff.measure.held_bytes", killed)
        start()
        session.tasks.run_until(lambda: shown and "BrokenProcessPool" in shown[-1])
    assert "Press “Compute”" in shown[-1]
    start()
    session.tasks.run_until(lambda: has_succeeded() and has_succeeded()[0] == "Done")
    assert shown[-1] == ""
