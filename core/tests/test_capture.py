"""Captures: consistent by construction, and what they say about their own light."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.scene import Scene
from core.simulate import simulate
from core.trigger import rate_per_bin, trigger_probability


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
    capture = capture_of(np.full((2, 3, 400), 255), dtype=np.uint8)
    assert capture.shape == (2, 3)
    np.testing.assert_array_equal(capture.counts, np.full((2, 3), 400 * 255))


def test_blocks_are_laid_out_once() -> None:
    capture = capture_of(np.ones((2, 3, 4)))
    assert capture.blocks is capture.blocks
    assert capture.blocks.n_pixels == 6


@pytest.mark.parametrize(("n_pulses", "armed"), [(None, None), (7, None), (8, 8), (1000, 1000)])
def test_pulses_count_as_armed_while_none_fires_twice(
    n_pulses: int | None, armed: int | None
) -> None:
    assert capture_of(np.full((2, 3, 4), 2), n_pulses).armed_pulses == armed


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


@pytest.mark.parametrize("first_photon", [True, False], ids=["first photons", "every photon"])
def test_typical_flux_is_that_of_the_expected_counts(first_photon: bool) -> None:
    signal, background, n_pulses = 0.5, 1.5, 50_000
    acquisition = Acquisition(n_pulses=n_pulses if first_photon else None)
    onset_bin = np.linspace(5, 90, 40).reshape(5, 8)
    rate = rate_per_bin(onset_bin, np.full((5, 8), signal), background, Pulse(), acquisition)
    expected = (trigger_probability(rate) if first_photon else rate) * n_pulses
    found_signal, found_background = Capture(
        np.rint(expected).astype(np.uint16), acquisition
    ).typical_flux
    scale = 1 if first_photon else n_pulses  # a pixel's photons where pulses are not known
    # The window holds four fifths of the echo or more; what it leaves counts as background.
    assert 0.8 * signal < found_signal / scale <= signal
    half_a_count = 0.5 * 100 / n_pulses  # in each of the hundred bins
    assert 0 <= found_background / scale - background + half_a_count <= 0.2 * signal


def test_typical_flux_survives_pixels_without_a_target() -> None:
    acquisition = Acquisition(n_pulses=1000)
    range_m = np.full((8, 8), 50.0)
    range_m[:, :4] = np.nan
    signal, background = simulate(Scene(range_m), acquisition, Flux(0.5, 1.0)).typical_flux
    # Shot noise: 600 detections in the window, 2 in a bin of the rest, over 32 pixels and more.
    assert signal == pytest.approx(0.5, rel=0.2)
    assert background == pytest.approx(0.5, rel=0.2)


@pytest.mark.parametrize("empty_column", range(4))
def test_typical_flux_is_not_fooled_by_a_picket_fence(empty_column: int) -> None:
    acquisition = Acquisition(n_pulses=50_000)
    onset_bin = np.full((64, 64), 50.0)
    onset_bin[:, empty_column::4] = np.nan
    rate = rate_per_bin(onset_bin, np.full((64, 64), 0.5), 1.5, Pulse(), acquisition)
    counts = np.rint(trigger_probability(rate) * 50_000).astype(np.uint16)
    # Three pixels in four see the target, as above.
    assert 0.8 * 0.5 < Capture(counts, acquisition).typical_flux[0] <= 0.5


@pytest.mark.parametrize("n_pulses", [None, 3, 1000])
@pytest.mark.parametrize("n_bins", [1, 2, 5, 100])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_typical_flux_is_always_defined(count: int, n_bins: int, n_pulses: int | None) -> None:
    cube = np.zeros((2, 3, n_bins))
    cube[..., 0] = count
    signal, background = capture_of(cube, n_pulses).typical_flux
    assert 0 <= signal < np.inf
    assert 0 <= background < np.inf
