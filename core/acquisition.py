"""The instrument: gate, bins, pulse, and the only place where bins become time and metres."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Literal

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import ArrayLike, NDArray

from core.checks import require, require_whole

Floats = NDArray[np.float64]

SPEED_OF_LIGHT_M_S = 299_792_458.0  # exactly: this is what a metre is

LONGEST_S = 10.0
"""Longest time that any part of an acquisition may take: light needs 2.6 s to the Moon and back."""

SHORTEST_BIN_S, SHORTEST_PULSE_S = 1e-18, 1e-21
"""Smallest bin width and pulse time constant: far below what any detector resolves."""

MOST_BINS = 2**24
"""Largest number of bins in a gate."""

_MOST_SHOWN = 10  # samples in a message

MOST_PULSES = 2**53
"""Largest number of pulses: every whole number up to here is exact as a float."""


def require_time(name: str, value_s: float, least_s: float) -> None:
    """Raise ``ValueError`` unless a time lies between `least_s` and `LONGEST_S` seconds."""
    accepted = f"a time from {least_s:g} to {LONGEST_S:g} s"
    require(name, value_s, least_s <= value_s <= LONGEST_S, accepted)


@dataclass(frozen=True)
class Acquisition:
    """How a capture was, or is to be, recorded.

    Bin ``k`` covers the time ``gate_delay_s + [k, k + 1) * bin_width_s`` after the pulse leaves.

    Parameters
    ----------
    n_bins : int
        Bins in the gate, from 1 to `MOST_BINS`.
    bin_width_s : float
        Width of one bin in seconds, from `SHORTEST_BIN_S` to `LONGEST_S`; the whole gate lasts at
        most `LONGEST_S`.
    gate_delay_s : float
        Time from the pulse to the opening of the gate in seconds, at most `LONGEST_S` in either
        direction.
    n_pulses : int or None
        Pulses sent for each pixel, from 1 to `MOST_PULSES`; None where a file does not say.
    pixel_angle_rad : float or None
        Angle between the lines of sight of neighbouring pixels, in radians; None where a file does
        not say.

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
            require_whole("n_pulses", self.n_pulses, MOST_PULSES, ", or None where it is not known")
        require(
            "pixel_angle_rad",
            self.pixel_angle_rad,
            self.pixel_angle_rad is None or 0 < self.pixel_angle_rad < 1,
            "between 0 and 1 radian, or None where it is not known",
        )

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
    def bin_length_m(self) -> float:
        """Range covered by one bin, in metres."""
        return float(self.bin_width_s * SPEED_OF_LIGHT_M_S / 2)


@dataclass(frozen=True)
class Pulse:
    """Shape in time of a returned echo, normalised to one photon.

    ``Pulse(tau_s)`` is the pulse of the paper, ``t / tau² · exp(-t / tau)`` for ``t >= 0``, whose
    time zero is its onset. `gaussian` has its time zero at its centre, `measured` at its first
    sample.

    Parameters
    ----------
    tau_s : float
        Time constant in seconds, from `SHORTEST_PULSE_S` to `LONGEST_S`: the peak comes ``tau``
        after the onset, the full width at half maximum is 2.446 ``tau``. (Standard deviation of a
        Gaussian, sample spacing of a measured pulse.)

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
        """A Gaussian pulse of standard deviation `sigma_s` seconds around its delay."""
        return cls(sigma_s, shape="gaussian")

    @classmethod
    def measured(cls, samples: ArrayLike, bin_width_s: float) -> Pulse:
        """A recorded pulse: non-negative `samples` (n,), each `bin_width_s` seconds wide."""
        return cls(
            bin_width_s,
            shape="measured",
            samples=tuple(np.asarray(samples, float).ravel().tolist()),
        )

    def cdf(self, time_s: ArrayLike) -> Floats:
        """Share of the pulse's photons that arrived before `time_s` (any shape) after time zero."""
        t = np.divide(time_s, self.tau_s)
        if self.shape == "gaussian":
            return np.asarray(scipy.special.ndtr(t))
        if self.shape == "measured":
            return np.asarray(np.interp(t, *self._measured_cdf))
        # In place: a fresh array for each step costs more, in page faults, than the exponential.
        t = np.maximum(t, 0.0, out=t) if isinstance(t, np.ndarray) else np.maximum(t, 0.0)
        decay = np.exp(-t)
        t += 1.0
        t *= decay
        return np.asarray(np.subtract(1.0, t))

    def density(self, time_s: ArrayLike) -> Floats:
        """Photons per second at `time_s` (any shape) after time zero: the slope of `cdf`.

        Where a measured pulse steps from one sample to the next it is that of the sample before.
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
        """Edges of the samples and the share of the photons before each; shape (sample + 1,)."""
        share = np.concatenate([[0.0], np.cumsum(self.samples)])
        return np.arange(share.size, dtype=float), share / share[-1]

    @cached_property
    def _measured_density(self) -> tuple[Floats, float]:
        """The samples between two zeros, shape (sample + 2,), and their sum."""
        samples = np.concatenate([[0.0], self.samples, [0.0]])
        return samples, samples.sum()

    @cached_property
    def span_s(self) -> tuple[float, float]:
        """Times after time zero by which a tenth and nine tenths of the photons have arrived."""
        return self.quantile_s(0.1), self.quantile_s(0.9)

    def quantile_s(self, share: float) -> float:
        """Time after time zero by which `share` of the photons, in (0, 1), have arrived."""
        return _quantile_s(self, share)

    def taps(
        self, n_bins: int, bin_width_s: float, delay_bin: ArrayLike = 0.0
    ) -> tuple[Floats, int]:
        """An echo as a filter sees it: all but a thousandth of its photons on either side.

        Parameters
        ----------
        n_bins : int
            Bins in the gate: no more of them before or after the delay count.
        bin_width_s : float
        delay_bin : array_like, any shape
            Delays from 0 to 1, in bins after the beginning of bin 0.

        Returns
        -------
        share : ndarray, shape (..., tap)
            Share of the echo's photons in each bin.
        first : int
            The bin of the first tap.
        """
        # In a gate that closes before that much has arrived, its last bin is what there is to see.
        first = math.floor(min(max(self.quantile_s(1e-3) / bin_width_s, -n_bins), n_bins - 1))
        end = math.ceil(min(self.quantile_s(1 - 1e-3) / bin_width_s, n_bins)) + 1
        delay = np.asarray(delay_bin, float) - first
        return self.bin_probability(delay, end - first, bin_width_s), first

    def cumulative(self, onset_bin: ArrayLike, n_bins: int, bin_width_s: float) -> Floats:
        """Share of the photons before each bin edge.

        Parameters
        ----------
        onset_bin : array_like, any shape
            Delay of the echo in fractional bins; one that is not finite means no echo.

        Returns
        -------
        ndarray, shape (..., n_bins + 1)
            From the gate's opening edge to its closing edge.
        """
        onset = np.asarray(onset_bin, float)
        before = self.cdf((np.arange(n_bins + 1) - onset[..., np.newaxis]) * bin_width_s)
        before[~np.isfinite(onset)] = 0.0
        return before

    def bin_probability(self, onset_bin: ArrayLike, n_bins: int, bin_width_s: float) -> Floats:
        """Share of the echo's photons in each bin (the pulse integrated over the bin).

        Parameters
        ----------
        onset_bin : array_like, any shape
            Delay of the echo in fractional bins, also outside the gate; NaN means no echo.
        n_bins : int
            Bins in the gate.
        bin_width_s : float
            Width of one bin in seconds.

        Returns
        -------
        ndarray, shape (..., n_bins)
            Sums to at most 1: what falls outside the gate is missing.
        """
        return np.diff(self.cumulative(onset_bin, n_bins, bin_width_s), axis=-1)


@lru_cache(maxsize=256)
def _quantile_s(pulse: Pulse, share: float) -> float:
    """As `Pulse.quantile_s`, found once: every capture of a session asks for the same few."""
    high = len(pulse.samples) + 40.0
    low = -high
    for _ in range(64):  # halvings: less is left than between two floats
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
    sbr : float
        Signal divided by the background over the *whole* gate, positive: it depends on the gate's
        width, so always quote it with the number of bins. Infinity means no background.
    """

    signal: float = 0.1041
    sbr: float = 0.06

    def __post_init__(self) -> None:
        require("signal", self.signal, 0 <= self.signal < np.inf, "photons per pulse, 0 or more")
        require("sbr", self.sbr, self.sbr > 0, "positive")
        background = self.signal / self.sbr
        require("background, signal / sbr", background, background < np.inf, "a finite number")

    @property
    def background(self) -> float:
        """Background photons per pulse over the whole gate."""
        return self.signal / self.sbr
