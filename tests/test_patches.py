"""Patches of Panel and Bokeh: they can be left out, and give what the libraries give."""

from __future__ import annotations

import gc
import json
import weakref
from pathlib import Path

import numpy as np
import pytest
from bokeh.core.property.descriptors import PropertyDescriptor
from bokeh.core.serialization import Deserializer, Serializer, UnknownReferenceError
from bokeh.document import Document
from bokeh.models import ColumnDataSource, Line, Range1d
from bokeh.plotting import figure
from playwright.sync_api import expect

import app.server.patches
from app.server.garbage import collect_all, spare
from app.server.patches import OFF_VARIABLE, PATCHES, Patch, in_use
from app.server.patches.default_values import cached
from app.server.patches.incoming_messages import QuickDeserializer
from app.server.patches.outgoing_messages import INLINE_BYTES, QuickSerializer
from tests.browser import fact, open_page, serving
from tests.test_browser import slider

FOLDER = Path(app.server.patches.__file__).parent

# -- switches --------------------------------------------------------------------------------------


def test_each_patch_is_a_file_that_states_its_upstream_issue():
    files = [*FOLDER.glob("*.js"), *(f for f in FOLDER.glob("*.py") if f.stem != "__init__")]
    assert sorted(f.stem for f in files) == sorted(patch.name for patch in PATCHES)
    for file in files:
        assert "Upstream:" in file.read_text(encoding="utf-8"), file.name


def test_patches_are_left_out_by_name(monkeypatch):
    monkeypatch.setenv(OFF_VARIABLE, "debounce, legend_items")
    assert len(list(in_use())) == len(PATCHES) - 2
    assert not {"debounce", "legend_items"} & {patch.name for patch in in_use()}
    monkeypatch.setenv(OFF_VARIABLE, "all")
    assert not list(in_use())
    monkeypatch.setenv(OFF_VARIABLE, "debonce")
    with pytest.raises(ValueError, match="debonce"):
        list(in_use())


def test_a_patch_for_another_version_is_left_out_with_a_warning(caplog):
    newer, present = Patch("newer", {"bokeh": "99.1"}), Patch("present", {"bokeh": "3"})
    assert list(in_use((newer, present))) == [present]
    assert "newer is left out: bokeh" in caplog.text


@pytest.mark.browser
def test_the_app_works_with_all_patches_off(browser):
    with serving(**{OFF_VARIABLE: "all"}) as address:
        page = open_page(browser, address)
        rmse = fact(page, "RMSE").inner_text()
        for _ in range(5):
            slider(page, "SBR").press("ArrowRight")
        expect(fact(page, "RMSE")).not_to_have_text(rmse)
        for name in ("Inspect", "Compare"):
            page.get_by_role("button", name=name, exact=True).click()
            expect(page.locator(".bk-Figure").filter(visible=True).first).to_be_visible()
        page.close()


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
    told = [known, new, [known, {"a": plot.y_range}], np.zeros(INLINE_BYTES)]
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
    few, many = np.arange(5, dtype=np.float32), np.zeros(INLINE_BYTES + 1, np.uint8)
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

    kept = cached(counting)
    for model in document.models:
        for name in model.properties() - model._property_values.keys():
            descriptor = model.lookup(name)
            theirs = [get(descriptor, model), kept(descriptor, model), kept(descriptor, model)]
            assert len({repr(each) for each in theirs}) == 1  # NaN is not itself
    lines = [each for each in document.models if isinstance(each, Line)]
    assert len(lines) > 1
    assert found.count((Line, "tags")) > found.count((Line, "line_width")) == 1


def test_defaults_that_may_be_changed_in_place_are_each_models_own():
    kept = cached(PropertyDescriptor._get_default)
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
