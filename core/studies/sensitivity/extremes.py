"""The far ends of everything that can be set, as data: what the laws of `laws` are held against."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture, Detection
from core.estimators import ESTIMATORS
from core.parameters import Choice, Number, spec_of
from core.scene import Scene
from core.simulation import simulate

Case = tuple[float, str]
"""How far from holding a law is, and where."""

SUBNORMAL = 5e-324
SIGNAL = 0.1041  # the paper's photons per pulse


@dataclass(frozen=True)
class Grid:
    """Values to combine; `long_gates` meet only some of the others, or the grid would take hours.

    Tau is the pulse's time constant, in bins.
    """

    sbr: tuple[float, ...] = (1e-6, 1e-3, 0.06, 1.0, 1e3, 1e6)
    photons: tuple[float, ...] = (0.0, SUBNORMAL, 1e-12, 1e-3, 1.0, 30.0, 1e6)
    n_pulses: tuple[int, ...] = (1, 1000, 10**9)
    n_bins: tuple[int, ...] = (1, 2, 100)
    long_gates: tuple[int, ...] = (4096, 100_000)
    tau_bins: tuple[float, ...] = (1e-3, 1.0, 1e3)
    numbers: tuple[float, ...] = (0.0, SUBNORMAL, 1e-300, 1e-12, 1e-3, 1.0, 1e3, 1e6, 1e9)
    """Tried for every setting that is a number, beside its bounds and the ends of its slider."""
    every: int = 5
    """Of all estimators under all lights, and of all settings on all histograms, one in so many."""
    tiles: int = 30
    """How often rows are repeated where the work must be worth several threads."""


FULL = Grid()
SHORT = Grid(
    sbr=(1e-6, 1e6),
    photons=(0.0, 1e-12, 1.0, 1e6),
    n_pulses=(1, 10**9),
    n_bins=(1, 100),
    long_gates=(4096,),
    tau_bins=(1e-3, 1e3),
    numbers=(0.0, SUBNORMAL, 1e6),
    every=31,
    tiles=1,
)


@dataclass(frozen=True)
class Light:
    """A gate, and the light that comes into it."""

    n_bins: int
    n_pulses: int
    tau_bins: float
    signal: float
    background: float

    def __str__(self) -> str:
        return ", ".join(f"{each.name} {getattr(self, each.name):g}" for each in fields(self))

    @property
    def acquisition(self) -> Acquisition:
        """The gate, its bins 1 ns wide."""
        return Acquisition(self.n_bins, n_pulses=self.n_pulses)

    @property
    def pulse(self) -> Pulse:
        """The paper's pulse."""
        return Pulse(self.tau_bins * self.acquisition.bin_width_s)

    def capture(self, seed: int = 0) -> Capture:
        """Pixels with `onsets`, as they would be recorded, and one without a target."""
        onset = np.append(onsets(self.n_bins), np.nan).reshape(3, -1)
        sbr = self.signal / self.background if self.background else np.inf
        # A flux has no background without a signal: there the scene reflects nothing.
        flux = Flux(self.signal, sbr) if sbr > 0 else Flux(self.background, 1.0)
        reflectivity = np.full(onset.shape, 1.0 if sbr > 0 else 0.0)
        scene = Scene(self.acquisition.bin_to_range_m(onset), reflectivity)
        return simulate(scene, self.acquisition, flux, self.pulse, seed)


def onsets(n_bins: int) -> Floats:
    """Delays before, at and behind each edge of a gate, and in it; shape (11,)."""
    edges = [-1e6, -1.0, -1e-9, 0.0, 1e-9, n_bins - 1e-9, n_bins, n_bins + 1.0, n_bins + 1e6]
    return np.array([*edges, 0.5, n_bins / 2])


def pairs(grid: Grid) -> list[tuple[float, float]]:
    """Signal and background: each with each, and the paper's signal at every SBR."""
    each = list(product(grid.photons, grid.photons))
    return each + [(SIGNAL, SIGNAL / sbr) for sbr in grid.sbr]


def lights(grid: Grid) -> Iterator[Light]:
    """Every gate under every light; long gates under a few."""
    for gate in product(grid.n_bins, grid.n_pulses, grid.tau_bins):
        for light in pairs(grid):
            yield Light(*gate, *light)
    few = ((0.0, 0.0), (1.0, 0.0), (SIGNAL, SIGNAL / 0.06), (grid.photons[-1], grid.photons[-1]))
    for n_bins, light in product(grid.long_gates, few):
        yield Light(n_bins, grid.n_pulses[-1], 1.0, *light)


@dataclass(frozen=True)
class Counts:
    """Histograms by name, as a capture of some type."""

    name: str
    cube: NDArray[np.unsignedinteger]
    n_pulses: int | None
    detection: Detection

    def __str__(self) -> str:
        return f"{self.name}, {self.cube.shape[2]} bins"

    @property
    def capture(self) -> Capture:
        """With a light that the oracle can be told."""
        return Capture(
            self.cube.copy(),
            Acquisition(self.cube.shape[2], n_pulses=self.n_pulses),
            signal=np.full(self.cube.shape[:2], SIGNAL),
            background=SIGNAL / 0.06,
            detection=self.detection,
        )


def histograms(grid: Grid) -> Iterator[Counts]:
    """Constant, one-hot, alternating, saturated and empty ones, and those beside an overflow."""
    rng = np.random.default_rng(0)
    for n_bins in grid.n_bins:
        shape = (2, 3, n_bins)
        places = np.array([0, 1, n_bins // 3, n_bins // 2, n_bins - 2, n_bins - 1]) % n_bins
        one_hot = np.eye(n_bins)[places].reshape(shape)
        noise = rng.poisson(3, shape)
        alternating = np.where(np.arange(n_bins) % 2, 0, 9) * np.ones(shape)
        first: dict[str, Any] = {
            "empty": np.zeros(shape),
            "constant": np.full(shape, 7),
            "alternating": alternating,
            "one photon": one_hot,
            "every pulse in one bin": 1000 * one_hot,
            "noise": noise,
        }
        for name, cube in first.items():
            yield Counts(name, cube.astype(np.uint16), 1000, "first")
        for most, dtype in ((2**8, np.uint8), (2**16, np.uint16), (2**32, np.uint32)):
            full = np.full(shape, most - 1, dtype)
            yield Counts(f"full {np.dtype(dtype)} counters", full, None, "all")
        for top in (254, 255, 256, 65534, 65535, 65536, 65537):
            kind = np.min_scalar_type(top)
            cube = np.where(one_hot > 0, top, noise).astype(kind)
            yield Counts(f"{top} counts in a bin", cube, None, "all")


def settings(method: str, grid: Grid) -> Iterator[Any]:
    """An estimator's settings as they come, and with one of them at each of its ends."""
    kind = ESTIMATORS[method].parameters
    yield kind()
    for each in fields(kind):
        for value in _values(spec_of(each), grid):
            yield kind(**{each.name: value})


def _values(spec: Number | Choice, grid: Grid) -> list[Any]:
    if isinstance(spec, Choice):
        return list(spec.options)
    tried = {spec.least, spec.low, spec.high, spec.most, *grid.numbers}
    # T_n at the gate's last bin, behind it, and beyond.
    tried |= {float(n_bins + more) for n_bins in grid.n_bins for more in (-1, 0, 1)}
    if spec.whole:
        return sorted({int(value) for value in tried if spec.takes(int(value))})
    return sorted(value for value in tried if spec.takes(value))


def impossible(method: str) -> Iterator[tuple[str, Any]]:
    """Field and value that an estimator must refuse: what is no number, and what has no end."""
    for each in fields(ESTIMATORS[method].parameters):
        for value in (np.inf, -np.inf, np.nan):
            yield each.name, value
