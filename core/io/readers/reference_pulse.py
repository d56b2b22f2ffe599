"""Pulses that a sensor records by a detector of its own, and the range zero that follows.

Time-of-flight sensors of AMS have a reference detector next to the laser. The sum of its
histograms from the first bin that reaches a hundredth of the highest is the pulse; that bin is its
time zero.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Pulse
from core.checks import require
from core.io.readers.options import ReadOptions
from core.io.readers.quantities import time_text

_RISE = 0.01


class ReferencePulse(NamedTuple):
    """Pulse of a sensor, and when it rises."""

    pulse: Pulse
    rise_s: float
    """Time from the beginning of the first bin to the pulse's time zero, in seconds."""

    @property
    def peak_s(self) -> float:
        """Time from the beginning of the first bin to the peak, in seconds."""
        return self.rise_s + peak_s(self.pulse)


def reference_pulse(references: NDArray[Any], bin_width_s: float, name: str) -> ReferencePulse:
    """Return the pulse of the sum of reference histograms.

    Parameters
    ----------
    references : ndarray, shape (histogram, bin)
        Counts.
    bin_width_s : float
        Width of a bin in seconds.
    name : str
        Name of the counts in errors.

    Raises
    ------
    ValueError
        If a count is negative or not finite, or all are 0.
    """
    lowest = references.min().item()
    require(name, lowest, lowest >= 0, "counts, 0 or more")
    reference = references.sum(axis=0, dtype=float)
    highest = float(reference.max())
    require(name, highest, 0 < highest < np.inf, "finite counts, not all 0")
    rise = int(np.argmax(reference >= _RISE * highest))
    return ReferencePulse(Pulse.measured(reference[rise:], bin_width_s), rise * bin_width_s)


def peak_s(pulse: Pulse) -> float:
    """Return the time from a pulse's zero to its peak, in seconds."""
    if pulse.shape == "measured":
        return (int(np.argmax(pulse.samples)) + 0.5) * pulse.tau_s
    return 0.0 if pulse.shape == "gaussian" else pulse.tau_s


def completed_by_sensor(
    request: ReadOptions, bin_width_s: float, pulse: Pulse | None, peak_at_0_m_s: float
) -> tuple[ReadOptions, list[str]]:
    """Complete a request by what is known of a sensor; return what was guessed, too.

    Parameters
    ----------
    bin_width_s : float
        Width of a bin in seconds where the request specifies none.
    pulse : Pulse or None
        The sensor's, if known.
    peak_at_0_m_s : float
        Time from the beginning of the first bin to the peak of an echo from 0 m, in seconds.
    """
    width_s = request.bin_width_s or bin_width_s
    known = replace(
        request,
        bin_width_s=width_s,
        pulse=request.pulse or pulse,
        detection=request.detection or "all",
    )
    guessed = [f"bin width {time_text(width_s)}"] * (request.bin_width_s is None)
    if request.gate_delay_s is None and request.stop_s is None:
        delay_s = peak_s(known.pulse or Pulse.gaussian(width_s)) - peak_at_0_m_s
        known = replace(known, gate_delay_s=delay_s)
        guessed.append(f"zero range {time_text(-delay_s)} after the first bin")
    return known, guessed
