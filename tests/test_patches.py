"""Patches of Panel and Bokeh can be left out, and return what the libraries return."""

from __future__ import annotations

import asyncio
import gc
import json
import math
import re
import weakref
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bokeh.core.property.descriptors import PropertyDescriptor
from bokeh.core.serialization import Deserializer, Serializer, UnknownReferenceError
from bokeh.document import Document
from bokeh.models import ColumnDataSource, Line, Range1d
from bokeh.plotting import figure
from playwright.sync_api import expect
from tornado.websocket import WebSocketClosedError

import app.server.patches
from app.server.garbage import collect_all, freeze_all
from app.server.patches import OFF_VARIABLE, PATCHES, Patch, in_use
from app.server.patches.default_values import cached
from app.server.patches.outgoing_messages import INLINE_BYTES, QuickSerializer
from app.server.patches.removed_models import PartialDeserializer
from app.server.patches.whole_messages import send_whole
from tests.browser import fact, open_page, serving
from tests.latency import STOPWATCH, moves

FOLDER = Path(app.server.patches.__file__).parent

# -- switches --------------------------------------------------------------------------------------


def test_each_file_states_the_upstream_issue_and_a_gain_or_a_fix():
    files = [*FOLDER.glob("*.js"), *(f for f in FOLDER.glob("*.py") if f.stem != "__init__")]
    assert sorted(f.stem for f in files) == sorted(patch.name for patch in PATCHES)
    for file in files:
        text = file.read_text(encoding="utf-8")
        assert re.search(r"Upstream:", text), file.name
        assert re.search(r"Gain:|Fixes", text), file.name


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
        page = open_page(browser, address, prepare=STOPWATCH)
        rmse = fact(page, "RMSE").inner_text()
        for move in moves(page, "SBR", 3):  # timed from the key to the last stroke
            assert 0 < move.server <= move.plots <= move.everything < math.inf
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


def test_a_message_refers_to_known_models_and_contains_new_ones(document):
    (plot,) = document.roots
    known, new = plot.x_range, Range1d(0, 5)
    sent = [known, new, [known, {"a": plot.y_range}], np.zeros(INLINE_BYTES)]
    written = []
    for serializer in (Serializer, QuickSerializer):
        made = serializer(references=set(document.models))
        written.append(made.encode(sent))
        assert made.has_ref(known)
        assert made.has_ref(new)
        assert not made.has_ref(Range1d())
        assert len(made.buffers) == 1
    theirs, ours = (json.dumps(each, default=lambda _: "buffer") for each in written)
    assert ours == theirs
    assert written[1][0] == known.ref


def test_short_arrays_are_part_of_the_message():
    few, many = np.arange(5, dtype=np.float32), np.zeros(INLINE_BYTES + 1, np.uint8)
    serializer = QuickSerializer()
    message = json.loads(json.dumps(serializer.encode(few)))
    assert serializer.buffers == []
    assert np.array_equal(Deserializer().decode(message), few)
    serializer.encode(many)
    assert [each.data.nbytes for each in serializer.buffers] == [many.nbytes]


def test_a_page_that_closes_during_a_message_leaves_no_error():
    parts = dict.fromkeys(("header_json", "metadata_json", "content_json"), "")
    errors, message = [], SimpleNamespace(buffers=[], **parts)

    class Closing:
        """A connection that is closed once it is written to."""

        parts = 0

        def is_closing(self):
            return self.parts > 0

        def write_message(self, part, binary):
            self.parts += 1
            return asyncio.get_running_loop().create_task(self.fail())

        async def fail(self):
            raise WebSocketClosedError

    async def send():
        asyncio.get_running_loop().set_exception_handler(lambda _, found: errors.append(found))
        await send_whole(SimpleNamespace(ws_connection=Closing()), message)
        gc.collect()

    asyncio.run(send())
    assert not errors


def test_a_default_is_computed_once_for_a_class(document):
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


def test_mutable_defaults_are_not_shared():
    kept = cached(PropertyDescriptor._get_default)
    one, other = (kept(each.lookup("tags"), each) for each in (Range1d(), Range1d()))
    one.append("x")
    assert other == []


def patch(**changed):
    """A message that sets attributes, by the id of the model."""
    events = [
        {"kind": "ModelChanged", "model": {"id": model}, "attr": "start", "new": value}
        for model, value in changed.items()
    ]
    return {"events": events}


def test_only_events_of_removed_models_are_dropped(document, monkeypatch):
    monkeypatch.setattr("bokeh.document.document.Deserializer", PartialDeserializer)
    present, removed = Range1d(), Range1d()
    document.add_root(present)
    document.add_root(removed)
    document.remove_root(removed)
    values = []
    present.on_change("start", lambda attr, old, new: values.append(new))
    document.apply_json_patch(patch(**{removed.id: 1}))
    document.apply_json_patch(patch(**{removed.id: 2, present.id: 3}))
    document.apply_json_patch(patch(**{present.id: 4, removed.id: 5}))
    assert values == [3, 4]
    with pytest.raises(UnknownReferenceError, match="never-there"):
        document.apply_json_patch(patch(**{present.id: 6, "never-there": 7}))
    assert present.start == 4


def test_frozen_objects_are_collected_with_all_others():
    class Loop:
        def __init__(self):
            self.itself = self

    loop = Loop()
    alive = weakref.ref(loop)
    freeze_all()
    try:
        assert gc.get_freeze_count() > 0
        del loop
        gc.collect()
        assert alive() is not None
        collect_all()
        assert alive() is None
        assert gc.get_freeze_count() > 0
    finally:
        gc.unfreeze()
