"""Tests of the consistency of captures, and of results cached for them."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from core.acquisition import Acquisition, Pulse
from core.capture import IMAGES, MOST_CACHED, Capture, cached_per_capture
from core.inference.flux import flux_prior_of


def capture_of(cube: Any, n_pulses: int | None = 1000, dtype: type = np.uint16) -> Capture:
    cube = np.array(cube, dtype)
    return Capture(cube, Acquisition(n_bins=cube.shape[2], n_pulses=n_pulses))


def test_the_cube_is_read_only() -> None:
    capture = capture_of(np.ones((2, 3, 4)))
    with pytest.raises(ValueError, match="read-only"):
        capture.cube[0, 0, 0] = 5


def test_counts_do_not_wrap() -> None:
    capture = capture_of(np.full((2, 3, 400), 255), None, np.uint8)
    assert capture.shape == (2, 3)
    np.testing.assert_array_equal(capture.counts, np.full((2, 3), 400 * 255))


@pytest.mark.parametrize("n_pulses", [None, 8, 1000])
def test_only_first_photons_have_gated_pulses(n_pulses: int | None) -> None:
    first = capture_of(np.full((2, 3, 4), 2), n_pulses)
    assert first.gated_pulses == n_pulses
    assert replace(first, detection="all").gated_pulses is None


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


def test_a_result_is_computed_once_for_each_capture_and_argument() -> None:
    calls = []

    @cached_per_capture
    def total(capture: Capture, factor: int) -> int:
        """Counts times a factor."""
        calls.append((capture, factor))
        return factor * int(capture.counts.sum())

    one, other = capture_of(np.ones((1, 2, 4))), capture_of(np.full((1, 2, 4), 2))
    assert not total.is_cached(one)
    for _ in range(2):
        assert (total(one, 1), total(one, 3), total(other, 1)) == (8, 24, 16)
    assert calls == [(one, 1), (one, 3), (other, 1)]
    assert total.is_cached(one) and not total.is_cached(replace(one))
    assert (total.__name__, total.__doc__) == ("total", "Counts times a factor.")


def test_only_the_latest_results_are_kept() -> None:
    calls = []

    @cached_per_capture
    def number(capture: Capture, given: int) -> int:
        calls.append(given)
        return given

    capture = capture_of(np.ones((1, 1, 1)))
    latest = [*range(1, MOST_CACHED + 1)]
    for given in (0, *latest, *latest, 0):
        assert number(capture, given) == given
    assert calls == [0, *latest, 0]


def test_none_is_cached_and_an_error_is_not() -> None:
    results = iter([ValueError("not yet"), None])

    @cached_per_capture
    def flaky(capture: Capture) -> None:
        result = next(results)
        if result is not None:
            raise result

    capture = capture_of(np.ones((1, 1, 1)))
    with pytest.raises(ValueError, match="not yet"):
        flaky(capture)
    assert flaky(capture) is None
    assert flaky(capture) is None


def test_a_cached_result_is_freed_with_its_capture() -> None:
    class Result:
        pass

    @cached_per_capture
    def result_of(capture: Capture) -> Result:
        return Result()

    capture = capture_of(np.ones((1, 1, 1)))
    result = weakref.ref(result_of(capture))
    assert result() is not None
    del capture
    gc.collect()
    assert result() is None


def test_a_copy_keeps_the_flux_prior() -> None:
    capture = capture_of(np.random.default_rng(0).poisson(1.0, (8, 8, 20)))
    prior = flux_prior_of(capture)
    part = replace(capture, cube=capture.cube[:2], flux_prior=prior)
    assert flux_prior_of(part) is prior
    assert flux_prior_of(replace(part, source="a copy")) is prior
    assert flux_prior_of(replace(part, flux_prior=None)) is not prior


COUNTS = np.full((2, 3, 4), 2, np.uint16)
REFUSED: list[tuple[dict[str, Any], str]] = [
    *(
        ({"cube": cube}, r"cube = .* give uint8, uint16 or uint32 counts")
        for cube in (COUNTS.astype(np.int32), COUNTS.astype(float), COUNTS[0])
    ),
    *(({"cube": cube}, r"cube = .*none of them 0") for cube in (COUNTS[:0], COUNTS[:, :0])),
    ({"cube": COUNTS[..., :0]}, r"cube = .*none of them 0"),
    ({"acquisition": Acquisition(n_bins=5)}, r"n_bins = 5 .*give 4, the cube's last axis"),
    ({"truth_range_m": np.zeros((3, 2))}, r"truth_range_m = 'shape \(3, 2\)' .*\(2, 3\)"),
    ({"signal": np.zeros((3, 2))}, r"signal = 'shape \(3, 2\)' .*\(2, 3\)"),
    ({"acquisition": Acquisition(4, n_pulses=7)}, r"n_pulses = 7, counts = 8 .*'all' for its"),
    ({"detection": "some"}, r"detection = 'some' .*'first' or 'all'"),
]


@pytest.mark.parametrize(("changed", "message"), REFUSED)
def test_inconsistent_captures_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Capture(**{"cube": COUNTS, "acquisition": Acquisition(n_bins=4)} | changed)


CUBE, TEN_BINS = np.zeros((2, 3, 10), np.uint16), Acquisition(n_bins=10)

WRONG_TYPES: dict[str, tuple[Any, str]] = {
    "list of counts": (
        lambda: Capture(CUBE.tolist(), TEN_BINS),
        r"cube = \[\[\[0, .* a NumPy array of uint8, uint16 or uint32",
    ),
    "no acquisition": (
        lambda: Capture(CUBE, acquisition=None),  # type: ignore[arg-type]
        "acquisition = None .* a core.Acquisition",
    ),
    "width as pulse": (
        lambda: Capture(CUBE, TEN_BINS, 1e-9),  # type: ignore[arg-type]
        "pulse = 1e-09 .* a core.Pulse",
    ),
    "texts as truth": (
        lambda: Capture(CUBE, TEN_BINS, truth_range_m=np.full((2, 3), "1 m")),
        "truth_range_m = .*<U3.* real numbers",
    ),
    "complex truth": (
        lambda: Capture(CUBE, TEN_BINS, truth_range_m=np.full((2, 3), 1j)),
        "truth_range_m = .*complex128.* real numbers",
    ),
    "rows of different lengths": (
        lambda: Capture(CUBE, TEN_BINS, truth_range_m=[[1.0], [1.0, 2.0]]),  # type: ignore[arg-type]
        "truth_range_m = .*object.* real numbers",
    ),
    "text as background": (
        lambda: Capture(CUBE, TEN_BINS, background="1"),  # type: ignore[arg-type]
        "background = '1' .* number",
    ),
}


@pytest.mark.parametrize("make, message", WRONG_TYPES.values(), ids=WRONG_TYPES)
def test_values_of_another_type_are_refused_by_name(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("name", IMAGES)
def test_images_may_be_lists(name: str) -> None:
    capture = Capture(CUBE, TEN_BINS, **{name: [[1, 2, 3], [4.5, 5, 6]]})
    np.testing.assert_array_equal(getattr(capture, name), [[1, 2, 3], [4.5, 5, 6]])
    assert isinstance(getattr(capture, name), np.ndarray)
    given = np.ones((2, 3), np.float32)
    assert getattr(Capture(CUBE, TEN_BINS, **{name: given}), name) is given
