"""Order of background work: the latest request wins, lanes are fair, pages take turns."""

from __future__ import annotations

import asyncio
import threading
import time
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from contextvars import ContextVar

import pytest

from app.tasks.busy import Busy
from app.tasks.page import PageTasks
from app.tasks.scheduler import GENERAL, PAGE, SHORT, Cancelled, Lane, Latest, LongWork, Step
from app.tasks.turns import ROUNDS_BETWEEN, Turns
from tests.browser import eventually
from tests.threads import HeldTasks

# -- the latest request wins -----------------------------------------------------------------------


class Client:
    """Submits requests, which wait for a signal unless `is_free`, and keeps their results."""

    def __init__(self, page=None, lane=GENERAL, is_free=False):
        self.channel = Latest(page or PageTasks(), lane)
        self.ran, self.threads, self.done, self.failed = [], [], [], []
        self.go = threading.Event()
        if is_free:
            self.go.set()

    def submit(self, name, lane=None):
        def work():
            self.ran.append(name)
            self.threads.append(threading.current_thread())
            assert self.go.wait(20)
            return name

        self.channel.submit(work, self.done.append, self.failed.append, lane)

    def fail(self, lane=None):
        self.channel.submit(lambda: 1 / 0, self.done.append, self.failed.append, lane)


def test_only_the_first_and_the_latest_request_run():
    client = Client()
    client.submit(0)
    eventually(lambda: client.ran)
    for name in range(1, 5):
        client.submit(name)
    client.go.set()
    eventually(lambda: 4 in client.done)
    assert client.ran == client.done == [0, 4]


def test_the_next_request_starts_after_the_page_has_drawn_the_last():
    page = HeldTasks()
    client = Client(page, is_free=True)
    client.submit("first")
    eventually(lambda: not page.waiting.empty())
    for name in ("second", "third"):
        client.submit(name)
    assert client.ran == ["first"]
    page.run_one()
    page.run_one()
    assert client.ran == client.done == ["first", "third"]


def test_a_failure_is_reported_and_the_next_request_runs():
    page = HeldTasks()
    client = Client(page, is_free=True)
    client.fail()
    page.run_one()
    client.channel.submit(lambda: 0, lambda _: 1 / 0, client.failed.append)  # cannot be drawn
    page.run_one()
    assert [type(each) for each in client.failed] == [ZeroDivisionError] * 2
    client.submit("next")
    page.run_one()
    assert client.done == ["next"]


def test_a_thread_that_cannot_start_is_reported_for_each_request(monkeypatch):
    def refuse(*_):
        raise BrokenExecutor("no thread available")

    monkeypatch.setattr(ThreadPoolExecutor, "submit", refuse)
    client = Client(lane=Lane(1, "dead"))
    for name in range(3):
        client.submit(name)
    assert [type(each) for each in client.failed] == [BrokenExecutor] * 3


# -- the progress bar ------------------------------------------------------------------------------


class Clock:
    """A page whose delayed callbacks run when the test says so."""

    def __init__(self):
        self.later = []

    def call_later(self, wait_ms, act):
        self.later.append((time.perf_counter() + 1e-3 * wait_ms, act))

    def run_next(self, act):
        act()

    def wait(self):
        """Let all delays pass, those of callbacks included."""
        while self.later:
            due_s, act = self.later.pop(0)
            time.sleep(max(due_s - time.perf_counter(), 0.0))
            act()


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def busy(clock):
    made = Busy(clock)
    made.said = []
    made.changed.subscribe(made.said.append)
    return made


def test_long_work_is_announced_once_and_until_the_last_of_it_has_ended(clock, busy):
    for work in "ab":
        busy.begin(work)
    clock.wait()
    assert busy.said == [True]
    busy.end("a")
    clock.wait()
    assert busy.said == [True]
    busy.end("b")
    assert busy.said == [True]
    clock.wait()
    assert busy.said == [True, False]


def test_short_work_is_not_announced_however_often_it_is_asked_for(clock, busy):
    for _ in range(3):
        busy.begin("a")
        busy.end("a")
    clock.wait()
    assert busy.said == []


def test_work_that_follows_soon_keeps_the_bar(clock, busy):
    busy.begin("a")
    clock.wait()
    busy.end("a")
    busy.begin("b")
    clock.wait()
    assert busy.said == [True]
    busy.end("b")
    clock.wait()
    assert busy.said == [True, False]


def test_each_request_of_a_channel_counts_by_itself():
    page = HeldTasks()
    heard = []

    class Heard:
        def begin(self, work):
            heard.append(("begin", work))

        def end(self, work):
            heard.append(("end", work))

    channel = Latest(page, PAGE, Heard())

    def ignore(_):
        return None

    channel.submit(int, ignore, ignore)  # replaced by the next
    channel.submit(int, lambda _: channel.submit(int, ignore, ignore), ignore)
    for n_done in (1, 2):
        page.run_one()
        assert heard[: 2 * n_done] == [("begin", channel), ("end", channel)] * n_done
    assert len(heard) == 4


# -- lanes -----------------------------------------------------------------------------------------


def test_page_work_runs_on_the_page_in_its_turn():
    page = HeldTasks()
    client = Client(page, is_free=True)
    for name in ("first", "second", "third"):
        client.submit(name, PAGE)
    assert client.ran == []
    page.run_one()
    assert page.waiting.empty()
    assert client.ran == client.done == ["third"]
    assert client.threads == [threading.current_thread()]
    client.fail(PAGE)
    page.run_one()
    assert isinstance(client.failed[0], ZeroDivisionError)
    assert not client.channel.has_more


def test_page_work_runs_at_once_on_a_page_that_is_at_hand():
    class AtHand(HeldTasks):
        is_at_hand = True

    page = AtHand()
    client = Client(page, is_free=True)
    client.submit("first", PAGE)
    assert client.done == ["first"]
    assert page.waiting.empty()


def test_short_work_waits_for_the_turn_of_its_page():
    page = HeldTasks()
    client = Client(page, is_free=True)
    for name in ("first", "second"):
        client.submit(name, SHORT)
    assert client.ran == []
    page.run_one()
    page.run_one()
    assert client.ran == client.done == ["second"]
    assert client.threads != [threading.current_thread()]


@pytest.mark.parametrize("lane", [SHORT, GENERAL])
def test_longer_work_that_replaces_page_work_runs_on_a_thread(lane):
    page = HeldTasks()
    client = Client(page, is_free=True)
    client.submit("quick", PAGE)
    client.submit("longer", lane)
    page.run_one()
    page.run_one()
    assert client.done == ["longer"]
    assert client.threads != [threading.current_thread()]


def test_short_work_runs_one_request_at_a_time_and_in_parallel_with_other_work():
    first, second, third, other = (Client() for _ in range(4))
    other.submit("long")
    for client in (first, second, third):
        client.submit("short", SHORT)
    eventually(lambda: first.ran and other.ran)
    assert second.ran == []
    second.submit("long", GENERAL)  # must not run on the thread for short work
    first.go.set()
    eventually(lambda: third.ran and second.ran)
    for client in (second, third, other):
        client.go.set()
    eventually(lambda: second.done == ["long"] and third.done == ["short"])
    eventually(lambda: other.done)


def test_a_client_that_waited_starts_with_its_newest_request():
    lane = Lane(1, "one")
    first, second = Client(lane=lane), Client(lane=lane, is_free=True)
    first.submit("first")
    eventually(lambda: first.ran)
    for name in ("old", "older", "newest"):
        second.submit(name)
    first.go.set()
    eventually(lambda: second.done)
    assert second.ran == second.done == ["newest"]


def test_a_thread_is_taken_until_its_result_is_about_to_be_drawn():
    class Closed(HeldTasks):
        def queue(self, act, due=None):
            self.waiting.put(due)  # nothing is drawn

    lane, page = Lane(1, "one"), Closed()
    first, second = Client(page, lane, is_free=True), Client(lane=lane, is_free=True)
    first.submit("first")
    eventually(lambda: not page.waiting.empty())
    second.submit("second")
    assert second.ran == []
    page.run_one()
    eventually(lambda: second.done)


@pytest.mark.parametrize("n_threads", [1, 3])
def test_threads_are_given_in_the_order_of_the_requests(n_threads):
    lane, ran, go = Lane(n_threads, "few"), [], threading.Semaphore(0)

    def begin(name):
        ran.append(name)
        assert go.acquire(timeout=20)
        lane.release()

    for name in range(6):
        lane.acquire(lambda name=name: begin(name), ran.append)
    for done in range(6):
        n_started = min(done + n_threads, 6)
        eventually(lambda n_started=n_started: len(ran) == n_started)
        assert sorted(ran) == [*range(n_started)]
        go.release()


# -- long work -------------------------------------------------------------------------------------


class AwayTasks(HeldTasks):
    """A page that may be away; it runs delayed callbacks when it is back."""

    is_away = False

    def call_later(self, _wait_ms, act):
        self.queue(act)


class Study:
    """Long work in three steps that wait for a signal, and its results."""

    def __init__(self, fails_at=None):
        self.gate, self.drawn, self.failures = threading.Semaphore(0), [], []
        self.n_begun, self.fails_at = 0, fails_at
        self.page = AwayTasks()
        self.work = LongWork(self.page, lambda: None, self.failures.append)
        self.steps = [Step(lambda k=k: self.run(k), self.drawn.append) for k in range(3)]

    def run(self, k):
        self.n_begun += 1
        assert self.gate.acquire(timeout=20)
        if k == self.fails_at:
            raise ValueError("no")
        return k

    def finish(self):
        while self.work.is_running:
            self.page.run_one()


def test_steps_wait_for_a_page_that_is_away_and_keep_what_is_done():
    study = Study()
    study.work.start(study.steps)
    study.page.is_away = True
    study.gate.release(3)
    study.page.run_one()
    study.page.run_one()
    assert (study.drawn, study.n_begun, study.work.is_running) == ([0], 1, True)
    study.page.is_away = False
    study.finish()
    assert study.drawn == [0, 1, 2]


def test_a_piece_ends_when_its_page_is_away_and_starts_again_when_it_is_back():
    study, begun = Study(), []

    def piece(progress):
        progress(0, 1)
        begun.append(True)
        while len(begun) == 1:
            progress(0, 1)
            time.sleep(0.001)
        return "done"

    study.work.start_piece(piece, study.drawn.append)
    eventually(lambda: begun)
    study.page.is_away = True
    study.page.run_one()  # the progress
    study.page.run_one()  # the end of the first attempt
    assert (study.drawn, study.failures, study.work.is_running) == ([], [], True)
    study.page.is_away = False
    study.finish()
    assert (study.drawn, study.failures, len(begun)) == (["done"], [], 2)


def test_paused_work_continues_with_the_next_step():
    study = Study()
    study.work.start(study.steps)
    study.work.pause(True)
    study.gate.release(3)
    study.page.run_one()
    assert (study.drawn, study.n_begun) == ([0], 1)
    study.work.pause(False)
    study.finish()
    assert study.drawn == [0, 1, 2]
    assert (study.n_begun, study.work.done, study.work.of) == (3, 3, 3)


def test_cancelled_work_draws_nothing_and_starts_no_step():
    study = Study()
    study.gate.release(1)
    study.work.start(study.steps)
    study.page.run_one()
    eventually(lambda: study.n_begun == 2)
    study.work.cancel()
    study.gate.release(2)
    study.page.run_one()
    assert (study.drawn, study.n_begun, study.work.is_running) == ([0], 2, False)


def test_a_second_start_replaces_the_first():
    study = Study()
    study.work.start(study.steps)
    eventually(lambda: study.n_begun == 1)
    study.work.start(study.steps[1:])
    study.gate.release(3)
    study.finish()
    assert study.drawn == [1, 2]


def test_a_failure_ends_the_work_and_is_reported():
    study = Study(fails_at=1)
    study.gate.release(3)
    study.work.start(study.steps)
    study.finish()
    assert (study.drawn, study.n_begun, len(study.failures)) == ([0], 2, 1)


def test_one_piece_reports_its_progress_and_can_be_cancelled():
    study, ended = Study(), []

    def piece(progress):
        progress(1, 4)
        assert study.gate.acquire(timeout=20)
        try:
            progress(2, 4)
        except Cancelled:
            ended.append(True)
            raise
        return "result"

    for is_cancelled in (False, True):
        study.work.start_piece(piece, study.drawn.append)
        study.page.run_one()
        assert (study.work.done, study.work.of, study.work.is_running) == (1, 4, True)
        if is_cancelled:
            study.work.cancel()
        study.gate.release()
        study.page.run_one()
        if not is_cancelled:
            study.page.run_one()  # the result, after the progress
        assert not study.work.is_running
    assert ended == [True]
    assert study.drawn == ["result"]


# -- turns of pages --------------------------------------------------------------------------------


def after_turns(ask):
    """Results of callbacks once all have had their turn, and errors that were logged."""

    async def run():
        turns, done, errors = Turns(), [], []
        asyncio.get_running_loop().set_exception_handler(lambda _, error: errors.append(error))
        ask(turns, done)
        while turns.is_crowded:
            await asyncio.sleep(0)
        await asyncio.sleep(0)
        return done, errors

    return asyncio.run(run())


def test_messages_are_handled_between_turns():
    async def queue():
        turns, done = Turns(), []

        async def message():
            while len(done) < 4 * ROUNDS_BETWEEN:
                done.append(" ")
                await asyncio.sleep(0)

        messages = asyncio.ensure_future(message())
        for name in "abc":
            turns.ask(lambda name=name: done.append(name))
        assert turns.is_crowded
        await messages
        return "".join(done)

    assert asyncio.run(queue()).split() == ["a", "b", "c"]


def test_each_turn_has_the_context_of_its_caller():
    caller = ContextVar("caller")

    def ask(turns, done):
        for name in "abc":
            caller.set(name)
            turns.ask(lambda: done.append(caller.get()))

    assert after_turns(ask) == (["a", "b", "c"], [])


def test_a_turn_that_fails_does_not_stop_the_next():
    def ask(turns, done):
        turns.ask(lambda: 1 / 0)
        turns.ask(lambda: done.append("second"))

    done, (error,) = after_turns(ask)
    assert done == ["second"]
    assert isinstance(error["exception"], ZeroDivisionError)


def test_results_and_other_callbacks_alternate():
    def ask(turns, done):
        for name in "abcxyz":
            turns.ask(lambda name=name: done.append(name), is_computed=name in "xyz")

    done, _ = after_turns(ask)
    assert "".join(done) == "xaybzc"
