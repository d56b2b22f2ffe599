"""Timing: that every call is called, in every round, and that the interval is what it says."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from core.studies import timing
from core.studies.timing import FEWEST_REPEATS, interleaved, machine, median_interval


def test_each_round_calls_each_once_in_an_order_of_its_own() -> None:
    called: list[str] = []
    calls = {name: (lambda name=name: called.append(name)) for name in "abc"}
    seconds = interleaved(calls, repeats=20, warm_up=2)
    rounds = ["".join(called[i : i + 3]) for i in range(0, len(called), 3)]
    assert len(rounds) == 22
    assert all(sorted(each) == list("abc") for each in rounds)
    assert len(Counter(rounds)) > 1
    assert all(times.shape == (20,) and (times > 0).all() for times in seconds.values())


def test_the_warm_up_is_not_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    takes = iter([100.0, 2.0, 3.0])

    def call() -> None:
        clock[0] += next(takes)

    monkeypatch.setattr(timing, "perf_counter", lambda: clock[0])
    np.testing.assert_array_equal(interleaved({"call": call}, repeats=2)["call"], [2.0, 3.0])


@pytest.mark.parametrize("n", [FEWEST_REPEATS, 7, 11, 30, 101])
def test_the_interval_holds_the_median_with_95_percent(n: int) -> None:
    # Of a skewed distribution whose median is known; the interval's share is an exact binomial's.
    drawn = np.random.default_rng(n).exponential(size=(4000, n))
    found = [median_interval(row) for row in drawn]
    held = sum(each.low <= np.log(2) <= each.high for each in found)
    # At least 95 %, four standard deviations allowed.
    assert held / 4000 >= 0.95 - 4 * np.sqrt(0.95 * 0.05 / 4000)
    assert all(each.low <= each.value <= each.high for each in found)


def test_the_interval_is_no_wider_than_it_must() -> None:
    # n = 11: from the second smallest to the second largest value 98.8 %, from the third 93.5 %.
    found = median_interval(np.random.default_rng(1).permutation(11).astype(float))
    assert (found.value, found.low, found.high) == (5.0, 1.0, 9.0)


def test_too_few_repeats_are_refused() -> None:
    with pytest.raises(ValueError, match=r"repeats = 5 is not accepted: give at least 6"):
        median_interval(np.ones(5))


def test_the_machine_is_told() -> None:
    told = dict(machine().rows)
    assert told["processor"]
    assert int(told["cores"]) >= 1
    assert told["numpy"] == np.__version__
