"""One contract for every registered estimator: a new one is covered by being registered."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy import stats

from core.acquisition import Acquisition, Flux, Pulse
from core.capture import Capture
from core.estimators import ESTIMATORS, RangeImage, estimate
from core.inference.flux import flux_prior_of
from core.io.readers.dense import guess_detection
from core.scene import Scene, uniform
from core.simulation import simulate
from core.tracking import PRESETS, TrackingParameters
from core.trigger import rate_per_bin, trigger_probability

SIZE = 48  # rows and columns where many pixels are wanted

# Every estimator as it comes, and the tracker also as the paper prints it.
CASES = {name: (name, estimator.parameters()) for name, estimator in ESTIMATORS.items()}
# With the l of the preset, the lag of a long pulse varies with the depth by more than half a bin.
CASES["tracking, literal"] = ("tracking", replace(PRESETS["literal"], l=0.001))

every_case = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
every_estimator = pytest.mark.parametrize("method", ESTIMATORS)
# Methods that use single pixels; methods that are invariant to a factor on all counts.
single_pixel = pytest.mark.parametrize(
    "method",
    [name for name in ESTIMATORS if name not in ("kde", "chi", "unmixing", "image_posterior")],
)
scale_free = pytest.mark.parametrize(
    "case",
    [("tracking", TrackingParameters(refine="none")), ("peak", None), ("matched_filter", None)],
    ids=lambda case: case[0],
)


# A capture keeps what was estimated of it, such as its flux model: all cases share one.


@cache
def simulated(size: int = 8, n_pulses: int = 1000, sbr: float = 0.06, **more: Any) -> Capture:
    scene = uniform(64)
    range_m = scene.range_m[:size, :size].copy()
    range_m[0, 0] = np.nan
    return simulate(Scene(range_m), Acquisition(n_pulses=n_pulses), Flux(sbr=sbr), **more)


def capture_of(cube: Any, n_pulses: int | None = 1000, dtype: type = np.uint16) -> Capture:
    """Return a capture with true fluxes, which the oracle needs."""
    cube = np.array(cube, dtype)
    return Capture(
        cube,
        Acquisition(n_bins=cube.shape[2], n_pulses=n_pulses),
        signal=np.full(cube.shape[:2], 0.1041),
        background=1.735,
        detection=guess_detection(cube, n_pulses),
    )


def assert_contract(capture: Capture, image: RangeImage) -> None:
    for field in (image.range_m, image.bin, image.score, image.confidence):
        assert field.shape == capture.shape
        assert field.dtype == np.float64
    assert image.valid.shape == capture.shape
    assert image.valid.dtype == np.bool_
    for field in (image.range_m, image.bin):
        np.testing.assert_array_equal(np.isnan(field), ~image.valid)
    assert np.isfinite(image.score).all()
    assert ((image.confidence >= 0) & (image.confidence <= 1)).all()
    assert (image.confidence[~image.valid] == 0).all()
    found = image.bin[image.valid]
    assert ((found >= 0) & (found <= capture.acquisition.n_bins)).all()
    np.testing.assert_array_equal(image.range_m, capture.acquisition.bin_to_range_m(image.bin))


@contextmanager
def naming(name: str) -> Iterator[None]:
    """Add the name of a capture to an error."""
    try:
        yield
    except Exception as error:
        error.add_note(f"capture: {name}")
        raise


def one_hot(n_bins: int, count: int) -> np.ndarray:
    return np.eye(n_bins)[np.newaxis] * count


CAPTURES: dict[str, Callable[[], Capture]] = {
    "simulated": simulated,
    "one pixel": lambda: capture_of(simulated().cube[3:4, 3:4]),
    "empty": lambda: capture_of(np.zeros((3, 4, 100))),
    "constant": lambda: capture_of(np.full((3, 4, 100), 9)),
    "one photon in each bin": lambda: capture_of(one_hot(100, 1)),
    "every pulse in one bin": lambda: capture_of(one_hot(100, 1000)),
    "full counters": lambda: capture_of(np.full((3, 4, 100), 2**16 - 1)),
    "full narrow counters": lambda: capture_of(np.full((3, 4, 100), 2**8 - 1), dtype=np.uint8),
    "full wide counters": lambda: capture_of(np.full((3, 4, 100), 2**32 - 1), dtype=np.uint32),
    "one bin": lambda: capture_of(np.arange(12).reshape(3, 4, 1)),
    "one bin, every pulse": lambda: capture_of(np.full((3, 4, 1), 1000)),
    "two bins": lambda: capture_of(np.arange(24).reshape(3, 4, 2)),
    "three bins": lambda: capture_of(np.arange(36).reshape(3, 4, 3)),
    "pulses unknown": lambda: capture_of(simulated().cube, n_pulses=None),
    "pulses unknown, one bin": lambda: capture_of(np.arange(12).reshape(3, 4, 1), n_pulses=None),
    "several photons a pulse": lambda: capture_of(simulated().cube, n_pulses=10),
    "one pulse": lambda: capture_of(one_hot(100, 1), n_pulses=1),
    "no background": lambda: simulated(sbr=np.inf),
    "a photon in two pixels": lambda: simulated(n_pulses=1),
    "wide counts": lambda: capture_of(simulated().cube, dtype=np.uint32),
}


@cache
def named(name: str) -> Capture:
    return CAPTURES[name]()


@pytest.mark.uncounted
@every_case
def test_estimates_keep_the_contract(case: tuple[str, Any]) -> None:
    for name in CAPTURES:
        capture = named(name)
        before = capture.cube.copy()
        with naming(name):
            assert_contract(capture, estimate(capture, *case))
        np.testing.assert_array_equal(capture.cube, before)


@cache
def with_an_empty_row() -> Capture:
    cube = simulated().cube.copy()
    cube[2] = 0
    return capture_of(cube)


@every_case
def test_a_pixel_without_photons_gets_no_estimate(case: tuple[str, Any]) -> None:
    method, settings = case
    if ESTIMATORS[method].fills:
        settings = replace(settings, pixels="allow empty pixels")
    image = estimate(with_an_empty_row(), method, settings)
    assert not image.valid[2].any()
    assert image.valid.any()


PULSES = {
    "gamma": Pulse(1e-9),
    "long gaussian": Pulse.gaussian(3e-9),
    "measured": Pulse.measured([0, 0, 1, 4, 6, 4, 3, 2, 1, 0.5], 0.5e-9),
}


def strong(onset_bin: np.ndarray, pulse: Pulse = Pulse()) -> Capture:
    acquisition = Acquisition(n_pulses=1000)
    scene = Scene(acquisition.bin_to_range_m(onset_bin))
    return simulate(scene, acquisition, Flux(0.5, 5.0), pulse)


@cache
def tiles(pulse: Pulse) -> Capture:
    """Return tiles at depths of their own: what looks at neighbours sees some that agree."""
    depths = np.random.default_rng(0).uniform(25, 85, (SIZE // 4, SIZE // 4))
    return strong(np.kron(depths, np.ones((4, 4))), pulse)


@cache
def strips() -> Capture:
    """Return strips five rows wide: what looks at neighbours sees some that agree."""
    return strong(np.repeat(np.linspace(25, 85, 13), 5 * 16).reshape(65, 16))


def errors(capture: Capture, *case: Any) -> np.ndarray:
    """Errors of the delays, in bins."""
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    return estimate(capture, *case).bin - truth_bin


@every_case
@pytest.mark.parametrize("pulse", PULSES.values(), ids=PULSES)
def test_strong_echoes_are_ranged_without_lag(pulse: Pulse, case: tuple[str, Any]) -> None:
    capture = tiles(pulse)
    error = errors(capture, *case)
    assert abs(np.median(error)) < 0.5
    # What is left spreads by rounding to whole bins and by the pulse's own length.
    assert (np.abs(error) < 1 + capture.echo_bins).mean() > 0.95


@every_estimator
def test_depths_do_not_bias_a_strong_echo(method: str) -> None:
    error = errors(strips(), method)
    # Whole bins: an onset on a bin's edge may fall to either side of it.
    assert (np.abs(np.median(error.reshape(13, -1), axis=1)) <= 1).all()


@cache
def lone_echo(**acquisition: Any) -> Capture:
    """Return four pixels with the same echo and no background."""
    setting = Acquisition(n_pulses=1000, **acquisition)
    pulse = Pulse(setting.bin_width_s)
    rate = rate_per_bin(np.full((2, 2), 40.3), np.full((2, 2), 0.4), 0.0, pulse, setting)
    counts = np.rint(trigger_probability(rate) * 1000).astype(np.uint16)
    return Capture(counts, setting, pulse, signal=np.full((2, 2), 0.4), background=0.0)


@cache
def later_echo(bins: int) -> Capture:
    capture = lone_echo()
    # The flux decides on the lag.
    cube, known = np.roll(capture.cube, bins, axis=2), flux_prior_of(capture)
    return replace(capture, cube=cube, flux_prior=known)


@every_estimator
def test_a_later_echo_gives_a_later_estimate(method: str) -> None:
    near = estimate(lone_echo(), method)
    assert near.valid.all()
    for later in (1, 7, 33):
        far = estimate(later_echo(later), method)
        # Rounding, once of bins near a hundred in float64 and once of densities in float32.
        np.testing.assert_allclose(far.bin - near.bin, later, rtol=0, atol=1e-4)
        if method in ("peak", "matched_filter", "cfar", "shi"):  # other scores depend on the delay
            np.testing.assert_allclose(far.score, near.score, rtol=1e-5)


@scale_free
def test_counts_and_pulses_have_no_unit(case: tuple[str, Any]) -> None:
    one = simulated()
    four = capture_of(4 * one.cube, n_pulses=4000)  # a power of two, so that ties stay ties
    np.testing.assert_array_equal(estimate(four, *case).bin, estimate(one, *case).bin)


@every_case
def test_time_has_no_unit(case: tuple[str, Any]) -> None:
    one = lone_echo()
    two = lone_echo(bin_width_s=2e-9, gate_delay_s=560e-9)  # exactly doubled
    np.testing.assert_array_equal(two.cube, one.cube)
    near, far = estimate(one, *case), estimate(two, *case)
    np.testing.assert_array_equal(far.bin, near.bin)
    np.testing.assert_array_equal(far.confidence, near.confidence)
    np.testing.assert_array_equal(far.range_m, 2 * near.range_m)


def assert_same(found: RangeImage, expected: RangeImage) -> None:
    for field in ("range_m", "bin", "score", "confidence", "valid"):
        np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))


@every_case
def test_estimates_do_not_depend_on_threads(
    monkeypatch: pytest.MonkeyPatch, case: tuple[str, Any]
) -> None:
    capture = simulated(size=14)
    serial = estimate(capture, *case)  # so small an image takes one thread
    monkeypatch.setattr("core.kernels.parallel.SERIAL_BELOW", 0)
    assert_same(estimate(capture, *case), serial)


ORDER = np.random.default_rng(1).permutation(14 * 14)


@cache
def ordered_and_shuffled() -> tuple[Capture, Capture]:
    """Return the same pixels in two orders, with the same true fluxes in all of them."""
    cube = simulated(size=14).cube
    return capture_of(cube), capture_of(cube.reshape(1, 196, 100)[:, ORDER])


@single_pixel
def test_pixels_are_ranged_one_by_one(method: str) -> None:
    expected, found = (estimate(each, method) for each in ordered_and_shuffled())
    for field in ("range_m", "bin", "score", "confidence", "valid"):
        # The flux model is a mean over all pixels, whose rounding depends on their order.
        np.testing.assert_allclose(
            getattr(found, field)[0], getattr(expected, field).ravel()[ORDER], rtol=0, atol=1e-3
        )


@cache
def of_many_counts(dtype: type) -> Capture:
    """Return a capture whose sums exceed what a narrow count can hold."""
    return capture_of(np.minimum(4 * simulated().cube, 255), 4000, dtype)


@every_case
def test_narrow_counts_are_ranged_like_wide_ones(case: tuple[str, Any]) -> None:
    assert_same(*(estimate(of_many_counts(each), *case) for each in (np.uint8, np.uint32)))


@cache
def sky(tau_s: float, sbr: float) -> Capture:
    """Return an image without targets, shared by all cases."""
    scene = Scene(np.full((2 * SIZE, 2 * SIZE), np.nan))
    return simulate(scene, Acquisition(), Flux(sbr=sbr), Pulse(tau_s), seed=3)


@every_case
@pytest.mark.parametrize(("tau_s", "sbr"), [(1e-9, 0.03), (3e-9, 0.2)])
def test_noise_seldom_earns_confidence(tau_s: float, sbr: float, case: tuple[str, Any]) -> None:
    image = estimate(sky(tau_s, sbr), *case)
    # Nine tenths of confidence is one false alarm in ten at most, and by chance a few more.
    alarms = np.count_nonzero(image.confidence > 0.9)
    assert alarms <= stats.binom.ppf(1 - 1e-4, image.confidence.size, 0.1)


@cache
def plane() -> Capture:
    """Return a plane, so that neighbours may help, with one pixel without a target."""
    range_m = np.full((8, 8), 49.6)
    range_m[0, 0] = np.nan
    return simulate(Scene(range_m), Acquisition(n_pulses=1000), Flux(sbr=0.5))


@every_case
def test_strong_echoes_earn_confidence(case: tuple[str, Any]) -> None:
    capture = plane()
    image = estimate(capture, *case)
    right = np.abs(image.range_m - capture.truth_range_m) < 3 * capture.acquisition.bin_length_m
    # 104 detections over a background of 8: no doubt is left, neither of right nor of wrong.
    assert right.sum() > 32
    assert (image.confidence[right] > 0.99).mean() > 0.95
    assert (image.confidence[~right] < 0.1).mean() > 0.95  # pixel (0, 0) has no target


def test_no_lag_is_known_where_no_echo_can_be_found() -> None:
    blind = TrackingParameters(t_n=1000)
    capture = simulated()
    assert ESTIMATORS["tracking"].lag_bins(capture, blind) == 0
    assert not estimate(capture, "tracking", blind).valid.any()


def test_peak_is_the_first_of_the_largest_bins() -> None:
    cube = np.zeros((1, 2, 50))
    cube[0, 0, [20, 30]] = 7
    cube[0, 1, 10] = 3
    capture = capture_of(cube)
    lag = ESTIMATORS["peak"].lag_bins(capture, ESTIMATORS["peak"].parameters())
    np.testing.assert_allclose(estimate(capture, "peak").bin + lag, [[20, 10]], rtol=1e-15)
    np.testing.assert_array_equal(estimate(capture, "peak").score, [[7, 3]])


def test_settings_may_be_given_field_by_field() -> None:
    capture = simulated()
    assert_same(
        estimate(capture, "tracking", m=2.0, t_n=30),
        estimate(capture, "tracking", TrackingParameters(m=2.0, t_n=30)),
    )


@pytest.mark.parametrize(
    ("arguments", "fields", "words"),
    [
        (("sonar",), {}, r"method = 'sonar' .*'tracking' or "),
        (("peak",), {"width": 3}, r"width = 3 .*one of \[\]"),
        (("tracking",), {"M": 3}, r"M = 3 .*'l', 'n', 'h', 'm'"),
        (("tracking",), {"m": -1.0}, r"m = -1\.0 "),
        (("tracking", "literal"), {}, r"settings = 'literal' .*TrackingParameters"),
        (("tracking", TrackingParameters()), {"m": 2.0}, r"settings = .*or single fields"),
        (("tracking",), {"weight": "survival"}, r"weight = 'survival' needs the number of pulses"),
    ],
)
def test_wrong_arguments_are_refused(
    arguments: tuple[Any, ...], fields: dict[str, Any], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        estimate(capture_of(simulated().cube, n_pulses=None), *arguments, **fields)


def test_the_oracle_needs_true_fluxes() -> None:
    capture = replace(simulated(), background=None)
    with pytest.raises(ValueError, match=r"method = 'oracle' needs the true .*take 'likelihood'"):
        estimate(capture, "oracle")
