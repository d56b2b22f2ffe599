"""Values of our components on their way to the page and back."""

from __future__ import annotations

import pytest
from bokeh.document import Document

from app.widgets.controls import Knob


@pytest.fixture
def knob():
    return Knob(label="l", value=0.5, low=0.0, high=1.0)


@pytest.fixture
def model(knob):
    """The knob's model in a page of its own."""
    document = Document()
    document.add_root(knob.get_root(document))
    return document.roots[0]


def test_only_changed_values_go_to_the_page(knob, model):
    before = model.data.properties_with_values()
    knob.value = 0.25
    knob.param.update(high=2.0, label="L")
    after = model.data.properties_with_values()
    changed = {name: after[name] for name in after if after[name] != before[name]}
    assert changed == {"value": 0.25, "high": 2.0, "label": "L"}


def test_a_value_from_the_page_is_not_sent_back(knob, model):
    received, changes = [], []
    knob.param.watch(lambda event: received.append(event.new), "value")
    model.document.on_change(lambda event: changes.append((event.attr, event.new)))
    model.data.value = 0.75
    assert received == [knob.value] == [0.75]
    assert changes == [("value", 0.75)]  # the page's own


def test_a_corrected_value_is_sent_back(knob, model):
    knob.param.watch(lambda event: setattr(knob, "value", round(event.new, 1)), "value")
    model.data.value = 0.777
    assert knob.value == model.data.value == 0.8


def test_panels_own_parameters_are_updated_together_with_values(knob, model):
    knob.param.update(visible=False, value=0.1)
    assert not model.visible
    assert model.data.value == 0.1
