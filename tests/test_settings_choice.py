"""Settings that are chosen for the capture on screen, without a browser."""

from dataclasses import replace
from threading import Event

import pytest

from app.model.store import built_in_sources
from app.pages.session import Session
from app.pages.shared.method import MethodChoice
from app.tasks.scheduler import Cancelled
from core import TrackingParameters, tuned
from tests.threads import HeldTasks, change

CHOOSE = "Choose for this capture"


@pytest.fixture
def session():
    session = Session({"car": built_in_sources()["car"]}, tasks=HeldTasks())
    session.state.light = replace(session.state.light, sbr=0.03)
    session.tasks.run_until(lambda: session.estimate.is_settled)
    return session


@pytest.fixture
def choice(session):
    choice = MethodChoice(session)
    session.estimate.changed.subscribe(choice.show)
    choice.show(session.answer)
    choice.chooser.part.collapsed = False
    return choice


def press(choice):
    """Press the button that starts the choice."""
    part = choice.chooser.part
    (button,) = part.select(lambda each: getattr(each, "label", None) == CHOOSE)
    assert not button.disabled
    button.clicks += 1


def test_settings_are_chosen_shown_and_undone(session, choice):
    chooser, before = choice.chooser, session.query()
    expected = tuned(session.answer.capture, "tracking")
    assert not expected.is_default
    press(choice)
    session.tasks.run_until(lambda: chooser.note.text)
    assert session.state.tracking == expected.settings
    assert expected.why in chooser.note.text
    first = chooser.table.rows[0]
    assert first["cells"][0][1] == expected.trials[0].rd and "l " in first["name"]
    session.tasks.run_until(lambda: session.answer.settings == expected.settings)
    assert chooser.note.text  # it is about the capture, which is still the same

    session.recall(before)  # as Undo does
    session.tasks.run_until(lambda: session.answer.settings == TrackingParameters())
    assert session.state.tracking == TrackingParameters()


def test_settings_of_the_method_on_screen_are_chosen(session, choice):
    change(session, method="likelihood")
    expected = tuned(session.answer.capture, "likelihood")
    assert not expected.is_default
    press(choice)
    session.tasks.run_until(lambda: session.answer.settings == expected.settings)
    assert session.state.settings["likelihood"] == expected.settings
    assert session.state.tracking == TrackingParameters()


def test_the_choice_is_forgotten_with_its_capture(session, choice):
    press(choice)
    session.tasks.run_until(lambda: choice.chooser.note.text)
    change(session, light=replace(session.state.light, sbr=0.06))
    session.tasks.run_until(lambda: not choice.chooser.note.text)
    assert not choice.chooser.table.visible


@pytest.mark.parametrize("other", ["method", "capture"])
def test_another_method_or_capture_cancels_the_choice(other, session, choice, monkeypatch):
    is_changed, has_ended, raised = Event(), Event(), []

    def held(capture, method, progress):
        is_changed.wait(60)
        try:
            progress(1, 2)
        except Cancelled as error:
            raised.append(error)
            raise
        finally:
            has_ended.set()

    monkeypatch.setattr("app.pages.shared.tuning.tuned", held)
    press(choice)
    if other == "method":
        change(session, method="peak")
    else:
        change(session, light=replace(session.state.light, sbr=0.06))
    is_changed.set()
    assert has_ended.wait(60) and raised
    assert session.state.tracking == TrackingParameters()
    assert choice.chooser.note.text == ""


def test_a_failure_names_the_button_that_starts_it(session, choice, monkeypatch):
    def fail(*_):
        raise MemoryError

    shown = []
    session.failures.shown.subscribe(shown.append)
    monkeypatch.setattr("app.pages.shared.tuning.tuned", fail)
    press(choice)
    session.tasks.run_until(lambda: shown)
    assert f"Press “{CHOOSE}” to run it again" in shown[-1]


@pytest.mark.parametrize(
    ("method", "is_offered"),
    [("likelihood", True), ("cfar", True), ("coates", False), ("oracle", False)],
)
def test_methods_with_settings_to_choose_have_the_button(method, is_offered, session, choice):
    change(session, method=method)
    assert choice.chooser.part.visible == is_offered
