"""Detection at a chosen rate of false alarms, for every registered estimator."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy import stats

from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.estimators import ESTIMATORS, base, estimate
from core.io.readers.dense import guess_detection
from core.scene import Scene
from core.simulation import simulate

pytestmark = pytest.mark.uncounted

SIZE = 40  # rows and columns of captures
NULL_SIDE = 64  # of the images on which thresholds are found
N_BINS = 40
FOUR_SIGMA = float(stats.norm.sf(4))

with_threshold = [name for name, each in ESTIMATORS.items() if not each.own_threshold]
every_estimator = pytest.mark.parametrize("method", with_threshold)

WINDOWS = {"chi": 7}
"""Rows and columns of the pixels that may change an estimate, if not `Estimator.window_size`."""


def window_of(method: str) -> int:
    return WINDOWS.get(method, ESTIMATORS[method].window_size(ESTIMATORS[method].parameters()))


@pytest.fixture(autouse=True, scope="module")
def _small_null_images() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(base, "NULL_SIDE", NULL_SIDE)
        yield


def simulated(onset_bin: np.ndarray, seed: int, **flux: float) -> Capture:
    """Echoes at some delays, (row, col), NaN where there is none."""
    acquisition = Acquisition(n_bins=N_BINS)
    scene = Scene(acquisition.bin_to_range_m(onset_bin))
    return simulate(scene, acquisition, Flux(**flux), seed=seed)


def delays(share: float) -> np.ndarray:
    """Delays for the first columns, `share` of them, and NaN for the others."""
    onset_bin = np.random.default_rng(1).uniform(22, N_BINS - 8, (SIZE, SIZE))
    onset_bin[:, round(share * SIZE) :] = np.nan
    return onset_bin


@pytest.fixture(scope="module")
def sky(_small_null_images: None) -> Capture:
    return simulated(delays(0.0), seed=7, sbr=0.1)


@pytest.fixture(scope="module")
def uneven(_small_null_images: None) -> Capture:
    """Rows without echoes, the lower half with three times the background."""
    dark, bright = (
        simulated(delays(0.0)[: SIZE // 2], seed=10 + i, signal=0.1, sbr=0.3 / (1 + 2 * i))
        for i in (0, 1)
    )
    cube = np.concatenate([dark.cube, bright.cube])
    return Capture(cube, dark.acquisition, signal=np.zeros((SIZE, SIZE)), background=0.7)


@pytest.fixture(scope="module")
def half(_small_null_images: None) -> Capture:
    return simulated(delays(0.5), seed=8, sbr=0.1)


@pytest.fixture(scope="module")
def strong(_small_null_images: None) -> Capture:
    """Strong echoes from one depth, so that neighbours agree."""
    onset_bin = np.random.default_rng(1).uniform(28, 29, (SIZE, SIZE))
    return simulated(onset_bin, seed=9, signal=0.5, sbr=5.0)


def expected_alarms(false_alarm: float, n_null: float, n_pixels: float) -> tuple[float, float]:
    """Fewest and most alarms among `n_pixels`, the threshold being found on `n_null` others.

    The r-th largest of n scores is exceeded with a probability that is Beta(r, n + 1 - r)
    distributed, so that alarms are beta-binomial; the threshold lies between two of the scores.
    """
    n_null, n_pixels = math.floor(n_null), math.floor(n_pixels)
    rank = false_alarm * (n_null - 1) + 1  # from above, and so many scores are as large or larger
    above, below = math.floor(rank), math.ceil(rank)
    low = stats.betabinom.ppf(FOUR_SIGMA, n_pixels, above, n_null + 1 - above)
    most = stats.betabinom.ppf(1 - FOUR_SIGMA, n_pixels, below, max(n_null + 1 - below, 1))
    return float(low), float(most)


def assert_alarms(method: str, capture: Capture, empty: np.ndarray, false_alarm: float) -> None:
    """Require the allowed number of false alarms among the `empty` pixels (row, col)."""
    image = estimate(capture, method, false_alarm=false_alarm)
    # Neighbours that share counts say as much as one of them, at worst.
    window = window_of(method)
    some = np.zeros(capture.shape, bool)
    some[window // 2 :: window, window // 2 :: window] = True
    some &= empty
    side = base.whole_patches(base.NULL_SIDE, SIZE)
    n_null = side**2 / window**2
    low, most = expected_alarms(false_alarm, n_null, np.count_nonzero(some))
    assert low <= np.count_nonzero(image.valid[some]) <= most


@every_estimator
@pytest.mark.parametrize("false_alarm", [0.1, 0.01])
def test_false_alarm_rate_of_an_empty_image(sky: Capture, method: str, false_alarm: float) -> None:
    assert_alarms(method, sky, np.full(sky.shape, True), false_alarm)


@every_estimator
def test_false_alarm_rate_over_an_uneven_background(uneven: Capture, method: str) -> None:
    assert_alarms(method, uneven, np.full(uneven.shape, True), 0.1)


@every_estimator
def test_false_alarm_rate_next_to_targets(half: Capture, method: str) -> None:
    empty = np.full(half.shape, True)
    empty[:, : SIZE // 2 + window_of(method) // 2] = False  # whose counts have no part of an echo's
    assert_alarms(method, half, empty, 0.1)


def same(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.array_equal(one, other, equal_nan=True))


@every_estimator
def test_a_false_alarm_rate_of_1_is_no_threshold(half: Capture, method: str) -> None:
    expected = estimate(half, method)
    for all_allowed in (1, 1.0, None):
        image = estimate(half, method, false_alarm=all_allowed)
        for field in ("range_m", "bin", "score", "confidence", "valid"):
            assert same(getattr(image, field), getattr(expected, field))


@every_estimator
def test_a_stricter_threshold_keeps_a_subset(half: Capture, method: str) -> None:
    looser = estimate(half, method)
    for false_alarm in (0.1, 0.001):
        image = estimate(half, method, false_alarm=false_alarm)
        assert not (image.valid & ~looser.valid).any()
        for field in ("range_m", "bin", "confidence"):
            expected = getattr(looser, field)[image.valid]
            np.testing.assert_array_equal(getattr(image, field)[image.valid], expected)
        np.testing.assert_array_equal(image.score, looser.score)
        assert np.isnan(image.range_m[~image.valid]).all()
        assert np.isnan(image.bin[~image.valid]).all()
        assert (image.confidence[~image.valid] == 0).all()
        looser = image
    # Each would leave one pixel in a thousand of an empty image, and this one is half empty.
    assert looser.valid.sum() < 0.75 * looser.valid.size


@every_estimator
def test_strong_echoes_stay(strong: Capture, method: str) -> None:
    image = estimate(strong, method, false_alarm=0.001)
    assert image.valid.mean() > 0.95
    # What is left is rounding to whole bins, and the pulse's own length.
    error = image.range_m - strong.truth_range_m
    assert (np.abs(error[image.valid]) < 4 * strong.acquisition.bin_length_m).mean() > 0.95


def with_fluxes(cube: np.ndarray, n_pulses: int | None = 1000) -> Capture:
    """Return a capture with true fluxes, which the oracle needs."""
    fluxes: dict[str, Any] = {"signal": np.full(cube.shape[:2], 0.1), "background": 1.7}
    setting = Acquisition(n_bins=cube.shape[2], n_pulses=n_pulses)
    return Capture(cube, setting, detection=guess_detection(cube, n_pulses), **fluxes)


CAPTURES = {
    "one photon": with_fluxes(np.eye(20, dtype=np.uint16)[np.newaxis, :1]),
    "one bin": with_fluxes(np.arange(12, dtype=np.uint16).reshape(3, 4, 1)),
    "empty": with_fluxes(np.zeros((3, 4, 20), np.uint16)),
    "full narrow counters": with_fluxes(np.full((3, 4, 20), 255, np.uint8)),
    "pulses unknown": with_fluxes(np.full((3, 4, 20), 3, np.uint32), n_pulses=None),
}


@pytest.mark.parametrize("method", ["tracking", "peak", "kde", "cfar", "likelihood"])
@pytest.mark.parametrize("capture", CAPTURES.values(), ids=CAPTURES)
def test_fewer_pixels_are_valid_as_the_rate_falls(capture: Capture, method: str) -> None:
    """One method for each kind of score."""
    images = [estimate(capture, method, false_alarm=rate) for rate in (1.0, 0.1, 0.001)]
    for looser, stricter in pairwise(images):
        assert not (stricter.valid & ~looser.valid).any()


def test_a_long_gates_threshold_is_found_on_fewer_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "NULL_SIDE", 256)
    for n_bins in (2**14, 2**20):
        capture = with_fluxes(np.zeros((1, 1, n_bins), np.uint16))
        side = base.null_pixels(capture).shape[0]
        assert side == max(1, math.isqrt(2**23 // n_bins)) < 256


def test_a_method_with_its_own_threshold_says_so(half: Capture) -> None:
    free, asked = (estimate(half, "unmixing", false_alarm=p) for p in (None, 0.1))
    assert same(free.range_m, asked.range_m)
    assert free.made_by is not None and asked.made_by is not None
    assert "the share of false alarms is not controlled" in asked.made_by.remark
    assert "false alarms" not in free.made_by.remark


@every_estimator
def test_a_method_that_adds_neighbours_says_that_it_exceeds_the_rate(method: str) -> None:
    rng = np.random.default_rng(4)
    onset_bin = rng.uniform(2, N_BINS - 8, (SIZE, SIZE))
    is_empty = rng.uniform(size=onset_bin.shape) < 0.5
    capture = simulated(np.where(is_empty, np.nan, onset_bin), seed=5, sbr=0.1)
    adds = ESTIMATORS[method].window_size(ESTIMATORS[method].parameters()) > 1
    for false_alarm, expected in ((0.01, adds), (1, False), (None, False)):
        image = estimate(capture, method, false_alarm=false_alarm)
        assert image.made_by is not None
        assert (base.NEXT_TO_SURFACES in image.made_by.remark) == expected
        if false_alarm == 0.01:
            assert (image.valid[is_empty].mean() > 0.05) == adds


def test_density_of_single_pixels_keeps_the_rate(half: Capture) -> None:
    image = estimate(half, "kde", false_alarm=0.1, neighbourhood="1x1")
    assert image.made_by is not None
    assert base.NEXT_TO_SURFACES not in image.made_by.remark


def test_other_false_alarm_rates_are_refused(half: Capture) -> None:
    for bad in (0, 0.0, -0.1, 0.0001, 1.001, 2, math.nan, math.inf, "x", True):
        with pytest.raises(ValueError, match=r"false_alarm = .* is not accepted"):
            estimate(half, "peak", false_alarm=bad)  # type: ignore[arg-type]
