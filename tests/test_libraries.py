"""What is done in the place of Panel and Bokeh gives what they give."""

from __future__ import annotations

import gc
import json
import weakref
from importlib import import_module

import numpy as np
import panel as pn
import pytest
from bokeh.core.property.descriptors import PropertyDescriptor
from bokeh.core.serialization import Deserializer, Serializer, UnknownReferenceError
from bokeh.document import Document
from bokeh.document.events import ModelChangedEvent
from bokeh.models import ColumnDataSource, Line, Range1d
from bokeh.plotting import figure
from bokeh.protocol import Protocol
from panel.io.document import _destroy_document

from app.server.garbage import collect_all, spare
from app.server.patches.latency import (
    FEW_BYTES,
    REPLACED,
    QuickDeserializer,
    QuickSerializer,
    _kept,
)
from app.widgets.component import Component
from app.widgets.controls import Knob, PixelKeys

# -- components ------------------------------------------------------------------------------------


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


# -- messages --------------------------------------------------------------------------------------


@pytest.fixture
def document():
    made = Document()
    plot = figure()
    plot.line("x", "y", source=ColumnDataSource({"x": np.arange(3.0), "y": np.ones(3)}))
    made.add_root(plot)
    return made


def test_a_message_names_known_models_and_spells_out_new_ones(document):
    (plot,) = document.roots
    known, new = plot.x_range, Range1d(0, 5)
    told = [known, new, [known, {"a": plot.y_range}], np.zeros(FEW_BYTES)]
    written = []
    for serializer in (Serializer, QuickSerializer):
        made = serializer(references=set(document.models))
        written.append(made.encode(told))
        assert made.has_ref(known)
        assert made.has_ref(new)
        assert not made.has_ref(Range1d())
        assert len(made.buffers) == 1
    theirs, ours = (json.dumps(each, default=lambda _: "buffer") for each in written)
    assert ours == theirs
    assert written[1][0] == known.ref


def test_few_numbers_travel_within_the_message():
    few, many = np.arange(5, dtype=np.float32), np.zeros(FEW_BYTES + 1, np.uint8)
    serializer = QuickSerializer()
    message = json.loads(json.dumps(serializer.encode(few)))
    assert serializer.buffers == []
    assert np.array_equal(Deserializer().decode(message), few)
    serializer.encode(many)
    assert [each.data.nbytes for each in serializer.buffers] == [many.nbytes]


def test_defaults_are_found_once_for_all_models_of_a_kind(document):
    found, get = [], PropertyDescriptor._get_default

    def counting(descriptor, model):
        found.append((type(model), descriptor.name))
        return get(descriptor, model)

    kept = _kept(counting)
    for model in document.models:
        for name in model.properties() - model._property_values.keys():
            descriptor = model.lookup(name)
            theirs = [get(descriptor, model), kept(descriptor, model), kept(descriptor, model)]
            assert len({repr(each) for each in theirs}) == 1  # NaN is not itself
    lines = [each for each in document.models if isinstance(each, Line)]
    assert len(lines) > 1
    assert found.count((Line, "tags")) > found.count((Line, "line_width")) == 1


def test_defaults_that_may_be_changed_in_place_are_each_models_own():
    kept = _kept(PropertyDescriptor._get_default)
    one, other = (kept(each.lookup("tags"), each) for each in (Range1d(), Range1d()))
    one.append("x")
    assert other == []


def test_a_message_finds_known_models_and_makes_new_ones(document):
    (plot,) = document.roots
    new = Range1d(0, 5)
    told = json.loads(json.dumps(Serializer(references={plot}).encode([plot, new, new])))
    for deserializer in (Deserializer, QuickDeserializer):
        made = deserializer(list(document.models), setter=None)
        found, range_, again = made.decode(told)
        assert found is plot
        assert range_ is again
        assert (range_.start, range_.end) == (0, 5)
        assert made.has_ref(plot)
        assert made.has_ref(range_)
        assert not made.has_ref(Range1d())


def test_a_model_that_comes_to_the_document_later_was_not_known(document):
    made = QuickDeserializer(list(document.models))
    later = Range1d()
    document.add_root(later)
    assert not made.has_ref(later)


def patch(**changed):
    """What a page would say of a model's attribute, by the model's id."""
    events = [
        {"kind": "ModelChanged", "model": {"id": model}, "attr": "start", "new": value}
        for model, value in changed.items()
    ]
    return {"events": events}


def test_what_is_said_of_others_than_of_a_model_that_is_gone_is_heard(document, monkeypatch):
    monkeypatch.setattr("bokeh.document.document.Deserializer", QuickDeserializer)
    there, gone = Range1d(), Range1d()
    document.add_root(there)
    document.add_root(gone)
    document.remove_root(gone)
    heard = []
    there.on_change("start", lambda attr, old, new: heard.append(new))
    document.apply_json_patch(patch(**{gone.id: 1}))
    document.apply_json_patch(patch(**{gone.id: 2, there.id: 3}))
    document.apply_json_patch(patch(**{there.id: 4, gone.id: 5}))
    assert heard == [3, 4]
    with pytest.raises(UnknownReferenceError, match="never-there"):
        document.apply_json_patch(patch(**{there.id: 6, "never-there": 7}))
    assert there.start == 4


# -- where it is put -------------------------------------------------------------------------------


@pytest.mark.parametrize("place", REPLACED, ids=" ".join)
def test_what_is_replaced_is_what_the_libraries_use(place, document, monkeypatch):
    """Under another name it would stand there in vain."""
    used, (module, name) = [], place

    def standing_in(*arguments, **options):
        used.append(place)
        return REPLACED[place](*arguments, **options)

    assert name in vars(import_module(module))
    monkeypatch.setitem(vars(import_module(module)), name, standing_in)
    (plot,) = document.roots
    event = ModelChangedEvent(document, plot, "width", 300)
    message = Protocol().create("PATCH-DOC", [event])
    document.apply_json_patch(message.payload)
    assert plot.width == 300
    scheduled = []
    monkeypatch.setattr(pn.state, "schedule_task", lambda _, act, **_at: scheduled.append(act))
    document.destroy = None
    _destroy_document(document, None)
    for act in scheduled:
        act()
    assert used == [place]


def test_all_in_use_is_passed_over_and_all_is_looked_through():
    class Loop:
        def __init__(self):
            self.itself = self

    left = Loop()
    gone = weakref.ref(left)
    spare()
    try:
        assert gc.get_freeze_count() > 0
        del left
        gc.collect()
        assert gone() is not None
        collect_all()
        assert gone() is None
        assert gc.get_freeze_count() > 0
    finally:
        gc.unfreeze()
