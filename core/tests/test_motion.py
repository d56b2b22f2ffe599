"""Tests of pulses in groups, and of the velocity of surfaces found from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy import stats

import core
from core import reductions
from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture, Detection
from core.effects import Motion
from core.estimators import RangeImage, estimate
from core.inference import flux_model_of
from core.inference.flux_model import FluxPrior
from core.inference.motion import flux_at_rest, shared_velocity, velocity_evidence
from core.io import save_capture
from core.io.readers import read_capture
from core.pulse_groups import PulseGroups, group_sizes
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.methods import motion as study
from core.trigger import draw_counts, rate_per_bin

GATE = Acquisition(32, 1e-9, 280e-9, n_pulses=60)
RATE_HZ = 20e3


def moving(scene: Scene, per_1000_bins: float, n_pulses: int = 1000) -> Scene:
    """Return a scene that recedes by a number of bins in 1000 pulses."""
    speed_m_per_s = per_1000_bins * scene.acquisition.bin_length_m * RATE_HZ / 1000
    acquisition = replace(scene.acquisition, n_pulses=n_pulses)
    return replace(scene, motion=Motion(speed_m_per_s, RATE_HZ), acquisition=acquisition)


def thinned(scene: Scene) -> Scene:
    """Return a scene with every second row and column."""
    return replace(scene, range_m=scene.range_m[::2, ::2])


def drawn(scene: Scene, sbr: float, n_groups: int | None = 40, seed: int = 0) -> Capture:
    return simulate(scene, scene.acquisition, Flux(sbr=sbr), seed=seed, n_groups=n_groups)


def flat(onset_bin: float, side: int = 3) -> Scene:
    return Scene(np.full((side, side), GATE.bin_to_range_m(onset_bin)), acquisition=GATE)


def test_groups_of_a_scene_at_rest_add_up_to_the_same_capture() -> None:
    scene = flat(12.3)
    whole, in_groups = drawn(scene, 0.5, None), drawn(scene, 0.5, 7)
    np.testing.assert_array_equal(in_groups.cube, whole.cube)
    assert in_groups.groups is not None and whole.groups is None
    assert in_groups.groups.n_pulses == group_sizes(60, 7)
    assert sum(in_groups.groups.n_pulses) == 60
    np.testing.assert_array_equal(in_groups.groups.total, whole.cube)


@pytest.mark.compiled
@pytest.mark.parametrize("per_1000_bins", [12.0, -12.0])
def test_pulses_of_a_moving_scene_are_drawn_in_order(per_1000_bins: float) -> None:
    gate = replace(GATE, n_pulses=1000)
    scene = replace(flat(15.0, side=12), acquisition=gate)
    bright = Flux(signal=1.0, sbr=1000.0)
    scene = moving(scene, per_1000_bins)
    capture = simulate(scene, scene.acquisition, bright, seed=3, n_groups=4)
    assert capture.groups is not None
    assert capture.groups.pulse_rate_hz == RATE_HZ
    bins = np.arange(32)
    means = [np.average(bins, weights=cube.sum(axis=(0, 1))) for cube in capture.groups.counts]
    # Four groups, whose middles lie a quarter of the way apart.
    np.testing.assert_allclose(np.diff(means), per_1000_bins / 4, atol=0.15)
    # The sum has the mean of the trigger probabilities.
    other = simulate(scene, scene.acquisition, bright, seed=4)
    table = np.stack([capture.cube.sum(axis=(0, 1)), other.cube.sum(axis=(0, 1))])
    kept = table.min(axis=0) > 20
    assert stats.chi2_contingency(table[:, kept]).pvalue > 1e-3


def ratio(capture: Capture, level: int, delay: float, travel_bins: float) -> float:
    """Log likelihood ratio of a moving surface to no echo, in bins that it may reach at rest."""
    groups, flux, n_bins = capture.groups, flux_model_of(capture), capture.cube.shape[2]
    assert groups is not None
    (bare, background), signal = flux.background[[0, level], 0, 0], flux.signal[level, 0, 0]
    found = 0.0
    for counts, sent, at in zip(
        groups.counts[:, 0, 0], groups.n_pulses, groups.middle, strict=True
    ):
        moved = at * travel_bins
        rate = rate_per_bin(delay + moved, signal, background, capture.pulse, capture.acquisition)
        without = np.full(n_bins, bare / n_bins)
        kept = (np.arange(n_bins) >= np.floor(moved)) & (
            np.arange(n_bins) < n_bins + np.floor(moved)
        )
        unfired = sent - np.cumsum(counts.astype(float))
        gain = np.log(np.expm1(-rate) / np.expm1(-without))
        found += float((gain * counts - (rate - without) * unfired)[kept].sum())
        if bare != background:  # the background is that of all bins
            flat = np.full(n_bins, background / n_bins)
            gain = np.log(np.expm1(-flat) / np.expm1(-without))
            found += float((gain * counts - (flat - without) * unfired)[~kept].sum())
    return found


def test_evidence_of_a_velocity_is_that_of_the_equation() -> None:
    levels, share = np.array([0.0, 0.1, 0.5]), np.array([0.2, 0.5, 0.3])
    # Given, since plain Python takes seconds to estimate it.
    known = FluxPrior(levels, share, np.ones(GATE.n_bins), np.asarray(0.2), 0.8)
    capture = drawn(moving(flat(14.0, side=1), 40.0, 60), 0.5, 3, seed=2)
    capture = replace(capture, flux_prior=known)
    groups, flux = capture.groups, flux_model_of(capture)
    assert groups is not None
    travel = np.array([0, 6, -12])  # whole steps in every group: nothing is interpolated
    found = velocity_evidence(capture, groups, flux, travel)[0, 0]
    delays = np.arange(2 * GATE.n_bins) / 2 + 1 / 8  # two steps of each bin
    left_out = 2e-3 * float(flux.signal.max()) * 60  # photons of an echo beyond its taps
    for travel_bins, log in zip(travel, found, strict=True):
        likelihoods = [
            share * np.mean([np.exp(ratio(capture, level, each, travel_bins)) for each in delays])
            for level, share in enumerate(flux.share[1:], 1)
        ]
        assert log == pytest.approx(np.log(flux.share[0] + sum(likelihoods)), abs=left_out)


@pytest.mark.compiled
def test_at_rest_it_is_the_likelihood() -> None:
    capture = drawn(scenes["piecewise"](32), 0.06)
    expected = estimate(capture, "likelihood")
    found = estimate(capture, "velocity")
    assert found.velocity is not None
    still = found.velocity.bins == 0
    assert still.mean() > 0.97
    np.testing.assert_allclose(found.bin[still], expected.bin[still], atol=0.3)
    assert np.abs(found.bin - expected.bin).max() > 0 or still.all()
    unordered = replace(capture, groups=None)
    without = estimate(unordered, "velocity")
    np.testing.assert_array_equal(without.bin, expected.bin)
    np.testing.assert_array_equal(without.confidence, expected.confidence)
    assert without.velocity is None
    assert without.made_by is not None
    assert "keeps no groups of pulses" in without.made_by.remark


def restored(image: RangeImage, capture: Capture) -> float:
    """Return the share of the target pixels within three bins of the truth."""
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    return float((np.abs(image.bin - truth_bin)[np.isfinite(truth_bin)] <= 3).mean())


@pytest.mark.compiled
@pytest.mark.parametrize("per_1000_bins", [10.0, -20.0])
def test_shared_velocity_restores_a_moving_scene(per_1000_bins: float) -> None:
    capture = drawn(moving(scenes["car"](), per_1000_bins), 0.05, seed=900)
    fewer = reductions.skip_pixels(capture, 2)
    found, still = estimate(fewer, "velocity"), estimate(capture, "likelihood")
    assert restored(found, fewer) > 0.95
    assert restored(still, capture) < 0.7
    target = np.isfinite(np.asarray(fewer.truth_range_m))
    velocity = found.velocity
    assert velocity is not None
    error = (velocity.bins - per_1000_bins)[target]
    assert (np.abs(error) <= 1).mean() > 0.98
    assert (np.abs(error) <= 1.96 * velocity.sd_bins[target]).mean() > 0.85
    speed = found.planes["velocity_m_per_s"].values[target]
    expected = per_1000_bins * capture.acquisition.bin_length_m * RATE_HZ / 1000
    assert np.nanmedian(speed) == pytest.approx(expected, rel=0.03)


@pytest.mark.compiled
def test_surfaces_faster_than_any_velocity_tried_have_no_confidence() -> None:
    capture = drawn(moving(thinned(scenes["wall"]()), 40.0), 0.3)
    found = estimate(capture, "velocity")
    assert found.velocity is not None
    at_end = np.isinf(found.velocity.sd_bins)
    assert at_end.mean() > 0.5
    assert (found.confidence[at_end] == 0).all()
    assert estimate(capture, "velocity", most_bins=48).confidence.mean() > 0.9


@pytest.mark.compiled
def test_velocities_are_shared_by_neighbours_only_within_reach() -> None:
    scene = scenes["wall"](16)
    here, there = (drawn(moving(scene, each), 0.3) for each in (0.0, 8.0))
    assert here.groups is not None and there.groups is not None
    counts = np.concatenate([here.groups.counts, there.groups.counts], axis=2)
    groups = PulseGroups(counts, here.groups.n_pulses)
    both = Capture(groups.total, here.acquisition, groups=groups)
    velocity = shared_velocity(both, groups, flux_model_of(both), 12, 5)
    assert np.median(velocity.travel_bins[:, :12]) == pytest.approx(0, abs=0.5)
    assert np.median(velocity.travel_bins[:, 20:]) == pytest.approx(8, abs=0.5)


def in_groups(
    travel_bins: ArrayLike,
    flux: Flux,
    side: int = 20,
    n_groups: int = 40,
    seed: int = 0,
    detection: Detection = "first",
) -> Capture:
    """Draw an oblique plane in bins 40 to 50 of 100, at rest within each group of 25 pulses."""
    rng, gate = np.random.default_rng(seed), Acquisition(100, 1e-9, n_pulses=25 * n_groups)
    onset = 40 + np.add.outer(np.linspace(0, 7, side), np.linspace(0, 3, side))
    signal, n_pulses = np.full(onset.shape, flux.signal), 25
    counts = []
    for middle in (np.arange(n_groups) + 0.5) / n_groups - 0.5:
        moved = onset + middle * np.asarray(travel_bins)
        rate = rate_per_bin(moved, signal, flux.background, Pulse(), gate)
        is_first = detection == "first"
        cube = draw_counts(rate if is_first else 25 * rate, n_pulses if is_first else None, rng)
        counts.append(cube.astype(np.uint16))
    groups = PulseGroups(np.stack(counts), (n_pulses,) * n_groups)
    truth_m = gate.bin_to_range_m(onset)
    return Capture(groups.total, gate, truth_range_m=truth_m, detection=detection, groups=groups)


def is_covered(hits: int, trials: int, level: float = 0.95) -> bool:
    """Return whether as many intervals hold the truth as should, but for one seed in 10 000."""
    low, high = stats.binom.ppf([5e-5, 1 - 5e-5], trials, level)
    return bool(low <= hits <= high)


@pytest.mark.compiled
@pytest.mark.parametrize("travel_bins", [1.0, 2.5])
def test_slow_motion_is_not_taken_for_slower(travel_bins: float) -> None:
    """Displacements between the steps of the delay are as likely as others."""
    capture = in_groups(travel_bins, Flux(0.3, 1.0), seed=1)
    assert capture.groups is not None
    whole = np.full(capture.shape, travel_bins)
    flux = flux_at_rest(capture, capture.groups, whole)
    found = shared_velocity(capture, capture.groups, flux, 6, 39)
    # One estimate from all pixels: a parabola through steps of a bin is right within 0.02.
    error, sd = found.travel_bins[10, 10] - travel_bins, found.sd_bins[10, 10]
    assert sd < 0.02
    assert abs(error) < 4 * sd


@pytest.mark.compiled
def test_a_moving_echo_is_not_taken_for_background() -> None:
    capture = in_groups(20.0, Flux(sbr=0.1))
    assert capture.groups is not None
    assert flux_model_of(capture).background_shape is not None
    flux = flux_at_rest(capture, capture.groups, np.full(capture.shape, 20.0))
    assert flux.background_shape is None


@pytest.mark.compiled
@pytest.mark.parametrize("detection", ["first", "all"])
def test_intervals_of_moving_surfaces_cover_their_range_and_velocity(detection: Detection) -> None:
    capture = in_groups(6.0, Flux(sbr=0.3), seed=2, detection=detection)
    image = estimate(capture, "velocity", neighbourhood=0, most_bins=12)
    assert image.velocity is not None
    truth_m = np.asarray(capture.truth_range_m)
    right = np.abs(image.range_m - truth_m) <= 3 * capture.acquisition.bin_length_m
    assert right.mean() > 0.99
    for level in (0.68, 0.95):
        low_m, high_m = core.range_interval(capture, image, level)
        holds = (low_m <= truth_m) & (truth_m <= high_m)
        # Of first photons, 0.42 at 0.68 by the sum of the pulses.
        assert is_covered(int(holds[right].sum()), int(right.sum()), level), holds.mean()
        row, col = 3, 4
        (one,) = core.pixel_range_intervals(capture, image, row, col, (level,))
        assert (one.low, one.high) == (low_m[row, col], high_m[row, col])
    holds = np.abs(image.velocity.bins - 6.0) <= 1.96 * image.velocity.sd_bins
    assert is_covered(int(holds.sum()), holds.size), holds.mean()


@pytest.mark.compiled
def test_intervals_of_velocities_hold_slow_motion_that_is_taken_for_rest() -> None:
    """Rest is likelier before, but an interval shows what the photons leave open."""
    capture = in_groups(1.0, Flux(sbr=0.1), seed=3)
    found = estimate(capture, "velocity", neighbourhood=0, most_bins=12).velocity
    assert found is not None
    assert (found.bins == 0).mean() > 0.5
    holds = np.abs(found.bins - 1.0) <= 1.96 * found.sd_bins
    assert holds.mean() > 0.95 - 4 * np.sqrt(0.95 * 0.05 / holds.size)


@pytest.mark.compiled
def test_intervals_of_velocities_widen_where_those_of_neighbours_differ() -> None:
    """Pixels that share a velocity, but turn or are two objects, do not have one of their mean."""
    turning = np.broadcast_to(np.linspace(-6, 6, 20), (20, 20))
    for travel_bins in (turning, np.where(turning < 0, -4.0, 4.0)):
        capture = in_groups(travel_bins, Flux(sbr=0.1), seed=4)
        found = estimate(capture, "velocity", most_bins=12).velocity
        assert found is not None
        holds = np.abs(found.bins - travel_bins) <= 1.96 * found.sd_bins
        # With the curvature of the evidence alone, 0.42 where they turn.
        assert holds.mean() > 0.9


REDUCED = {
    "bins": lambda capture: reductions.merge_bins(capture, 3),
    "gate": lambda capture: reductions.cut_gate(capture, 4, 30),
    "skip": lambda capture: reductions.skip_pixels(capture, 2),
    "pool": lambda capture: reductions.pool_pixels(capture, 2),
    "pulses": lambda capture: reductions.first_pulses(capture, 31),
}


@pytest.mark.parametrize("name", REDUCED)
def test_reductions_keep_groups(name: str) -> None:
    capture = drawn(moving(flat(12.0, side=4), 30.0, 60), 0.5, 6)
    reduced = REDUCED[name](capture)
    groups = reduced.groups
    assert groups is not None
    np.testing.assert_array_equal(groups.total, reduced.cube)
    assert sum(groups.n_pulses) == reduced.acquisition.n_pulses
    # The recording lasts as long as before.
    assert groups.pulse_rate_hz is not None
    duration_s = sum(groups.n_pulses) / groups.pulse_rate_hz
    assert duration_s == pytest.approx(60 / RATE_HZ)
    if name in ("bins", "gate", "skip"):  # which draw and add no pulses
        plain = REDUCED[name](replace(capture, groups=None))
        np.testing.assert_array_equal(plain.cube, reduced.cube)
        assert plain.acquisition == reduced.acquisition


def test_fewer_pulses_than_groups_are_refused() -> None:
    capture = drawn(flat(12.0), 0.5, 6)
    with pytest.raises(ValueError, match=r"n_pulses = 5 .*6 or more, a pulse for each group"):
        reductions.first_pulses(capture, 5)


def test_groups_that_do_not_add_up_are_refused() -> None:
    capture = drawn(flat(12.0), 0.5, 6)
    with pytest.raises(ValueError, match=r"groups = .*add up to the cube, or None"):
        replace(capture, cube=capture.cube + np.uint16(1), detection="all")
    with pytest.raises(ValueError, match=r"pulses of the groups = 60 .*61"):
        replace(capture, acquisition=replace(GATE, n_pulses=61))
    with pytest.raises(ValueError, match=r"groups of pulses = 61 .*1 to 60"):
        group_sizes(60, 61)


@pytest.mark.files
def test_files_keep_groups_or_refuse_them(tmp_path: Path) -> None:
    capture = drawn(moving(flat(12.0), 30.0, 60), 0.5, 6)
    save_capture(capture, tmp_path / "a.npz")
    found = read_capture(tmp_path / "a.npz")
    assert found.groups is not None and capture.groups is not None
    np.testing.assert_array_equal(found.groups.counts, capture.groups.counts)
    assert found.groups.n_pulses == capture.groups.n_pulses
    assert found.groups.pulse_rate_hz == RATE_HZ
    with pytest.raises(ValueError, match=r"groups = '6 groups of pulses' .*\.npz"):
        save_capture(capture, tmp_path / "a.nc")
    save_capture(replace(capture, groups=None), tmp_path / "a.nc")


@pytest.mark.parametrize("records", [None, (3, 20)])
def test_frames_are_kept_in_groups_on_request(
    tmp_path: Path, records: tuple[int, int] | None
) -> None:
    rng = np.random.default_rng(5)
    frames = rng.integers(-20, 30, (24, 3, 4)).clip(-1).astype(np.int16)
    np.save(tmp_path / "f.npy", frames)
    options = {"no_trigger": -1, "n_bins": 30, "records": records}
    plain = read_capture(tmp_path / "f.npy", **options)
    found = read_capture(tmp_path / "f.npy", **options, pulse_groups=5, pulse_rate_hz=2e4)
    np.testing.assert_array_equal(found.cube, plain.cube)
    assert plain.groups is None and found.groups is not None
    chosen = frames if records is None else frames[3:21]
    assert found.groups.n_pulses == group_sizes(len(chosen), 5)
    begin = np.cumsum((0, *found.groups.n_pulses))
    for counts, first, end in zip(found.groups.counts, begin[:-1], begin[1:], strict=True):
        for k in range(30):
            np.testing.assert_array_equal(counts[:, :, k], (chosen[first:end] == k).sum(axis=0))
    with pytest.raises(ValueError, match="pulse_rate_hz"):
        read_capture(tmp_path / "f.npy", **options, pulse_rate_hz=2e4)


@pytest.mark.files
def test_a_sequence_of_files_is_kept_in_groups(tmp_path: Path) -> None:
    for n in range(5):
        save_capture(drawn(flat(12.0), 0.5, None, seed=n), tmp_path / f"r_{n}.npz")
    found = read_capture(tmp_path / "r_*.npz", pulse_groups=2)
    assert found.groups is not None
    assert found.groups.n_pulses == (180, 120)
    np.testing.assert_array_equal(found.groups.total, found.cube)
    with pytest.raises(ValueError, match=r"pulse_groups = 2 .*no order of its pulses"):
        read_capture(tmp_path / "r_0.npz", pulse_groups=2)


@pytest.mark.compiled
def test_photons_of_all_kinds_have_velocities() -> None:
    rng, pulse = np.random.default_rng(0), Pulse(1e-9)
    gate = replace(GATE, n_pulses=400)
    cubes = [
        rng.poisson(
            np.broadcast_to(
                rate_per_bin(10.0 + moved, 0.3, 0.2, pulse, gate) * 50, (2, 2, GATE.n_bins)
            )
        )
        for moved in range(8)
    ]
    counts = np.array(cubes, np.uint16)
    groups = PulseGroups(counts, (50,) * 8, 1e3)
    capture = Capture(groups.total, gate, pulse, detection="all", groups=groups)
    found = estimate(capture, "velocity", most_bins=12)
    assert found.velocity is not None
    assert np.median(found.velocity.bins) == pytest.approx(8 / 400 * 1000, abs=1.5)
    np.testing.assert_allclose(found.bin, 13.5, atol=0.5)


@pytest.mark.compiled
def test_the_study_compares_methods_that_know_less_and_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in (("SPEEDS", (10.0,)), ("SBRS", (0.06,)), ("STILL", ("wall",))):
        monkeypatch.setattr(study, name, value)
    for name in ("car", "wall"):
        full = scenes[name]
        monkeypatch.setitem(scenes, name, lambda full=full, **given: thinned(full(**given)))
    moving, still, velocity = study.tables(range(2))
    restored = {row[0]: row[1].value for row in moving.rows}
    assert restored["likelihood, at rest"] < 0.8
    assert restored["shared velocity"] > restored["true velocity"] - 0.02
    assert [row[0] for row in still.rows] == list(study.METHODS)
    assert [row[1] for row in velocity.rows][1] == "share within 1"
    assert velocity.rows[1][2].value > 0.98
