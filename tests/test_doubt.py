"""Doubtful settings: zones marked on the slider, and a sentence that says why."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest

from app.widgets.controls import SettingsPanel
from core import PRESETS, TrackingParameters
from core.estimators import ESTIMATORS
from core.parameters import Number, joint_doubts, spec_of


@pytest.mark.parametrize("method", ESTIMATORS)
def test_sliders_have_the_doubtful_zones_of_their_settings(method):
    settings = ESTIMATORS[method].parameters()
    controls = SettingsPanel(settings, lambda new: None).controls
    for each in fields(settings):
        spec = spec_of(each)
        if isinstance(spec, Number):
            zones = [[zone.low, zone.high, zone.why] for zone in spec.doubtful]
            assert controls[each.name].doubtful == zones


def test_a_doubtful_combination_is_explained_while_it_is_set():
    panel = SettingsPanel(TrackingParameters(), lambda new: None)
    assert panel.doubts.live
    assert panel.doubts.text == ""
    panel.controls["l"].value = 0.7
    assert panel.doubts.text == joint_doubts(TrackingParameters(l=0.7))[0]
    before = panel.doubts.text
    panel.controls["start"].value = "zero"
    assert panel.doubts.text.startswith(before) and panel.doubts.text != before
    panel.show(PRESETS["literal"])
    assert panel.doubts.text == ""


def test_doubts_that_do_not_hold_for_the_data_are_not_shown():
    panel = SettingsPanel(replace(TrackingParameters(), alpha=5.0), lambda new: None)
    zones, doubts = panel.controls["l"].doubtful, panel.doubts.text
    assert zones and doubts
    panel.mark_doubts(False)
    panel.controls["l"].value = 0.7
    assert (panel.controls["l"].doubtful, panel.doubts.text) == ([], "")
    panel.controls["l"].value = TrackingParameters().l
    panel.mark_doubts(True)
    assert (panel.controls["l"].doubtful, panel.doubts.text) == (zones, doubts)


def test_a_panel_explains_its_initial_settings():
    settings = replace(TrackingParameters(), alpha=5.0)
    panel = SettingsPanel(settings, lambda new: None)
    assert panel.doubts.text == " ".join(joint_doubts(settings)) != ""
    assert panel.doubts in panel.layout
