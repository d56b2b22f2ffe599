"""Whose request is computed next, and whose page is drawn next."""

from __future__ import annotations

import asyncio
import threading
import time
from contextvars import ContextVar

import pytest

from app.tasks.jobs import Effort, LatestWins, Places
from app.tasks.turns import MESSAGES_FIRST, Turns
from tests.browser import eventually
from tests.threads import at_once, queued

# -- off the page's thread -------------------------------------------------------------------------


class Desk:
    """Requests that wait for a word, and what became of them."""

    def __init__(self, on_page=at_once, **shared):
        self.jobs = LatestWins(on_page, **shared)
        self.ran, self.threads, self.done, self.failed = [], [], [], []
        self.go = threading.Event()

    def submit(self, name, effort=Effort.ANY):
        def work():
            self.ran.append(name)
            self.threads.append(threading.current_thread())
            assert self.go.wait(20)
            return name

        self.jobs.submit(work, self.done.append, self.failed.append, effort)


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
    waiting_to_be_drawn = []
    desk = Desk(on_page=queued(waiting_to_be_drawn.append))
    desk.go.set()
    desk.submit("first")
    eventually(lambda: waiting_to_be_drawn)
    for name in ("second", "third"):
        desk.submit(name)
    time.sleep(0.05)
    assert desk.ran == ["first"]
    waiting_to_be_drawn.pop()()
    eventually(lambda: waiting_to_be_drawn)
    waiting_to_be_drawn.pop()()
    assert desk.ran == desk.done == ["first", "third"]


def test_a_failure_is_told_and_the_next_request_runs():
    desk = Desk()
    desk.go.set()
    desk.jobs.submit(lambda: 1 / 0, desk.done.append, desk.failed.append)
    eventually(lambda: desk.failed)
    assert isinstance(desk.failed[0], ZeroDivisionError)
    desk.submit("next")
    eventually(lambda: desk.done == ["next"])


def test_an_answer_that_cannot_be_drawn_is_told_and_does_not_stop_the_next():
    drawings = []
    desk = Desk(on_page=queued(drawings.append))
    desk.go.set()
    desk.jobs.submit(lambda: 0, lambda _: 1 / 0, desk.failed.append)
    eventually(lambda: drawings)
    desk.submit("next")
    drawings.pop()()
    assert isinstance(desk.failed[0], ZeroDivisionError)
    eventually(lambda: drawings)
    drawings.pop()()
    assert desk.done == ["next"]


def test_a_slow_request_of_one_session_holds_up_no_other():
    slow, quick = Desk(), Desk()
    slow.submit("slow")
    quick.go.set()
    quick.submit("quick")
    eventually(lambda: quick.done)
    assert not slow.done
    slow.go.set()
    eventually(lambda: slow.done)


def test_quick_work_is_done_on_the_page_in_its_turn_the_newest_alone():
    turns = []
    desk = Desk(on_page=queued(turns.append))
    desk.go.set()
    for name in ("first", "second", "third"):
        desk.submit(name, Effort.QUICK)
    assert desk.ran == []
    (turn,) = turns
    turn()
    assert desk.ran == desk.done == ["third"]
    assert desk.threads == [threading.current_thread()]
    desk.jobs.submit(lambda: 1 / 0, desk.done.append, desk.failed.append, Effort.QUICK)
    turns.pop()()
    assert isinstance(desk.failed[0], ZeroDivisionError)
    assert not desk.jobs.has_more


@pytest.mark.parametrize("effort", [Effort.SHORT, Effort.ANY])
def test_what_overtakes_quick_work_is_no_work_of_the_page(effort):
    turns = []
    desk = Desk(on_page=queued(turns.append))
    desk.go.set()
    desk.submit("quick", Effort.QUICK)
    desk.submit("longer", effort)
    turns.pop()()
    eventually(lambda: turns)
    turns.pop()()
    assert desk.done == ["longer"]
    assert desk.threads != [threading.current_thread()]


def test_short_work_is_done_one_at_a_time_and_waits_for_no_other():
    first, second, third, other = (Desk() for _ in range(4))
    other.submit("long")
    for desk in (first, second, third):
        desk.submit("short", Effort.SHORT)
    eventually(lambda: first.ran)
    time.sleep(0.05)
    assert second.ran == []
    second.submit("long", Effort.ANY)  # which is not done in a place for what is short
    first.go.set()
    eventually(lambda: third.ran and second.ran)
    for desk in (second, third, other):
        desk.go.set()
    eventually(lambda: second.done == ["long"] and third.done == ["short"])
    eventually(lambda: other.done)


def test_who_waits_for_a_place_begins_with_the_newest_of_its_requests():
    places = Places(1, "one")
    first, second = Desk(places=places), Desk(places=places)
    first.submit("first")
    eventually(lambda: first.ran)
    second.go.set()
    for name in ("old", "older", "newest"):
        second.submit(name)
    first.go.set()
    eventually(lambda: second.done)
    assert second.ran == second.done == ["newest"]


def test_a_place_is_kept_until_its_answer_is_about_to_be_drawn():
    places, turns = Places(1, "one"), []
    first = Desk(lambda act, due: turns.append((act, due)), places=places)
    second = Desk(places=places)
    first.go.set()
    second.go.set()
    first.submit("first")
    eventually(lambda: turns)
    second.submit("second")
    time.sleep(0.05)
    assert second.ran == []
    (_, due) = turns.pop()  # the page is gone: nothing is drawn
    due()
    eventually(lambda: second.done)


@pytest.mark.parametrize("number", [1, 3])
def test_places_are_had_in_the_order_in_which_they_were_asked_for(number):
    places, ran, go = Places(number, "few"), [], threading.Semaphore(0)

    def begin(name):
        ran.append(name)
        assert go.acquire(timeout=20)
        places.leave()

    for name in range(6):
        places.ask(lambda name=name: begin(name), ran.append)
    for done in range(6):
        there = min(done + number, 6)
        eventually(lambda there=there: len(ran) == there)
        time.sleep(0.01)
        assert sorted(ran) == [*range(there)]  # no other, and no more
        go.release()


# -- on the page's thread, which all pages share ---------------------------------------------------


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
