"""Timing and its intervals."""

from __future__ import annotations

from collections import Counter

import numba
import numpy as np
import pytest
from scipy import stats

from core.studies import timing
from core.studies.statistics import MIN_REPEATS, mean_interval, median_interval
from core.studies.timing import interleaved, kernel_threads, machine


def test_each_round_makes_every_call_once_in_random_order() -> None:
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


@pytest.mark.parametrize("n", [MIN_REPEATS, 11, 101])
def test_the_interval_covers_the_median_with_95_percent(n: int) -> None:
    # A skewed distribution of known median; the coverage is an exact binomial's.
    drawn = np.random.default_rng(n).exponential(size=(4000, n))
    found = [median_interval(row) for row in drawn]
    covered = sum(each.low <= np.log(2) <= each.high for each in found)
    # At least 95 %, four standard deviations allowed.
    assert covered / 4000 >= 0.95 - 4 * np.sqrt(0.95 * 0.05 / 4000)


def test_the_interval_is_the_narrowest() -> None:
    # n = 11: from the second smallest to the second largest value 98.8 %, from the third 93.5 %.
    found = median_interval(np.random.default_rng(1).permutation(11).astype(float))
    assert (found.value, found.low, found.high) == (5.0, 1.0, 9.0)
    with pytest.raises(ValueError, match=r"repeats = 5 is not accepted: give at least 6"):
        median_interval(np.ones(5))


def test_the_interval_of_a_mean_is_student_s() -> None:
    values = np.array([1.0, 2.0, 4.0])
    found = mean_interval(values)
    expected = stats.t.interval(0.95, 2, values.mean(), stats.sem(values))
    assert (found.low, found.high) == pytest.approx(expected)
    assert np.isnan(mean_interval(values[:1]).value)


def test_threads_are_restored() -> None:
    before = numba.get_num_threads()
    with pytest.raises(ZeroDivisionError), kernel_threads(1):
        assert numba.get_num_threads() == 1
        raise ZeroDivisionError
    assert numba.get_num_threads() == before


def test_the_machine_is_described() -> None:
    known = dict(machine().rows)
    assert known["processor"]
    assert int(known["cores"]) >= 1
    assert known["numpy"] == np.__version__
