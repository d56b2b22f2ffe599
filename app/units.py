"""Numbers on screen: formatted quantities, and positions along the gate in a chosen unit.

Data stay in bins; only displayed numbers are converted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from core import Acquisition
from core.metrics import Interval
from core.typesetting import interval_text, three_digits, typeset

OPPOSITE_UNIT = {"bins": "m", "ns": "m", "m": "bins"}
"""Unit of the axis opposite to the chosen one."""

AXIS_TITLES = {"bins": "Bin", "ns": "Time (ns)", "m": "Range (m)"}
WHOLE_GATE_TITLE = "Bin of the whole gate"
"""Title of an axis over bins of a cut gate, or over merged bins."""


class Quantity(str):
    """Text of a number that keeps the number, which tables and downloads use.

    Parameters
    ----------
    text : str
        As shown on screen; a dash if `value` is NaN.
    value : float
    unit : str
    low, high : float, optional
        Ends of an interval.
    note : str
        Remark in the text.
    decimals : int, optional
        Decimals that the interval of the number supports.
    """

    value: float
    unit: str
    low: float | None
    high: float | None
    note: str
    decimals: int | None

    def __new__(
        cls,
        text: str,
        value: float,
        unit: str = "",
        low: float | None = None,
        high: float | None = None,
        note: str = "",
        decimals: int | None = None,
    ) -> Quantity:
        """Attach a number to its text."""
        quantity = super().__new__(cls, "–" if math.isnan(value) else text)
        quantity.value, quantity.unit, quantity.note = value, unit, note
        quantity.low, quantity.high, quantity.decimals = low, high, decimals
        return quantity

    def rounded(self, value: float | None) -> float | None:
        """Return the number, or an end of its interval, with the decimals that these support."""
        return value if value is None or self.decimals is None else round(value, self.decimals)


def number(value: float, unit: str, sign: bool = False, decimals: int | None = None) -> Quantity:
    """Format a number with its unit, by default with four digits; a dash if it is not finite."""
    value = value if math.isfinite(value) else math.nan
    plus = "+" if sign else ""
    if decimals is not None:
        text = f"{value:{plus},.{decimals}f}"
    elif sign or abs(value) < 1000:
        text = f"{value:{plus}.4g}"
    else:
        text = f"{value:,.2f}"
    return Quantity(f"{typeset(text)} {unit}".strip(), value, unit, decimals=decimals)


def plus_minus(low: float, high: float, unit: str) -> Quantity:
    """Format an interval as its middle and half its width; a dash for NaN."""
    middle, half = (low + high) / 2, (high - low) / 2
    decimals = Interval(middle, low, high).decimals
    if decimals is None:
        return Quantity("", math.nan, unit)
    text = f"{middle:,.{decimals}f} ± {half:.{decimals}f} {unit}"
    return Quantity(text, middle, unit, low, high, decimals=decimals)


def with_margin(found: Interval, unit: str, note: str = "") -> Quantity:
    """Format an estimate with a margin that includes its interval; without one as `number`.

    A remark on the margin follows in brackets.

    The estimate of a method need not be the middle of the interval: the margin is the distance to
    the farther end.
    """
    margin = max(found.high - found.value, found.value - found.low)
    decimals = Interval(found.value, found.value - margin, found.value + margin).decimals
    if decimals is None:
        return number(found.value, unit)
    text = typeset(f"{found.value:,.{decimals}f} ± {margin:.{decimals}f}")
    text = f"{text} {unit}".strip() + (f" ({note})" if note else "")
    return Quantity(text, found.value, unit, found.low, found.high, note, decimals)


def between(low: float, high: float, unit: str) -> Quantity:
    """Format the ends of an interval; a dash for NaN."""
    decimals = Interval((low + high) / 2, low, high).decimals
    if decimals is None:
        return Quantity("", math.nan, unit)
    text = f"{low:,.{decimals}f}–{high:,.{decimals}f} {unit}"
    return Quantity(text, (low + high) / 2, unit, low, high, decimals=decimals)


def count(value: int, note: str = "") -> Quantity:
    """Format an integer, with a remark in brackets."""
    return Quantity(f"{value:,} ({note})" if note else f"{value:,}", value, note=note)


def noted(value: float, note: str) -> Quantity:
    """Format a number with three digits, with a remark in brackets."""
    text = three_digits(value)
    return Quantity(f"{text} ({note})" if note else text, value, note=note)


def share(value: float) -> Quantity:
    """Format a share in percent."""
    return Quantity(f"{100 * value:.1f} %", 100 * value, "%")


def milliseconds(seconds: float) -> Quantity:
    """Format a duration."""
    if seconds < 1:
        return Quantity(f"{1000 * seconds:.1f} ms", 1000 * seconds, "ms")
    return Quantity(f"{seconds:.2f} s", seconds, "s")


def interval(value: float, low: float, high: float) -> Quantity:
    """Format a number with the ends of its interval, or with the lower one if it has no other."""
    return Quantity(interval_text(value, low, high), value, low=low, high=high)


@dataclass(frozen=True)
class ShownGate:
    """The gate of a reduced capture as a part of the whole one, whose bins are those on screen.

    Parameters
    ----------
    acquisition : Acquisition
        The reduced capture's; positions are given in its bins.
    first : int
        Bin of the whole gate at which it opens.
    merge : int
        Bins of the whole gate in each of its bins.
    """

    acquisition: Acquisition
    first: int = 0
    merge: int = 1

    @property
    def n_bins(self) -> int:
        """Number of its bins."""
        return self.acquisition.n_bins


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

    @property
    def title(self) -> str:
        """Title of an axis or a column."""
        is_whole = self.name != "bins" or (self.origin, self.step) == (0, 1)
        return AXIS_TITLES[self.name] if is_whole else WHOLE_GATE_TITLE

    def at(self, position_bin: float) -> float:
        """Convert a position from bins to the unit."""
        return self.origin + self.step * position_bin

    @property
    def decimals(self) -> int:
        """Number of decimals that resolves a hundredth of a bin."""
        return max(0, 2 - math.floor(math.log10(self.step)))

    @property
    def edge_decimals(self) -> int:
        """Number of decimals that resolves a tenth of a bin; none for whole bins."""
        return 0 if self.name == "bins" else max(0, self.decimals - 1)

    def length(self, bins: float) -> str:
        """Format a distance, given in bins, with the unit."""
        return f"{self.step * bins:.{max(0, self.decimals - 1)}f} {self.name}"

    def number(self, position_bin: float) -> Quantity:
        """Format a position without its unit; a dash for NaN."""
        value = self.at(position_bin)
        return Quantity(f"{value:,.{self.decimals}f}", value, decimals=self.decimals)

    def place(self, position_bin: float) -> Quantity:
        """Format a position with its unit; a dash for NaN."""
        return self._named(self.number(position_bin))

    def number_with_margin(self, found: Interval) -> Quantity:
        """Format a position with its interval, given in bins, without the unit."""
        return with_margin(Interval(*map(self.at, (found.value, found.low, found.high))), "")

    def place_with_margin(self, found: Interval) -> Quantity:
        """Format a position with its interval, given in bins, with the unit."""
        return self._named(self.number_with_margin(found))

    def _named(self, number: Quantity) -> Quantity:
        text = f"bin {number}" if self.name == "bins" else f"{number} {self.name}"
        ends = number.low, number.high
        return Quantity(text, number.value, self.name, *ends, decimals=number.decimals)


def scale(unit: str, gate: ShownGate) -> Scale:
    """Return a unit of `app.model.state.UNITS` along a gate; bins are those of the whole gate."""
    acquisition = gate.acquisition
    if unit == "bins":
        return Scale(unit, float(gate.first), float(gate.merge))
    if unit == "ns":
        return Scale(unit, acquisition.gate_delay_s * 1e9, acquisition.bin_width_s * 1e9)
    return Scale(unit, float(acquisition.bin_to_range_m(0)), acquisition.bin_length_m)
