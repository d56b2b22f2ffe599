"""Properties that hold at every extreme of gate, flux, counts and settings.

``pytest core/tests/test_extremes.py --hypothesis-profile thorough`` tries many more examples.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, note, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture, Detection
from core.estimators import ESTIMATORS, RangeImage, estimate
from core.inference import limits
from core.inference.flux import flux_prior_of
from core.inference.likelihood import Conditions, log_likelihood_ratio
from core.inference.posterior import TOLERANCE_BINS
from core.inference.refinement import FEWEST, SHARP_BINS
from core.parameters import Choice, Number, spec_of
from core.scene import Scene
from core.simulation import simulate
from core.studies.sensitivity.sweep import float32_disagreement
from core.studies.trials import Condition
from core.tracking import CALM_M, PRESETS, TrackingParameters
from core.trigger import coates_rate, no_trigger_probability, rate_per_bin, trigger_probability

pytestmark = [pytest.mark.compiled, pytest.mark.uncounted]

SUBNORMAL = 5e-324
SIGNAL = 0.1041  # the paper's photons per pulse
EPS_32 = float(np.finfo(np.float32).eps)
ROUNDINGS = 16  # float32 operations between a count and a score, about
PHOTONS = (0.0, SUBNORMAL, 1e-12, SIGNAL / 1e6, 1e-3, SIGNAL, 1.0, 30.0, 1e6)
WITHOUT_ORACLE = [name for name in ESTIMATORS if name != "oracle"]


# -- Flux and gates --------------------------------------------------------------------------------


@dataclass(frozen=True)
class FluxCase:
    """A gate with bins of 1 ns and its flux."""

    n_bins: int
    n_pulses: int
    tau_bins: float
    signal: float
    background: float

    @property
    def acquisition(self) -> Acquisition:
        return Acquisition(self.n_bins, n_pulses=self.n_pulses)

    @property
    def pulse(self) -> Pulse:
        return Pulse(self.tau_bins * self.acquisition.bin_width_s)

    @property
    def model(self) -> tuple[float, float, Pulse, Acquisition]:
        """Signal, background, pulse and gate, as functions of `core.limits` take them."""
        return self.signal, self.background, self.pulse, self.acquisition

    @property
    def rate(self) -> Floats:
        """Rate of each onset in each bin, shape (onset, bin)."""
        at = onsets(self.n_bins)
        return rate_per_bin(at, np.full(at.size, self.signal), *self.model[1:])

    def capture(self) -> Capture:
        """Simulate one pixel for each onset, and one without a target."""
        onset = np.append(onsets(self.n_bins), np.nan).reshape(3, -1)
        sbr = self.signal / self.background if self.background else np.inf
        # A flux without signal has no background: there the scene reflects nothing.
        flux = Flux(self.signal, sbr) if sbr > 0 else Flux(self.background, 1.0)
        reflectivity = np.full(onset.shape, 1.0 if sbr > 0 else 0.0)
        scene = Scene(self.acquisition.bin_to_range_m(onset), reflectivity)
        return simulate(scene, self.acquisition, flux, self.pulse)


def onsets(n_bins: int) -> Floats:
    """Delays before, at, after and between the edges of a gate, shape (11,)."""
    edges = [-1e6, -1.0, -1e-9, 0.0, 1e-9, n_bins - 1e-9, n_bins, n_bins + 1.0, n_bins + 1e6]
    return np.array([*edges, 0.5, n_bins / 2])


def fluxes(n_bins: tuple[int, ...] = (1, 2, 100, 4096)) -> st.SearchStrategy[FluxCase]:
    return st.builds(
        FluxCase,
        st.sampled_from(n_bins),
        st.sampled_from((1, 1000, 10**9)),
        st.sampled_from((1e-3, 1.0, 1e3)),
        st.sampled_from(PHOTONS),
        st.sampled_from((*PHOTONS, SIGNAL / 0.06, SIGNAL / 1e-6)),
    )


@given(fluxes())
def test_trigger_probabilities_sum_to_one_and_keep_their_digits(case: FluxCase) -> None:
    rate = case.rate
    probability = trigger_probability(rate)
    assert ((probability >= 0) & (probability <= 1)).all()
    total = probability.sum(axis=-1) + no_trigger_probability(rate)
    np.testing.assert_allclose(total, 1.0, atol=1e-12)
    before = np.cumsum(np.pad(rate[:, :-1], ((0, 0), (1, 0))), axis=-1)
    with np.errstate(divide="ignore"):
        expected = np.log(-np.expm1(-rate)) - before
        found = np.log(probability)
    normal = expected > math.log(np.finfo(float).tiny)
    off = np.abs(found[normal] - expected[normal]) / np.maximum(1.0, np.abs(expected[normal]))
    assert off.max(initial=0.0) <= 1e-12
    assert (found[expected < math.log(SUBNORMAL) - 1] == -np.inf).all()


@given(fluxes())
def test_simulated_counts_are_possible(case: FluxCase) -> None:
    capture = case.capture()
    onset = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    rate = rate_per_bin(onset, np.asarray(capture.signal), *case.model[1:])
    assert (capture.counts <= case.n_pulses).all()
    assert (capture.cube[trigger_probability(rate) == 0] == 0).all()


@given(fluxes((1, 2, 100)))
def test_coates_rates_reproduce_simulated_counts(case: FluxCase) -> None:
    assert_coates_reproduces(case.capture())


def assert_coates_reproduces(capture: Capture) -> None:
    sent = int(capture.gated_pulses or 0)
    rate = np.nan_to_num(coates_rate(capture.cube, sent), nan=0.0, posinf=np.inf)
    off = np.abs(trigger_probability(rate) * sent - capture.cube)
    assert (off <= 1e-9 * np.maximum(capture.cube, 1)).all()


@given(fluxes((1, 2, 100)))
def test_limits_are_defined_and_background_never_lowers_the_bound(case: FluxCase) -> None:
    onset = onsets(case.n_bins)
    right = limits.right_bin_probability(onset, *case.model)
    assert ((right >= 0) & (right <= 1)).all()
    if case.n_pulses == 1:
        exposure = limits.best_exposure(onset, *case.model)
        assert ((exposure > 0) & (exposure <= 1)).all()
    before = np.zeros(11)
    for background in PHOTONS:
        model = replace(case, background=background).model
        bound = limits.cramer_rao_bins(onset, *model)
        assert ((bound >= before) | (bound >= before * (1 - 1e-9))).all(), background
        before = bound


# -- Histograms and settings -----------------------------------------------------------------------


@dataclass(frozen=True)
class Histograms:
    """Named histograms of a few pixels."""

    name: str
    cube: NDArray[np.unsignedinteger]
    n_pulses: int | None
    detection: Detection

    def __repr__(self) -> str:
        return f"{self.name}, {self.cube.shape[2]} bins"

    @property
    def capture(self) -> Capture:
        """The histograms as a capture with a known flux, for the oracle."""
        return Capture(
            self.cube.copy(),
            Acquisition(self.cube.shape[2], n_pulses=self.n_pulses),
            signal=np.full(self.cube.shape[:2], SIGNAL),
            background=SIGNAL / 0.06,
            detection=self.detection,
        )


def histograms_of(n_bins: int) -> Iterator[Histograms]:
    """Constant, one-hot, alternating, saturated and empty ones, and those next to an overflow."""
    shape = (2, 3, n_bins)
    places = np.array([0, 1, n_bins // 3, n_bins // 2, n_bins - 2, n_bins - 1]) % n_bins
    one_hot = np.eye(n_bins)[places].reshape(shape)
    noise = np.random.default_rng(0).poisson(3, shape)
    first: dict[str, Any] = {
        "empty": np.zeros(shape),
        "constant": np.full(shape, 7),
        "alternating": np.where(np.arange(n_bins) % 2, 0, 9) * np.ones(shape),
        "one photon": one_hot,
        "every pulse in one bin": 1000 * one_hot,
        "noise": noise,
    }
    for name, cube in first.items():
        yield Histograms(name, cube.astype(np.uint16), 1000, "first")
    for dtype in (np.uint8, np.uint16, np.uint32):
        full = np.full(shape, np.iinfo(dtype).max, dtype)
        yield Histograms(f"full {np.dtype(dtype)} counters", full, None, "all")
    for top in (254, 255, 256, 65534, 65535, 65536, 65537):
        cube = np.where(one_hot > 0, top, noise).astype(np.min_scalar_type(top))
        yield Histograms(f"{top} counts in a bin", cube, None, "all")


HISTOGRAMS = [each for n_bins in (1, 2, 100) for each in histograms_of(n_bins)]


def settings_of(method: str) -> Iterator[Any]:
    """The default settings of an estimator, and each setting at each of its extremes."""
    kind = ESTIMATORS[method].parameters
    yield kind()
    for field in fields(kind):
        for value in extremes(spec_of(field)):
            yield kind(**{field.name: value})


def extremes(spec: Number | Choice) -> list[Any]:
    if isinstance(spec, Choice):
        return list(spec.options)
    numbers = (0.0, SUBNORMAL, 1e-300, 1e-12, 1e-3, 1.0, 1e3, 1e6, 1e9)
    # T_n in, at and after the last bin of a gate.
    edges = (0, 1, 2, 3, 99, 100, 101)
    tried = {spec.least, spec.low, spec.high, spec.most, *numbers, *map(float, edges)}
    values = {int(x) if spec.whole else x for x in tried if spec.takes(int(x) if spec.whole else x)}
    return sorted(values)


SETTINGS = [(method, each) for method in ESTIMATORS for each in settings_of(method)]


@pytest.mark.parametrize("counts", HISTOGRAMS, ids=repr)
def test_the_likelihood_is_finite(counts: Histograms) -> None:
    gate, fluxes = Acquisition(counts.cube.shape[2]), np.array(list(product(PHOTONS, PHOTONS)))
    for pixel in counts.cube.reshape(-1, gate.n_bins).astype(float):
        conditions = Conditions(gate, Pulse(), counts.n_pulses, *fluxes.T, 1.0)
        ratio = log_likelihood_ratio(np.tile(pixel, (len(fluxes), 1)), conditions)
        assert fluxes[~np.isfinite(ratio).all(axis=1)].tolist() == []


@pytest.mark.parametrize("counts", [h for h in HISTOGRAMS if h.detection == "first"], ids=repr)
def test_coates_rates_reproduce_extreme_counts(counts: Histograms) -> None:
    assert_coates_reproduces(counts.capture)


def assert_valid(capture: Capture, image: RangeImage) -> None:
    """Every estimate lies in the gate and is finite; every other pixel is NaN and not valid."""
    valid = image.valid
    assert ((image.bin >= 0) & (image.bin <= capture.acquisition.n_bins))[valid].all()
    assert np.isfinite(image.range_m[valid]).all()
    assert np.isnan(image.bin[~valid]).all()
    assert np.isnan(image.range_m[~valid]).all()
    assert np.isfinite(image.score).all()
    assert ((image.confidence >= 0) & (image.confidence <= valid)).all()
    assert image.made_by is not None
    assert ESTIMATORS[image.made_by.method].fills or (capture.counts[valid] > 0).all()


@settings(max_examples=30)
@given(fluxes((1, 2, 100)) | st.just(FluxCase(4096, 10**9, 1.0, SIGNAL, SIGNAL / 0.06)))
def test_estimates_are_valid_under_any_flux(case: FluxCase) -> None:
    capture = case.capture()
    for method in ESTIMATORS:
        note(f"method = {method}")
        assert_valid(capture, estimate(capture, method))


@given(st.sampled_from(SETTINGS), st.sampled_from(HISTOGRAMS))
def test_estimates_are_valid_with_any_settings(chosen: tuple[str, Any], counts: Histograms) -> None:
    method, parameters = chosen
    # This weight needs the number of pulses.
    assume(getattr(parameters, "weight", None) != "survival" or counts.n_pulses is not None)
    assert_valid(counts.capture, estimate(counts.capture, method, parameters))


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_infinite_numbers_are_refused_by_name(value: float) -> None:
    built: list[tuple[str, Any]] = [
        ("bin_width_s", lambda: Acquisition(bin_width_s=value)),
        ("gate_delay_s", lambda: Acquisition(gate_delay_s=value)),
        ("tau_s", lambda: Pulse(value)),
        ("signal", lambda: Flux(value)),
        ("signal", lambda: limits.cramer_rao_bins(1.0, value, 1.0, Pulse(), Acquisition())),
        ("background", lambda: limits.cramer_rao_bins(1.0, 1.0, value, Pulse(), Acquisition())),
    ]
    for each in ESTIMATORS.values():
        names = [field.name for field in fields(each.parameters)]
        built += [(n, lambda each=each, n=n: each.parameters(**{n: value})) for n in names]
    for name, build in built:
        with pytest.raises(ValueError, match=rf"{name}.* is not accepted: give"):
            build()


# -- Invariance ------------------------------------------------------------------------------------


def echoes(sbr: float = 0.06, rows: int = 16, cols: int = 64) -> Capture:
    """Echoes at depths all over the gate."""
    whole = Condition("uniform", sbr).capture(0)
    return replace(
        whole,
        cube=whole.cube[:rows, :cols].copy(),
        truth_range_m=np.asarray(whole.truth_range_m)[:rows, :cols],
        signal=np.asarray(whole.signal)[:rows, :cols],
    )


@pytest.mark.parametrize("method", ESTIMATORS)
@pytest.mark.parametrize("sbr", [0.1, 1.0])  # some methods find nothing at the lower one
def test_more_photons_in_an_echo_never_move_the_estimate_away(method: str, sbr: float) -> None:
    acquisition, onset = Acquisition(), 53.6
    plane = Scene(np.full((8, 8), float(acquisition.bin_to_range_m(onset))))
    capture = simulate(plane, acquisition, Flux(SIGNAL, sbr), seed=4)
    before = estimate(capture, method)
    right = np.abs(before.bin - onset) <= TOLERANCE_BINS
    for added in (1, 3, 10, 30, 100):
        cube = capture.cube.copy()
        cube[:, :, int(onset) + 1] += np.minimum(added, 1000 - capture.counts).astype(cube.dtype)
        after = estimate(replace(capture, cube=cube, flux_prior=flux_prior_of(capture)), method)
        assert (np.abs(after.bin - onset)[right] <= TOLERANCE_BINS).all(), added
        assert (after.confidence >= before.confidence - 1e-3)[right].all(), added


@pytest.mark.parametrize("method", ["likelihood", "coates", "tracking"])
def test_confidence_does_not_exceed_the_share_of_right_estimates(method: str) -> None:
    # At the last six the background triggers nearly every pulse.
    for sbr in (1e6, 1.0, 0.06, 0.02, 0.015, 0.01, 0.003, 1e-4, 1e-6):
        capture = echoes(sbr, rows=32)
        truth = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
        image = estimate(capture, method)
        right = np.abs(image.bin - truth)[image.valid] <= TOLERANCE_BINS
        confidence = image.confidence[image.valid]
        assert confidence.size == 0 or float((confidence - right).mean()) <= 0.05, sbr


# -- Precision -------------------------------------------------------------------------------------


@pytest.mark.parametrize("sbr", [0.06, 10.0])
@pytest.mark.parametrize("preset", PRESETS)
def test_float32_tracking_differs_by_rounding_only(preset: str, sbr: float) -> None:
    rows, default = echoes(sbr, rows=4).cube.reshape(-1, 100), TrackingParameters()
    for chosen in settings_of("tracking"):
        changed = {n: v for n, v in vars(chosen).items() if v != getattr(default, n)}
        mixed = replace(PRESETS[preset], **changed)
        if mixed.m >= CALM_M:
            share, roundings = float32_disagreement(rows, mixed, 1000)
            assert share <= 1e-3, changed
            assert roundings <= 1, changed


@pytest.mark.parametrize("n_pulses", [1, 1000, 10**9])
@pytest.mark.parametrize("sbr", [1e-6, 1e-3, 0.06, 1.0, 1e3, 1e6])
def test_no_delay_is_likelier_in_float64_than_the_one_found_in_float32(
    n_pulses: int, sbr: float
) -> None:
    steps = 2
    case = FluxCase(100, n_pulses, 1.0, SIGNAL, SIGNAL / sbr)
    capture = case.capture()
    delay = (np.arange(100 * steps) + 0.5) / steps
    rate = rate_per_bin(delay, np.full(delay.size, SIGNAL), *case.model[1:])
    armed = n_pulses - np.cumsum(capture.cube, axis=2, dtype=np.int64)
    log = capture.cube @ np.log(-np.expm1(-rate)).T - armed @ rate.T
    flat = np.log(-np.expm1(-case.background / 100))
    size = np.abs(capture.cube * flat).sum(axis=2) + armed[..., -1] * (SIGNAL + case.background)
    found = estimate(capture, "oracle", steps_per_bin=steps)
    place = np.nan_to_num(found.bin) * steps
    # Interpolation may lead to the edge of a step: both sides are possible.
    at = np.stack([np.floor(place), np.ceil(place) - 1], axis=2).astype(np.intp)
    there = np.take_along_axis(log, np.clip(at, 0, delay.size - 1), axis=2).max(axis=2)
    # Echoes of fewer photons than these are not searched in finer steps.
    fewest = FEWEST * (case.pulse.sigma_s / case.acquisition.bin_width_s / SHARP_BINS) ** 2
    may_be_fine = capture.counts >= fewest
    assert may_be_fine.any() == (n_pulses > 1)
    fine = rate_per_bin(found.bin, np.full(found.bin.shape, SIGNAL), *case.model[1:])
    between = (capture.cube * np.log(-np.expm1(-fine)) - armed * fine).sum(axis=2)
    there = np.where(may_be_fine, np.fmax(there, between), there)
    lost = np.where(found.valid, log.max(axis=2) - there, 0.0)
    assert (lost <= np.maximum(ROUNDINGS * EPS_32 * size, 0.0)).all()
