"""Units of positions along the gate: bins, nanoseconds and metres.

Data stay in bins; only displayed numbers are converted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from core import Acquisition

OPPOSITE_UNIT = {"bins": "m", "ns": "m", "m": "bins"}
"""Unit of the axis opposite to the chosen one."""

AXIS_TITLES = {"bins": "Bin", "ns": "Time (ns)", "m": "Range (m)"}


@dataclass(frozen=True)
class Scale:
    """A unit along a gate.

    Parameters
    ----------
    name : str
        "bins", "ns" or "m".
    origin : float
        Value at the start of bin 0.
    step : float
        Width of a bin.
    """

    name: str
    origin: float
    step: float

    def at(self, position_bin: float) -> float:
        """Convert a position from bins to the unit."""
        return self.origin + self.step * position_bin

    @property
    def decimals(self) -> int:
        """Number of decimals that resolves a hundredth of a bin."""
        return max(0, 2 - math.floor(math.log10(self.step)))

    def number(self, position_bin: float) -> str:
        """Format a position without its unit; a dash for NaN."""
        is_known = math.isfinite(position_bin)
        return f"{self.at(position_bin):,.{self.decimals}f}" if is_known else "–"

    def place(self, position_bin: float) -> str:
        """Format a position with its unit; a dash for NaN."""
        number = self.number(position_bin)
        if number == "–":
            return number
        return f"bin {number}" if self.name == "bins" else f"{number} {self.name}"


def scale(unit: str, acquisition: Acquisition) -> Scale:
    """Return a unit of `app.model.state.UNITS` for the gate of an acquisition."""
    if unit == "bins":
        return Scale(unit, 0.0, 1.0)
    if unit == "ns":
        return Scale(unit, acquisition.gate_delay_s * 1e9, acquisition.bin_width_s * 1e9)
    return Scale(unit, float(acquisition.bin_to_range_m(0)), acquisition.bin_length_m)
