"""Gate, bins, pulse and flux, and the conversion of bins to time and range."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from numbers import Real
from typing import Literal

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import ArrayLike, NDArray

from core.checks import require, require_type, require_whole

Floats = NDArray[np.float64]

SPEED_OF_LIGHT_M_S = 299_792_458.0  # exact by definition

LONGEST_S = 10.0
"""Upper bound of every time in an acquisition; light takes 2.6 s to the Moon and back."""

SHORTEST_BIN_S, SHORTEST_PULSE_S = 1e-18, 1e-21
"""Smallest bin width and pulse time constant, far below what any detector resolves."""

MOST_BINS = 2**24
"""Largest number of bins in a gate."""

_MOST_SHOWN = 10  # samples in a message

MOST_PULSES = 2**53
"""Largest number of pulses: integers up to here are exact as float64."""


def require_time(name: str, value_s: float, least_s: float) -> None:
    """Raise ``ValueError`` unless a time lies between `least_s` and `LONGEST_S` seconds."""
    accepted = f"a time from {least_s:g} to {LONGEST_S:g} s"
    require_type(name, value_s, Real, f"{accepted}, as a number of seconds")
    require(name, value_s, least_s <= value_s <= LONGEST_S, accepted)


@dataclass(frozen=True)
class Acquisition:
    """Settings with which a capture was, or will be, recorded.

    Bin ``k`` covers the time ``gate_delay_s + [k, k + 1) * bin_width_s`` after the pulse leaves.

    Parameters
    ----------
    n_bins : int
        Bins in the gate, from 1 to `MOST_BINS`.
    bin_width_s : float
        Width of one bin in seconds, from `SHORTEST_BIN_S` to `LONGEST_S`; the whole gate lasts at
        most `LONGEST_S`.
    gate_delay_s : float
        Time from the pulse to the opening of the gate in seconds, from -`LONGEST_S` to `LONGEST_S`.
    n_pulses : int or None
        Pulses sent for each pixel, from 1 to `MOST_PULSES`; None if unknown.
    pixel_angle_rad : float or None
        Angle between the lines of sight of neighbouring pixels, in radians; None if unknown.

    Raises
    ------
    ValueError
        If a field is out of its range.
    """

    n_bins: int = 100
    bin_width_s: float = 1e-9
    gate_delay_s: float = 280e-9
    n_pulses: int | None = 1000
    pixel_angle_rad: float | None = 2e-3

    def __post_init__(self) -> None:
        require_whole("n_bins", self.n_bins, MOST_BINS)
        require_time("bin_width_s", self.bin_width_s, SHORTEST_BIN_S)
        gate_s = self.n_bins * self.bin_width_s
        require(
            "gate, n_bins * bin_width_s,", gate_s, gate_s <= LONGEST_S, f"at most {LONGEST_S} s"
        )
        require_time("gate_delay_s", self.gate_delay_s, -LONGEST_S)
        if self.n_pulses is not None:
            require_whole("n_pulses", self.n_pulses, MOST_PULSES, ", or None if unknown")
        if self.pixel_angle_rad is not None:
            angle_rad, accepted = self.pixel_angle_rad, "between 0 and 1 radian, or None if unknown"
            require_type("pixel_angle_rad", angle_rad, Real, accepted)
            require("pixel_angle_rad", angle_rad, 0 < angle_rad < 1, accepted)

    def bin_to_range_m(self, bins: ArrayLike) -> Floats:
        """Range in metres of a (fractional) bin position, any shape; NaN stays NaN."""
        return np.asarray(self.bin_to_time_s(bins) * (SPEED_OF_LIGHT_M_S / 2))

    def bin_to_time_s(self, bins: ArrayLike) -> Floats:
        """Seconds from the pulse to a (fractional) bin position, any shape; NaN stays NaN."""
        return np.asarray(self.gate_delay_s + np.asarray(bins, float) * self.bin_width_s)

    def range_m_to_bin(self, range_m: ArrayLike) -> Floats:
        """Fractional bin position of a range in metres, any shape; NaN stays NaN."""
        time_s = np.asarray(range_m, float) * (2 / SPEED_OF_LIGHT_M_S)
        return np.asarray((time_s - self.gate_delay_s) / self.bin_width_s)

    @property
    def gate_length_m(self) -> float:
        """Length of the gate in range: no error of an estimate within it is larger."""
        return self.n_bins * self.bin_length_m

    @property
    def bin_length_m(self) -> float:
        """Range covered by one bin, in metres."""
        return float(self.bin_width_s * SPEED_OF_LIGHT_M_S / 2)


def pulses_sent(acquisition: Acquisition) -> int:
    """Return the number of pulses of an acquisition.

    Raises
    ------
    ValueError
        If it is unknown.
    """
    if acquisition.n_pulses is None:
        raise ValueError("n_pulses = None is not accepted: give the number of pulses.")
    return acquisition.n_pulses


@dataclass(frozen=True)
class Pulse:
    """Temporal shape of an echo, normalised to one photon.

    ``Pulse(tau_s)`` is the paper's pulse, ``t / tau² · exp(-t / tau)`` for ``t >= 0``. Its time
    zero is the onset; that of `gaussian` is the centre, and that of `measured` the first sample.

    Parameters
    ----------
    tau_s : float
        Time constant in seconds, from `SHORTEST_PULSE_S` to `LONGEST_S`: the peak lies ``tau``
        after the onset, the full width at half maximum is 2.446 ``tau``. For a Gaussian the
        standard deviation, for a measured pulse the sample spacing.
    shape : str
        ``"gamma"``, ``"gaussian"`` or ``"measured"``.
    samples : tuple of float
        Samples of a measured pulse, in any unit.

    Raises
    ------
    ValueError
        If the time constant is out of its range, the shape is unknown, or the samples are negative,
        all zero, or together longer than `LONGEST_S`.
    """

    tau_s: float = 1e-9
    shape: Literal["gamma", "gaussian", "measured"] = field(default="gamma", kw_only=True)
    samples: tuple[float, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        require_time("tau_s", self.tau_s, SHORTEST_PULSE_S)
        shapes = ("gamma", "gaussian", "measured")
        require("shape", self.shape, self.shape in shapes, " or ".join(shapes))
        if self.shape == "measured":
            samples = np.asarray(self.samples, float)
            usable = samples.ndim == 1 and bool(np.all(samples >= 0)) and 0 < samples.sum() < np.inf
            shown = self.samples if samples.size < _MOST_SHOWN else f"{samples.size:,} of them"
            require("samples", shown, usable, "a list of non-negative numbers, not all zero")
            length_s = samples.size * self.tau_s
            allowed = f"at most {LONGEST_S} s"
            require("length of the samples", length_s, length_s <= LONGEST_S, allowed)

    @classmethod
    def gaussian(cls, sigma_s: float) -> Pulse:
        """Return a Gaussian pulse of standard deviation `sigma_s` seconds, centred on its delay."""
        return cls(sigma_s, shape="gaussian")

    @classmethod
    def measured(cls, samples: ArrayLike, bin_width_s: float) -> Pulse:
        """Return a pulse of non-negative `samples` (n,), each `bin_width_s` seconds wide."""
        return cls(
            bin_width_s,
            shape="measured",
            samples=tuple(np.asarray(samples, float).ravel().tolist()),
        )

    def cdf(self, time_s: ArrayLike) -> Floats:
        """Share of the photons that arrive before `time_s` seconds after time zero, any shape."""
        t = np.divide(time_s, self.tau_s)
        if self.shape == "gaussian":
            return np.asarray(scipy.special.ndtr(t))
        if self.shape == "measured":
            return np.asarray(np.interp(t, *self._measured_cdf))
        # In place: page faults of new arrays cost more than the exponential.
        t = np.maximum(t, 0.0, out=t) if isinstance(t, np.ndarray) else np.maximum(t, 0.0)
        decay = np.exp(-t)
        t += 1.0
        t *= decay
        return np.asarray(np.subtract(1.0, t))

    def density(self, time_s: ArrayLike) -> Floats:
        """Photons per second at `time_s` seconds after time zero, any shape: the slope of `cdf`.

        At the boundary of two samples of a measured pulse, that of the earlier one.
        """
        t = np.divide(time_s, self.tau_s)
        if self.shape == "gaussian":
            share = np.exp(-0.5 * t * t) / math.sqrt(2 * math.pi)
        elif self.shape == "measured":
            samples, total = self._measured_density
            at = np.clip(np.ceil(t), 0, samples.size - 1).astype(np.intp)
            share = samples[at] / total
        else:
            t = np.maximum(t, 0.0)
            share = t * np.exp(-t)
        return np.asarray(share / self.tau_s)

    @cached_property
    def _measured_cdf(self) -> tuple[Floats, Floats]:
        """Edges of the samples and the share of the photons before each, shape (sample + 1,)."""
        share = np.concatenate([[0.0], np.cumsum(self.samples)])
        return np.arange(share.size, dtype=float), share / share[-1]

    @cached_property
    def _measured_density(self) -> tuple[Floats, float]:
        """Samples padded with a zero on either side, shape (sample + 2,), and their sum."""
        samples = np.concatenate([[0.0], self.samples, [0.0]])
        return samples, samples.sum()

    @cached_property
    def sigma_s(self) -> float:
        """Standard deviation of the photons' arrival times in seconds."""
        if self.shape == "measured":
            at, weights = np.arange(len(self.samples)), np.asarray(self.samples)
            mean = np.average(at, weights=weights)
            variance = np.average((at - mean) ** 2, weights=weights) + 1 / 12
            return float(self.tau_s * math.sqrt(variance))
        return self.tau_s * (math.sqrt(2.0) if self.shape == "gamma" else 1.0)

    @cached_property
    def span_s(self) -> tuple[float, float]:
        """Times after time zero by which 10 % and 90 % of the photons have arrived."""
        return self.quantile_s(0.1), self.quantile_s(0.9)

    def quantile_s(self, share: float) -> float:
        """Time after time zero by which `share` of the photons, in (0, 1), have arrived."""
        return _quantile_s(self, share)

    def taps(
        self, n_bins: int, bin_width_s: float, delay_bin: ArrayLike = 0.0
    ) -> tuple[Floats, int]:
        """Return an echo as a filter, without the first and the last thousandth of its photons.

        Parameters
        ----------
        n_bins : int
            Bins in the gate; taps farther than this from the delay are left out.
        bin_width_s : float
            Width of one bin in seconds.
        delay_bin : array_like, any shape
            Delays from 0 to 1, in bins after the beginning of bin 0.

        Returns
        -------
        share : ndarray, shape (..., tap)
            Share of the echo's photons in each bin.
        first : int
            Bin of the first tap.
        """
        bins = self.tap_bins(n_bins, bin_width_s)
        delay = np.asarray(delay_bin, float) - bins.start
        return self.bin_probability(delay, len(bins), bin_width_s), bins.start

    def tap_bins(self, n_bins: int, bin_width_s: float) -> range:
        """Return the bins of the taps of `taps`, relative to the delay."""
        # If the gate closes before the echo arrives, its last bin is the only tap.
        first = math.floor(min(max(self.quantile_s(1e-3) / bin_width_s, -n_bins), n_bins - 1))
        return range(first, math.ceil(min(self.quantile_s(1 - 1e-3) / bin_width_s, n_bins)) + 1)

    def cumulative(self, onset_bin: ArrayLike, n_bins: int, bin_width_s: float) -> Floats:
        """Share of the photons before each bin edge.

        Parameters
        ----------
        onset_bin : array_like, any shape
            Delay of the echo in fractional bins; not finite means no echo.
        n_bins, bin_width_s
            As in `taps`.

        Returns
        -------
        ndarray, shape (..., n_bins + 1)
            From the opening edge of the gate to its closing edge.
        """
        onset = np.asarray(onset_bin, float)
        before = self.cdf((np.arange(n_bins + 1) - onset[..., np.newaxis]) * bin_width_s)
        before[~np.isfinite(onset)] = 0.0
        return before

    def bin_probability(self, onset_bin: ArrayLike, n_bins: int, bin_width_s: float) -> Floats:
        """Share of the echo's photons in each bin: the pulse integrated over the bin.

        Takes the parameters of `cumulative` and returns shape (..., n_bins), which sums to at most
        1: photons outside the gate are missing.
        """
        return np.diff(self.cumulative(onset_bin, n_bins, bin_width_s), axis=-1)


@lru_cache(maxsize=256)
def _quantile_s(pulse: Pulse, share: float) -> float:
    """Return `Pulse.quantile_s`, cached: captures share a few pulses."""
    high = len(pulse.samples) + 40.0
    low = -high
    for _ in range(64):  # bisection to the spacing of floats
        middle = 0.5 * (low + high)
        low, high = (low, middle) if pulse.cdf(middle * pulse.tau_s) > share else (middle, high)
    return pulse.tau_s * high


@dataclass(frozen=True)
class Flux:
    """Detected photons per pulse.

    Parameters
    ----------
    signal : float
        Signal photons per pulse from a surface of reflectivity 1 (the paper's PPP), non-negative.
        PPP is photons per pulse in all texts here; for others it is often photons per pixel.
    sbr : float
        Signal divided by the background over the *whole* gate, positive. It depends on the width of
        the gate, so quote it with the number of bins. Infinity means no background.

    Raises
    ------
    ValueError
        If a value is out of its range, or the background is not finite.
    """

    signal: float = 0.1041
    sbr: float = 0.06

    def __post_init__(self) -> None:
        accepted = "a finite and non-negative number of photons per pulse"
        require_type("signal", self.signal, Real, accepted)
        require("signal", self.signal, 0 <= self.signal < np.inf, accepted)
        require_type("sbr", self.sbr, Real, "a positive number")
        require("sbr", self.sbr, self.sbr > 0, "a positive number")
        background = self.signal / self.sbr
        require("background, signal / sbr", background, background < np.inf, "a finite number")

    @property
    def background(self) -> float:
        """Background photons per pulse over the whole gate."""
        return self.signal / self.sbr
