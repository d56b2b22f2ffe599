"""Memory and time of a request, and memory of all requests together."""

from __future__ import annotations

from dataclasses import replace
from threading import Event, Thread
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from app.model import budget
from app.model.state import ReductionSettings
from app.model.store import Request, built_in_sources, compute, file_source
from app.pages.compare.ranking import Task, run_task
from app.pages.inspect.results import inspect_capture, inspect_pixel_with_flux
from app.pages.session import Session
from app.pages.shared.estimate import FEW_COUNTS, lane_of
from app.pages.tradeoff.speed import affordable
from app.tasks.scheduler import GENERAL
from core import ESTIMATORS, Acquisition, Capture, TrackingParameters, save_capture
from core.cost import Cost
from core.studies.tradeoff.measure import candidates
from tests.states import ask

MB = 2**20


@pytest.fixture
def source(tmp_path):
    """A file of 120 x 120 pixels and 100 bins."""
    cube = np.random.default_rng(0).poisson(0.2, (120, 120, 100)).astype(np.uint8)
    save_capture(Capture(cube, Acquisition(100, 1e-9, n_pulses=500)), tmp_path / "wide.npz")
    return file_source(tmp_path / "wide.npz")


@pytest.fixture
def tight(monkeypatch):
    """A server on which half of that file's pixels is too much."""
    monkeypatch.setattr(budget, "FREE_BYTES", 16 * MB)
    monkeypatch.setattr(budget, "REQUEST_BYTES", 16 * MB)


def test_a_costly_capture_opens_reduced_and_says_so(source, tight):
    answer = compute(ask(source), None)
    reduction = answer.request.reduction
    assert reduction.merge * reduction.skip > 1
    assert answer.requested == ReductionSettings()
    assert answer.capture.cube.size < answer.whole.cube.size
    assert "limits of this server" in answer.capture.source
    # As few as will do: one step less is refused.
    for name in ("merge", "skip"):
        if getattr(reduction, name) > 1:
            more = replace(reduction, **{name: getattr(reduction, name) - 1})
            with pytest.raises(ValueError, match="working memory of 'tracking'"):
                compute(ask(source, reduction=more), answer)


def test_a_capture_that_fits_is_not_reduced(source):
    answer = compute(ask(source), None)
    assert answer.request.reduction == answer.requested == ReductionSettings()
    assert answer.capture.cube.shape == (120, 120, 100)


def test_the_controls_show_the_reduction(source, tight):
    session = Session({"wide": source})
    assert session.state.reduction == session.answer.request.reduction != ReductionSettings()
    assert session.answer.request == session.estimate.request  # the next request asks for the same


def test_a_weaker_reduction_is_refused_with_a_remedy(source, tight):
    answer = compute(ask(source), None)
    with pytest.raises(ValueError, match="Data reduction") as refused:
        compute(ask(source), answer)
    assert "120 x 120 pixels of 100 bins" in str(refused.value)


def test_time_is_limited_like_memory(source, monkeypatch):
    monkeypatch.setattr(budget, "REQUEST_S", 0.04)
    answer = compute(ask(source), None)
    assert answer.request.reduction != ReductionSettings()
    with pytest.raises(ValueError, match="estimated time of 'tracking'"):
        compute(ask(source), answer)


def test_confidence_from_the_image_counts_for_the_limits(source, monkeypatch):
    monkeypatch.setattr(budget, "REQUEST_S", 0.4)
    judged = replace(ask(source), judged_by="image")
    assert compute(ask(source), None).request.reduction == ReductionSettings()
    answer = compute(judged, None)
    assert answer.request.reduction != ReductionSettings()
    with pytest.raises(ValueError, match="estimated time of 'image_posterior'"):
        compute(judged, answer)


def test_groups_of_pulses_count_for_the_limits(monkeypatch):
    monkeypatch.setattr(budget, "REQUEST_S", 0.5)
    moving = Request(built_in_sources()["approach"], method="velocity")
    assert (
        compute(replace(moving, method="likelihood"), None).request.reduction == ReductionSettings()
    )
    for judge in ("pixel", "image"):
        request = replace(moving, judged_by=judge)
        assert compute(request, None).request.reduction != ReductionSettings()


def test_computations_of_other_pages_are_limited(source, monkeypatch):
    answer = compute(ask(source), None)
    monkeypatch.setattr(budget, "REQUEST_S", 1e-4)
    for method in ("unmixing", "likelihood"):
        with pytest.raises(ValueError, match=f"estimated time of '{method}'"):
            run_task(Task(method, ESTIMATORS[method].parameters()), answer)
    for work in (inspect_capture, lambda each: inspect_pixel_with_flux(each, 0, 0)):
        with pytest.raises(ValueError, match="estimated time of 'flux'"):
            work(answer)


def test_the_trade_off_leaves_out_slow_configurations(source, monkeypatch):
    capture = compute(ask(source), None).whole
    ways = candidates()
    assert affordable(capture, ways) == ways
    monkeypatch.setattr(budget, "REQUEST_S", 0.4)
    left_out = [each for each in ways if each not in affordable(capture, ways)]
    slow = {(each.method.estimator, each.reduction.merge) for each in left_out}
    assert slow == {("unmixing", 1), *(("image_posterior", merge) for merge in (1, 2, 4))}
    monkeypatch.setattr(budget, "REQUEST_S", 1e-4)
    with pytest.raises(ValueError, match="estimated time of 'likelihood'"):
        affordable(capture, ways)


def test_a_long_gate_is_not_processed_on_the_page(tmp_path):
    """It has few counts, but many delays."""
    cube = np.ones((1, 1, 60_000), np.uint8)
    capture = Capture(cube, Acquisition(60_000, 1e-9, n_pulses=10**6))
    save_capture(capture, tmp_path / "long.npz")
    answer = compute(ask(file_source(tmp_path / "long.npz")), None)
    again = replace(answer.request, tracking=TrackingParameters(t_n=50))
    assert answer.capture.cube.size < FEW_COUNTS
    assert lane_of(again, answer) is GENERAL


def test_requests_wait_until_there_is_memory_for_them(monkeypatch):
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=8 * 100 * MB))
    shared, begun, end = budget.Budget(), [Event() for _ in range(5)], Event()

    def work(number):
        with shared.spending(100 * MB):
            begun[number].set()
            end.wait()

    threads = [Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    assert all(each.wait(60) for each in begun[:4])
    last = Thread(target=work, args=(4,))
    last.start()
    with shared.spending(MB):  # what is small does not wait
        pass
    last.join(0.05)
    assert last.is_alive() and not begun[4].is_set()
    end.set()
    assert begun[4].wait(60)
    for thread in (*threads, last):
        thread.join()


def test_a_failed_request_returns_its_memory():
    shared = budget.Budget()
    for _ in range(2):
        with pytest.raises(KeyError), shared.spending(10**15):
            raise KeyError


def test_a_request_beyond_the_limit_is_never_started():
    cost = Cost(10**15, 0.0)
    with pytest.raises(ValueError, match="on this server"), budget.spending((1, 1, 9), "x", cost):
        raise AssertionError
