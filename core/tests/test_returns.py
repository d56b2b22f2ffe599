"""Tests of several returns of a pixel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import binom

import core
from core import Acquisition, Capture, Flux, Pulse, Scene, simulate
from core.effects import SecondSurface
from core.inference import FALSE_RETURN
from core.inference.returns import fitted_echoes
from core.kernels.returns import EchoModel, fill_further
from core.scene import net
from core.trigger import draw_counts, rate_per_bin

compiled = pytest.mark.compiled  # all but the tests that compare kernels with their definitions

GATE = Acquisition(100, 1e-9, 280e-9, n_pulses=1000)
_TIME = np.arange(40)
_PEAK, _TAIL = np.exp(-0.5 * ((_TIME - 6) / 3) ** 2), np.exp(-_TIME / 12) * (_TIME > 6)
PULSE, TAILED = Pulse(), Pulse.measured(0.9 * _PEAK + 0.1 * _TAIL, 0.4e-9)


def two_surfaces(
    separation: float, share: float, sbr: float, side: int = 16, pulse: Pulse = PULSE
) -> tuple[Capture, tuple[np.ndarray, np.ndarray]]:
    """Random depths in bins 20 to 30, and a second surface of a share of the signal behind."""
    near = np.random.default_rng(1).uniform(20, 30, (side, side))
    near_m, far_m = map(GATE.bin_to_range_m, (near, near + separation))
    second = SecondSurface(far_m, np.full(near.shape, share))
    scene = Scene(near_m, acquisition=GATE, second_surface=second if share else None)
    return simulate(scene, GATE, Flux(0.1041, sbr), pulse, seed=2), (near, near + separation)


def counted(capture: Capture, photons: float, background: float, seed: int = 0) -> Capture:
    """Draw a capture of all photons with the depths of another."""
    assert capture.truth_range_m is not None
    delay = capture.acquisition.range_m_to_bin(capture.truth_range_m)
    n_bins = capture.acquisition.n_bins
    echo = capture.pulse.bin_probability(delay, n_bins, capture.acquisition.bin_width_s)
    rng = np.random.default_rng(seed)
    cube = rng.poisson(photons * echo + background / n_bins).astype(np.uint16)
    return replace(capture, cube=cube, detection="all", signal=None, background=None)


def found_both(image: core.RangeImage, delays: tuple[np.ndarray, ...]) -> float:
    """Return the share of pixels with two returns, each within two bins of a surface."""
    returns = image.returns
    assert returns is not None
    shape = image.valid.shape
    errors = [
        np.abs(returns.image("bin", number, shape) - delay)
        for number, delay in enumerate(delays, 1)
    ]
    right = (errors[0] <= 2) & (errors[1] <= 2) & (returns.count(shape) == 2)
    return float(right.mean())


def log_likelihood(capture: Capture, counts: np.ndarray, values: np.ndarray) -> float:
    """Log likelihood of counts (bin,) for background, two signals and two delays (5,)."""
    n_bins, n_pulses = counts.size, capture.gated_pulses
    echoes = capture.pulse.bin_probability(values[3:], n_bins, capture.acquisition.bin_width_s)
    rate = np.maximum(values[0] / n_bins + values[1:3] @ echoes, 1e-12)
    if n_pulses is None:
        return float(counts @ np.log(rate) - rate.sum())
    armed = n_pulses - np.cumsum(counts) + counts
    return float(counts @ np.log(-np.expm1(-rate)) - (armed - counts) @ rate)


@pytest.mark.parametrize("detection", ["first", "all"])
def test_no_two_echoes_are_likelier_than_those_fitted(detection: str) -> None:
    capture, (near, far) = two_surfaces(8.0, 0.5, 1.0, 2)
    capture = counted(capture, 60.0, 20.0) if detection == "all" else capture
    n = 1.0 if detection == "all" else 1e3
    counts = capture.cube.reshape(-1, 100)
    if detection == "all":
        counts = counts + np.roll(counts, 8, axis=1)
    # The background is given: plain Python takes seconds to estimate its shape.
    fitted = fitted_echoes(capture, counts, 2, 0.0, np.full(100, 0.01))
    assert (fitted.number == 2).all()
    for pixel in range(len(counts)):
        here = counts[pixel].astype(float)
        values = np.array([fitted.background[pixel], *fitted.signal[pixel], *fitted.delay[pixel]])
        found = log_likelihood(capture, here, values)
        start = [*(here.sum() / n * np.array([0.6, 0.2, 0.2])), near.flat[pixel], far.flat[pixel]]
        best = minimize(
            lambda each, here=here: -log_likelihood(capture, here, np.abs(each)),
            start,
            method="Nelder-Mead",
            options={"maxiter": 4000, "xatol": 1e-4, "fatol": 1e-6},
        )
        # Delays are fitted in eighths of a bin.
        assert found >= -best.fun - 0.1


@pytest.mark.parametrize("detection", ["first", "all"])
def test_bins_without_echoes_are_added_up_at_once_or_one_by_one(detection: str) -> None:
    capture, _ = two_surfaces(8.0, 0.5, 0.5, 2)
    capture = counted(capture, 30.0, 40.0) if detection == "all" else capture
    uniform = np.full(100, 0.01)
    alike, one_by_one = (
        fitted_echoes(capture, capture.cube, 2, 0.0, uniform * (1 + differing))
        for differing in (0.0, 1e-12 * np.arange(100))
    )
    np.testing.assert_array_equal(alike.number, one_by_one.number)
    for found, other in zip(alike[:4], one_by_one[:4], strict=True):
        np.testing.assert_allclose(found, other, rtol=1e-6)


@compiled
@pytest.mark.parametrize(
    ("separation", "share", "sbr", "least"),
    [(3, 0.5, 0.1, 0.58), (6, 0.5, 0.1, 0.87), (3, 0.3, 0.3, 0.63), (6, 0.3, 0.3, 0.94)],
)
def test_both_surfaces_of_a_pixel_are_found(
    separation: float, share: float, sbr: float, least: float
) -> None:
    capture, delays = two_surfaces(separation, share, sbr)
    found = found_both(core.estimate(capture, "likelihood", returns=2), delays)
    n = capture.counts.size
    assert found * n >= binom.ppf(0.001, n, least)


@compiled
@pytest.mark.parametrize("kind", ["first photons", "all photons", "tail"])
def test_few_pixels_with_one_surface_get_a_second_return(kind: str) -> None:
    capture, _ = two_surfaces(0.0, 0.0, 0.1, 32, TAILED if kind == "tail" else PULSE)
    if kind == "all photons":
        capture = counted(capture, 20.0, 20.0)
    image = core.estimate(capture, "likelihood", returns=2)
    assert image.returns is not None
    n = capture.counts.size
    false = np.count_nonzero(image.returns.count(capture.shape) > 1)
    assert false <= binom.ppf(0.999, n, FALSE_RETURN)
    asked = core.with_returns(capture, image, 2, false_return=0.1).returns
    assert asked is not None
    more = np.count_nonzero(asked.count(capture.shape) > 1)
    assert binom.ppf(0.0001, n, 0.07) <= more <= binom.ppf(0.999, n, 0.1)


def log_probability_of(counts: np.ndarray, rate: np.ndarray, n_pulses: int) -> float:
    """Log likelihood of counts (bin,), of first photons unless there are no pulses."""
    if n_pulses == 0:
        return float(counts @ np.log(rate) - rate.sum())
    unfired = n_pulses - np.cumsum(counts)
    return float(counts @ np.log(-np.expm1(-rate)) - unfired @ rate)


@pytest.mark.parametrize("n_pulses", [0, 200])
@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_one_more_echo_has_the_likelihood_of_its_definition(n_pulses: int, slope: float) -> None:
    rng, n_bins, first_tap = np.random.default_rng(3), 20, -1
    echo = rng.dirichlet(np.ones(5), 3)  # shares of the bins at three delays within one
    shape = 1 + slope * np.linspace(-1, 1, n_bins)
    model = EchoModel(
        echo, first_tap, shape / n_bins, slope == 0, n_pulses > 0, float(n_pulses or 1), 1.0
    )
    background, levels, weight = 0.9, np.array([[0.2], [1.5]]), np.log([0.3, 0.2])

    def placed(at: int) -> np.ndarray:
        whole = np.zeros(n_bins + 10)
        whole[at + first_tap + 5 : at + first_tap + 10] = echo[1]
        return whole[5:-5]

    for known, at in ((0.0, 8), (0.6, 8), (0.6, 19), (0.6, 0)):
        counts = rng.integers(0, 4, (1, n_bins)).astype(np.uint32)
        given = np.array([[known]]), np.array([[at + 0.5]]), levels, weight
        log = np.empty((1, n_bins), np.float32)
        fill_further(0, 1, counts, model, np.array([background]), *given, log)
        rest = known * placed(at)
        before = log_probability_of(counts[0], background * model.background + rest, n_pulses)
        for k in range(n_bins):
            after = [
                weight[i]
                + log_probability_of(
                    counts[0],
                    max(background - s, 0.1 * background) * model.background + rest + s * placed(k),
                    n_pulses,
                )
                for i, s in enumerate(levels[:, 0])
            ]
            assert log[0, k] == pytest.approx(np.logaddexp.reduce(after) - before, abs=1e-4)


@compiled
def test_a_single_return_is_the_estimate() -> None:
    capture, _ = two_surfaces(6.0, 0.3, 0.1)
    plain = core.estimate(capture, "tracking", false_alarm=0.01)
    image = core.estimate(capture, "tracking", false_alarm=0.01, returns=2)
    returns = image.returns
    assert plain.returns is None
    assert returns is not None
    count = returns.count(capture.shape)
    assert np.array_equal(count > 0, plain.valid)
    one = count == 1
    assert np.array_equal(image.bin[one], plain.bin[one])
    assert np.array_equal(returns.image("range_m", 1, capture.shape)[one], plain.range_m[one])
    row, col = np.argwhere(count == 2)[0]
    those = returns.at(row, col)
    assert those.number.tolist() == [1, 2]
    assert (np.diff(those.range_m) > 0).all()
    assert image.range_m[row, col] in those.range_m
    assert image.confidence[row, col] >= those.confidence.max() - 1e-3
    assert image.made_by is not None
    assert image.made_by.facts["most_returns"] == 2


@compiled
def test_confidences_of_returns_are_probabilities() -> None:
    capture, delays = two_surfaces(8.0, 0.2, 0.15, 32)
    returns = core.estimate(capture, "likelihood", returns=3).returns
    assert returns is not None
    error = np.min(
        [np.abs(returns.bin - each[returns.row, returns.col]) for each in delays], axis=0
    )
    right, stated = error <= 3, returns.confidence
    deviation = np.sqrt((stated * (1 - stated)).sum())
    assert abs(right.sum() - stated.sum()) < 4 * deviation + 0.01 * right.size


@compiled
@pytest.mark.parametrize("separation", [3.0, 25.0])
def test_neighbours_show_a_net_that_single_pixels_do_not(separation: float) -> None:
    scene = net(32, separation)
    capture = simulate(scene, scene.acquisition, Flux(0.1041, 0.06), seed=1)
    assert scene.second_surface is not None
    delays = tuple(
        scene.acquisition.range_m_to_bin(each)
        for each in (scene.second_surface.range_m, scene.range_m)
    )
    assert found_both(core.estimate(capture, "likelihood", returns=2), delays) < 0.2
    image = core.estimate(capture, "image_posterior", returns=2)
    assert found_both(image, delays) > 0.96
    assert image.returns is not None
    assert image.returns.confidence.mean() > 0.96


@compiled
def test_neighbours_add_no_second_surface_to_one() -> None:
    """After two rounds, 8 % of these pixels have a second surface; after three, none."""
    scene = core.scenes["wall"](64)
    capture = simulate(scene, scene.acquisition, Flux(0.1041, 0.03), seed=6)
    returns = core.estimate(capture, "image_posterior", returns=2).returns
    assert returns is not None
    false = np.count_nonzero(returns.count(capture.shape) > 1)
    assert false <= binom.ppf(0.9999, capture.counts.size, FALSE_RETURN)


@compiled
def test_few_holes_of_a_net_get_a_second_surface() -> None:
    """All strands are as bright, so that hardly any surface in a hole is faint."""
    col = np.mgrid[:64, :64][1]
    is_strand = np.random.default_rng(3).random(col.shape) < 0.3
    acquisition = Acquisition(n_pulses=1000)
    wall, front = (
        rate_per_bin(onset, np.full(onset.shape, 0.05), 0.0, Pulse(), acquisition)
        for onset in (55 + 10 * col / 64, np.full(col.shape, 20.0))
    )
    rate = wall + np.where(is_strand[..., np.newaxis], front, 0.0) + 1 / acquisition.n_bins
    counts = draw_counts(rate, acquisition.n_pulses, np.random.default_rng(2))
    image = core.estimate(core.Capture(counts, acquisition), "image_posterior", returns=2)
    has_two = image.returns.count(col.shape) > 1
    assert has_two[~is_strand].mean() < 0.05
    assert has_two[is_strand].mean() > 0.8


@compiled
@pytest.mark.parametrize(("signal", "n_pulses", "most_false"), [(0.5, 50, 0.3), (0.2, 1000, 0.05)])
def test_gaps_in_foliage_get_few_second_surfaces(
    signal: float, n_pulses: int, most_false: float
) -> None:
    """Half of the pixels, at random, have a second surface behind the first."""
    col = np.mgrid[:32, :32][1]
    has_behind = np.random.default_rng(0).random(col.shape) < 0.5
    acquisition = Acquisition(n_pulses=n_pulses)
    front, behind = (
        rate_per_bin(onset + 0.1 * col, np.full(col.shape, signal), 0.0, Pulse(), acquisition)
        for onset in (30.4, 50.4)
    )
    rate = front + np.where(has_behind[..., np.newaxis], behind, 0.0) + 1 / acquisition.n_bins
    counts = draw_counts(rate, n_pulses, np.random.default_rng(1))
    image = core.estimate(core.Capture(counts, acquisition), "image_posterior", returns=2)
    has_two = image.returns.count(col.shape) > 1
    assert has_two[~has_behind].mean() < most_false
    assert has_two[has_behind].mean() > 0.9
    second = image.returns.number == 2
    is_true = has_behind[image.returns.row, image.returns.col][second]
    sure = image.returns.confidence[second] >= 0.9
    assert is_true[sure].mean() > 0.9


@compiled
def test_three_surfaces_are_found() -> None:
    delay = np.array([12.0, 30.0, 50.0]) + np.random.default_rng(0).uniform(0, 40, (64, 1))
    echoes = Pulse().bin_probability(delay, 100, 1e-9)
    counts = draw_counts(0.002 + 0.1 * echoes.sum(axis=1), 1000, np.random.default_rng(1))
    capture = Capture(counts.reshape(8, 8, 100), GATE)
    returns = core.estimate(capture, "likelihood", returns=4).returns
    assert returns is not None
    three = (returns.count((8, 8)) == 3).ravel()
    assert np.count_nonzero(three) >= binom.ppf(0.001, 64, 0.95)
    found = np.array([returns.at(*divmod(i, 8)).bin for i in np.flatnonzero(three)])
    assert np.mean(np.abs(found - delay[three])) < 0.3
    assert abs(returns.strength.mean() - 0.1) < 0.01


@compiled
def test_the_map_of_returns_counts_surfaces() -> None:
    capture, _ = two_surfaces(10.0, 0.5, 0.3, 16)
    counted_map = core.inspection.maps["Returns"](capture)
    assert np.issubdtype(counted_map.dtype, np.integer)  # so that its scale has no fractions
    assert np.count_nonzero(counted_map == 2) >= binom.ppf(0.001, 256, 0.97)
    empty = replace(capture, cube=np.zeros_like(capture.cube))
    assert (core.inspection.maps["Returns"](empty) == 0).all()


@compiled
def test_arguments_out_of_their_bounds_are_refused() -> None:
    capture, _ = two_surfaces(6.0, 0.3, 0.1, 8)
    for returns in (0, 5):
        with pytest.raises(ValueError, match="returns"):
            core.estimate(capture, "peak", returns=returns)
    image = core.estimate(capture, "peak")
    with pytest.raises(ValueError, match="false_return"):
        core.with_returns(capture, image, 2, false_return=0.0)


@compiled
def test_files_hold_all_returns(tmp_path: Path) -> None:
    scene = net(16, separation_bins=12.0)
    capture = simulate(scene, scene.acquisition, Flux(0.3, 0.5), seed=1)
    image = core.estimate(capture, "likelihood", returns=2)
    returns = image.returns
    assert returns is not None
    assert (returns.count(capture.shape) == 2).mean() > 0.9
    for suffix in (".laz", ".csv", ".npz", ".ply"):
        core.save_image(capture, image, tmp_path / f"cloud{suffix}")
    las = laspy.read(tmp_path / "cloud.laz")
    assert np.array_equal(las.return_number, returns.number)
    count = returns.count(capture.shape)
    assert np.array_equal(las.number_of_returns, count[returns.row, returns.col])
    assert np.array_equal(las["range_m"], returns.range_m)
    with np.load(tmp_path / "cloud.npz") as stored:
        assert np.array_equal(stored["returns"], count)
        second = returns.image("range_m", 2, capture.shape)
        assert np.array_equal(stored["return_2_range_m"], second, equal_nan=True)
    lines = (tmp_path / "cloud.csv").read_text().splitlines()
    head = next(line for line in lines if line[0] != "#")
    assert "returns,return_1_range_m,return_1_strength,return_1_confidence" in head
    assert image.to_xarray().return_1_range_m.attrs["units"] == "m"
    half = image.cropped(core.geometry.Box(to_m=float(np.median(returns.range_m)))).returns
    assert half is not None
    assert 0 < len(half) < len(returns)
    sure = image.confident(0.9).returns
    assert sure is not None
    assert (sure.confidence >= 0.9).all()
