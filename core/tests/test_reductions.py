"""Tests that counts of reduced captures follow the model of their acquisition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from core.acquisition import Acquisition, Flux
from core.capture import Capture
from core.kernels.streams import pixel_key, uniform_at
from core.reductions import (
    Reduction,
    cut_gate,
    first_pulses,
    merge_bins,
    pool_pixels,
    share_of_pulses,
    skip_pixels,
)
from core.scene import Scene
from core.simulation import simulate
from core.trigger import no_trigger_probability, rate_per_bin, trigger_probability

SIDE = 32  # rows and columns of 500 pulses each
PULSES = 500 * SIDE**2
SIGNIFICANCE = 1e-4  # by chance, one fixed seed in ten thousand would fall below

ACQUISITION = Acquisition(n_bins=60, n_pulses=500)
ONSET_BIN = 32.3


@pytest.fixture(scope="module")
def wall() -> Capture:
    """A square image of one range, its counts too many for uint8."""
    scene = Scene(np.full((SIDE, SIDE), ACQUISITION.bin_to_range_m(ONSET_BIN)))
    return simulate(scene, ACQUISITION, Flux(0.4, 0.3), seed=1)


def expected_share(capture: Capture) -> np.ndarray:
    """Probability of each bin, and of no trigger, by the model of a capture of one range."""
    acquisition = capture.acquisition
    onset = acquisition.range_m_to_bin(np.asarray(capture.truth_range_m)[0, 0])
    signal = np.asarray(capture.signal)[0, 0]
    rate = rate_per_bin(onset, signal, capture.background or 0.0, capture.pulse, acquisition)
    return np.append(trigger_probability(rate), no_trigger_probability(rate))


def fits(capture: Capture, n_pulses: int) -> bool:
    """Whether the counts of all pixels together are those of so many pulses."""
    bins = capture.cube.sum(axis=(0, 1), dtype=np.int64)
    found = np.append(bins, n_pulses - bins.sum())
    expected = expected_share(capture) * n_pulses
    assert expected.min() > 5  # where chi-square holds
    return bool(stats.chisquare(found, expected).pvalue > SIGNIFICANCE)


@pytest.mark.compiled
@pytest.mark.parametrize("factor", [1, 2, 4, 7])
def test_merged_bins_are_what_wider_bins_would_have_recorded(wall: Capture, factor: int) -> None:
    merged = merge_bins(wall, factor)
    assert merged.acquisition.n_bins == 60 // factor
    assert merged.acquisition.bin_width_s == pytest.approx(factor * 1e-9)
    assert fits(merged, PULSES)
    end = 60 // factor * factor
    np.testing.assert_array_equal(merged.counts, wall.cube[:, :, :end].sum(axis=2))


@pytest.mark.compiled
def test_a_later_window_is_a_gate_that_opens_later(wall: Capture) -> None:
    window = cut_gate(wall, 20, 50)
    armed = 500 - wall.cube[:, :, :20].sum(axis=2, dtype=np.int64)
    assert window.acquisition.n_pulses == round(armed.mean())
    assert f"{window.acquisition.n_pulses} pulses are armed" in window.source
    assert window.acquisition.bin_to_range_m(0) == pytest.approx(ACQUISITION.bin_to_range_m(20))
    assert fits(window, int(armed.sum()))
    # The same as a simulation with a gate that opens later.
    later = simulate(
        Scene(np.asarray(wall.truth_range_m)),
        window.acquisition,
        Flux(0.4, 0.4 / (window.background or 0.0)),
        seed=2,
    )
    bins = [c.cube.sum(axis=(0, 1), dtype=np.int64) for c in (window, later)]
    assert stats.chi2_contingency(bins).pvalue > SIGNIFICANCE


@pytest.mark.compiled
def test_a_gate_that_only_ends_earlier_loses_no_pulse(wall: Capture) -> None:
    window = cut_gate(wall, 0, 50)
    assert window.acquisition.n_pulses == 500
    assert fits(window, PULSES)


def test_a_window_of_few_pulses_still_holds_its_detections() -> None:
    cube = np.array([[[10, 0, 0], [0, 10, 0]]], np.uint16)
    window = cut_gate(Capture(cube, Acquisition(n_bins=3, n_pulses=10)), 1, 3)
    assert window.acquisition.n_pulses == 10  # five on average are fewer than one pixel's ten


@pytest.mark.compiled
def test_photons_that_hide_nothing_stay_armed(wall: Capture) -> None:
    photons = replace(wall, detection="all")
    assert cut_gate(photons, 20, 50).acquisition.n_pulses == 500


@pytest.mark.compiled
def test_pooled_pixels_are_as_many_pulses_as_all_of_them(wall: Capture) -> None:
    pooled = pool_pixels(wall, 3)
    assert pooled.shape == (SIDE // 3, SIDE // 3)
    assert pooled.acquisition.n_pulses == 4500
    assert fits(pooled, 4500 * (SIDE // 3) ** 2)


def test_pooled_truth_is_of_the_pixels_that_have_one() -> None:
    truth_m = np.array([[1.0, 5.0, np.nan, np.nan], [2.0, 9.0, 7.0, np.nan]])
    capture = Capture(
        np.full((2, 4, 3), 200, np.uint8),
        Acquisition(n_bins=3, n_pulses=None),
        truth_range_m=truth_m,
        reported_range_m=truth_m + 1,
        signal=np.array([[0.0, 1.0, 2.0, 2.0], [2.0, 1.0, 2.0, 2.0]]),
    )
    pooled = pool_pixels(capture, 2)
    np.testing.assert_array_equal(pooled.truth_range_m, [[3.5, 7.0]])
    np.testing.assert_array_equal(pooled.reported_range_m, [[4.5, 8.0]])
    np.testing.assert_array_equal(pooled.signal, [[1.0, 2.0]])
    np.testing.assert_array_equal(pooled.cube, np.full((1, 2, 3), 800))  # more than uint8 holds
    sky = replace(capture, truth_range_m=np.full((2, 4), np.nan))
    assert np.isnan(np.asarray(pool_pixels(sky, 2).truth_range_m)).all()


@pytest.mark.compiled
def test_fewer_pulses_have_the_moments_of_a_draw_without_replacement() -> None:
    side, n, sent = 60, 120, 200
    histogram = np.array([40, 0, 100, 7, 13])  # and 40 pulses that fired nowhere
    cube = np.tile(histogram.astype(np.uint16), (side, side, 1))
    capture = Capture(cube, Acquisition(n_bins=5, n_pulses=sent))
    drawn = first_pulses(capture, n, seed=3).cube.reshape(-1, 5).astype(float)
    share = histogram / sent
    covariance = n * (sent - n) / (sent - 1) * (np.diag(share) - np.outer(share, share))
    sd = np.sqrt(np.diag(covariance))
    # Five standard errors: of a mean sd/√N, of a covariance below √2·sd·sd/√N.
    np.testing.assert_array_less(
        np.abs(drawn.mean(axis=0) - n * share), 5 * sd / side + 1e-12, strict=False
    )
    error = np.abs(np.cov(drawn.T) - covariance)
    assert (error <= 5 * np.sqrt(2) * np.outer(sd, sd) / side + 1e-12).all()


@pytest.mark.compiled
def test_fewer_pulses_follow_the_law_of_as_many(wall: Capture) -> None:
    fewer = first_pulses(wall, 40, seed=5)
    assert fewer.acquisition.n_pulses == 40
    assert fits(fewer, 40 * SIDE**2)
    np.testing.assert_array_equal(first_pulses(wall, 500).cube, wall.cube)


@pytest.mark.compiled
def test_all_photons_are_kept_each_by_chance() -> None:
    cube = np.full((80, 80, 4), 50, np.uint16)
    capture = Capture(cube, Acquisition(n_bins=4, n_pulses=10), detection="all")
    drawn = first_pulses(capture, 3, seed=1).cube
    found = np.bincount(drawn.ravel(), minlength=51)
    law = stats.binom(50, 0.3)
    tails = [law.cdf(8), *law.pmf(np.arange(9, 23)), law.sf(22)]
    found = [found[:9].sum(), *found[9:23], found[23:].sum()]
    assert stats.chisquare(found, np.array(tails) * cube.size).pvalue > SIGNIFICANCE


def test_fewer_pulses_are_a_part_of_more() -> None:
    cube = np.random.default_rng(0).poisson(8, (4, 5, 30)).astype(np.uint16)
    some = Capture(cube, Acquisition(n_bins=30, n_pulses=500))
    for capture in (some, replace(some, detection="all")):
        more = capture
        for n_pulses in (499, 250, 30, 1):
            fewer = first_pulses(capture, n_pulses, seed=2)
            assert (fewer.cube <= more.cube).all()
            assert fewer.cube.sum() < more.cube.sum()
            more = fewer


def drawn_by_hand(
    histogram: np.ndarray, sent: int, n_pulses: int, uniform: np.ndarray
) -> list[int]:
    """Pulses looked at one after another; each is taken as likely as those wanted of those left."""
    taken, looked_at = [0] * len(histogram), 0
    for k, fired in enumerate(histogram):
        for _ in range(fired):
            wanted = n_pulses - sum(taken)
            taken[k] += bool(uniform[looked_at] < wanted / (sent - looked_at))
            looked_at += 1
    return taken


def test_pulses_are_drawn_as_one_would_by_hand() -> None:
    cube = np.array([[[3, 0, 9, 4], [0, 0, 20, 0]]], np.uint16)
    capture = Capture(cube, Acquisition(n_bins=4, n_pulses=20))
    for n_pulses in range(1, 21):
        drawn = first_pulses(capture, n_pulses, seed=7).cube
        for pixel in range(2):
            key = np.uint64(pixel_key(np.uint64(7), pixel))
            uniform = np.array([uniform_at(key, draw) for draw in range(20)])
            by_hand = drawn_by_hand(cube[0, pixel], 20, n_pulses, uniform)
            np.testing.assert_array_equal(drawn[0, pixel], by_hand)


@pytest.mark.compiled
def test_draws_bin_by_bin_follow_the_same_law(
    wall: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("core.reductions.DRAWN_ONE_BY_ONE", 0)
    assert fits(first_pulses(wall, 40, seed=5), 40 * SIDE**2)
    photons = replace(wall, detection="all")
    kept = first_pulses(photons, 250, seed=5).cube.sum() / wall.cube.sum()
    assert kept == pytest.approx(0.5, abs=4 * 0.5 / np.sqrt(wall.cube.sum()))


@pytest.mark.compiled
def test_a_share_of_unknown_pulses_keeps_detections_at_random(wall: Capture) -> None:
    unknown = replace(wall, acquisition=replace(wall.acquisition, n_pulses=None))
    some = share_of_pulses(unknown, 0.1, seed=4)
    assert some.acquisition.n_pulses is None
    # Pulses are taken by chance, so that their number is, too: counts are those of thinned ones.
    expected = expected_share(wall)[:60] * PULSES * 0.1
    found = some.cube.sum(axis=(0, 1))
    assert stats.chi2.sf(((found - expected) ** 2 / expected).sum(), 60) > SIGNIFICANCE
    np.testing.assert_allclose(some.signal, 0.1 * np.asarray(wall.signal))
    assert share_of_pulses(wall, 0.1).acquisition.n_pulses == 50
    assert share_of_pulses(wall, 1e-9).acquisition.n_pulses == 1
    np.testing.assert_array_equal(share_of_pulses(unknown, 1.0).cube, wall.cube)


@given(st.tuples(st.integers(1, 12), st.integers(1, 12)), st.integers(1, 4), st.integers(1, 3))
def test_missing_pixels_take_the_value_of_a_neighbour(
    shape: tuple[int, int], skip: int, pool: int
) -> None:
    row, col = np.indices(shape)
    marked = Capture(
        np.ones((*shape, 2), np.uint16),
        Acquisition(n_bins=2, n_pulses=None),
        truth_range_m=(row + 0.01 * col).astype(float),
        reported_range_m=(row + 0.01 * col).astype(float),
    )
    if min(shape) < skip or len(range((skip - 1) // 2, min(shape), skip)) < pool:
        with pytest.raises(ValueError, match="a whole number from 1 to"):
            Reduction(skip=skip, pool=pool).of(marked)
        return
    reduction = Reduction(skip=skip, pool=pool)
    reduced = reduction.of(marked)
    np.testing.assert_array_equal(reduced.reported_range_m, reduced.truth_range_m)
    found_m = reduction.spread(np.asarray(reduced.truth_range_m), shape)
    assert found_m.shape == shape
    row_off = np.abs(np.round(found_m) - row)
    col_off = np.abs(found_m % 1 / 0.01 - col) if pool == 1 else np.zeros(shape)
    # Within the tile, or one tile behind where the image ends in a part of one.
    assert max(row_off.max(), col_off.max()) < 2 * skip * pool
    if pool == 1:
        kept = np.s_[(skip - 1) // 2 :: skip, (skip - 1) // 2 :: skip]
        np.testing.assert_array_equal(found_m[kept], np.asarray(marked.truth_range_m)[kept])


@pytest.mark.compiled
def test_reductions_combine(wall: Capture) -> None:
    both = Reduction(merge=2, gate=(10, 50), skip=2, pool=2, pulses=0.5)
    found = both.of(wall)
    assert share_of_pulses(wall, 0.5).acquisition.n_pulses == 250
    assert 4 * 250 > (found.acquisition.n_pulses or 0) > 2 * 250  # the gate opens later
    assert found.cube.shape == (SIDE // 4, SIDE // 4, 20)
    assert (
        str(both)
        == "0.5 of the pulses, 1 pixel of 2 x 2, 2 x 2 pixels added, bins 10 to 49, 2 bins merged"
    )
    assert found.acquisition.pixel_angle_rad == pytest.approx(4 * 2e-3)
    assert Reduction().of(wall) is wall
    assert str(Reduction()) == "whole"


@pytest.mark.compiled
@pytest.mark.parametrize(
    "refused",
    [
        lambda c: merge_bins(c, 0),
        lambda c: merge_bins(c, 61),
        lambda c: cut_gate(c, 5, 5),
        lambda c: cut_gate(c, -1, 5),
        lambda c: cut_gate(c, 0, 61),
        lambda c: skip_pixels(c, SIDE + 1),
        lambda c: pool_pixels(c, 1.5),
        lambda c: first_pulses(c, 501),
        lambda c: first_pulses(c, 0),
        lambda c: share_of_pulses(c, 0.0),
        lambda c: share_of_pulses(c, 1.1),
        lambda c: Reduction(pulses=-1.0).of(c),
        lambda c: first_pulses(replace(c, acquisition=Acquisition(n_bins=60, n_pulses=None)), 5),
    ],
)
def test_wrong_reductions_are_refused(wall: Capture, refused: Callable[[Capture], Capture]) -> None:
    with pytest.raises(ValueError, match="is not accepted: give"):
        refused(wall)
