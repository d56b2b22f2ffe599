"""What a scene may have besides one surface in each pixel: each a part, absent unless it is told.

A part says what it does to the photons that are expected, or to what is recorded of them; the
first-photon model itself (`core.simulate`) stays what it is. Lengths, times and rates are SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.checks import require


@dataclass(frozen=True, eq=False)
class SecondSurface:
    """Another surface in a pixel's view, which returns a share of its echo: a partial return.

    A pixel that straddles an edge, or looks through a window, sees two surfaces, each in proportion
    to the area that it fills: its echo is ``S [(1 - q) p(d) + q p(d')]``.

    Parameters
    ----------
    range_m : ndarray, shape (row, col)
        Range of the other surface in metres; NaN where there is none.
    share : ndarray, shape (row, col)
        What it returns of the pixel's signal, ``q``, from 0 to 1.

    Raises
    ------
    ValueError
        If the shapes differ, or a share is out of its range.
    """

    range_m: Floats
    share: Floats

    def __post_init__(self) -> None:
        shape = np.shape(self.range_m)
        fits = np.shape(self.share) == shape
        require("share", f"shape {np.shape(self.share)}", fits, f"shape {shape}, that of range_m")
        low, high = float(np.min(self.share)), float(np.max(self.share))
        require("share", (low, high), 0 <= low <= high <= 1, "shares from 0 to 1")

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return np.shape(self.range_m)

    @property
    def seen_share(self) -> Floats:
        """``q``, 0 where there is no other surface, shape (row, col)."""
        return np.where(np.isfinite(self.range_m), self.share, 0.0)


LIDAR_RATIO_SR = 18.8
"""Extinction over backscatter of water droplets in the near infrared (O'Connor et al. 2004)."""

OVERLAP_M = 1.0
"""Nearer than this no receiver beside its laser sees what the laser lights."""


@dataclass(frozen=True)
class Backscatter:
    """Fog: droplets that return light from everywhere, and dim what lies behind them.

    Single scattering in air of one extinction ``a`` (the lidar equation as in Rasshofer, Spies &
    Spies 2011): a path of length ``dr`` at range ``r`` returns ``K (a / L) exp(-2 a r) / r² dr``
    photons, ``L`` being the lidar ratio, and a Lambertian surface of reflectivity 1 at range ``R``
    returns ``K / π exp(-2 a R) / R²``. In clear air the latter is the signal ``S`` of `core.Flux`
    at `reference_m`, which gives ``K = π S R²``.

    Parameters
    ----------
    extinction_per_m : float
        ``a``; 3 over the meteorological optical range ("visibility").
    reference_m : float
        Range for which the signal is told, in metres.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    extinction_per_m: float
    reference_m: float = 50.0

    def __post_init__(self) -> None:
        extinction, reference_m = self.extinction_per_m, self.reference_m
        require("extinction_per_m", extinction, 0 <= extinction < np.inf, "0 or more, finite")
        require("reference_m", reference_m, 0 < reference_m < np.inf, "metres, positive")

    def transmission(self, range_m: Floats) -> Floats:
        """Share of an echo from a range that fog lets pass, to the surface and back."""
        return np.asarray(np.exp(-2 * self.extinction_per_m * range_m))

    def photons_before(self, signal: float, pulse: Pulse, acquisition: Acquisition) -> Floats:
        """Photons that fog returns before each bin edge, per pulse; shape (n_bins + 1,).

        The integral of ``exp(-2 a r) / r²`` beyond a range is ``E₂(2 a r) / r``, with the
        exponential integral ``E₂``. Within a bin the ramp is taken for even where the pulse spreads
        it over its neighbours.
        """
        n_bins = acquisition.n_bins
        spread, first = pulse.taps(n_bins, acquisition.bin_width_s, 0.5)
        edge = np.arange(1 - first - spread.size, n_bins + 1 - first)
        range_m = np.maximum(acquisition.bin_to_range_m(edge), OVERLAP_M)
        extinction = self.extinction_per_m
        beyond = scipy.special.expn(2, 2 * extinction * range_m) / range_m
        scale = math.pi * signal * self.reference_m**2 * extinction / LIDAR_RATIO_SR
        ramp = scale * np.convolve(-np.diff(beyond), spread / spread.sum(), mode="valid")
        return np.concatenate([[0.0], np.cumsum(ramp)])


@dataclass(frozen=True, eq=False)
class FaultyPixels:
    """Pixels that fire by themselves (hot), and pixels that never fire (dead).

    Parameters
    ----------
    dark_count_hz : ndarray, shape (row, col)
        Dark counts per second of an armed pixel beyond those of its neighbours, 0 or more.
    dead : ndarray of bool, shape (row, col)
        Which pixels never fire.

    Raises
    ------
    ValueError
        If the shapes differ, or a rate is negative or not finite.
    """

    dark_count_hz: Floats
    dead: NDArray[np.bool_]

    def __post_init__(self) -> None:
        shape = np.shape(self.dark_count_hz)
        fits = np.shape(self.dead) == shape
        require("dead", f"shape {np.shape(self.dead)}", fits, f"{shape}, that of dark_count_hz")
        low, high = float(np.min(self.dark_count_hz)), float(np.max(self.dark_count_hz))
        require("dark_count_hz", (low, high), 0 <= low <= high < np.inf, "finite rates, 0 or more")

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return np.shape(self.dark_count_hz)

    def photons(self, acquisition: Acquisition) -> Floats:
        """Dark counts per pulse over the gate, shape (row, col)."""
        return np.asarray(self.dark_count_hz * (acquisition.n_bins * acquisition.bin_width_s))


@dataclass(frozen=True)
class Motion:
    """The scene comes nearer or recedes while its pulses are sent.

    Each pulse meets the surface elsewhere: its trigger probabilities are those of Eq. 1 at that
    place, and the histogram's are their mean over the pulses. (Histograms are drawn from that mean.
    Pulses that stand in order scatter a little less, in bin k by the variance of ``P_k`` over the
    pulses, relative to its mean: a few hundredths at the echo.)

    Parameters
    ----------
    speed_m_per_s : float
        Along the line of sight; positive where the scene recedes.
    pulse_rate_hz : float
        Pulses a second. A scene's ranges are those at half the time that its pulses take.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    speed_m_per_s: float
    pulse_rate_hz: float

    def __post_init__(self) -> None:
        speed, rate_hz = self.speed_m_per_s, self.pulse_rate_hz
        require("speed_m_per_s", speed, math.isfinite(speed), "finite metres per second")
        require("pulse_rate_hz", rate_hz, 0 < rate_hz < np.inf, "pulses a second, positive")

    def shifts_bins(self, pulse: Pulse, acquisition: Acquisition, n_pulses: int) -> Floats:
        """How far the scene stands from its ranges, at pulses or, closer than echoes tell, groups.

        Groups lie a quarter of a bin apart, or of the pulse's time constant if that is shorter.
        """
        travel_m = abs(self.speed_m_per_s) * n_pulses / self.pulse_rate_hz
        travel_bins = travel_m / acquisition.bin_length_m
        step_bins = min(1.0, pulse.tau_s / acquisition.bin_width_s) / 4
        groups = min(n_pulses, max(1, math.ceil(travel_bins / step_bins)))
        return np.asarray(((np.arange(groups) + 0.5) / groups - 0.5) * travel_bins)


@dataclass(frozen=True)
class Jitter:
    """The time that is recorded of a detection scatters: detector, electronics and clock.

    It moves the time of the photon that fired, but not which photon is the first: the trigger
    probabilities are convolved with it, not the rates. Within a bin detections are taken for even.
    What leaves the gate that way is not recorded.

    Parameters
    ----------
    sigma_s : float
        Standard deviation of a Gaussian, in seconds.

    Raises
    ------
    ValueError
        If it is negative or not finite.
    """

    sigma_s: float

    def __post_init__(self) -> None:
        require("sigma_s", self.sigma_s, 0 <= self.sigma_s < np.inf, "seconds, 0 or more")

    def recorded(self, triggered: Floats, bin_width_s: float) -> Floats:
        """Probability that a detection is recorded before each bin edge, shape (pixel, edge).

        `triggered`, the same without jitter, is a straight line between edges, whose mean over a
        Gaussian is a sum over edges with second differences of ``x Φ(x/σ) + σ φ(x/σ)`` for weights.
        """
        sigma_bins = max(self.sigma_s / bin_width_s, np.finfo(float).tiny)
        reach = 1 + math.ceil(8 * sigma_bins)
        x = np.arange(-reach - 1, reach + 2.0)
        with np.errstate(over="ignore"):  # next to no jitter: infinitely many of its σ away
            z = x / sigma_bins
            ramp = x * scipy.special.ndtr(z) + sigma_bins * np.exp(-z * z / 2) / math.sqrt(
                2 * math.pi
            )
        recorded = scipy.ndimage.correlate1d(triggered, np.diff(ramp, 2), axis=1, mode="nearest")
        return np.asarray(recorded - recorded[:, :1])
