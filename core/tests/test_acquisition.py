"""Tests of the conversion of bins, of pulses and of fluxes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.constants import speed_of_light
from scipy.integrate import quad
from scipy.special import ndtr

from core.acquisition import Acquisition, Flux, Pulse

BIN_S = 1e-9
SAMPLES = (0.0, 1.0, 4.0, 6.0, 3.0, 0.5)
PULSES = {
    "gamma": Pulse(1e-9),
    "long gamma": Pulse(4e-9),
    "gaussian": Pulse.gaussian(0.8e-9),
    "measured": Pulse.measured(SAMPLES, 0.5e-9),
}
any_pulse = pytest.mark.parametrize("pulse", PULSES.values(), ids=PULSES)


def density(pulse: Pulse, time_s: float) -> float:
    """Photons per second `time_s` after the pulse's time zero."""
    t = time_s / pulse.tau_s
    if pulse.shape == "gamma":
        return t * math.exp(-t) / pulse.tau_s if t > 0 else 0.0
    if pulse.shape == "gaussian":
        return math.exp(-t * t / 2) / math.sqrt(2 * math.pi) / pulse.tau_s
    inside = 0 <= t < len(pulse.samples)
    return pulse.samples[int(t)] / sum(pulse.samples) / pulse.tau_s if inside else 0.0


def test_bins_become_metres_at_half_the_speed_of_light() -> None:
    acquisition = Acquisition(n_bins=10, bin_width_s=2e-9, gate_delay_s=100e-9)
    expected_m = [(100e-9 + k * 2e-9) * speed_of_light / 2 for k in (0, 1, 7.5, 10)]
    # Three roundings, of a relative 1.1e-16 each.
    np.testing.assert_allclose(acquisition.bin_to_range_m([0, 1, 7.5, 10]), expected_m, rtol=1e-15)
    assert acquisition.bin_length_m == pytest.approx(2e-9 * speed_of_light / 2, rel=1e-15)


@given(st.floats(-1e4, 1e4, allow_subnormal=False), st.floats(1e-12, 1e-6), st.floats(-1e-3, 1e-3))
def test_bins_survive_conversion_to_metres_and_back(
    position: float, width_s: float, delay_s: float
) -> None:
    acquisition = Acquisition(bin_width_s=width_s, gate_delay_s=delay_s)
    back = acquisition.range_m_to_bin(acquisition.bin_to_range_m(position))
    # Four roundings of the time since the pulse, gate delay included, seen in bins.
    tolerance = 4 * np.finfo(float).eps * (abs(position) + abs(delay_s) / width_s)
    assert abs(back - position) <= tolerance


def test_shape_and_nan_survive_conversion() -> None:
    bins = np.array([[0.0, np.nan], [2.0, 3.0]])
    acquisition = Acquisition()
    np.testing.assert_array_equal(np.isnan(acquisition.bin_to_range_m(bins)), np.isnan(bins))
    np.testing.assert_array_equal(np.isnan(acquisition.range_m_to_bin(bins)), np.isnan(bins))


@any_pulse
@pytest.mark.parametrize("onset_bin", [20.0, 20.37, -1.6, 38.9])
def test_bin_probability_is_the_pulse_integrated_over_the_bin(
    pulse: Pulse, onset_bin: float
) -> None:
    corners = [i * pulse.tau_s for i in range(len(SAMPLES) + 1)]  # where a measured pulse jumps
    expected = []
    for k in range(40):
        begin_s, end_s = (k - onset_bin) * BIN_S, (k + 1 - onset_bin) * BIN_S
        inside = [corner for corner in corners if begin_s < corner < end_s] or None
        expected.append(
            quad(lambda t: density(pulse, t), begin_s, end_s, points=inside, epsabs=1e-12)[0]
        )
    # Tenfold the quadrature's own bound.
    np.testing.assert_allclose(
        pulse.bin_probability(onset_bin, 40, BIN_S), expected, rtol=0, atol=1e-11
    )


@any_pulse
@given(st.floats(-1e3, 1e3), st.integers(1, 60), st.floats(1e-11, 1e-7))
def test_shares_are_probabilities(
    pulse: Pulse, onset_bin: float, n_bins: int, bin_s: float
) -> None:
    share = pulse.bin_probability(onset_bin, n_bins, bin_s)
    assert share.shape == (n_bins,)
    assert (share >= 0).all()
    assert share.sum() <= 1 + 1e-12


@any_pulse
def test_no_echo_leaves_nothing(pulse: Pulse) -> None:
    assert (pulse.bin_probability([np.nan, np.nan], 30, BIN_S) == 0).all()


def test_papers_pulse_peaks_at_tau_and_is_as_wide_as_stated() -> None:
    share = Pulse(1e-9).bin_probability(0.0, 6000, 1e-12)
    assert abs(share.argmax() - 1000) <= 1
    above = np.flatnonzero(share >= share.max() / 2)
    # Each of the two ends is known to a bin of .001.
    assert (above[-1] - above[0]) / 1000 == pytest.approx(2.446, abs=0.002)


@any_pulse
@pytest.mark.parametrize("share", [1e-3, 0.1, 0.5, 0.84, 1 - 1e-3])
def test_quantiles_are_when_a_share_has_arrived(pulse: Pulse, share: float) -> None:
    # Quantiles are solved for to 2e-12 of a time constant, in which a pulse changes by less.
    assert pulse.cdf(pulse.quantile_s(share)) == pytest.approx(share, rel=0, abs=1e-11)
    assert pulse.span_s == (pulse.quantile_s(0.1), pulse.quantile_s(0.9))


@any_pulse
def test_the_standard_deviation_is_that_of_the_photons(pulse: Pulse) -> None:
    times_s = np.linspace(pulse.quantile_s(1e-9), pulse.quantile_s(1 - 1e-9), 10_001)
    share, middle_s = np.diff(pulse.cdf(times_s)), (times_s[1:] + times_s[:-1]) / 2
    mean_s = share @ middle_s
    assert pulse.sigma_s == pytest.approx(
        np.sqrt(share @ (middle_s - mean_s) ** 2), rel=1e-6, abs=0
    )


def test_quantiles_know_where_time_zero_lies() -> None:
    gaussian = Pulse.gaussian(1.3e-9)
    assert gaussian.quantile_s(0.5) == pytest.approx(0, abs=1e-20)
    assert gaussian.quantile_s(ndtr(-2.5)) == pytest.approx(-2.5 * 1.3e-9, rel=1e-9)
    # A thousand empty samples first; half of the last one but one.
    late = Pulse.measured([0] * 1000 + [1, 1], BIN_S)
    assert late.quantile_s(0.25) == pytest.approx(1000.5 * BIN_S, rel=1e-9)


def test_pulses_are_values() -> None:
    assert Pulse.measured([1, 3], BIN_S) == Pulse.measured(np.array([1.0, 3.0]), BIN_S)
    assert len({Pulse(), Pulse(1e-9), Pulse.gaussian(1e-9)}) == 2


def test_the_widest_acquisitions_have_finite_ranges() -> None:
    widest = Acquisition(10, 1.0, 10.0, 2**53)
    finest = Acquisition(2**24, 1e-18, -10.0)
    for acquisition in (widest, finest):
        edges = acquisition.bin_to_range_m([0, acquisition.n_bins])
        assert np.isfinite(acquisition.range_m_to_bin(edges)).all()


def test_background_follows_from_the_signal_to_background_ratio() -> None:
    assert Flux(signal=0.3, sbr=0.06).background == 0.3 / 0.06
    assert Flux(sbr=math.inf).background == 0
    assert Flux(signal=0.0).background == 0


IMPOSSIBLE: dict[str, tuple[Any, ...]] = {
    "n_bins": (0, 2**24 + 1, 10**400),
    "bin_width_s": (5e-324, 0.0, 10.1, np.inf, np.nan),
    "gate_delay_s": (10.1, np.nan, -np.inf),
    "n_pulses": (2**63, 2**53 + 1, 0, -3),
    "pixel_angle_rad": (0.0, 1.0),
}
REFUSED = [
    *(
        (Acquisition, {name: value}, rf"{name} = .*{value}.* is not accepted: give ")
        for name, values in IMPOSSIBLE.items()
        for value in values
    ),
    (Acquisition, {"n_bins": 20, "bin_width_s": 1.0}, r"gate, .* = 20.0 .*at most 10"),
    *(
        (Pulse, {"tau_s": value}, r"tau_s = .* a time from 1e-21 to 10 s")
        for value in (0.0, 5e-324, -1e-9, 10.1, 1e300, np.inf, np.nan)
    ),
    (Pulse, {"shape": "square"}, r"shape = 'square' .*gamma or gaussian or measured"),
    (
        Pulse.measured,
        {"samples": np.ones(20), "bin_width_s": 1.0},
        r"length .* = 20.0 .*at most 10",
    ),
    *(
        (Pulse.measured, {"samples": samples, "bin_width_s": BIN_S}, r"samples = .*non-negative")
        for samples in ([], [0, 0], [1, -1], [1, np.nan], [1, np.inf])
    ),
    *((Flux, {"signal": value}, f"signal = {value} ") for value in (-0.1, np.inf, np.nan)),
    *((Flux, {"sbr": value}, f"sbr = {value} ") for value in (0.0, np.nan)),
    # Of another type
    (Acquisition, {"bin_width_s": "1ns"}, r"bin_width_s = '1ns' .*1e-18 to 10 s, as a number of s"),
    (Acquisition, {"gate_delay_s": None}, r"gate_delay_s = None .*-10 to 10 s, as a number of sec"),
    (Acquisition, {"pixel_angle_rad": "1mrad"}, r"pixel_angle_rad = '1mrad' .*1 radian"),
    (Pulse, {"tau_s": "1ns"}, r"tau_s = '1ns' .*as a number of seconds"),
    (Flux, {"signal": "a", "sbr": 1}, r"signal = 'a' .*number of photons per pulse"),
    (
        Flux,
        {"sbr": [0.1] * 10**6},
        r"sbr = \[0.1, .*\.\.\.\] is not accepted: give a positive number",
    ),
]


@pytest.mark.parametrize(("kind", "arguments", "message"), REFUSED)
def test_impossible_values_are_refused(kind: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**arguments)
