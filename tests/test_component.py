"""The short path of a component's own values to the page and back."""

from __future__ import annotations

import pytest
from bokeh.document import Document

from app.widgets.component import Component
from app.widgets.controls import Knob, PixelKeys


def shown(component):
    """A component's model in a page of its own."""
    component.server_doc(Document())
    ((model, _),) = component._models.values()
    return model


@pytest.fixture
def knob():
    return Knob(label="l", value=0.5, low=0.0, high=1.0)


def test_a_value_goes_to_the_page_and_no_other_does(knob):
    model = shown(knob)
    before = model.data.properties_with_values()
    knob.value = 0.25
    knob.param.update(high=2.0, label="L")
    after = model.data.properties_with_values()
    changed = {name: after[name] for name in after if after[name] != before[name]}
    assert changed == {"value": 0.25, "high": 2.0, "label": "L"}


def test_a_value_comes_from_the_page_and_is_not_sent_back(knob):
    model, heard, changes = shown(knob), [], []
    knob.param.watch(lambda event: heard.append(event.new), "value")
    model.document.on_change(lambda event: changes.append((event.attr, event.new)))
    model.data.value = 0.75
    assert heard == [knob.value] == [0.75]
    assert changes == [("value", 0.75)]  # the page's own


def test_what_is_made_of_a_value_from_the_page_is_sent(knob):
    model = shown(knob)
    knob.param.watch(lambda event: setattr(knob, "value", round(event.new, 1)), "value")
    model.data.value = 0.777
    assert knob.value == model.data.value == 0.8


def test_what_is_no_value_of_its_own_goes_as_panel_has_it(knob):
    model = shown(knob)
    knob.param.update(visible=False, value=0.1)
    assert not model.visible
    assert model.data.value == 0.1


def test_a_child_is_no_plain_value():
    assert PixelKeys._are_plain({"pixel": [1, 2], "shape": [3, 3]})
    assert not PixelKeys._are_plain({"child": None})
    assert not Component._are_plain({"visible": True})
