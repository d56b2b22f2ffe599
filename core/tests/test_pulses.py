"""Photons of single pulses, against the simulation of whole histograms."""

from __future__ import annotations

import numpy as np
import pytest

from core.acquisition import Flux, Pulse
from core.scene import PAPER_GATE, Scene
from core.simulation import simulate
from core.studies.lessons import VIEWS, Bench
from core.studies.pulses import Pulses, photon_times
from core.trigger import rate_per_bin


@pytest.mark.parametrize("onset_bin", [50.0, np.nan])
def test_first_photons_of_pulses_fill_the_histogram_of_the_simulation(onset_bin: float) -> None:
    flux = Flux(0.5, 0.2)
    scene = Scene(np.full((1, 1), PAPER_GATE.bin_to_range_m(onset_bin)))
    rate = rate_per_bin(onset_bin, flux.signal, flux.background, Pulse(), PAPER_GATE)
    n_pulses = PAPER_GATE.n_pulses
    assert n_pulses is not None
    item = Pulses("", "", *photon_times(rate, n_pulses, seed=3), probability=rate)
    simulated = simulate(scene, PAPER_GATE, flux, seed=3).cube[0, 0]
    np.testing.assert_array_equal(item.histogram, simulated)
    photons = np.bincount(item.times.astype(int), minlength=rate.size)
    expected = n_pulses * rate
    assert np.abs((photons - expected) / np.sqrt(expected)).max() < 5  # Poisson, in each bin
    times, ends = photon_times(rate, 20, seed=3)
    np.testing.assert_array_equal(times, item.times[: ends[-1]])
    np.testing.assert_array_equal(ends, item.ends[:20])


def test_photons_of_a_pulse_are_in_order_and_exact_in_single_precision() -> None:
    item = VIEWS["pulse_by_pulse"](Bench(signal=0.0, background=20.0, n_pulses=5000))
    assert isinstance(item, Pulses)
    assert item.ends.size == 1000  # more are not shown one by one
    begins = np.zeros(item.times.size, bool)
    begins[item.ends[:-1]] = True
    assert (np.diff(item.times)[~begins[1:]] >= 0).all()
    np.testing.assert_array_equal(item.times.astype(np.float32), item.times)
