"""The choice of what determines the confidence: pages, scripts and comparisons follow it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from app.model.script import script_of
from app.model.state import Comparison, Illumination, State
from app.model.store import Answer, Request, compute, scene_source
from app.pages.compare.ranking import run_task, tasks_of
from app.pages.shared.estimate import lane_of
from app.tasks.scheduler import GENERAL, PAGE
from core import TrackingParameters, estimate

SOURCE = scene_source("Planes before a wall", "piecewise")


@pytest.fixture(scope="module")
def alone() -> Answer:
    return compute(Request(SOURCE, Illumination(sbr=0.03)), None)


@pytest.fixture(scope="module")
def judged(alone: Answer) -> Answer:
    return compute(replace(alone.request, judged_by="image"), alone)


@pytest.mark.compiled
def test_the_confidence_on_screen_is_that_of_core(alone: Answer, judged: Answer) -> None:
    expected = estimate(alone.capture, "tracking", judged_by="image")
    shown = judged.run.image
    assert judged.capture is alone.capture
    np.testing.assert_array_equal(shown.confidence, expected.confidence)
    np.testing.assert_array_equal(shown.range_m, alone.run.image.range_m)
    assert not np.array_equal(shown.confidence, alone.run.image.confidence)


@pytest.mark.compiled
def test_methods_are_compared_with_the_same_choice(judged: Answer) -> None:
    chosen = Comparison(methods=("tracking", "coates"))
    tasks = tasks_of(chosen, judged.request)
    assert run_task(tasks["tracking"], judged).answer is judged
    found = run_task(tasks["coates"], judged).answer.run.image
    expected = estimate(judged.capture, "coates", judged_by="image")
    np.testing.assert_array_equal(found.confidence, expected.confidence)
    state = State(page="Compare", comparison=chosen)
    script = script_of(judged, state)
    assert script.count('judged_by="image"') == 2


@pytest.mark.compiled
def test_the_posterior_of_an_image_is_computed_off_the_page_and_once(
    alone: Answer, judged: Answer
) -> None:
    assert lane_of(judged.request, alone) is GENERAL
    moved = replace(judged.request, tracking=TrackingParameters(l=9))
    assert lane_of(moved, judged) is PAGE
    assert lane_of(replace(moved, light=Illumination(sbr=0.04)), judged) is GENERAL
    assert lane_of(replace(moved, returns="all returns"), judged) is GENERAL
