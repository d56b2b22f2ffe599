"""``python -m tests.load`` in short: answers arrive, memory stays, verdicts are as measured."""

from __future__ import annotations

import asyncio
from contextvars import ContextVar
from dataclasses import replace

import numpy as np
import pytest

from app.turns import MESSAGES_FIRST, Turns
from tests.browser import serving
from tests.load import Bounds, Growth, Load, as_markdown, growth, load, server_mb, verdicts


@pytest.fixture(scope="module")
def address():
    """A server of its own: what it holds is measured."""
    with serving() as running_at:
        yield running_at


def test_sessions_at_once_are_all_answered_and_none_wrongly(address):
    used = asyncio.run(load(address, server_mb(), sessions=3, seconds=2.0, forgotten_s=0.0))
    assert used.troubles == []
    assert used.latencies_s.size > 40
    assert used.session_mb <= Bounds().session_mb


def test_interactions_do_not_pile_up(address):
    grown = asyncio.run(growth(address, server_mb(), interactions=150, warm=40))
    assert grown.troubles == []
    assert grown.after_mb - grown.before_mb < 15


def test_a_bound_that_is_missed_is_told():
    used = Load(2, np.array([0.1, 0.2]), [], 500.0, 540.0, 510.0)
    grown = Growth(100, [], 510.0, 515.0)
    bounds = Bounds()
    assert all(reached for *_, reached in verdicts(used, grown, bounds))
    for broken in (
        (replace(used, latencies_s=np.array([2.0])), grown),
        (replace(used, with_mb=700.0), grown),
        (replace(used, troubles=["no answer"]), grown),
        (used, replace(grown, after_mb=600.0)),
    ):
        found = verdicts(*broken, bounds)
        assert sum(not reached for *_, reached in found) == 1
        assert as_markdown(found).count("missed") == 1


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
