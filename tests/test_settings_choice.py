"""Tests of settings that choose themselves, without a browser."""

from dataclasses import replace

import pytest

from app.model.store import built_in_sources
from app.pages.session import Session
from app.pages.shared.tuning import SettingsChooser
from core import TrackingParameters, tuned
from tests.threads import HeldTasks


@pytest.fixture
def session():
    session = Session({"car": built_in_sources()["car"]}, tasks=HeldTasks())
    session.state.light = replace(session.state.light, sbr=0.03)
    session.tasks.run_until(lambda: session.estimate.is_settled)
    return session


def test_settings_are_chosen_shown_and_forgotten_with_the_capture(session):
    chooser = SettingsChooser(session)
    session.estimate.changed.subscribe(chooser.follow)
    expected = tuned(session.answer.capture, "tracking")
    assert not expected.is_default
    chooser.work.start()
    session.tasks.run_until(lambda: chooser.note.text)
    assert session.state.tracking == expected.settings
    assert expected.why in chooser.note.text
    first = chooser.table.rows[0]
    assert first["cells"][0][1] == expected.trials[0].rd and "l " in first["name"]

    session.tasks.run_until(lambda: session.answer.settings == expected.settings)
    assert chooser.note.text  # it is about the capture, which is still the same
    session.state.light = replace(session.state.light, sbr=0.06)
    session.tasks.run_until(lambda: not chooser.note.text)
    assert not chooser.table.visible


def test_a_choice_for_another_capture_is_dropped(session):
    chooser = SettingsChooser(session)
    chooser.work.start()
    session.state.light = replace(session.state.light, sbr=0.06)
    session.tasks.run_until(
        lambda: session.estimate.is_settled and "Done" in chooser.work.sentence.text
    )
    assert session.state.tracking == TrackingParameters() and not chooser.note.text


def test_methods_without_settings_have_no_button(session):
    chooser = SettingsChooser(session)
    session.estimate.changed.subscribe(chooser.follow)
    for method, is_offered in (("oracle", False), ("coates", False), ("likelihood", True)):
        session.state.method = method
        session.tasks.run_until(lambda method=method: session.answer.method == method)
        assert chooser.part.visible == is_offered
