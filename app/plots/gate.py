"""Positions along the gate in the unit of the user's choice: on axes, in tables, in words.

Data stay in bins; only what is written at a position changes with the unit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bokeh.models import (
    CustomJSHover,
    CustomJSTicker,
    CustomJSTickFormatter,
    HoverTool,
    LinearAxis,
)

from core import Acquisition

COMPLEMENT = {"bins": "m", "ns": "m", "m": "bins"}
"""What stands on the opposite axis."""

TITLES = {"bins": "Bin", "ns": "Time (ns)", "m": "Range (m)"}

# Ticks at 1, 2, 2.5 or 5 times a power of ten in the unit, and where these are in bins.
TICKS = """
const ends = [cb_data.start, cb_data.end].map((bin) => origin + step * bin);
const [low, high] = [Math.min(...ends), Math.max(...ends)];
const rough = (high - low) / 7;
if (!(rough > 0)) return [];
const power = 10 ** Math.floor(Math.log10(rough));
const least = name === "bins" ? 1 : 0;
const every = Math.max(least, power * [1, 2, 2.5, 5, 10].find((nice) => nice * power >= rough));
const ticks = [];
for (let n = Math.ceil(low / every); n * every <= high + 1e-9 * every; n++) {
  ticks.push((n * every - origin) / step);
}
return ticks;
"""

# As many decimals as tell neighbouring ticks apart.
WORDS = """
const every = ticks.length > 1 ? Math.abs(step * (ticks[1] - ticks[0])) : Math.abs(step);
const isWhole = (value) => Math.abs(value - Math.round(value)) < 1e-6;
const decimals = [0, 1, 2, 3, 4, 5].find((n) => isWhole(every * 10 ** n)) ?? 6;
return (origin + step * tick).toFixed(decimals);
"""


@dataclass(frozen=True)
class Scale:
    """A unit along a gate: ``origin + step * bin``."""

    name: str
    origin: float
    step: float

    def at(self, position_bin: float) -> float:
        """A position in the unit."""
        return self.origin + self.step * position_bin

    @property
    def decimals(self) -> int:
        """Of a position: as many as show about a hundredth of a bin."""
        return max(0, 2 - math.floor(math.log10(self.step)))

    def number(self, position_bin: float) -> str:
        """A position without its unit; a dash where there is none."""
        known = math.isfinite(position_bin)
        return f"{self.at(position_bin):,.{self.decimals}f}" if known else "–"

    def place(self, position_bin: float) -> str:
        """A position in words; a dash where there is none."""
        number = self.number(position_bin)
        if number == "–":
            return number
        return f"bin {number}" if self.name == "bins" else f"{number} {self.name}"


def scale(unit: str, acquisition: Acquisition) -> Scale:
    """A unit of `app.model.state.UNITS` along the gate of an acquisition."""
    if unit == "bins":
        return Scale(unit, 0.0, 1.0)
    if unit == "ns":
        return Scale(unit, acquisition.gate_delay_s * 1e9, acquisition.bin_width_s * 1e9)
    return Scale(unit, float(acquisition.bin_to_range_m(0)), acquisition.bin_length_m)


class GateAxes:
    """Both horizontal axes of a plot over bins: the unit below, its complement above.

    Parameters
    ----------
    figure : bokeh.plotting.figure
        With one horizontal axis, over bins.
    has_top : bool
        Whether it gets a second one, above.
    """

    def __init__(self, figure: Any, has_top: bool = True) -> None:
        self._axes = [figure.below[0]]
        if has_top:
            figure.add_layout(LinearAxis(), "above")
            self._axes.append(figure.above[0])
        for axis in self._axes:
            args = {"origin": 0.0, "step": 1.0, "name": "bins"}
            axis.ticker = CustomJSTicker(args=args, major_code=TICKS)
            axis.formatter = CustomJSTickFormatter(args=args, code=WORDS)
        self.follow("bins", Acquisition())

    def follow(self, unit: str, acquisition: Acquisition) -> None:
        """Take on another unit or gate."""
        for axis, name in zip(self._axes, (unit, COMPLEMENT[unit]), strict=False):
            along = scale(name, acquisition)
            args = {"origin": along.origin, "step": along.step, "name": name}
            if axis.formatter.args != args:
                axis.ticker.args = axis.formatter.args = args
            axis.axis_label = TITLES[name]


# What stands where the pointer is: the bin's own number, the place of its middle, or a curve there.
READ_OUT = """
const bin = special_vars.index;
if (format === "bin") return String(bin);
if (format in along) {
  const [origin, step, decimals] = along[format];
  return `${(origin + step * (bin + 0.5)).toFixed(decimals)} ${format}`;
}
const found = sources[format].data[columns[format]][bin];
return Number.isFinite(found) ? String(Number(found.toPrecision(4))) : "–";
"""


class GateReadOut:
    """Bin, time, range and values of curves under the pointer, as the browser knows them.

    Parameters
    ----------
    figure : bokeh.plotting.figure
    renderer : GlyphRenderer
        One item for each bin; over these the read-out opens.
    rows : sequence of (name, source, column)
        What is read out, each a column with a value for each bin.
    """

    def __init__(self, figure: Any, renderer: Any, rows: Sequence[tuple[str, Any, str]]) -> None:
        self._names = CustomJSHover(code=READ_OUT)
        self._columns = {f"{n}": column for n, (_, _, column) in enumerate(rows)}
        self._sources = {f"{n}": source for n, (_, source, _) in enumerate(rows)}
        self._acquisition: Acquisition | None = None
        self.follow(Acquisition())
        field = "@left" if "left" in renderer.data_source.data else "@bin"
        values = [(name, f"{field}{{{n}}}") for n, (name, _, _) in enumerate(rows)]
        figure.add_tools(
            HoverTool(
                renderers=[renderer],
                mode="vline",
                tooltips=[
                    ("Bin", f"{field}{{bin}}"),
                    ("Time", f"{field}{{ns}}"),
                    ("Range", f"{field}{{m}}"),
                    *values,
                ],
                formatters={field: self._names},
            )
        )

    def follow(self, acquisition: Acquisition) -> None:
        """Take on another gate."""
        if acquisition == self._acquisition:
            return
        self._acquisition = acquisition
        along = {name: scale(name, acquisition) for name in ("ns", "m")}
        self._names.args = {
            "along": {n: [each.origin, each.step, each.decimals] for n, each in along.items()},
            "sources": self._sources,
            "columns": self._columns,
        }
