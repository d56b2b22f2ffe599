"""Settings of a lesson, and the rates and captures that its views share."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.checks import require
from core.parameters import Choice, Number, Settings, parameter
from core.scene import PAPER_GATE, Scene, scenes
from core.simulation import simulate
from core.tracking import PRESETS, TrackingParameters
from core.trigger import rate_per_bin

PULSE = Pulse()

SWITCH = ("off", "on")

PIXELS = ("A", "B", "C", "D")
"""Names of some pixels of the field capture."""

SIDE = 24
"""Rows and columns of flat targets."""


@dataclass(frozen=True)
class Bench(Settings):
    """Everything that a lesson can set, over the paper's gate of 100 bins of 1 ns."""

    signal: float = parameter(
        0.1041,
        Number("Signal", 0.001, 10.0, log=True, least=0.0, most=1e3, unit="per pulse"),
        "Signal photons per pulse (PPP), if the detector were always armed.",
    )
    background: float = parameter(
        1.735,
        Number("Background", 0.05, 20.0, log=True, least=1e-3, most=1e3, unit="per pulse"),
        "Background photons per pulse over the gate, if the detector were always armed.",
    )
    exposure: float = parameter(
        1.0,
        Number("Exposure", 0.01, 10.0, log=True, least=1e-3, most=100.0),
        "Factor on signal and background: below 1 a filter, above 1 a longer exposure.",
    )
    onset_bin: int = parameter(
        50, Number("Bin of the echo", 0, 99, whole=True, least=0, most=99), "Where the echo begins."
    )
    n_pulses: int = parameter(
        1000,
        Number("Pulses", 10, 8000, log=True, whole=True, least=1, most=50_000),
        "Pulses per pixel.",
    )
    seed: int = parameter(
        0,
        Number("Seed", 0, 999, whole=True, least=0, most=2**53),
        "Random seed of the simulations: the same seed gives the same counts.",
    )
    preset: str = parameter(
        "recommended",
        Choice("Preset", tuple(PRESETS)),
        "Settings of the tracking differentiator: recommended, or the paper's literal equations.",
    )
    correction: str = parameter(
        "off",
        Choice("Coates correction", SWITCH),
        "Divide each bin by the pulses that are still armed there, which undoes pile-up.",
    )
    alpha: float = parameter(
        0.15,
        Number("α", 0.1, 30.0, log=True, least=0.0, most=1e6),
        "Strength of the weight with which the tracking differentiator raises late bins.",
    )
    least_confidence: float = parameter(
        0.0,
        Number("Least confidence", 0.0, 1.0, least=0.0, most=1.0),
        "Estimates of less confidence are removed.",
    )
    pixel: str = parameter(
        "A",
        Choice("Pixel", PIXELS),
        "Pixel of the capture that the plots show.",
    )
    neighbours: str = parameter(
        "off",
        Choice("Neighbours", SWITCH),
        "Estimate each pixel by itself, or all of them together.",
    )

    @property
    def acquisition(self) -> Acquisition:
        """The gate, with these pulses."""
        return replace(PAPER_GATE, n_pulses=self.n_pulses)

    @property
    def flux(self) -> Flux:
        """Signal and background with this exposure.

        Raises
        ------
        ValueError
            Without a signal: an SBR of 0 does not define the background.
        """
        require("signal", self.signal, self.signal > 0, "a number above 0")
        return Flux(self.exposure * self.signal, self.signal / self.background)

    @property
    def tracking(self) -> TrackingParameters:
        """Settings of the preset."""
        return PRESETS[self.preset]


def rate_of(bench: Bench) -> Floats:
    """Return photons per pulse and bin, of an always armed detector."""
    signal, background = (bench.exposure * each for each in (bench.signal, bench.background))
    rate = rate_per_bin(bench.onset_bin, signal, background, PULSE, bench.acquisition)
    return np.asarray(rate, np.float64)


def flat_target(bench: Bench, range_m: float, side: int = 1) -> Capture:
    """Simulate a flat target at a range, or none if it is NaN or the signal is 0."""
    if bench.signal:
        flux = bench.flux
    else:  # the background is all that a scene without a surface returns
        range_m, flux = math.nan, Flux(bench.exposure * bench.background, 1.0)
    scene = Scene(np.full((side, side), range_m))
    return simulate(scene, bench.acquisition, flux, PULSE, bench.seed)


def captured(name: str, bench: Bench) -> Capture:
    """Simulate a built-in scene with these fluxes and pulses, and cache it."""
    return _captured(name, bench.n_pulses, bench.flux, bench.seed)


@lru_cache(maxsize=8)
def _captured(name: str, n_pulses: int, flux: Flux, seed: int) -> Capture:
    scene = scenes[name]()
    return simulate(scene, replace(scene.acquisition, n_pulses=n_pulses), flux, PULSE, seed)


def centres(bench: Bench) -> Floats:
    """Return the centres of the bins."""
    return np.arange(bench.acquisition.n_bins, dtype=float) + 0.5
