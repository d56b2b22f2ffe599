"""Tests of reports on pixels, regions and captures, and of their intervals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp
from scipy.stats import nbinom

import core
from core import inspection
from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.effects import FaultyPixels
from core.estimators import ESTIMATORS, estimate
from core.geometry import Box
from core.inference import TOLERANCE_BINS, flux_prior_of
from core.inference.faults import (
    ordinary_pixels,
    outlier_pixels,
    pixel_verdict,
    probability_of_fewer,
)
from core.inference.posterior import same_echo_bins
from core.inspection import estimate_flux, pixels_in
from core.inspection.maps import likeliest
from core.inspection.mean_flux import largest_fit, mean_flux_of
from core.inspection.profile import Box as Bounds
from core.inspection.profile import difference_of, product_of, ratio_of, zoomed
from core.metrics import Interval, restored
from core.reductions import cut_gate, share_of_pulses
from core.scene import Scene, scenes
from core.simulation import simulate
from core.studies.methods.calibration import FLUX_REGIMES
from core.tracking import TrackingParameters
from core.trigger import draw_counts, rate_per_bin

pytestmark = pytest.mark.compiled

SIGNIFICANCE = 1e-4  # by chance, one fixed seed in ten thousand would fall below
ACQUISITION = Acquisition(n_bins=60, n_pulses=400)


def random_depths(side: int, seed: int = 0, acquisition: Acquisition = ACQUISITION) -> Scene:
    onset = np.random.default_rng(seed).uniform(10, acquisition.n_bins - 8, (side, side))
    return Scene(acquisition.bin_to_range_m(onset), acquisition=acquisition)


@cache
def seen(signal: float, sbr: float) -> Capture:
    """Return a capture that tests share: it keeps what is estimated of it."""
    return simulate(random_depths(8), ACQUISITION, Flux(signal, sbr), seed=4)


def covers(found: Interval, truth: float) -> bool:
    return found.low <= truth <= found.high


def is_covered_often_enough(hits: int, trials: int) -> bool:
    """Return whether 95 % intervals cover the truth so rarely only by chance."""
    return bool(stats.binom.cdf(hits, trials, inspection.LEVEL) > SIGNIFICANCE)


# -- one pixel -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("signal", "sbr", "n_pulses"),
    [(0.2, 0.1, 400), (0.5, 1.0, 100), (0.3, 30.0, 400), (0.0, 1, 99)],
)
def test_flux_intervals_cover_the_truth(signal: float, sbr: float, n_pulses: int) -> None:
    acquisition = replace(ACQUISITION, n_pulses=n_pulses)
    flux = Flux(signal, sbr) if signal else Flux(1.0, sbr)
    scene = random_depths(8, acquisition=acquisition)
    if not signal:
        scene = replace(scene, range_m=np.full((8, 8), np.nan))
    capture = simulate(scene, acquisition, flux, seed=1)
    truth = (signal, flux.background, signal / flux.background)
    pixels = capture.cube.reshape(-1, acquisition.n_bins)
    found = [estimate_flux(each, acquisition, capture.pulse, n_pulses) for each in pixels]
    for number, value in enumerate(truth):
        hits = sum(covers(each[number], value) for each in found)
        assert is_covered_often_enough(hits, len(found))
    widths = [each.background.high - each.background.low for each in found]
    chance = math.sqrt(math.expm1(flux.background + signal) / n_pulses)
    assert np.median(widths) < 1.5 * 2 * 1.96 * chance  # and no wider than need be


def test_photons_of_unknown_pulses_are_counted() -> None:
    rng, pulse = np.random.default_rng(3), Pulse()
    echo = pulse.bin_probability(30.2, 60, 1e-9)
    hits = np.zeros(3, int)
    for _ in range(100):
        counts = rng.poisson(8 * echo + 12 / 60)
        found = estimate_flux(counts, ACQUISITION, pulse, None)
        hits += [covers(each, value) for each, value in zip(found, (8, 12, 8 / 12), strict=True)]
    assert all(is_covered_often_enough(each, 100) for each in hits)


@pytest.mark.parametrize("n_echo", [0, 15])
@pytest.mark.parametrize("n_pulses", [None, 300])
def test_fluxes_of_few_photons_in_a_long_gate_are_those_of_all_delays(
    n_pulses: int | None, n_echo: int
) -> None:
    """Most delays meet no photon, and are computed together."""
    n_bins, pulse, rng = 300, Pulse(), np.random.default_rng(5)
    acquisition = Acquisition(n_bins=n_bins, n_pulses=n_pulses)
    counts = rng.multinomial(25, np.full(n_bins, 1 / n_bins)).astype(float)
    counts += rng.multinomial(n_echo, pulse.bin_probability(222.4, n_bins, 1e-9))
    found = estimate_flux(counts, acquisition, pulse, n_pulses)
    delays = (np.arange(2 * n_bins) + 0.5) / 2
    echo = pulse.bin_probability(delays, n_bins, 1e-9)
    unfired = np.ones(n_bins) if n_pulses is None else n_pulses - np.cumsum(counts)

    def log_likelihood(signal: float, background: float) -> float:
        rate = background / n_bins + signal * echo
        fires = rate if n_pulses is None else -np.expm1(-rate)
        return float(logsumexp(np.log(fires) @ counts - rate @ unfired))

    most = log_likelihood(found.signal.value, found.background.value)
    for factors in product((0.95, 1.0, 1.05), repeat=2):
        there = (each.value * by for each, by in zip(found, factors, strict=False))
        assert log_likelihood(*there) <= most + 1e-3
    assert (found.signal.low > 0) == (n_echo > 0)
    for end in {found.signal.low, found.signal.high} - {0.0}:
        near = found.background.value * np.linspace(0.7, 1.3, 25)
        highest = max(log_likelihood(end, each) for each in near)
        assert highest == pytest.approx(most - 1.92, abs=0.02)  # of splines on a grid


def test_more_pixels_narrow_the_interval() -> None:
    capture = simulate(random_depths(4), ACQUISITION, Flux(0.2, 0.2), seed=2)
    pixels = capture.cube.reshape(16, -1)
    one, all_of_them = (
        estimate_flux(each, ACQUISITION, capture.pulse, 400) for each in (pixels[0], pixels)
    )
    assert covers(all_of_them.signal, 0.2) and covers(all_of_them.background, 1.0)
    narrower = (all_of_them.signal.high - all_of_them.signal.low) / (
        one.signal.high - one.signal.low
    )
    assert narrower < 0.5  # a quarter, by the square root of 16


@pytest.mark.parametrize("method", [name for name in ESTIMATORS if name != "oracle"])
def test_the_best_candidate_is_the_estimate(method: str) -> None:
    capture = seen(0.6, 1.0)
    image = estimate(capture, method)
    right = 0
    for row, col in np.ndindex(3, 3):
        report = inspection.pixel_report(capture, image, row, col, method)
        scores = [each.score for each in report.candidates]
        assert scores == sorted(scores, reverse=True)
        assert report.candidates[0].relative == 1.0
        assert all(0 <= each.probability <= 1 for each in report.candidates)
        right += abs(report.candidates[0].bin - report.answer_bin) <= 1.0
        assert report.answer_bin == image.bin[row, col]
    assert right >= 8  # neighbours may move a spatial method's


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        ("tracking", None),
        ("tracking", TrackingParameters(refine="none")),
        ("likelihood", None),
        ("unmixing", None),
        ("image_posterior", None),
    ],
    ids=["tracking", "tracking in whole bins", "likelihood", "unmixing", "image_posterior"],
)
def test_the_candidate_at_the_estimate_is_the_estimate(method: str, settings: Any) -> None:
    capture = seen(0.3, 0.3)
    image = estimate(capture, method, settings)
    for row, col in np.ndindex(3, 5):
        report = inspection.pixel_report(capture, image, row, col, method, settings)
        near = [c for c in report.candidates if abs(c.bin - report.answer_bin) < capture.echo_bins]
        # Neighbours may move a spatial method's estimate away from all peaks.
        assert len(near) == 1 or (method == "unmixing" and not near)
        for each in near:
            assert (each.bin, each.range_m) == (report.answer_bin, report.answer_m)
            assert each.probability == report.confidence


@pytest.mark.parametrize("method", ["tracking", "peak"])
def test_candidates_other_than_the_estimate_lie_within_their_intervals(method: str) -> None:
    capture = seen(0.3, 0.3)
    image = estimate(capture, method)
    for row, col in np.ndindex(8, 8):
        report = inspection.pixel_report(capture, image, row, col, method)
        others = [each for each in report.candidates if each.bin != report.answer_bin]
        assert all(each.range_low_m <= each.range_m <= each.range_high_m for each in others)


def test_a_pixel_far_below_the_mean_signal_has_candidates() -> None:
    taps = np.diff(stats.norm.cdf(np.arange(61), 40.5, 1.5))
    signal = np.where(np.arange(32).reshape(4, 8) == 0, 5e3, 2e4)
    rate = 3000.0 + signal[..., np.newaxis] * taps
    counts = np.random.default_rng(1).poisson(rate).astype(np.uint32)
    pulse = Pulse(shape="gaussian", tau_s=1.5e-9)
    capture = Capture(counts, Acquisition(60, 1e-9, n_pulses=None), pulse=pulse, detection="all")
    image = estimate(capture, "likelihood")
    report = inspection.pixel_report(capture, image, 0, 0, "likelihood")
    assert report.curve.max() < 0  # the echo that it expects is four times as strong
    (at,) = (each for each in report.candidates if each.bin == image.bin[0, 0])
    assert at.probability == report.confidence > 0.99
    assert 0 < at.relative <= 1


def test_candidates_within_one_pulse_are_one() -> None:
    acquisition = Acquisition(n_bins=60, n_pulses=400)
    pulse = Pulse.gaussian(2e-9)
    scene = random_depths(8, acquisition=acquisition)
    capture = simulate(scene, acquisition, Flux(0.1, 0.1), pulse, seed=4)
    assert capture.echo_bins == 6
    image = estimate(capture, "peak")
    for row, col in np.ndindex(8, 8):
        report = inspection.pixel_report(capture, image, row, col, "peak")
        bins = np.sort([each.bin for each in report.candidates])
        assert (np.diff(bins) >= capture.echo_bins).all()
        scores = [each.score for each in report.candidates]
        assert scores == sorted(scores, reverse=True)
        assert report.candidates[0].score == report.curve.max()


def net_before_wall(
    n_pulses: int | None, sigma_bins: float, net: float = 10.0
) -> tuple[Capture, Floats, Floats]:
    """Draw walls of 30 photons and, in half of the pixels, nets of fewer; also their delays."""
    acquisition = Acquisition(n_bins=150, n_pulses=n_pulses)
    pulse = Pulse.gaussian(sigma_bins * acquisition.bin_width_s)
    rng, shape = np.random.default_rng(1), (8, 8)
    walls, nets = rng.uniform(80, 140, shape), rng.uniform(10, 70, shape)
    nets[4:] = np.nan
    photons = 1.0 if n_pulses is None else 1 / n_pulses
    rate = rate_per_bin(walls, np.full(shape, 30 * photons), 10 * photons, pulse, acquisition)
    rate += rate_per_bin(nets, np.full(shape, net * photons), 0.0, pulse, acquisition)
    kind = "all" if n_pulses is None else "first"
    cube = draw_counts(rate, n_pulses, rng)
    return Capture(cube, acquisition, pulse, detection=kind), walls, nets


@pytest.mark.parametrize(("n_pulses", "sigma_bins"), [(300, 3.0), (None, 0.7)])
def test_estimate_and_candidates_of_a_region_agree(n_pulses: int | None, sigma_bins: float) -> None:
    capture = net_before_wall(n_pulses, sigma_bins)[0]
    rng, width_bins, n_sure = np.random.default_rng(0), same_echo_bins(capture), []
    for method, share in (("tracking", 0.0), ("tracking", 0.5), ("matched_filter", 0.05)):
        mask = rng.random(capture.shape) < share
        mask[rng.integers(4), rng.integers(8)] = True
        region = inspection.region_report(capture, estimate(capture, method), mask, method)
        pixel = region.pixel
        bins = np.array([each.bin for each in pixel.candidates])
        assert (np.diff(np.sort(bins)) >= width_bins).all()
        near = [c for c in pixel.candidates if abs(c.bin - pixel.answer_bin) < width_bins]
        assert [(c.bin, c.probability) for c in near] == [(pixel.answer_bin, pixel.confidence)]
        # The estimate alone assumes one surface.
        assert pixel.confidence >= region.image.confidence[0, 0]
        n_sure.append(sum(each.probability > 0.9 for each in pixel.candidates))
    assert max(n_sure) >= 2


@pytest.mark.parametrize(
    ("n_pulses", "net"),
    [(300, 10.0), (300, 5.0), (None, 10.0)],
    ids=["first photons", "faint net", "photons"],
)
def test_a_candidate_has_the_probability_of_a_surface_there(
    n_pulses: int | None, net: float
) -> None:
    """Half of the pixels see a net before a wall."""
    capture, *delays = net_before_wall(n_pulses, 1.5, net)
    image = estimate(capture, "matched_filter")
    probability, is_right = [], []
    for row, col in np.ndindex(capture.shape):
        for each in inspection.pixel_report(capture, image, row, col, "matched_filter").candidates:
            errors = np.abs(each.bin - np.array([delay[row, col] for delay in delays]))
            probability.append(each.probability)
            is_right.append(bool(np.nanmin(errors) <= TOLERANCE_BINS))
    stated, right = np.array(probability), np.array(is_right)
    assert np.mean(right[stated > 0.9]) > 0.98
    assert np.mean(right[stated < 0.1]) < 0.05
    between = (stated >= 0.1) & (stated <= 0.9)
    chance = math.sqrt(float((stated * (1 - stated))[between].sum()))
    assert abs(stated[between].sum() - np.count_nonzero(right[between])) < 3 * chance
    assert np.count_nonzero(right[stated > 0.9]) > capture.counts.size + (25 if net == 10.0 else 10)


@pytest.mark.parametrize("n_pulses", [300, None])
def test_the_echo_of_another_surface_is_not_counted_as_background(n_pulses: int | None) -> None:
    """Rows 0 to 3 see a net before the wall, the others the wall alone."""
    capture, walls, _ = net_before_wall(n_pulses, 1.5)
    image, unit = estimate(capture, "likelihood"), 1 / (n_pulses or 1)
    hits, trials = np.zeros(2, int), 0
    for row, col in product((0, 3, 6), range(8)):
        report = inspection.pixel_report(capture, image, row, col, "likelihood")
        has_net = row < 4
        if len(report.surfaces_bin) == 1 + has_net and abs(report.answer_bin - walls[row, col]) < 3:
            assert ("other surfaces" in report.flux_method) == has_net
            assert report.surfaces_text.startswith("2 surfaces: " if has_net else "1 surface: ")
            assert report.surfaces_text.count("probability") == 1 + has_net
            hits += covers(report.flux.signal, 30 * unit), covers(report.flux.background, 10 * unit)
            trials += 1
    assert trials >= 16
    assert all(is_covered_often_enough(each, trials) for each in hits), (hits, trials)


def test_a_report_has_the_intervals_of_the_range() -> None:
    capture = seen(0.3, 0.3)
    image = estimate(capture, "tracking")
    report = inspection.pixel_report(capture, image, 2, 3)
    inner, outer = report.interval_68_m, report.interval_95_m
    assert (inner, outer) == core.pixel_range_intervals(capture, image, 2, 3)
    assert inner.value == outer.value == report.answer_m
    assert outer.low < inner.low < inner.high < outer.high
    half_m = (outer.high - outer.low) / 2
    assert 0.01 < half_m < 0.1
    assert report.interval_text == f"{outer.low + half_m:.3f} m ± {half_m:.3f} m (95 %)"
    coarse = replace(report, interval_95_m=Interval(50, 0, 98))
    assert coarse.interval_text == "49 m ± 49 m (95 %)"
    nothing = Capture(np.zeros((1, 1, 60), np.uint16), ACQUISITION)
    empty = inspection.pixel_report(nothing, estimate(nothing, "peak"), 0, 0, "peak")
    assert math.isnan(empty.interval_95_m.low)
    assert empty.interval_text == "–"


def test_hot_and_dead_pixels_are_found() -> None:
    hot, dead = np.zeros((9, 9)), np.zeros((9, 9), bool)
    hot[4, 4] = hot[0, 8] = 3e7
    dead[7, 2] = dead[0, 0] = True
    scene = replace(random_depths(9), faulty_pixels=FaultyPixels(hot, dead))
    capture = simulate(scene, ACQUISITION, Flux(0.2, 0.2), seed=5)
    image = estimate(capture, "peak")

    def health(row: int, col: int) -> str:
        return inspection.pixel_report(capture, image, row, col, "peak").verdict.health

    assert [health(4, 4), health(0, 8), health(7, 2), health(0, 0)] == ["hot"] * 2 + ["dead"] * 2
    assert health(2, 5) == "ordinary"
    report = inspection.capture_report(capture)
    assert (report.n_hot, report.n_dead) == (2, 2)
    faulty, counts = inspection.faulty_pixels(capture), capture.counts
    assert {each[:3] for each in faulty[:2]} == {(4, 4, "hot"), (0, 8, "hot")}
    assert {each[:3] for each in faulty[2:]} == {(7, 2, "dead"), (0, 0, "dead")}
    around = np.delete(counts[3:6, 3:6], 4)
    of_middle = next(each for each in faulty if each.row == 4)
    assert of_middle[3:] == (counts[4, 4], around.min(), around.max())
    excess = [each.counts - each.neighbours_most for each in faulty[:2]]
    assert excess == sorted(excess, reverse=True)
    dark = Capture(np.zeros((3, 3, 60), np.uint8), ACQUISITION)
    assert inspection.capture_report(dark).n_dead == 0
    assert inspection.faulty_pixels(Capture(capture.cube[:2], ACQUISITION)) == []
    assert (
        inspection.pixel_report(dark, estimate(dark, "peak"), 1, 1).verdict.health == "cannot tell"
    )


def test_a_dark_surface_between_bright_ones_is_not_dead() -> None:
    scene = random_depths(24, seed=1)
    reflectivity = np.random.default_rng(0).gamma(4.0, 0.25, scene.range_m.shape)
    scene = replace(scene, reflectivity=reflectivity)
    capture = simulate(scene, Acquisition(), Flux(3.0, sbr=10.0), seed=0)
    assert inspection.capture_report(capture).n_dead == 0
    row, col = np.argwhere(outlier_pixels(capture).dark)[0].tolist()
    verdict = pixel_verdict(capture, row, col)
    assert verdict.health == "ordinary" and "dark surface" in verdict.why
    broken = capture.cube.copy()
    broken[5, 6] = 0
    found = inspection.faulty_pixels(replace(capture, cube=broken))
    assert [(each.row, each.col) for each in found if each.health == "dead"] == [(5, 6)]


@pytest.mark.parametrize("reflectivity", [(1.0, 1.0), (0.15, 1.0)])
def test_mean_fluxes_in_strong_sun_are_right(reflectivity: tuple[float, float]) -> None:
    """Nearly all pulses of the brighter pixels fire before the echo of a far wall."""
    shape, signal, background = (24, 24), 0.5, 8.0
    factor = np.random.default_rng(1).choice(reflectivity, shape)
    acquisition = Acquisition()
    onset_bin = np.where(np.arange(24) < 12, 30.4, 70.7) * np.ones(shape)
    rate = rate_per_bin(onset_bin, signal * factor, 0.0, Pulse(), acquisition)
    rate += background * factor[..., np.newaxis] / acquisition.n_bins
    for seed in range(2):
        counts = draw_counts(rate, acquisition.n_pulses, np.random.default_rng(seed))
        capture = Capture(counts, acquisition)
        found = mean_flux_of(capture)
        assert found.pulse == Pulse()
        assert flux_prior_of(capture).is_in_proportion == (reflectivity[0] < 1)
        mean = factor.mean()
        assert found.image.signal.value == pytest.approx(signal * mean, rel=0.1)
        assert found.image.background.value == pytest.approx(background * mean, rel=0.02)


@pytest.mark.parametrize("photons", [2.0, 4.0, 6.0, 10.0])
def test_the_largest_likelihood_of_a_few_bright_pixels_is_found(photons: float) -> None:
    """Many faint pixels of which hardly any shows a photon are a local maximum."""
    rng, n_pixels = np.random.default_rng(0), 1000
    counts = np.where(rng.random(n_pixels) < 0.03, rng.poisson(photons, n_pixels), 0)
    signal = counts.mean() * np.array([0.8, 0.9, 1.0, 1.1])[:, np.newaxis, np.newaxis]

    def fit(share: Floats, shape: Floats) -> Floats:
        log = np.zeros(np.broadcast_shapes(signal.shape, share.shape, shape.shape))
        for value, times in zip(*np.unique(counts, return_counts=True), strict=True):
            seen = share * nbinom.pmf(value, shape, shape / (shape + signal / share))
            log += times * np.log(np.maximum(seen + (1 - share) * (value == 0), 1e-300))
        return log

    found, _ = largest_fit(fit, np.full(signal.size, 1e-6), None)
    share = np.linspace(0.02, 1.0, 120)[:, np.newaxis] ** 2
    largest = fit(share, np.geomspace(0.3, 3000, 40)).max(axis=(1, 2))
    assert (found > largest - 0.5).all()


@pytest.mark.parametrize("method", ["tracking", "likelihood", "coates"])
def test_the_estimate_of_a_region_with_two_surfaces_is_what_the_method_finds(method: str) -> None:
    scene = scenes["car"]()
    capture = simulate(scene, scene.acquisition, Flux(), seed=0)
    mask = np.zeros(capture.shape, bool)
    mask[20:41, 10:51] = True
    report = inspection.region_report(capture, estimate(capture, method), mask, method)
    assert report.image.returns is not None and len(report.image.returns) == 2
    alone = estimate(report.summed, method).bin.item()
    others = [abs(each.bin - alone) for each in report.pixel.candidates]
    best = report.pixel.candidates[int(np.argmin(others))]
    assert report.image.bin.item() == best.bin


def test_pixels_of_a_dead_column_are_dead_but_not_those_of_a_night_sky() -> None:
    scene = random_depths(24, seed=1)
    capture = simulate(scene, replace(scene.acquisition, n_pulses=500), Flux(0.1, sbr=0.1), seed=0)
    broken = capture.cube.copy()
    broken[:, 20] = broken[10, 5] = 0
    day = replace(capture, cube=broken)
    assert inspection.capture_report(day).n_dead == 25
    assert pixel_verdict(day, 12, 20).health == "dead"
    assert "no background fires it" in pixel_verdict(day, 12, 20).why
    # The fluxes are those of the pixels that work, and no surface is certain in the others.
    background = inspection.capture_report(day).flux.background
    assert background.low < 1.0 < background.high
    assert estimate(day, "image_posterior").confidence[:, 20].max() < 0.5
    night = simulate(
        scene, replace(scene.acquisition, n_pulses=500), Flux(0.1, sbr=math.inf), seed=0
    )
    sky = night.cube.copy()
    sky[:6] = 0
    assert inspection.capture_report(replace(night, cube=sky)).n_dead == 0


def test_a_pixel_with_few_counts_is_only_dead_if_it_has_hardly_any() -> None:
    counts = np.full((5, 5, 10), 40, np.uint16)
    counts[1, 1], counts[3, 3] = 12, 1
    capture = Capture(counts, Acquisition(10, n_pulses=100_000))
    verdict = pixel_verdict(capture, 1, 1)
    assert verdict.health == "cannot tell" and "less sensitive" in verdict.why
    assert pixel_verdict(capture, 3, 3).health == "dead"
    assert [each[:3] for each in inspection.faulty_pixels(capture)] == [(3, 3, "dead")]


def test_a_pixel_may_miss_pulses_that_its_neighbours_do_not() -> None:
    assert probability_of_fewer(398, 400, 400) > 0.1
    assert probability_of_fewer(200, 400, 400) < 1e-100


@pytest.mark.parametrize("n_pulses", [None, 400])
def test_a_bright_surface_in_one_pixel_is_not_hot(n_pulses: int | None) -> None:
    scale = 1 if n_pulses else 400
    acquisition, pulse = replace(ACQUISITION, n_pulses=n_pulses), Pulse.gaussian(1e-9)
    onset, signal, dark_counts = np.full((7, 7), 30.3), np.full((7, 7), 0.02), np.zeros((7, 7))
    signal[1, 1] = signal[5, 5] = 0.5
    dark_counts[5, 1], dark_counts[5, 5] = 0.5, 3.0
    rate = rate_per_bin(onset, signal, 0.02, pulse, acquisition)
    rate = scale * (rate + dark_counts[..., np.newaxis] / acquisition.n_bins)
    cube = draw_counts(rate, n_pulses, np.random.default_rng(0))
    capture = Capture(cube, acquisition, pulse, detection="first" if n_pulses else "all")
    faulty = inspection.faulty_pixels(capture)
    assert {(each.row, each.col, each.health) for each in faulty} == {(5, 1, "hot"), (5, 5, "hot")}
    verdict = inspection.pixel_report(capture, estimate(capture, "peak"), 1, 1, "peak").verdict
    assert verdict.health == "ordinary" and "bright surface" in verdict.why


@pytest.mark.compiled
@pytest.mark.parametrize("faint", [0.02, 0.03])
def test_a_few_bright_pixels_do_not_hide_that_all_have_an_echo(faint: float) -> None:
    """No gamma distribution has such signals, the likeliest takes faint pixels for empty ones."""
    acquisition, pulse = Acquisition(n_bins=200, n_pulses=500), Pulse.gaussian(1.5e-9)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        onset, signal = rng.uniform(40, 42, (32, 32)), np.full((32, 32), faint)
        signal[rng.random(signal.shape) < 0.05] = 4.0
        rate = rate_per_bin(onset, signal, 0.5, pulse, acquisition)
        counts = draw_counts(rate, acquisition.n_pulses, rng)
        found = mean_flux_of(Capture(counts, acquisition, pulse)).target
        assert found.signal.low < signal.mean() < found.signal.high
        assert found.sbr.low < signal.mean() / 0.5 < found.sbr.high
        assert found.signal.value < 2 * signal.mean()


@pytest.mark.compiled
def test_pixels_that_fire_nearly_all_pulses_do_not_lower_the_mean_signal() -> None:
    acquisition, pulse = Acquisition(n_bins=200, n_pulses=50), Pulse.gaussian(1.5e-9)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        onset, signal = rng.uniform(40, 42, (32, 32)), np.full((32, 32), 0.5)
        signal[rng.random(signal.shape) < 0.3] = 4.0
        rate = rate_per_bin(onset, signal, 0.3, pulse, acquisition)
        counts = draw_counts(rate, acquisition.n_pulses, rng)
        found = inspection.estimate_mean_flux(Capture(counts, acquisition, pulse))
        assert found.signal.low < signal.mean() < found.signal.high


@pytest.mark.compiled
@pytest.mark.parametrize("seed", range(4))
def test_surfaces_of_uneven_reflectivity_in_the_sun_are_neither_hot_nor_dead(seed: int) -> None:
    """Their signal and their background are in proportion to it."""
    rng = np.random.default_rng(seed)
    acquisition, pulse = Acquisition(n_bins=200, n_pulses=500), Pulse.gaussian(1.5e-9)
    onset, reflectivity = rng.uniform(40, 42, (24, 24)), rng.lognormal(-1.0, 0.8, (24, 24))
    rate = rate_per_bin(onset, 0.2 * reflectivity, 0.0, pulse, acquisition)
    rate += 0.5 * reflectivity[..., np.newaxis] / acquisition.n_bins
    capture = Capture(draw_counts(rate, acquisition.n_pulses, rng), acquisition, pulse)
    assert inspection.faulty_pixels(capture) == []
    found = outlier_pixels(capture)
    assert found is not None and found.bright.any() and found.dark.any()


def test_a_pixel_outside_the_image_is_refused() -> None:
    capture = Capture(np.ones((2, 2, 60), np.uint8), ACQUISITION)
    image = estimate(capture, "peak")
    with pytest.raises(ValueError, match=r"row, col = \(2, 0\)"):
        inspection.pixel_report(capture, image, 2, 0)


# -- a region --------------------------------------------------------------------------------------


def test_pixels_of_a_polygon_are_those_with_their_centre_in_it() -> None:
    rectangle = pixels_in([(1, 2), (1, 5), (3, 5), (3, 2)], (6, 8))
    assert rectangle.sum() == 12 and rectangle[1:4, 2:6].all()
    np.testing.assert_array_equal(pixels_in([(3, 2), (3, 5), (1, 5), (1, 2)], (6, 8)), rectangle)
    triangle = pixels_in([(-0.5, -0.5), (-0.5, 3.5), (3.5, -0.5)], (4, 4))
    np.testing.assert_array_equal(triangle, np.add.outer(range(4), range(4)) <= 3)
    for refused in ([(0, 0), (1, 1)], [(0, 0), (1, 1), (np.nan, 2)]):
        with pytest.raises(ValueError, match="3 or more finite"):
            pixels_in(refused, (4, 4))


def test_a_region_is_its_pixels_added_to_one() -> None:
    wall = Scene(np.full((8, 8), ACQUISITION.bin_to_range_m(30.3)), acquisition=ACQUISITION)
    capture = simulate(wall, ACQUISITION, Flux(0.1, 0.1), seed=6)
    image = estimate(capture, "tracking")
    mask = pixels_in([(2, 2), (2, 6), (6, 6), (6, 2)], capture.shape)
    report = inspection.region_report(capture, image, mask)
    assert report.n_pixels == 25
    assert report.summed.acquisition.n_pulses == 25 * 400
    np.testing.assert_array_equal(report.pixel.counts, capture.cube[mask].sum(axis=0))
    assert report.pixel.answer_bin == pytest.approx(30.3, abs=0.7)
    assert report.pixel.confidence > 0.99
    assert report.mean_counts == pytest.approx(capture.counts[mask].mean())
    assert report.median_m == pytest.approx(np.nanmedian(image.range_m[mask]))
    assert report.fit.fits and "no deviation" in report.fit.verdict
    for flux in (report.flux, report.pixel.flux):
        assert covers(flux.signal, 0.1) and covers(flux.background, 1.0)
    with pytest.raises(ValueError, match="region = '0 pixels'"):
        inspection.region_report(capture, image, np.zeros((8, 8), bool))
    with pytest.raises(ValueError, match="mask = "):
        inspection.region_report(capture, image, np.zeros((8, 7), bool))


@pytest.mark.compiled
def test_a_region_of_two_surfaces_says_so_and_a_slope_does_not() -> None:
    for scene, sbr, several in ((scenes["net"](16), 0.06, True), (scenes["wall"](16), 0.3, False)):
        capture = simulate(scene, scene.acquisition, Flux(sbr=sbr))
        mask = np.zeros(capture.shape, bool)
        mask[:, 6:9] = True
        image = estimate(capture, "peak")
        report = inspection.region_report(capture, image, mask, "likelihood")
        found = np.sort(report.pixel.surfaces_bin)
        middle_m = np.mean(scene.surfaces_m[:, mask], axis=1)
        np.testing.assert_allclose(
            found, np.sort(capture.acquisition.range_m_to_bin(middle_m)), atol=1.0
        )
        assert report.pixel.surfaces_text.startswith("2 surfaces: " if several else "1 surface: ")


@pytest.mark.compiled
def test_an_echo_with_a_tail_is_not_said_to_be_two_surfaces_for_certain() -> None:
    acquisition = Acquisition(n_bins=120, n_pulses=1000)
    time_ns = np.arange(0, 50, 0.25)
    tailed = np.convolve(np.exp(-0.5 * (time_ns - 6) ** 2), np.exp(-time_ns / 12))[: time_ns.size]
    wall = Scene(np.full((8, 8), acquisition.bin_to_range_m(40.3)), acquisition=acquisition)
    pulse = Pulse.measured(tailed, 0.25e-9)
    seen = simulate(wall, acquisition, Flux(0.3, 1.0), pulse=pulse, seed=1)
    capture = replace(seen, pulse=Pulse.gaussian(1e-9))
    image = estimate(capture, "likelihood")
    region = inspection.region_report(capture, image, np.ones((8, 8), bool), "likelihood").pixel
    pixels = (
        inspection.pixel_report(capture, image, *each, "likelihood") for each in np.ndindex(8, 8)
    )
    pixel = next(each for each in pixels if len(each.surfaces_bin) == 2)
    for report in (region, pixel):
        assert report.surfaces_text.startswith("2 surfaces, or an echo longer than the pulse: ")
        assert "probability" not in report.surfaces_text
        # No longer echo holds both if they are farther apart.
        apart = replace(report, longest_echo_bins=1)
        assert apart.surfaces_text.count("(probability") == 2


@pytest.mark.compiled
def test_returns_with_neighbours_are_candidates_of_a_pixel() -> None:
    scene = scenes["net"](24)
    capture = simulate(scene, scene.acquisition, Flux(sbr=0.1))
    image = estimate(capture, "image_posterior", returns=2)
    assert image.returns is not None
    report = inspection.pixel_report(capture, image, 12, 12, "image_posterior")
    here = image.returns.at(12, 12)
    probability = {each.bin: each.probability for each in report.candidates}
    assert [probability[each] for each in here.bin.tolist()] == here.confidence.tolist()
    assert len(report.surfaces_bin) == 2


def test_fluxes_of_a_region_are_with_the_pulse_of_its_echoes() -> None:
    wall = Scene(np.full((8, 8), ACQUISITION.bin_to_range_m(30.3)), acquisition=ACQUISITION)
    capture = simulate(wall, ACQUISITION, Flux(0.2, 0.5), Pulse.gaussian(2e-9), seed=1)
    wrong = replace(capture, pulse=Pulse.gaussian(0.7e-9))
    mask = np.ones(capture.shape, bool)
    region = inspection.region_report(wrong, estimate(wrong, "peak"), mask, "peak")
    for flux in (region.flux, region.pixel.flux):
        assert covers(flux.signal, 0.2) and covers(flux.background, 0.4)


def test_a_profile_holds_ranges_and_intervals_of_the_pixels_on_a_line() -> None:
    acquisition = replace(ACQUISITION, pixel_angle_rad=1e-3)
    rows = np.repeat(np.linspace(20, 40, 9), 9).reshape(9, 9)  # in bins
    scene = Scene(acquisition.bin_to_range_m(rows), acquisition=acquisition)
    capture = simulate(scene, acquisition, Flux(1.0, 1.0), seed=8)
    image = estimate(capture, "likelihood").cropped(Box(((-1, -1), (-1, 9), (5, 9), (5, -1))))
    found = inspection.line_profile(capture, image, [(0, 0), (8, 4), (8, 4), (8, 8)])
    assert list(zip(found.row, found.col, strict=True))[::2] == [
        *((2 * n, n) for n in range(5)),
        *((8, 6), (8, 8)),
    ]
    here = found.row, found.col
    np.testing.assert_array_equal(found.range_m, image.range_m[here])
    assert np.isnan(found.range_m[6:]).all() and np.isfinite(found.range_m[:6]).all()
    interval = core.range_interval(capture, image)
    np.testing.assert_allclose(found.low_m, interval.low_m[here])
    np.testing.assert_allclose(found.high_m, interval.high_m[here])
    assert capture.truth_range_m is not None and found.truth_m is not None
    np.testing.assert_array_equal(found.truth_m, capture.truth_range_m[here])
    np.testing.assert_array_equal(found.confidence, image.confidence[here])
    # Across the line of sight, at the median depth: 8 rows and 4 columns, then 4 columns.
    assert found.depth_m == pytest.approx(np.median(found.range_m[:6]), rel=1e-4)
    pixel_m = found.depth_m * np.tan(1e-3)
    assert found.distance_m[[0, 8, 12]] == pytest.approx(
        [0, math.sqrt(80) * pixel_m, (math.sqrt(80) + 4) * pixel_m]
    )
    assert (np.diff(found.distance_m) > 0).all()
    wider = inspection.line_profile(capture, image, [(0, 0), (8, 4)], 2e-3)
    assert wider.distance_m[-1] == pytest.approx(2 * found.distance_m[8], rel=1e-4)
    unseen = inspection.line_profile(capture, image, [(8, 0), (8, 8)])
    assert np.isnan(unseen.distance_m).all()
    for points in (
        [(0, 0)],
        [(1, 1), (1, 1)],
        [(0, 0), (0, 9)],
        [(0, -1), (0, 1)],
        [(0, 0.5), (1, 1)],
    ):
        with pytest.raises(ValueError, match=r"points = .* 2 or more"):
            inspection.line_profile(capture, image, points)
    unknown = replace(capture, acquisition=replace(acquisition, pixel_angle_rad=None))
    with pytest.raises(ValueError, match="pixel_angle_rad = None"):
        inspection.line_profile(unknown, image, [(0, 0), (1, 1)])


# -- a capture -------------------------------------------------------------------------------------


def _reflecting(side: int, seed: int = 0) -> Scene:
    """Surfaces of all reflectivities in half of the pixels, sky in the others."""
    scene, rng = random_depths(side, seed=seed), np.random.default_rng(seed)
    sky = rng.uniform(size=(side, side)) < 0.5
    reflectivity = rng.uniform(0.3, 1.0, (side, side))
    return replace(scene, range_m=np.where(sky, np.nan, scene.range_m), reflectivity=reflectivity)


def _hot(side: int, seed: int = 0) -> Scene:
    hot_hz = np.where(np.random.default_rng(seed).uniform(size=(side, side)) < 0.02, 5e7, 0.0)
    return replace(
        random_depths(side, seed=seed),
        faulty_pixels=FaultyPixels(hot_hz, np.zeros((side, side), bool)),
    )


def _mean_flux_of(scene: Scene, flux: Flux) -> tuple[float, float, float]:
    """Signal, background and their ratio of a scene's ordinary pixels."""
    reflectivity = 1.0 if scene.reflectivity is None else scene.reflectivity
    ordinary = np.ones(np.shape(scene.range_m), bool)
    if scene.faulty_pixels is not None:
        ordinary = scene.faulty_pixels.dark_count_hz == 0
    signal = np.where(np.isfinite(scene.range_m), flux.signal * reflectivity, 0.0)[ordinary].mean()
    return float(signal), flux.background, float(signal) / flux.background


def _photons(scene: Scene, flux: Flux, capture: Capture) -> Capture:
    """Draw all photons of as many pulses, whose number is unknown."""
    fires = Flux(flux.signal / 1000, flux.sbr)
    many = replace(capture.acquisition, n_pulses=1000 * (capture.gated_pulses or 0))
    # At this flux hardly any photon hides another.
    dim = simulate(scene, many, fires)
    unknown = replace(many, n_pulses=None)
    return replace(dim, acquisition=unknown, detection="all", signal=None, background=None)


@pytest.mark.parametrize(
    ("scene", "flux", "n_pulses", "counting"),
    [
        (random_depths, Flux(0.2, 0.1), 400, False),
        (_hot, Flux(0.3, 0.5), 200, False),
        (_reflecting, Flux(0.3, 0.5), 50, True),
    ],
    ids=["dim", "hot pixels", "half sky, unknown pulses"],
)
def test_mean_flux_intervals_cover_the_truth(
    scene: Callable[..., Scene], flux: Flux, n_pulses: int, counting: bool
) -> None:
    """One capture; ``make calibration`` measures the coverage of many regimes."""
    acquisition, seen = replace(ACQUISITION, n_pulses=n_pulses), scene(10)
    capture = simulate(seen, acquisition, flux)
    truth = np.array(_mean_flux_of(seen, flux))
    if counting:
        capture = _photons(seen, flux, capture)
        truth[:2] *= n_pulses
    found = inspection.estimate_mean_flux(capture)
    assert found.background.high < 1.2 * found.background.low  # no wider for hot pixels or sky
    for each, true in zip(found, truth, strict=True):
        assert each.low <= each.value <= each.high
        # An interval of 95 %, made twice as long, misses once in ten thousand times.
        below, above = each.value - each.low, each.high - each.value
        assert each.value - 2 * below < true < each.value + 2 * above


def test_the_mean_background_is_found_where_pixels_differ() -> None:
    """Half of the pixels see a third of the background of the others."""
    half, signal, backgrounds = random_depths(16), 0.1, (0.75, 2.25)
    captures = [simulate(half, ACQUISITION, Flux(signal, signal / each)) for each in backgrounds]
    both = Capture(np.concatenate([each.cube for each in captures]), ACQUISITION)
    mean = np.mean(backgrounds)
    for each, true in zip(
        inspection.estimate_mean_flux(both), (signal, mean, signal / mean), strict=True
    ):
        assert each.high < 1.2 * each.low
        below, above = each.value - each.low, each.high - each.value
        assert each.value - 2 * below < true < each.value + 2 * above


def test_bright_echoes_have_the_length_of_their_pulse() -> None:
    """Between delays that are tried, they would seem shorter, and fainter."""
    capture = simulate(scenes["staircase"](16), Acquisition(), Flux(signal=0.3, sbr=1.0))
    report = inspection.capture_report(capture)
    assert report.flux.signal.low < 0.3 < report.flux.signal.high
    assert "fit" not in report.flux_remark
    assert "background is" not in report.flux_remark  # a uniform one is not worth a remark


def test_flux_depends_neither_on_the_pulse_nor_on_the_bins() -> None:
    """Here the pulse has a tail; ``make calibration`` covers other pulses."""
    captures, truth = FLUX_REGIMES[3].captures(seed=3)
    for of, true in zip(
        (inspection.estimate_mean_flux, inspection.estimate_target_flux), truth, strict=True
    ):
        finest, coarsest = of(captures[0]), of(captures[-1])
        for one, other, value in zip(finest, coarsest, true, strict=True):
            assert one.overlaps(other)
            # Half as wide again as the 95 % interval, which makes 99.7 %.
            half = 0.75 * (one.high - one.low)
            assert abs((one.high + one.low) / 2 - value) < half


@pytest.mark.parametrize("regime", [-2, -1])
def test_mean_signals_are_right_whether_or_not_they_vary_with_the_background(regime: int) -> None:
    signals = []
    for seed in range(3):
        captures, truth = FLUX_REGIMES[regime].captures(seed)
        signals.append(inspection.estimate_target_flux(captures[-1]).signal.value / truth[1][0])
        if regime == -2:
            assert not flux_prior_of(captures[-1]).is_in_proportion
    # Four standard deviations of the mean; that of a capture is 0.02.
    assert np.mean(signals) == pytest.approx(1, abs=0.05)


@pytest.mark.compiled
def test_pixels_without_an_echo_may_be_darker_than_those_with_one() -> None:
    """Signals relative to the mean background of all pixels would be a quarter too small."""
    rng, shape, acquisition = np.random.default_rng(0), (40, 40), Acquisition(n_pulses=1000)
    reflectivity, onset = rng.gamma(4, 1 / 4, shape), rng.uniform(28, 63, shape)
    onset[:16] = np.nan
    signal = np.where(np.isfinite(onset), 0.12 * reflectivity, 0.0)
    background = np.where(np.isfinite(onset), 2 * reflectivity, 0.5)
    rate = rate_per_bin(onset, signal, 0.0, Pulse(), acquisition)
    rate += background[..., np.newaxis] / acquisition.n_bins
    capture = Capture(draw_counts(rate, acquisition.n_pulses, rng), acquisition)
    assert flux_prior_of(capture).is_in_proportion
    found = mean_flux_of(capture).image
    kept = ordinary_pixels(capture)
    assert covers(found.signal, signal[kept].mean())
    assert covers(found.sbr, signal[kept].mean() / background[kept].mean())


def test_the_search_for_fluxes_ends_around_their_peak() -> None:
    start = Bounds((-2.5, 0.95), (-1.3, 2.05), (-15.0, 0.0), (12.0, 5.3))
    for peak, sd in product(np.linspace(0, 5, 101), (0.05, 0.1, 0.2, 0.3, 0.5)):

        def surface(first: Floats, second: Floats, peak: float = peak, sd: float = sd) -> Floats:
            along = ((first - peak) / sd) ** 2 / 2
            return np.asarray(-along[:, np.newaxis] - ((second - 1.5) / 0.05) ** 2 / 2)

        found = zoomed(start, surface, (7, 9))
        assert found.low[0] < peak - 1.96 * sd and peak + 1.96 * sd < found.high[0]
        assert found.high[0] - found.low[0] < 16 * sd


def test_a_flux_lies_well_inside_its_interval() -> None:
    """Signal and background of this capture are correlated."""
    capture = FLUX_REGIMES[7].captures(1000)[0][1]
    found = (inspection.estimate_target_flux(capture), inspection.estimate_mean_flux(capture))
    for each in (*found[0], *found[1]):
        assert each.low < 0.97 * each.value and 1.03 * each.value < each.high


def test_the_flux_of_target_pixels_is_the_one_simulated() -> None:
    scene = scenes["car"]()
    capture = simulate(scene, scene.acquisition, Flux(0.1041, 0.06), seed=1)
    report = inspection.capture_report(capture)
    assert covers(report.target_flux.signal, 0.1041) and covers(report.target_flux.sbr, 0.06)
    assert report.target_flux.sbr.high - report.target_flux.sbr.low < 0.01
    share = float(np.isfinite(np.asarray(capture.truth_range_m)).mean())
    assert covers(report.flux.sbr, 0.06 * share)
    assert report.echo_free_background is not None
    assert covers(report.echo_free_background, Flux(0.1041, 0.06).background)
    assert "they agree" in report.flux_remark and "times as long" not in report.flux_remark


def test_fluxes_of_a_dim_car_are_those_of_all_its_pixels() -> None:
    """The share of target pixels in a random sample would be off by a tenth."""
    scene = scenes["car"]()
    capture = simulate(scene, scene.acquisition, Flux(0.1041, 0.03), seed=4)
    found = inspection.estimate_mean_flux(capture)
    signal = 0.1041 * float(np.isfinite(scene.range_m).mean())
    assert covers(found.signal, signal) and covers(found.background, 3.47)
    assert abs(found.signal.value - signal) < 0.06 * signal


def foggy_report(regime: int, n_fog: int) -> inspection.CaptureReport:
    """Return the report on a capture with half a photon of fog in each of the first bins."""
    captures, _ = FLUX_REGIMES[regime].captures(seed=4)
    capture, rng = captures[-1], np.random.default_rng(4)
    cube = capture.cube + rng.poisson(0.5, capture.cube.shape) * (np.arange(150) < n_fog)
    return inspection.capture_report(replace(capture, cube=cube.astype(np.uint32)))


def test_a_report_names_fog_as_the_shape_of_the_background() -> None:
    report = foggy_report(regime=0, n_fog=20)
    assert "disagree" not in report.flux_remark
    assert "the background varies over the gate" in report.flux_remark
    # 10 photons of fog and 0.25 of background, but no smooth shape.
    assert report.flux.background.value == pytest.approx(10.25, rel=0.1)


def test_a_report_says_where_bins_without_echoes_contradict_the_model() -> None:
    report = foggy_report(regime=4, n_fog=120)
    free = report.echo_free_background
    assert free is not None and "disagree" in report.flux_remark
    assert report.flux.background.high > 1.5 * report.flux.background.low
    assert report.flux.background.low <= free.low and free.high <= report.flux.background.high


def test_intervals_of_differences_ratios_and_products_cover_the_truth() -> None:
    rng, trials, mean = np.random.default_rng(5), 400, (30.0, 12.0)
    tail, hits = 0.5 - inspection.LEVEL / 2, np.zeros(3, int)
    for pair in rng.poisson(mean, (trials, 2)):
        one, other = (
            Interval(n, stats.gamma.ppf(tail, n) if n else 0.0, stats.gamma.isf(tail, n + 1))
            for n in map(float, pair)
        )
        hits[0] += covers(difference_of(one, other), mean[0] - mean[1])
        hits[1] += covers(ratio_of(one, other), mean[0] / mean[1])
        hits[2] += covers(product_of(one, other), mean[0] * mean[1])
    assert all(is_covered_often_enough(each, trials) for each in hits), hits
    nothing, some = Interval(0.0, 0.0, 3.7), Interval(4.0, 1.1, 10.2)
    assert ratio_of(some, nothing).value == ratio_of(some, nothing).high == math.inf
    assert ratio_of(nothing, some).value == ratio_of(nothing, some).low == 0.0
    assert product_of(nothing, some).value == product_of(some, nothing).value == 0.0
    assert difference_of(nothing, some) == Interval(0.0, 0.0, difference_of(nothing, some).high)


def _counts(shape: tuple[int, int, int], kind: str, n_pulses: int | None) -> np.ndarray:
    cube = np.zeros(shape, np.uint32)
    if kind == "full":
        cube[..., 0] = n_pulses or 20
    if kind == "one":
        cube[0, 0, shape[2] // 2] = 1
    return cube


@pytest.mark.uncounted
@pytest.mark.parametrize("kind", ["empty", "full", "one"])
@pytest.mark.parametrize("n_pulses", [1, 1000, None])
@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 5, 1), (3, 4, 30)])
def test_extreme_captures_have_reports(
    shape: tuple[int, int, int], n_pulses: int | None, kind: str
) -> None:
    acquisition = Acquisition(n_bins=shape[2], n_pulses=n_pulses)
    capture = Capture(_counts(shape, kind, n_pulses), acquisition)
    image = estimate(capture, "tracking")
    whole = inspection.capture_report(capture)
    pixel = inspection.pixel_report(capture, image, 0, 0)
    region = inspection.region_report(capture, image, np.ones(shape[:2], bool))
    for flux in (whole.flux, pixel.flux, region.flux, region.pixel.flux):
        for each in flux:
            assert each.low >= 0 and each.high >= each.low
            assert covers(each, each.value) or math.isnan(each.value)
        assert not math.isnan(flux.signal.value) and not math.isnan(flux.background.value)
    first, end = whole.suggestion.gate
    assert 0 <= first < end <= shape[2]
    assert 0 <= whole.suggestion.t_n < shape[2]
    for find in inspection.maps.values():
        assert find(capture).shape == shape[:2]
    if kind == "empty":
        assert pixel.candidates == ()
        assert whole.flux.signal.low == whole.flux.background.low == 0
    if kind == "full" and n_pulses:
        assert math.isinf(pixel.flux.background.high)


def test_maps_are_of_each_pixel() -> None:
    capture = simulate(random_depths(10), ACQUISITION, Flux(0.5, 0.5), seed=7)
    np.testing.assert_array_equal(inspection.maps["Peak"](capture), capture.cube.max(axis=2))
    np.testing.assert_allclose(inspection.maps["Fired"](capture), capture.counts / 400)
    assert np.median(inspection.maps["SBR"](capture)) == pytest.approx(0.5, rel=0.15)
    photons = replace(capture, detection="all")
    assert np.isnan(inspection.maps["Fired"](photons)).all()
    assert inspection.maps["SBR"](capture) is inspection.maps["SBR"](capture)  # found once


def test_the_most_probable_bin_is_that_of_the_surface() -> None:
    """Although a surface is equally probable within 3 bins of each of seven bins."""
    capture = simulate(random_depths(40), ACQUISITION, Flux(0.5, 3.0), seed=7)
    delay, probability = likeliest(capture)
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    off = (delay + 0.5 - truth_bin)[probability > 0.999]
    assert off.size > 0.9 * capture.counts.size
    assert np.abs(off).max() <= 1


def test_suggested_settings_improve_the_estimate() -> None:
    scene = scenes["building"](32)
    capture = simulate(scene, scene.acquisition, Flux(0.1041, 0.05), seed=1)
    suggested = inspection.capture_report(capture).suggestion
    cut = cut_gate(capture, *suggested.gate)
    before = estimate(capture, "tracking")
    after = estimate(cut, "tracking", t_n=max(suggested.t_n - suggested.gate[0], 0))
    tolerance_m = 3 * scene.acquisition.bin_length_m
    truth_m = np.asarray(capture.truth_range_m)
    one, other = (restored(each.range_m, truth_m, tolerance_m)[0] for each in (before, after))
    assert other > one
    nearest = np.nanmin(scene.acquisition.range_m_to_bin(truth_m))
    assert suggested.t_n == pytest.approx(nearest, abs=6)


def test_a_gate_is_cut_in_front_only_without_loss_of_pulses() -> None:
    acquisition = Acquisition(n_bins=200, n_pulses=100)
    wall = Scene(np.full((8, 8), acquisition.bin_to_range_m(90.0)), acquisition=acquisition)
    capture = simulate(wall, acquisition, Flux(0.5, 5.0), seed=9)
    first = inspection.capture_report(capture).suggestion
    photons = inspection.capture_report(replace(capture, detection="all")).suggestion
    assert first.gate[0] == 0 < photons.gate[0] < 90 - 3
    assert 90 + 8 < first.gate[1] == photons.gate[1] < 200
    assert photons.gate[0] < photons.t_n
    assert first.t_n == photons.t_n <= 92
    assert (
        "64 estimates of the likelihood with a confidence of 0.9 or more lie in bin 90;"
        in first.why_gate
    )


# -- fewer pulses ----------------------------------------------------------------------------------


def test_accuracy_over_pulses_is_held_against_the_truth_or_all_pulses() -> None:
    capture = simulate(random_depths(10), ACQUISITION, Flux(0.3, 0.2), seed=8)
    few, more, every = inspection.accuracy_over_pulses(capture, [0.02, 0.3, 1.0])
    assert (few.n_pulses, more.n_pulses, every.n_pulses) == (8, 120, 400)
    assert few.against == "truth"
    assert few.within.value < more.within.value <= every.within.value
    assert every.rmse_m.low < every.rmse_m.value < every.rmse_m.high
    assert every.rmse_m.value < few.rmse_m.value
    (alone,) = inspection.accuracy_over_pulses(
        simulate(random_depths(1), ACQUISITION, Flux(0.3, 0.2), seed=8), [1.0]
    )
    assert (alone.rmse_m.low, alone.rmse_m.high) == (0.0, ACQUISITION.gate_length_m)
    unknown = replace(capture, truth_range_m=None, acquisition=replace(ACQUISITION, n_pulses=None))
    part, whole = inspection.accuracy_over_pulses(unknown, [0.1, 1.0], "peak")
    assert part.against == "all pulses" and part.n_pulses is None
    assert whole.within.value == 1.0 and whole.rmse_m.value == 0.0
    assert part.within.value < 1.0
    confident = estimate(unknown, "peak").confident(inspection.CONFIDENT).range_m
    fewer = estimate(share_of_pulses(unknown, 0.1), "peak").range_m
    hits, targets = restored(fewer, confident, TOLERANCE_BINS * ACQUISITION.bin_length_m)
    assert targets < capture.counts.size and part.within.value == hits / targets
    steps = inspection.accuracy_over_pulses(capture, [0.5])
    assert next(steps).share == 0.5  # one at a time
    with pytest.raises(ValueError, match="share = 0"):
        inspection.accuracy_over_pulses(capture, [0.5, 0])
