"""Captures: consistent by construction, and what is found in them found once."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from core.acquisition import Acquisition, Pulse
from core.capture import Capture, once_per_capture


def capture_of(cube: Any, n_pulses: int | None = 1000, dtype: type = np.uint16) -> Capture:
    cube = np.array(cube, dtype)
    return Capture(cube, Acquisition(n_bins=cube.shape[2], n_pulses=n_pulses))


@pytest.mark.parametrize(
    "cube",
    [
        np.zeros((2, 3, 4), np.int32),
        np.zeros((2, 3, 4)),
        np.zeros((3, 4), np.uint16),
        np.zeros((0, 3, 4), np.uint16),
        np.zeros((2, 0, 4), np.uint16),
        np.zeros((2, 3, 0), np.uint16),
    ],
    ids=["signed", "float", "flat", "no rows", "no columns", "no bins"],
)
def test_other_than_unsigned_cubes_are_refused(cube: np.ndarray) -> None:
    with pytest.raises(
        ValueError, match=r"cube = .* is not accepted: give uint8, uint16 or uint32 counts"
    ):
        Capture(cube, Acquisition(n_bins=4))


def test_a_gate_of_other_bins_is_refused() -> None:
    with pytest.raises(ValueError, match=r"n_bins = 5 .*give 4, the cube's last axis"):
        Capture(np.zeros((2, 3, 4), np.uint16), Acquisition(n_bins=5))


@pytest.mark.parametrize("field", ["truth_range_m", "signal"])
def test_images_of_another_shape_are_refused(field: str) -> None:
    images: dict[str, Any] = {field: np.zeros((3, 2))}
    with pytest.raises(ValueError, match=rf"{field} = 'shape \(3, 2\)' .*\(2, 3\)"):
        Capture(np.zeros((2, 3, 4), np.uint16), Acquisition(n_bins=4), **images)


def test_the_cube_is_read_only() -> None:
    capture = capture_of(np.ones((2, 3, 4)))
    with pytest.raises(ValueError, match="read-only"):
        capture.cube[0, 0, 0] = 5


def test_counts_do_not_wrap() -> None:
    capture = capture_of(np.full((2, 3, 400), 255), None, np.uint8)
    assert capture.shape == (2, 3)
    np.testing.assert_array_equal(capture.counts, np.full((2, 3), 400 * 255))


def test_blocks_are_laid_out_once() -> None:
    capture = capture_of(np.ones((2, 3, 4)))
    assert capture.blocks is capture.blocks
    assert capture.blocks.n_pixels == 6


@pytest.mark.parametrize("n_pulses", [None, 8, 1000])
def test_pulses_are_armed_for_first_photons_alone(n_pulses: int | None) -> None:
    first = capture_of(np.full((2, 3, 4), 2), n_pulses)
    assert first.gated_pulses == n_pulses
    assert replace(first, detection="all").gated_pulses is None


def test_first_photons_do_not_outnumber_the_pulses() -> None:
    with pytest.raises(ValueError, match=r"n_pulses = 7, counts = 8 .*'all' for its detection"):
        capture_of(np.full((2, 3, 4), 2), 7)
    with pytest.raises(ValueError, match=r"detection = 'some' .*'first' or 'all'"):
        replace(capture_of(np.ones((2, 3, 4))), detection="some")


@pytest.mark.parametrize(
    "pulse",
    [Pulse(0.05e-9), Pulse(1e-9), Pulse(6e-9), Pulse.gaussian(2e-9), Pulse.measured([1, 1], 4e-9)],
)
def test_echo_bins_hold_the_middle_of_an_echo(pulse: Pulse) -> None:
    capture = Capture(np.zeros((1, 1, 60), np.uint16), Acquisition(n_bins=60), pulse)
    begin_s, end_s = pulse.span_s
    assert capture.echo_bins >= 1
    assert capture.echo_bins - 1 < (end_s - begin_s) / 1e-9 or capture.echo_bins == 1
    assert capture.echo_bins * 1e-9 >= end_s - begin_s


def summed() -> tuple[Callable[[Capture], list[int]], list[Capture]]:
    """Something found in captures once, and the captures in which it was sought."""
    sought: list[Capture] = []

    @once_per_capture
    def sums(capture: Capture) -> list[int]:
        """Counts of the first row."""
        sought.append(capture)
        return [int(count) for count in capture.counts[0]]

    return sums, sought


def test_what_is_found_in_a_capture_is_kept() -> None:
    sums, sought = summed()
    one, other = capture_of(np.full((2, 3, 4), 1)), capture_of(np.full((2, 3, 4), 2))
    assert sums(one) == [4, 4, 4]
    assert sums(other) == [8, 8, 8]
    assert sums(one) is sums(one)
    assert sums(other) is not sums(one)
    assert [id(capture) for capture in sought] == [id(one), id(other)]


def test_a_changed_capture_is_searched_anew() -> None:
    sums, _ = summed()
    one = capture_of(np.full((2, 3, 4), 1))
    assert sums(one) == [4, 4, 4]
    assert sums(replace(one, cube=np.full((2, 3, 4), 2, np.uint16))) == [8, 8, 8]


def test_each_thing_found_is_kept_for_itself() -> None:
    @once_per_capture
    def largest(capture: Capture) -> int:
        return int(capture.cube.max())

    @once_per_capture
    def smallest(capture: Capture) -> int:
        return int(capture.cube.min())

    capture = capture_of(np.arange(24).reshape(2, 3, 4))
    for _ in range(2):
        assert (largest(capture), smallest(capture)) == (23, 0)


def test_nothing_found_is_something_found() -> None:
    calls = []

    @once_per_capture
    def nothing(capture: Capture) -> None:
        calls.append(capture)

    capture = capture_of(np.ones((1, 1, 1)))
    assert nothing(capture) is None
    assert nothing(capture) is None
    assert len(calls) == 1


def test_what_could_not_be_found_is_sought_again() -> None:
    tries = []

    @once_per_capture
    def second_time(capture: Capture) -> int:
        tries.append(capture)
        if len(tries) == 1:
            raise ValueError("not yet")
        return 7

    capture = capture_of(np.ones((1, 1, 1)))
    with pytest.raises(ValueError, match="not yet"):
        second_time(capture)
    assert second_time(capture) == 7


def test_what_is_found_goes_with_its_capture() -> None:
    class Found:
        pass

    @once_per_capture
    def something(capture: Capture) -> Found:
        return Found()

    capture = capture_of(np.ones((1, 1, 1)))
    found = weakref.ref(something(capture))
    assert found() is not None
    del capture
    gc.collect()
    assert found() is None


def test_a_function_asked_once_keeps_its_name() -> None:
    sums, _ = summed()
    assert sums.__name__ == "sums"
    assert sums.__doc__ == "Counts of the first row."
