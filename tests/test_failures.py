"""What goes wrong is told by the page in words, and the next move works."""

from __future__ import annotations

import asyncio
import os
import re
import signal
from concurrent.futures import BrokenExecutor
from dataclasses import replace
from itertools import cycle
from pkgutil import resolve_name

import panel as pn
import pytest

from app import __main__ as started
from app.model import download_text as download_words
from app.model import text as words
from app.model.address import Wanted
from app.model.state import Illumination
from app.model.store import built_in_sources, scene_source
from app.model.uploads import Uploads
from app.pages.compare import text as ranking_words
from app.pages.compare.page import Compare
from app.pages.inspect.capture import Whole
from app.pages.inspect.page import Inspector
from app.pages.inspect.pins import Pins
from app.pages.inspect.pixel import Sight
from app.pages.inspect.views import rectangle
from app.pages.layout import Layout, Template
from app.pages.navigation import Pages, View
from app.pages.paper.page import Jump, RangeImages, Repeated, Sliders, Trials, jump
from app.pages.session import Session
from app.pages.shared.failures import FailureLog
from app.pages.tradeoff.ablation import Judged, Requires
from app.pages.tradeoff.page import Acquisition, Effort, Ways
from app.pages.tradeoff.sensitivity import Trust
from core import ESTIMATORS, CaptureError
from core.studies.paper import figures as paper
from core.studies.trials import Condition
from tests.broken import AT_SEED, WHEN_DRAWN, WHEN_INSPECTED, WHEN_TAPPED
from tests.browser import ROOT, eventually, serving
from tests.load import opened as opened_wire
from tests.test_app import opened
from tests.threads import control


@pytest.fixture(scope="module")
def broken():
    """Where the app is served whose parts break."""
    with serving(module="tests.broken") as running_at:
        yield running_at


def provoke(address, break_it, mend_it):
    """What the page says when something is broken, and when it has been mended."""

    async def session():
        wire, _ = await opened_wire(address, seed=0)
        alert = wire.find("Sentence", warning=True)
        said = []
        for act, is_over in ((break_it, bool), (mend_it, lambda text: not text)):
            await act(wire)
            async with asyncio.timeout(60), wire.news:
                await wire.news.wait_for(lambda is_over=is_over: is_over(text(wire, alert)))
            said.append(text(wire, alert))
        wire.close()
        assert all(str(ROOT) not in trouble for trouble in wire.troubles)
        return said

    return asyncio.run(session())


def text(wire, sentence):
    return wire.values.get((sentence, "text"), "")


def moving(kind, attribute, value, **attributes):
    async def move(wire):
        await wire.set(wire.find(kind, **attributes), attribute, value)

    return move


@pytest.mark.parametrize("seed", [*AT_SEED, WHEN_DRAWN])
def test_an_answer_that_fails_is_told_and_the_next_move_works(broken, seed):
    said, mended = provoke(
        broken,
        moving("Knob", "value", seed, label="Seed"),
        moving("Knob", "value", 99, label="Seed"),
    )
    assert "The picture still shows" in said
    assert str(ROOT) not in said and "Traceback" not in said
    assert mended == ""


def test_a_callback_that_fails_is_told_and_the_next_works(broken):
    for row, col in (WHEN_INSPECTED, WHEN_TAPPED):
        said, _ = provoke(
            broken,
            moving("PixelKeys", "pixel", [row, col]),
            moving("Knob", "value", 98, label="Seed"),
        )
        assert "KeyError" in said
        assert str(ROOT) not in said


# -- parts of the pages, without a browser ---------------------------------------------------------

FOLDER = "/srv/data/secret"

RAISED = (
    CaptureError(f"face.mat: cannot be read (OSError: [Errno 5] '{FOLDER}/face.mat'): copy it."),
    OSError(28, "No space left on device", f"{FOLDER}/x"),
    MemoryError(),
    BrokenExecutor("a worker has died"),
)


def breaking(monkeypatch, where):
    """What a function raises from now on, where there is something; else it works."""
    works, raised = resolve_name(where), []

    def work(*arguments, **options):
        if raised:
            raise raised[0]
        return works(*arguments, **options)

    monkeypatch.setattr(where, work)
    return raised


def check_told(sentence, error):
    assert FOLDER not in sentence and "Traceback" not in sentence
    told = "cannot be read (OSError: [Errno 5] 'face.mat')", type(error).__name__
    assert any(each in sentence for each in told)


def started_by_compute(make):
    def build(session):
        study = make(session)._study
        is_under_way = re.compile(r"Done|[1-9]\d* of")
        return study.start, lambda: is_under_way.match(study.controls[-1].text)

    return build


def moved(session):
    part, places = Sliders(session, Jump(), "", jump, count=2), iter(range(20, 99))
    return lambda: part._ask(Jump(onset_bin=next(places))), lambda: part._cards[1].figure


def repeated(session):
    plan, table = {Condition("car", 0.06): paper.COMPARED[:1]}, paper.arithmetic()
    return Trials(session, Repeated(repetitions=2), "", lambda _: plan, lambda *_: table)


def ways(session):
    part = Ways(session, lambda *_: None)
    part._effort = Effort(repetitions=2, repeats=6, merges="none")
    return part


def trust(session):
    part = Trust(session)
    part._swept = type(part._swept)(ESTIMATORS["kde"].title)
    return part


def requires(session):
    part = Requires(session)
    part._judged = Judged(repetitions=2)
    return part


def navigated(session):
    page, maps = Inspector(session), cycle(["Peak", "Counts"])
    nothing = page._navigator.figure.title.text
    page.view.show(True)
    return (
        lambda: session.state.param.update(map=next(maps)),
        lambda: page._navigator.figure.title.text != nothing,
    )


def pinned(session):
    part, places = Pins(session), cycle([(0, 0), (1, 1)])
    part.view.show(True)
    return lambda: session.state.param.update(pins=(next(places),)), lambda: part._table.rows


def added(session):
    part, rows = Sight(session, "region"), cycle([1, 2])
    part.view.show(True)
    region = (rectangle((0, row), (0, 1)) for row in rows)
    return lambda: session.state.param.update(region=next(region)), lambda: part._facts.facts


def reported(session):
    part = Whole(session)
    part.view.show(True)
    return part._follow, lambda: part._facts.facts


PARTS = {
    "app.pages.inspect.page.map_of": navigated,
    "app.pages.inspect.pins.pixel_lit": pinned,
    "core.inspection.region_report": added,
    "core.inspection.capture_report": reported,
    "core.inspection.accuracy_over_pulses": started_by_compute(Whole),
    "core.studies.paper.figures.figure_1": moved,
    "app.pages.paper.page.trials": started_by_compute(repeated),
    "core.studies.paper.figures.figure_8": started_by_compute(RangeImages),
    "app.pages.tradeoff.page.study": started_by_compute(ways),
    "app.pages.tradeoff.page.acquired": started_by_compute(Acquisition),
    "app.pages.tradeoff.ablation.requirements": started_by_compute(requires),
    "app.pages.tradeoff.sensitivity.setting_sweep": started_by_compute(trust),
}


REFUSE = ("core.inspection.region_report",)
"""Parts that may refuse their input: their ``ValueError`` stands where the picture would be."""


def few_pixels():
    return {"uniform": scene_source("Few pixels", "uniform", size=8)}


@pytest.fixture
def session():
    return Session(few_pixels())


@pytest.mark.parametrize("where", PARTS)
def test_work_of_a_page_that_fails_is_told_and_the_next_works(where, monkeypatch, session):
    raised, told = breaking(monkeypatch, where), []
    session.failures.shown.subscribe(told.append)
    errors = RAISED[1:] if where in REFUSE else RAISED
    raised[:] = errors[:1]
    act, goes_on = PARTS[where](session)
    for error in errors:
        raised[:], before = [error], len(told)
        act()
        eventually(lambda before=before: len(told) > before and told[-1])
        check_told(told[-1], error)
        assert "Compute" in told[-1] or "The picture still shows" in told[-1]
        assert not goes_on()
    raised.clear()
    act()
    eventually(goes_on)
    eventually(lambda: told[-1] == "")


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


def test_another_pixel_does_not_silence_a_map_that_failed(monkeypatch, session):
    raised, told = breaking(monkeypatch, "app.pages.inspect.page.map_of"), []
    session.failures.shown.subscribe(told.append)
    raised.append(MemoryError())
    change_map, _ = navigated(session)
    sight = Sight(session, "pixel")
    sight.view.show(True)
    change_map()
    eventually(lambda: told)
    session.choose_pixel(1, 1)
    eventually(lambda: sight._facts.facts[0][1] == "1, 1")
    assert told[-1]


def messages(page):
    return {row["name"]: row.get("message", "") for row in page._table.rows}


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_a_method_that_fails_is_told_and_works_once_it_is_picked_anew(error, monkeypatch, session):
    raised, name = (
        breaking(monkeypatch, "app.pages.compare.page.run_task"),
        ESTIMATORS["peak"].title,
    )
    raised[:] = [error]
    session.state.comparison = replace(session.state.comparison, methods=("peak",))
    page = Compare(session)
    page.view.show(True)
    eventually(lambda: page._measure is not None)
    check_told(messages(page)[name], error)
    raised.clear()
    page._picks.value = []
    page._picks.value = ["peak"]
    eventually(lambda: len(page._answers()) == 1)
    eventually(lambda: messages(page)[name] == "")


def test_a_limit_that_fails_is_told_and_is_not_called_unknown(monkeypatch, session):
    raised = breaking(monkeypatch, "app.pages.compare.page.yardstick")
    raised[:] = RAISED[2:]
    session.state.comparison = replace(session.state.comparison, methods=("peak",))
    page = Compare(session)
    session.estimate.changed.subscribe(page.view.follow)
    page.view.show(True)
    eventually(lambda: messages(page)["Physics’ limit"] not in ("", words.NOT_COMPUTED))
    check_told(messages(page)["Physics’ limit"], raised[0])
    raised.clear()
    session.state.light = Illumination(seed=1)
    eventually(lambda: page._measure is not None and page._measure.limit is not None)
    eventually(lambda: messages(page)["Physics’ limit"] == "")


def test_curves_that_fail_are_told_and_those_of_the_next_pixel_are_drawn(monkeypatch, session):
    raised, told = breaking(monkeypatch, "app.pages.compare.page.score_curves"), []
    session.failures.shown.subscribe(told.append)
    session.state.comparison = replace(session.state.comparison, methods=("peak",))
    page = Compare(session)
    page.view.show(True)
    eventually(lambda: page._measure is not None)
    for error in RAISED:
        raised[:], before = [error], len(told)
        page._ask_curves()
        eventually(lambda before=before: len(told) > before and told[-1])
        check_told(told[-1], error)
    raised.clear()
    session.choose_pixel(1, 2)
    eventually(lambda: told[-1] == "")


def test_what_is_typed_in_vain_is_told_and_the_next_reading_works():
    layout = Layout({"sample": built_in_sources()["sample"]})
    opened(layout, "How to read the file")
    width, alert, again = (
        control(layout, "Bin width (s)"),
        layout.alert,
        control(layout, "Read again"),
    )
    width.value = "<b>wide</b>"
    again.clicks += 1
    assert "bin_width_s = '<b>wide</b>' is not accepted: give" in alert.text
    width.value = "-2e-9"
    again.clicks += 1
    eventually(lambda: "bin_width_s = -2e-09" in alert.text)
    width.value = "2e-9"
    again.clicks += 1
    eventually(lambda: alert.text == "")
    assert layout.session.answer.capture.acquisition.bin_width_s == 2e-9


def test_an_address_that_asks_for_an_unreadable_file_names_no_folder(monkeypatch):
    raised, wanted = breaking(monkeypatch, "app.model.restore.compute"), Wanted({"seed": "3"})
    for error in RAISED:
        raised[:] = [error]
        with pytest.raises(type(error)):
            Session(few_pixels(), wanted)
        check_told(wanted.refused.pop(), error)


# -- a page that cannot be built -------------------------------------------------------------------


def test_a_page_that_cannot_be_built_says_so_and_the_log_says_why(monkeypatch, caplog):
    raised = breaking(monkeypatch, "app.__main__.build_page")
    for error in RAISED:
        raised[:] = [error]
        page = started.page_for(few_pixels(), Uploads())
        assert (page.text, page.warning) == (words.NO_PAGE, True)
        assert caplog.records[-1].exc_info[1] is error
    raised.clear()
    assert isinstance(started.page_for(few_pixels(), Uploads()), Template)


def test_files_have_names_and_no_folders():
    for path, name in (
        ("/srv/data/secret/face.mat", "face.mat"),
        ("'/srv/my data/fa ce.mat'", "'fa ce.mat'"),
        ('"/srv/a/b.npz"', '"b.npz"'),
    ):
        told = f"it.mat: cannot be read ({path}: 3.5 counts/s, 1/2/3, m/s): give another"
        kept = f"it.mat: cannot be read ({name}: 3.5 counts/s, 1/2/3, m/s): give another"
        assert words.without_folders(told) == kept
        for say in (
            words.failure,
            words.reason,
            words.unfinished,
            ranking_words.problem,
            ranking_words.no_yardstick,
            download_words.not_saved,
        ):
            assert "/srv" not in say(CaptureError(told))
            assert "/srv" not in say(OSError(told))


def test_a_page_that_cannot_be_built_leaves_the_one_that_is_open():
    broken = True

    def build():
        if broken:
            raise OSError(28, "No space left on device")
        return View(pn.pane.Str("there"), [])

    pages = Pages({"first": lambda: View([], []), "second": build})
    with pytest.raises(OSError, match="No space"):
        pages.choice.value = "second"
    assert pages.choice.value == "first"
    assert [pages.mains[name].visible for name in ("first", "second")] == [True, False]
    broken = False
    pages.choice.value = "second"
    assert [pages.mains[name].visible for name in ("first", "second")] == [False, True]
    assert len(pages.mains["second"]) == 1


def killed(_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_is_killed_is_told_and_the_next_works(monkeypatch, session):
    told = []
    session.failures.shown.subscribe(told.append)
    start, goes_on = started_by_compute(ways)(session)
    with monkeypatch.context() as patched:
        patched.setattr("core.studies.tradeoff.measure.held_bytes", killed)
        start()
        eventually(lambda: told and "BrokenProcessPool" in told[-1])
    assert "Compute begins anew" in told[-1]
    start()
    eventually(lambda: goes_on() and goes_on()[0] == "Done")
    assert told[-1] == ""
