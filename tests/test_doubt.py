"""Doubtful settings: zones marked on the slider, and a sentence that says why."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest
from playwright.sync_api import expect

from app.widgets.controls import SettingsPanel
from core import PRESETS, TrackingParameters
from core.estimators import ESTIMATORS
from core.parameters import Number, joint_doubts, spec_of
from tests.browser import eventually


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
    panel.show(PRESETS["as printed"])
    assert panel.doubts.text == ""


def test_a_panel_explains_its_initial_settings():
    settings = replace(TrackingParameters(), alpha=5.0)
    panel = SettingsPanel(settings, lambda new: None)
    assert panel.doubts.text == " ".join(joint_doubts(settings)) != ""
    assert panel.doubts in panel.layout


@pytest.mark.browser
def test_a_slider_shows_its_doubtful_zone_and_says_why_while_it_is_there(page):
    shown = page()
    knob = shown.locator(".knob", has=shown.get_by_role("slider", name="m", exact=True))
    knob = knob.filter(visible=True)
    zones, doubt = knob.locator(".zone"), knob.get_by_role("status", include_hidden=True)
    expect(zones).to_have_count(3)
    expect(doubt).to_be_hidden()

    # Where the thumb stands at a zone's edge, the band ends: half a thumb is beyond either end.
    knob.locator(".field").fill("0.8")
    knob.locator(".field").press("Enter")
    (m,) = (each for each in fields(TrackingParameters) if each.name == "m")
    reasons = [zone.why for zone in spec_of(m).doubtful if zone.low <= 0.8 <= zone.high]
    expect(doubt).to_have_text(" ".join(reasons))
    track, band = knob.locator(".track").bounding_box(), zones.nth(1).bounding_box()
    position = float(knob.locator(".track").input_value()) / 400
    thumb = track["x"] + 8 + position * (track["width"] - 16)
    assert abs(band["x"] + band["width"] - thumb) <= 1.5

    # What a screen reader reads of the slider includes the sentence, and the help the zones.
    assert knob.locator(".track").get_attribute("aria-describedby") == "help doubt"
    knob.get_by_role("button", name="Help on m").click()
    expect(knob.locator(".help")).to_contain_text(f"Unreliable from 0.8 to 1: {reasons[-1]}")

    # In both modes it can be distinguished from what is behind it.
    for _ in ("light", "dark"):
        eventually(lambda: zones.nth(1).evaluate(CONTRAST) >= 3)  # once colours have faded over
        before = shown.evaluate(PAPER)
        shown.get_by_role("button", name="Toggle theme").click()
        eventually(lambda before=before: shown.evaluate(PAPER) != before)

    knob.get_by_role("button", name="Reset m to 1.4").click()
    expect(doubt).to_be_hidden()


PAPER = "getComputedStyle(document.body).backgroundColor"
CONTRAST = """
(element) => {
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const light = (rgb) => rgb.slice(0, 3)
    .map((c) => c / 255)
    .map((c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4))
    .reduce((sum, c, i) => sum + c * [0.2126, 0.7152, 0.0722][i], 0);
  let behind = element;
  const solid = (node) => {
    const color = parts(getComputedStyle(node).backgroundColor);
    return color.length < 4 || color[3] === 1 ? color : null;
  };
  const up = (node) => node.assignedSlot || node.parentNode || node.host;
  let color = null;
  while (behind && !color) {
    if (behind instanceof Element) color = solid(behind);
    behind = up(behind);
  }
  const border = parts(getComputedStyle(element).borderColor);
  const pair = [light(border), light(color)].sort((a, b) => b - a);
  return (pair[0] + 0.05) / (pair[1] + 0.05);
}
"""
