"""Tests of the tracking differentiator against its equations and its theory."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from itertools import product
from typing import Any, NamedTuple, get_args

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from core.acquisition import Acquisition, Flux
from core.kernels.blocks import LANES, to_blocks
from core.parameters import Number, spec_of
from core.scene import Scene, uniform
from core.simulation import simulate
from core.tracking import (
    PRESETS,
    SigmaFrom,
    Start,
    TrackingParameters,
    Weight,
    track,
    tracking_signals,
)

# Half a millisecond a pixel where the kernels are plain Python.
PIXELS = 16 if numba.config.DISABLE_JIT else 64 * LANES
N_PULSES = 1000
EPS_32 = float(np.finfo(np.float32).eps)

Variant = tuple[Any, Any, Any]
VARIANTS = list(product(get_args(Weight), get_args(Start), get_args(SigmaFrom)))
IN_PLAIN_PYTHON = VARIANTS[::5]  # each option of each choice once
any_variant = pytest.mark.parametrize(
    "variant",
    [
        pytest.param(
            each,
            id=" ".join(each),
            marks=() if each in IN_PLAIN_PYTHON else pytest.mark.compiled,
        )
        for each in VARIANTS
    ],
)


def settings_of(variant: Variant, **more: Any) -> TrackingParameters:
    weight, start, sigma_from = variant
    return TrackingParameters(weight=weight, start=start, sigma_from=sigma_from, **more)


@pytest.fixture(scope="module")
def cube() -> np.ndarray:
    """First photons of uniform depths at several SBRs; every eighth pixel has no target."""
    pixels = uniform(64).range_m.ravel()[:PIXELS].copy()
    pixels[::8] = np.nan
    acquisition = Acquisition(n_pulses=N_PULSES)
    rows = []
    for seed, some in enumerate(np.split(pixels, 2)):
        scene = Scene(some[np.newaxis])
        rows.append(simulate(scene, acquisition, Flux(sbr=0.04 + 0.02 * seed), seed=seed).cube[0])
    return np.concatenate(rows)


# --- The twin: the method's equations, one histogram, one line at a time, in plain Python. ---


def sign(x: float) -> float:
    return math.copysign(1.0, x) if x != 0 else 0.0


def differentiator(s: list[float], r: float, h: float, m: float, x1: float) -> list[float]:
    x2, h0 = 0.0, m * h
    out = []
    for s_k in s:
        d = r * h0
        d0 = h0 * d
        y = x1 - s_k + h0 * x2
        a0 = math.sqrt(d**2 + 8 * r * abs(y))
        a = x2 + (a0 - d) / 2 * sign(y) if abs(y) > d0 else x2 + y / h0
        if abs(a) > d:
            fh = -r * sign(a)
        elif r > 0:
            fh = -r * a / d
        else:
            fh = 0.0
        x1, x2 = x1 + h * x2, x2 + h * fh
        out.append(x1)
    return out


class Twin(NamedTuple):
    small: list[float]
    large: list[float]
    residual: list[float]
    weight: list[float]
    enhanced: list[float]
    sigma: float
    position_bin: float


def twin(s: list[float], p: TrackingParameters, n_pulses: int = N_PULSES) -> Twin:
    n_bins = len(s)
    of = s if p.sigma_from == "gate" else s[: p.t_n]
    sigma = 0.0
    if of:
        mean = math.fsum(of) / len(of)
        sigma = math.sqrt(math.fsum((x - mean) ** 2 for x in of) / len(of))
    r_small = p.l * sigma
    r_large = p.n * r_small
    start = math.fsum(s[:5]) / len(s[:5]) if p.start == "mean" else 0.0
    small = differentiator(s, r_small, p.h, p.m, start)
    large = differentiator(s, r_large, p.h, p.m, start)

    # Not in the paper: residuals below this share of the largest count are rounding errors.
    floor = 16 * 2.0**-23 * max(s)
    residual = [max(b - a, 0.0) for a, b in zip(small, large, strict=True)]
    residual = [x if x > floor else 0.0 for x in residual]

    weight = []
    for k in range(n_bins):
        armed = n_pulses - sum(s[:k])
        w = {
            "none": 1.0,
            "cubic": p.alpha * (k / n_bins) ** 3,
            "exponential": math.exp(p.alpha * (k / n_bins) ** 3),
            "survival": n_pulses / max(armed, 1.0),
        }[p.weight]
        weight.append(w if k >= p.t_n else 0.0)
    enhanced = [a * b for a, b in zip(residual, weight, strict=True)]
    best = max(enhanced)
    position = float(enhanced.index(best)) if best > 0 else math.nan
    return Twin(small, large, residual, weight, enhanced, sigma, position)


def assert_equals_twin(s: np.ndarray, p: TrackingParameters, tolerance: float) -> None:
    """Require every stage within `tolerance` of the largest count."""
    found, expected = tracking_signals(s, p, N_PULSES), twin(s.tolist(), p)
    unit = tolerance * max(float(s.max()), 1e-300)
    assert found.sigma == pytest.approx(expected.sigma, rel=1e-12, abs=1e-12 * s.max())
    np.testing.assert_allclose(found.small, expected.small, rtol=0, atol=unit)
    np.testing.assert_allclose(found.large, expected.large, rtol=0, atol=unit)
    np.testing.assert_allclose(found.weight, expected.weight, rtol=1e-12)
    # Rounding decides about residuals at the floor.
    floor = 16 * EPS_32 * float(s.max()) * (1 + tolerance)
    np.testing.assert_allclose(found.residual, expected.residual, rtol=0, atol=2 * unit + floor)
    np.testing.assert_array_equal(found.enhanced, found.residual * found.weight)
    if not math.isnan(expected.position_bin):
        # Rounding decides between two equal bins.
        top = max(found.weight)
        at = expected.enhanced[int(found.position_bin)]
        assert at >= max(expected.enhanced) - 2 * top * unit


@any_variant
def test_signals_are_the_equations(cube: np.ndarray, variant: Variant) -> None:
    for settings in (
        settings_of(variant),
        settings_of(variant, l=0.05, n=30.0, m=2.2, h=0.5, alpha=9.0),
    ):
        for histogram in cube[:4].astype(float):
            # Rounding of 1.1e-16 through a hundred contracting steps.
            assert_equals_twin(histogram, settings, 1e-10)


@given(
    st.lists(st.integers(0, 60_000), min_size=1, max_size=25),
    st.builds(
        TrackingParameters,
        l=st.floats(0, 1),
        n=st.floats(0, 1e4),
        h=st.floats(0.25, 4),
        m=st.floats(1, 5),
        alpha=st.floats(0, 30),
        t_n=st.integers(0, 30),
        weight=st.sampled_from(get_args(Weight)),
        start=st.sampled_from(get_args(Start)),
        sigma_from=st.sampled_from(get_args(SigmaFrom)),
    ),
)
def test_signals_are_the_equations_for_any_histogram(
    counts: list[int], settings: TrackingParameters
) -> None:
    # The switching curve magnifies rounding to its square root where it crosses zero.
    assert_equals_twin(np.array(counts, float), settings, 1e-7)


# --- Track: the same positions as the signals. ---


def assert_track_agrees(rows: np.ndarray, settings: TrackingParameters) -> None:
    """Require the same bin unless the best bins differ by less than the rounding of float32."""
    signals = tracking_signals(rows, settings, N_PULSES)
    position, score = track(to_blocks(rows), settings, N_PULSES)
    assert position.shape == score.shape == (len(rows),)
    differ = ~np.isclose(position, signals.position_bin, rtol=0, atol=0, equal_nan=True)
    best = signals.enhanced.max(axis=1)
    # A dozen roundings of float32 numbers as large as the largest count, then weighted.
    rounding = 16 * EPS_32 * rows.max(axis=1) * signals.weight.max(axis=1)
    chosen = np.where(np.isnan(position), 0, position).astype(int)
    at = np.take_along_axis(signals.enhanced, chosen[:, np.newaxis], axis=1)[:, 0]
    at[np.isnan(position)] = 0.0
    assert (best - at <= rounding)[differ].all()
    assert differ.mean() < 0.02  # ties are rare
    # The switching curve magnifies rounding to its square root.
    magnified = np.sqrt(16 * EPS_32) * rows.max(axis=1) * signals.weight.max(axis=1)
    assert (np.abs(score - best) <= magnified)[~differ].all()
    assert (score[np.isnan(position)] == 0).all()


CHANGED: list[dict[str, Any]] = [
    {"l": 0.001, "n": 300.0},
    {"l": 0.1, "n": 10.0},
    {"m": 1.0},
    {"m": 5.0},
    {"h": 3.0},
    {"t_n": 0},
    {"t_n": 99},
    {"alpha": 30.0, "weight": "exponential"},
]
SETTINGS = PRESETS | {str(changed): TrackingParameters(**changed) for changed in CHANGED}


@any_variant
def test_track_finds_the_positions_of_the_signals(cube: np.ndarray, variant: Variant) -> None:
    assert_track_agrees(cube, settings_of(variant))


@pytest.mark.compiled
@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_track_finds_the_positions_with_any_settings(
    cube: np.ndarray, settings: TrackingParameters
) -> None:
    assert_track_agrees(cube, settings)


@pytest.mark.compiled
@pytest.mark.parametrize("settings", PRESETS.values(), ids=PRESETS)
def test_presets_find_most_positions(cube: np.ndarray, settings: TrackingParameters) -> None:
    assert np.isfinite(track(to_blocks(cube), settings)[0]).mean() > 0.9


# --- Theory. ---


def random_rows(n_rows: int = 8, n_bins: int = 60) -> np.ndarray:
    return np.random.default_rng(5).poisson(20, (n_rows, n_bins)).astype(float)


@pytest.mark.parametrize("start", get_args(Start))
@pytest.mark.parametrize("h", [0.5, 1.0, 2.0])
def test_within_the_linear_zone_m_of_one_is_a_pure_delay(h: float, start: Start) -> None:
    rows = random_rows()
    signals = tracking_signals(rows, TrackingParameters(l=1e6, n=2.0, h=h, m=1.0, start=start))
    for scale in (signals.small, signals.large):
        # Element k of a scale is x1(k + 1), which follows s(k - 1): two bins behind.
        np.testing.assert_allclose(scale[:, 1:], rows[:, :-1], rtol=1e-12)


@pytest.mark.parametrize("m", [1.2, 2.0, 4.0])
def test_within_the_linear_zone_the_mean_delay_is_two_m(m: float) -> None:
    step = np.concatenate([np.zeros(5), np.ones(400)])
    small = tracking_signals(step, TrackingParameters(l=1e6, m=m)).small
    # An edge's mean delay is the area it lacks; x1(k + 1) is stored at k, as above.
    assert (step - small).sum() + 1 == pytest.approx(2 * m, rel=1e-9)


@pytest.mark.parametrize("l", [0.0, 1e-3, 0.1, 1e6])
def test_equal_scales_leave_no_residual(l: float) -> None:  # noqa: E741 - the paper's letter
    rows = random_rows()
    settings = TrackingParameters(l=l, n=1.0)
    signals = tracking_signals(rows, settings)
    assert (signals.residual == 0).all()
    assert np.isnan(signals.position_bin).all()
    position, score = track(to_blocks(rows.astype(np.uint16)), settings)
    assert np.isnan(position).all()
    assert (score == 0).all()


@pytest.mark.parametrize("scale", [1 / 3, 37.7, 1e-9, 1e9])
@pytest.mark.parametrize("start", get_args(Start))
def test_scaled_counts_scale_the_signals(scale: float, start: Start) -> None:
    rows, settings = random_rows(), TrackingParameters(start=start)
    one, other = tracking_signals(rows, settings), tracking_signals(scale * rows, settings)
    np.testing.assert_array_equal(other.position_bin, one.position_bin)
    # As for the twin: rounding through a hundred contracting steps.
    np.testing.assert_allclose(other.enhanced, scale * one.enhanced, rtol=0, atol=scale * 1e-8)


@pytest.mark.compiled
@pytest.mark.parametrize("factor", [0.25, 4.0])  # powers of two, so that not even rounding differs
def test_step_and_speed_are_one_parameter(cube: np.ndarray, factor: float) -> None:
    one = PRESETS["recommended"]
    other = replace(one, h=factor * one.h, l=one.l / factor**2)
    rows = cube[:LANES].astype(float)
    for a, b in zip(tracking_signals(rows, one), tracking_signals(rows, other), strict=True):
        np.testing.assert_array_equal(a, b)
    blocks = to_blocks(cube[:LANES])
    np.testing.assert_array_equal(track(blocks, one), track(blocks, other))


@pytest.mark.compiled
def test_alpha_moves_ranges_with_the_exponential_weight_only(cube: np.ndarray) -> None:
    def positions(preset: str, alpha: float) -> np.ndarray:
        return track(to_blocks(cube), replace(PRESETS[preset], alpha=alpha))[0]

    literal = positions("literal", 1.0)
    for alpha in (0.125, 32.0):  # powers of two, so that ties stay ties
        np.testing.assert_array_equal(positions("literal", alpha), literal)
    later = np.nanmean(positions("recommended", 30.0))
    assert later > np.nanmean(positions("recommended", 0.1))


def test_cubic_weight_of_no_strength_finds_nothing(cube: np.ndarray) -> None:
    settings = TrackingParameters(weight="cubic", alpha=0.0)
    assert np.isnan(track(to_blocks(cube[:LANES]), settings)[0]).all()
    assert np.isnan(tracking_signals(cube[:LANES], settings).position_bin).all()


def test_survival_weight_undoes_the_decay() -> None:
    counts = np.array([500.0, 250.0, 125.0, 0.0])
    weight = tracking_signals(counts, TrackingParameters(weight="survival", t_n=0), 1000).weight
    np.testing.assert_array_equal(weight, [1, 2, 4, 8])


def test_survival_weight_survives_more_detections_than_pulses() -> None:
    rows = random_rows()
    settings = TrackingParameters(weight="survival")
    signals = tracking_signals(rows, settings, n_pulses=100)
    assert np.isfinite(signals.weight).all()
    position, _ = track(to_blocks(rows.astype(np.uint16)), settings, n_pulses=100)
    np.testing.assert_array_equal(position, signals.position_bin)


def test_survival_weight_without_pulses_is_refused() -> None:
    settings = TrackingParameters(weight="survival")
    with pytest.raises(ValueError, match=r"weight = 'survival' needs the number of pulses"):
        tracking_signals(np.ones(10), settings)
    with pytest.raises(ValueError, match=r"weight = 'survival' needs the number of pulses"):
        track(to_blocks(np.ones((1, 10), np.uint16)), settings)


@pytest.mark.uncounted
@any_variant
def test_no_position_lies_before_t_n(variant: Variant) -> None:
    rows = random_rows(n_bins=40)
    rows[:, 3] = 500
    for t_n in (0, 1, 39, 40, 1000):
        settings = settings_of(variant, t_n=t_n)
        position = tracking_signals(rows, settings, N_PULSES).position_bin
        fast, _ = track(to_blocks(rows.astype(np.uint16)), settings, N_PULSES)
        np.testing.assert_array_equal(fast, position)
        if t_n >= 40 or (t_n == 0 and settings.sigma_from == "before T_n"):
            assert np.isnan(position).all()  # no bin is left, or no bin for σ
        else:
            assert (position[np.isfinite(position)] >= t_n).all()


@pytest.mark.uncounted
@any_variant
def test_a_histogram_without_change_has_no_echo(variant: Variant) -> None:
    for n_bins in (1, 2, 40):
        rows = np.repeat([[0], [1], [60_000]], n_bins, axis=1).astype(np.uint16)
        settings = settings_of(variant, t_n=1)
        signals = tracking_signals(rows, settings, N_PULSES)
        assert (signals.sigma == 0).all()
        assert np.isnan(signals.position_bin).all()
        position, score = track(to_blocks(rows), settings, N_PULSES)
        assert np.isnan(position).all()
        assert (score == 0).all()


@pytest.mark.uncounted
@any_variant
def test_gates_of_few_bins_have_defined_positions(variant: Variant) -> None:
    settings = settings_of(
        variant, t_n=0 if settings_of(variant).sigma_from == "gate" else 1, l=0.1
    )
    for n_bins in (1, 2, 3):
        rows = np.array(list(product([0, 1, 1000], repeat=n_bins)), np.uint16)
        position = tracking_signals(rows, settings, N_PULSES).position_bin
        fast, _ = track(to_blocks(rows), settings, N_PULSES)
        np.testing.assert_array_equal(fast, position)
        assert n_bins > 1 or np.isnan(position).all()  # one bin alone has no deviation


NUMBERS = [each.name for each in fields(TrackingParameters) if isinstance(spec_of(each), Number)]
# The smallest of float64, and of float32 with few digits; beyond float32, int32, int64, float64.
EXTREMES = [0, 5e-324, 1e-40, 1e308, math.inf, 2**31, 2**70, 10**400]


@pytest.mark.compiled
@pytest.mark.parametrize("name", NUMBERS)
@pytest.mark.parametrize("value", EXTREMES, ids=lambda value: str(value)[:20])
def test_extreme_settings_are_refused_or_give_valid_positions(
    cube: np.ndarray, name: str, value: float
) -> None:
    rows = cube[:8].copy()
    rows[0], rows[1, 50] = 0, 60_000
    changed: dict[str, Any] = {name: value}
    for weight, start in (("none", "mean"), ("cubic", "zero"), ("exponential", "mean")):
        try:
            settings = TrackingParameters(weight=weight, start=start, **changed)
        except ValueError as error:
            assert f"{name} = " in str(error)
            return
        position, score = track(to_blocks(rows), settings)
        for found in (position, tracking_signals(rows, settings).position_bin):
            assert np.isnan(found[0])  # the empty pixel
            positions = found[~np.isnan(found)]
            assert np.isin(positions, range(settings.t_n, 100)).all()
        assert (np.isfinite(score) & (score >= 0)).all()
        assert ((score > 0) == np.isfinite(position)).all()


def test_signals_keep_the_histograms_shape() -> None:
    rows = random_rows(6, 40).reshape(2, 3, 40)
    signals = tracking_signals(rows, TrackingParameters())
    for name in ("raw", "small", "large", "residual", "weight", "enhanced"):
        assert getattr(signals, name).shape == (2, 3, 40)
    assert signals.sigma.shape == signals.position_bin.shape == (2, 3)
    one = tracking_signals(rows[1, 2].tolist(), TrackingParameters())
    assert one.position_bin.shape == ()
    np.testing.assert_array_equal(one.enhanced, signals.enhanced[1, 2])


@pytest.mark.parametrize("histogram", [5.0, [], np.zeros((3, 0))])
def test_histograms_without_bins_are_refused(histogram: Any) -> None:
    with pytest.raises(ValueError, match=r"histogram = .* is not accepted: give \(\.\.\., bin\)"):
        tracking_signals(histogram, TrackingParameters())
