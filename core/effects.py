"""Optional parts of a scene besides one surface per pixel.

A part changes the expected photons or what is recorded of them; the first-photon model of
`core.simulation` stays the same. Lengths, times and rates are SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Pulse
from core.checks import require


def _require_same_shape(name: str, image: NDArray[np.generic], other: str, shape: object) -> None:
    found = np.shape(image)
    require(name, f"shape {found}", found == shape, f"shape {shape}, that of {other}")


@dataclass(frozen=True, eq=False)
class SecondSurface:
    """Another surface in a pixel's field of view, which returns a share of its echo.

    A pixel at an edge, or behind a window, sees two surfaces in proportion to the areas that they
    fill. Its echo is ``S [(1 - q) p(d) + q p(d')]``.

    Parameters
    ----------
    range_m : ndarray, shape (row, col)
        Range of the other surface in metres; NaN where there is none.
    share : ndarray, shape (row, col)
        Share of the pixel's signal that it returns, ``q``, from 0 to 1.

    Raises
    ------
    ValueError
        If the shapes differ, or a share is out of its range.
    """

    range_m: Floats
    share: Floats

    def __post_init__(self) -> None:
        _require_same_shape("share", self.share, "range_m", self.shape)
        low, high = float(np.min(self.share)), float(np.max(self.share))
        require("share", (low, high), 0 <= low <= high <= 1, "shares from 0 to 1")

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return np.shape(self.range_m)

    @property
    def effective_share(self) -> Floats:
        """``q``, and 0 where there is no other surface, shape (row, col)."""
        return np.where(np.isfinite(self.range_m), self.share, 0.0)


LIDAR_RATIO_SR = 18.8
"""Extinction over backscatter of water droplets in the near infrared (O'Connor et al. 2004)."""

OVERLAP_M = 1.0
"""Range below which the fields of view of laser and receiver do not overlap."""


@dataclass(frozen=True)
class Falloff:
    """Fall of the signal with range: an aperture collects ``1 / R²`` of a Lambertian echo.

    Parameters
    ----------
    reference_m : float
        Range in metres to which the signal of `core.Flux` refers.

    Raises
    ------
    ValueError
        If it is not positive.
    """

    reference_m: float

    def __post_init__(self) -> None:
        range_m = self.reference_m
        require("reference_m", range_m, 0 < range_m < np.inf, "metres, positive")

    def transmission(self, range_m: Floats) -> Floats:
        """Signal from each range relative to that from the reference, shape of `range_m`."""
        return np.asarray((self.reference_m / np.maximum(range_m, OVERLAP_M)) ** 2)


@dataclass(frozen=True)
class Backscatter:
    """Fog: droplets that scatter light back from every range and attenuate echoes behind them.

    Single scattering in air of one extinction ``a`` (lidar equation as in Rasshofer, Spies & Spies
    2011): a path of length ``dr`` at range ``r`` returns ``K (a / L) exp(-2 a r) / r² dr`` photons,
    with the lidar ratio ``L``, and a Lambertian surface of reflectivity 1 at range ``R`` returns
    ``K / π exp(-2 a R) / R²``. In clear air the latter is the signal ``S`` of `core.Flux` at
    `reference_m`, hence ``K = π S R²``.

    Parameters
    ----------
    extinction_per_m : float
        ``a``; 3 over the meteorological optical range ("visibility").
    reference_m : float
        Range in metres to which the signal refers.

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    extinction_per_m: float
    reference_m: float = 50.0

    def __post_init__(self) -> None:
        extinction, reference_m = self.extinction_per_m, self.reference_m
        finite = 0 <= extinction < np.inf
        require("extinction_per_m", extinction, finite, "finite and non-negative")
        require("reference_m", reference_m, 0 < reference_m < np.inf, "metres, positive")

    def transmission(self, range_m: Floats) -> Floats:
        """Share of an echo that the fog transmits to the surface and back, shape of `range_m`."""
        return np.asarray(np.exp(-2 * self.extinction_per_m * range_m))

    def photons_before(self, signal: float, pulse: Pulse, acquisition: Acquisition) -> Floats:
        """Photons per pulse that the fog returns before each bin edge, shape (n_bins + 1,).

        The integral of ``exp(-2 a r) / r²`` beyond a range is ``E₂(2 a r) / r``, with the
        exponential integral ``E₂``. Within a bin the backscatter is taken as constant before the
        pulse spreads it over neighbouring bins.
        """
        n_bins = acquisition.n_bins
        spread, first = pulse.taps(n_bins, acquisition.bin_width_s, 0.5)
        edge = np.arange(1 - first - spread.size, n_bins + 1 - first)
        range_m = np.maximum(acquisition.bin_to_range_m(edge), OVERLAP_M)
        extinction = self.extinction_per_m
        beyond = scipy.special.expn(2, 2 * extinction * range_m) / range_m
        scale = math.pi * signal * self.reference_m**2 * extinction / LIDAR_RATIO_SR
        per_bin = scale * np.convolve(-np.diff(beyond), spread / spread.sum(), mode="valid")
        return np.concatenate([[0.0], np.cumsum(per_bin)])


@dataclass(frozen=True, eq=False)
class FaultyPixels:
    """Hot pixels, which fire without light, and dead pixels, which never fire.

    Parameters
    ----------
    dark_count_hz : ndarray, shape (row, col)
        Dark counts per second of an armed pixel in excess of its neighbours', non-negative.
    dead : ndarray of bool, shape (row, col)
        Pixels that never fire.

    Raises
    ------
    ValueError
        If the shapes differ, or a rate is negative or not finite.
    """

    dark_count_hz: Floats
    dead: NDArray[np.bool_]

    def __post_init__(self) -> None:
        _require_same_shape("dead", self.dead, "dark_count_hz", self.shape)
        low, high = float(np.min(self.dark_count_hz)), float(np.max(self.dark_count_hz))
        accepted = 0 <= low <= high < np.inf
        require("dark_count_hz", (low, high), accepted, "finite and non-negative rates")

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return np.shape(self.dark_count_hz)

    def photons(self, acquisition: Acquisition) -> Floats:
        """Dark counts per pulse over the gate, shape (row, col)."""
        return np.asarray(self.dark_count_hz * (acquisition.n_bins * acquisition.bin_width_s))


@dataclass(frozen=True)
class Motion:
    """Approach or recession of the whole scene while its pulses are sent.

    Each pulse meets the surface at another range. Its trigger probabilities are those of Eq. 1 at
    that range, and those of the histogram are their mean over the pulses. Histograms are drawn from
    this mean; pulses in order (``n_groups`` of `core.simulate`) scatter slightly less, in bin k by
    the variance of ``P_k`` over the pulses relative to its mean, a few hundredths at the echo.

    Parameters
    ----------
    speed_m_per_s : float
        Speed along the line of sight; positive if the scene recedes.
    pulse_rate_hz : float
        Pulses per second. The scene's ranges are those at the middle of the recording.

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
        """Displacement in bins at each group of pulses in increasing order, shape (group,).

        Groups are single pulses, or lie a quarter of a bin apart (or of the pulse's time constant,
        if that is shorter) where pulses lie closer.
        """
        travel_m = abs(self.speed_m_per_s) * n_pulses / self.pulse_rate_hz
        travel_bins = travel_m / acquisition.bin_length_m
        step_bins = min(1.0, pulse.tau_s / acquisition.bin_width_s) / 4
        groups = min(n_pulses, max(1, math.ceil(travel_bins / step_bins)))
        return np.asarray(((np.arange(groups) + 0.5) / groups - 0.5) * travel_bins)


@dataclass(frozen=True)
class Jitter:
    """Timing jitter of detector, electronics and clock.

    Jitter moves the recorded time of a detection but not which photon is the first, so it convolves
    the trigger probabilities rather than the rates. Within a bin detections are taken as uniform.
    Detections that leave the gate are not recorded.

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
        accepted = 0 <= self.sigma_s < np.inf
        require("sigma_s", self.sigma_s, accepted, "seconds, finite and non-negative")

    def recorded(self, triggered: Floats, bin_width_s: float) -> Floats:
        """Probability that a detection is recorded before each bin edge, shape (pixel, edge).

        `triggered` is the same without jitter. It is linear between edges, and its mean over a
        Gaussian is a sum over edges weighted by second differences of ``x Φ(x/σ) + σ φ(x/σ)``.
        """
        sigma_bins = max(self.sigma_s / bin_width_s, np.finfo(float).tiny)
        half_width = 1 + math.ceil(8 * sigma_bins)
        x = np.arange(-half_width - 1, half_width + 2.0)
        with np.errstate(over="ignore"):  # with tiny σ a bin is infinitely many σ wide
            z = x / sigma_bins
            gaussian = sigma_bins * np.exp(-z * z / 2) / math.sqrt(2 * math.pi)
            ramp = x * scipy.special.ndtr(z) + gaussian
        recorded = scipy.ndimage.correlate1d(triggered, np.diff(ramp, 2), axis=1, mode="nearest")
        return np.asarray(recorded - recorded[:, :1])
