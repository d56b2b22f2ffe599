"""Order of work: the latest request wins, lanes are fair, pages take turns."""

from __future__ import annotations

import asyncio
import threading
from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from contextvars import ContextVar

import pytest

from app.tasks.page import PageTasks
from app.tasks.scheduler import GENERAL, PAGE, SHORT, Lane, Latest, LongWork, Step
from app.tasks.turns import MESSAGES_FIRST, Turns
from tests.browser import eventually
from tests.threads import HeldTasks

# -- the latest request wins -----------------------------------------------------------------------


class Desk:
    """Requests that wait for a signal, and their outcomes."""

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


def test_the_latest_request_wins_and_the_overtaken_never_run():
    desk = Desk()
    desk.submit(0)
    eventually(lambda: desk.ran)
    for name in range(1, 5):
        desk.submit(name)
    desk.go.set()
    eventually(lambda: 4 in desk.done)
    assert desk.ran == desk.done == [0, 4]


def test_nothing_is_computed_ahead_of_a_page_that_is_still_drawing():
    page = HeldTasks()
    desk = Desk(page, is_free=True)
    desk.submit("first")
    eventually(lambda: not page.waiting.empty())
    for name in ("second", "third"):
        desk.submit(name)
    assert desk.ran == ["first"]
    page.run_one()
    page.run_one()
    assert desk.ran == desk.done == ["first", "third"]


def test_a_failure_is_reported_and_the_next_request_runs():
    page = HeldTasks()
    desk = Desk(page, is_free=True)
    desk.fail()
    page.run_one()
    desk.channel.submit(lambda: 0, lambda _: 1 / 0, desk.failed.append)  # cannot be drawn
    page.run_one()
    assert [type(each) for each in desk.failed] == [ZeroDivisionError] * 2
    desk.submit("next")
    page.run_one()
    assert desk.done == ["next"]


def test_a_failure_to_start_a_thread_is_reported_for_each_request(monkeypatch):
    def refuse(*_):
        raise BrokenExecutor("no thread can be had")

    monkeypatch.setattr(ThreadPoolExecutor, "submit", refuse)
    desk = Desk(lane=Lane(1, "dead"))
    for name in range(3):
        desk.submit(name)
    assert [type(each) for each in desk.failed] == [BrokenExecutor] * 3


# -- lanes -----------------------------------------------------------------------------------------


def test_a_slow_request_of_one_session_delays_no_other():
    slow, quick = Desk(), Desk(is_free=True)
    slow.submit("slow")
    quick.submit("quick")
    eventually(lambda: quick.done)
    assert not slow.done
    slow.go.set()
    eventually(lambda: slow.done)


def test_quick_work_runs_on_the_page_in_its_turn_and_only_the_newest():
    page = HeldTasks()
    desk = Desk(page, is_free=True)
    for name in ("first", "second", "third"):
        desk.submit(name, PAGE)
    assert desk.ran == []
    page.run_one()
    assert page.waiting.empty()
    assert desk.ran == desk.done == ["third"]
    assert desk.threads == [threading.current_thread()]
    desk.fail(PAGE)
    page.run_one()
    assert isinstance(desk.failed[0], ZeroDivisionError)
    assert not desk.channel.has_more


def test_quick_work_runs_at_once_on_a_page_that_is_at_hand():
    class AtHand(HeldTasks):
        is_at_hand = True

    page = AtHand()
    desk = Desk(page, is_free=True)
    desk.submit("first", PAGE)
    assert desk.done == ["first"]
    assert page.waiting.empty()


@pytest.mark.parametrize("lane", [SHORT, GENERAL])
def test_longer_work_that_overtakes_quick_work_leaves_the_page(lane):
    page = HeldTasks()
    desk = Desk(page, is_free=True)
    desk.submit("quick", PAGE)
    desk.submit("longer", lane)
    page.run_one()
    page.run_one()
    assert desk.done == ["longer"]
    assert desk.threads != [threading.current_thread()]


def test_short_work_runs_one_request_at_a_time_beside_other_work():
    first, second, third, other = (Desk() for _ in range(4))
    other.submit("long")
    for desk in (first, second, third):
        desk.submit("short", SHORT)
    eventually(lambda: first.ran)
    assert second.ran == []
    second.submit("long", GENERAL)  # must not run on the thread for short work
    first.go.set()
    eventually(lambda: third.ran and second.ran)
    for desk in (second, third, other):
        desk.go.set()
    eventually(lambda: second.done == ["long"] and third.done == ["short"])
    eventually(lambda: other.done)


def test_a_session_that_waited_starts_with_its_newest_request():
    lane = Lane(1, "one")
    first, second = Desk(lane=lane), Desk(lane=lane, is_free=True)
    first.submit("first")
    eventually(lambda: first.ran)
    for name in ("old", "older", "newest"):
        second.submit(name)
    first.go.set()
    eventually(lambda: second.done)
    assert second.ran == second.done == ["newest"]


def test_a_thread_is_held_until_its_result_is_about_to_be_drawn():
    class Gone(HeldTasks):
        def queue(self, act, due=None):
            self.waiting.put(due)  # the page is gone: nothing is drawn

    lane, page = Lane(1, "one"), Gone()
    first, second = Desk(page, lane, is_free=True), Desk(lane=lane, is_free=True)
    first.submit("first")
    eventually(lambda: not page.waiting.empty())
    second.submit("second")
    assert second.ran == []
    page.run_one()
    eventually(lambda: second.done)


@pytest.mark.parametrize("number", [1, 3])
def test_threads_are_had_in_the_order_of_the_requests(number):
    lane, ran, go = Lane(number, "few"), [], threading.Semaphore(0)

    def begin(name):
        ran.append(name)
        assert go.acquire(timeout=20)
        lane.release()

    for name in range(6):
        lane.acquire(lambda name=name: begin(name), ran.append)
    for done in range(6):
        there = min(done + number, 6)
        eventually(lambda there=there: len(ran) == there)
        assert sorted(ran) == [*range(there)]
        go.release()


# -- long work -------------------------------------------------------------------------------------


class Long:
    """Long work in steps that wait for a signal, and their outcomes."""

    def __init__(self, count=3, fails_at=None):
        self.gate, self.drawn, self.failures = threading.Semaphore(0), [], []
        self.begun = self.changes = 0
        self.page = HeldTasks()
        self.work = LongWork(self.page, self.changed, self.failures.append)
        self.steps = [
            Step(lambda k=k: self.do(k, fails_at), self.drawn.append) for k in range(count)
        ]

    def changed(self):
        self.changes += 1

    def do(self, k, fails_at):
        self.begun += 1
        assert self.gate.acquire(timeout=20)
        if k == fails_at:
            raise ValueError("no")
        return k

    def finish(self):
        while self.work.is_running:
            self.page.run_one()


def test_steps_run_one_after_the_other():
    long = Long()
    long.gate.release(3)
    long.work.start(long.steps)
    long.finish()
    assert long.drawn == [0, 1, 2]
    assert (long.work.done, long.work.of) == (3, 3)


def test_cancelled_work_draws_nothing_more_and_starts_no_step():
    long = Long()
    long.gate.release(1)
    long.work.start(long.steps)
    long.page.run_one()
    eventually(lambda: long.begun == 2)
    long.work.cancel()
    long.gate.release(2)
    long.page.run_one()
    assert (long.drawn, long.begun, long.work.is_running) == ([0], 2, False)


def test_paused_work_continues_with_the_next_step():
    long = Long()
    long.work.start(long.steps)
    long.work.pause(True)
    long.gate.release(3)
    long.page.run_one()
    assert (long.drawn, long.begun) == ([0], 1)
    long.work.pause(False)
    long.finish()
    assert long.drawn == [0, 1, 2]
    assert long.begun == 3


def test_another_start_replaces_the_first():
    long = Long()
    long.work.start(long.steps)
    eventually(lambda: long.begun == 1)
    long.work.start(long.steps[1:])
    long.gate.release(3)
    long.finish()
    assert long.drawn == [1, 2]


def test_a_failure_ends_the_work_and_is_reported():
    long = Long(fails_at=1)
    long.gate.release(3)
    long.work.start(long.steps)
    long.finish()
    assert (long.drawn, long.begun, len(long.failures)) == ([0], 2, 1)


def test_one_piece_reports_its_progress_and_sees_that_it_is_cancelled():
    long, cancelled_seen = Long(), []

    def piece(progress, cancelled):
        progress(1, 4)
        assert long.gate.acquire(timeout=20)
        cancelled_seen.append(cancelled())
        progress(2, 4)
        return "result"

    for is_cancelled in (False, True):
        long.work.start_piece(piece, long.drawn.append)
        long.page.run_one()
        assert (long.work.done, long.work.of, long.work.is_running) == (1, 4, True)
        if is_cancelled:
            long.work.cancel()
        long.gate.release()
        long.page.run_one()
        long.page.run_one()
        assert not long.work.is_running
    assert cancelled_seen == [False, True]
    assert long.drawn == ["result"]


# -- turns of pages -------------------------------------------------------------------------------


async def when_all_had_their_turn(turns):
    while turns.is_crowded:
        await asyncio.sleep(0)
    await asyncio.sleep(0)


def test_turns_are_taken_in_order_and_messages_come_in_between():
    async def queue():
        turns, done = Turns(), []

        async def message():
            while len(done) < 4 * MESSAGES_FIRST:
                done.append(" ")
                await asyncio.sleep(0)

        messages = asyncio.ensure_future(message())
        for name in "abc":
            turns.ask(lambda name=name: done.append(name))
        assert turns.is_crowded
        await messages
        return "".join(done)

    assert asyncio.run(queue()).split() == ["a", "b", "c"]


def test_each_turn_begins_in_the_context_of_who_asked():
    who = ContextVar("who")

    async def queue():
        turns, done = Turns(), []
        for name in "abc":
            who.set(name)
            turns.ask(lambda: done.append(who.get()))
        await when_all_had_their_turn(turns)
        return done

    assert asyncio.run(queue()) == ["a", "b", "c"]


def test_a_turn_that_fails_does_not_hold_up_the_next():
    async def queue():
        turns, done = Turns(), []
        asyncio.get_running_loop().set_exception_handler(lambda _, told: done.append(told))
        turns.ask(lambda: 1 / 0)
        turns.ask(lambda: done.append("second"))
        await when_all_had_their_turn(turns)
        turns.ask(lambda: done.append("third"))
        await when_all_had_their_turn(turns)
        return done

    told, *done = asyncio.run(queue())
    assert isinstance(told["exception"], ZeroDivisionError)
    assert done == ["second", "third"]


def test_what_was_computed_and_the_rest_take_turns():
    async def queue():
        turns, done = Turns(), []
        for name in "abc":
            turns.ask(lambda name=name: done.append(name))
        for name in "xyz":
            turns.ask(lambda name=name: done.append(name), is_computed=True)
        await when_all_had_their_turn(turns)
        return "".join(done)

    assert asyncio.run(queue()) == "xaybzc"
