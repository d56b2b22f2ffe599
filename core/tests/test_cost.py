"""Tests of the prediction of memory and time, and of the refusal of too large estimates."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from core import Acquisition, Capture, estimate, run
from core.cost import predicted

MB = 10**6

MEASURE = """
import os, sys
from core.studies.performance.costs import measured
for line in sys.stdin:
    method, *shape = line.split()
    if os.fork() == 0:
        print(measured(tuple(map(int, shape)), method).working_bytes, flush=True)
        os._exit(0)
    if os.wait()[1]:
        print("failed", flush=True)
"""


@pytest.fixture(scope="module")
def working_bytes() -> Iterator[Callable[..., int]]:
    """Function that measures the peak of an estimate beyond what a fresh process held before.

    Each is measured in a process of its own, all forked from one that has the libraries loaded.
    """
    with subprocess.Popen(
        [sys.executable, "-c", MEASURE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as forking:
        assert forking.stdin is not None and forking.stdout is not None
        asked, answers = forking.stdin, forking.stdout

        def measured(method: str, *shape: int) -> int:
            print(method, *shape, file=asked, flush=True)
            return int(answers.readline())

        yield measured
        asked.close()


def empty(*shape: int) -> Capture:
    return Capture(np.zeros(shape, np.uint8), Acquisition(shape[2], 1e-9, n_pulses=1000))


@pytest.mark.parametrize(
    ("method", "shape"),
    [
        ("tracking", (1, 1, 100_000)),
        ("likelihood", (1, 1, 100_000)),
        ("kde", (24, 24, 2_000)),
        ("tracking", (500, 500, 1)),
        ("unmixing", (200, 200, 4)),
    ],
)
def test_predicted_memory_is_measured(
    method: str, shape: tuple[int, int, int], working_bytes: Callable[..., int]
) -> None:
    expected = predicted(shape, method).working_bytes
    assert expected / 3 < working_bytes(method, *shape) < 1.3 * expected


@pytest.mark.parametrize("method", ["tracking", "likelihood", "chi", "unmixing"])
def test_memory_of_a_long_gate_depends_on_its_pixels(method: str) -> None:
    # A block of 64 lanes would take 3.3 kB a bin, for a single pixel: 660 MB.
    assert predicted((1, 1, 200_000), method).working_bytes < 150 * MB


def test_a_cached_posterior_is_not_counted() -> None:
    shape = (256, 256, 100)
    whole, rest = (
        predicted(shape, "coates", posterior_is_cached=posterior_is_cached)
        for posterior_is_cached in (False, True)
    )
    assert rest.working_bytes <= whole.working_bytes - 4 * 256 * 256 * 100
    assert rest.seconds < whole.seconds


def test_twice_the_steps_take_more_than_one() -> None:
    shape = (64, 64, 1000)
    steps = (SimpleNamespace(steps_per_bin=count) for count in (1, 8))
    one, eight = (predicted(shape, "likelihood", each).seconds for each in steps)
    assert eight > 2 * one


@pytest.mark.parametrize("call", [estimate, run])
def test_an_estimate_that_does_not_fit_is_refused_before_it_begins(call, monkeypatch) -> None:
    free = SimpleNamespace(available=50 * MB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: free)
    capture = empty(1000, 1000, 1)
    with pytest.raises(ValueError, match="1000 x 1000 pixels of 1 bins") as refused:
        call(capture, "tracking")
    assert "0.05 GB" in str(refused.value)
    assert "merge bins" in str(refused.value)
    assert "blocks" not in vars(capture)  # nothing has been laid out
    call(empty(8, 8, 100), "tracking")  # any machine has room for this


@pytest.mark.parametrize("method", ["tracking", "likelihood", "kde", "chi", "unmixing"])
def test_estimates_do_not_depend_on_the_numbers_held_at_once(method, monkeypatch):
    rng = np.random.default_rng(0)
    cube = rng.poisson(rng.gamma(2, 0.05, (11, 17, 1)), (11, 17, 40)).astype(np.uint16)
    cube[..., 20:22] += rng.poisson(2.0, (11, 17, 2)).astype(np.uint16)

    def found() -> tuple[np.ndarray, ...]:
        image = estimate(Capture(cube, Acquisition(40, 1e-9, n_pulses=200)), method)
        return image.bin, image.score, image.confidence

    expected = found()
    monkeypatch.setattr("core.inference.likelihood.TABLE_NUMBERS", 1000)  # two pixels side by side
    monkeypatch.setattr("core.inference.likelihood.FLUX_NUMBERS", 1000)
    monkeypatch.setattr("core.inference.likelihood.NUMBERS_AT_ONCE", 100)
    for module in ("base", "chi", "unmixing"):
        monkeypatch.setattr(f"core.estimators.{module}.NUMBERS_AT_ONCE", 2000)
    for one, other in zip(found(), expected, strict=True):
        np.testing.assert_array_equal(one, other)
