"""Axes and read-outs along the gate in the chosen unit.

Data stay in bins; only the labels change with the unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bokeh.models import (
    CustomJSHover,
    CustomJSTicker,
    CustomJSTickFormatter,
    HoverTool,
    LinearAxis,
)

from app.model.state import UNITS
from app.units import OPPOSITE_UNIT, ShownGate, scale
from core import Acquisition

# Ticks at 1, 2, 2.5 or 5 times a power of ten in the unit, and where these are in bins.
TICKS = """
const ends = [cb_data.start, cb_data.end].map((bin) => origin + step * bin);
const [low, high] = [Math.min(...ends), Math.max(...ends)];
const rough = (high - low) / (innerWidth < 500 ? 5 : 7);
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

# As many decimals as distinguish neighbouring ticks.
LABELS = """
const every = ticks.length > 1 ? Math.abs(step * (ticks[1] - ticks[0])) : Math.abs(step);
const isWhole = (value) => Math.abs(value - Math.round(value)) < 1e-6;
const decimals = [0, 1, 2, 3, 4, 5].find((n) => isWhole(every * 10 ** n)) ?? 6;
return (origin + step * tick).toFixed(decimals);
"""


class GateAxes:
    """Both horizontal axes of a plot over bins: the chosen unit below, its complement above.

    Parameters
    ----------
    figure : bokeh.plotting.figure
        Has one horizontal axis, over bins.
    has_top : bool
        Whether to add the upper axis.
    """

    def __init__(self, figure: Any, has_top: bool = True) -> None:
        self._axes = [figure.below[0]]
        if has_top:
            figure.add_layout(LinearAxis(), "above")
            self._axes.append(figure.above[0])
        for axis in self._axes:
            args = {"origin": 0.0, "step": 1.0, "name": "bins"}
            axis.ticker = CustomJSTicker(args=args, major_code=TICKS)
            axis.formatter = CustomJSTickFormatter(args=args, code=LABELS)
        self.follow("bins", ShownGate(Acquisition()))

    def follow(self, unit: str, gate: ShownGate) -> None:
        """Set the unit and the gate."""
        for axis, name in zip(self._axes, (unit, OPPOSITE_UNIT[unit]), strict=False):
            along = scale(name, gate)
            args = {"origin": along.origin, "step": along.step, "name": name}
            if axis.formatter.args != args:
                axis.ticker.args = axis.formatter.args = args
            axis.axis_label = along.title


# At the pointer: the bins of the whole gate, the position of the centre, or the value of a curve.
READ_OUT = """
const bin = special_vars.index;
const [along] = renderer.tags;
if (format === "bin") {
  const [first, merge] = along.bins;
  const begin = first + merge * bin;
  return merge > 1 ? `${begin}–${begin + merge - 1}` : String(begin);
}
if (format in along) {
  const [origin, step, decimals] = along[format];
  return `${(origin + step * (bin + 0.5)).toFixed(decimals)} ${format}`;
}
const found = sources[format].data[columns[format]][bin];
return Number.isFinite(found) ? String(Number(found.toPrecision(4))) : "–";
"""


class GateReadOut:
    """Bin, time, range and values of curves under the pointer, computed in the browser.

    Parameters
    ----------
    figure : bokeh.plotting.figure
    renderer : GlyphRenderer
        Opens the read-out; has one item for each bin.
    rows : sequence of (name, source, column)
        Values that are read out, each a column with a value for each bin.
    """

    def __init__(self, figure: Any, renderer: Any, rows: Sequence[tuple[str, Any, str]]) -> None:
        columns = {f"{n}": column for n, (_, _, column) in enumerate(rows)}
        sources = {f"{n}": source for n, (_, source, _) in enumerate(rows)}
        args = {"renderer": renderer, "sources": sources, "columns": columns}
        self._renderer = renderer
        self._gate: ShownGate | None = None
        self.follow(ShownGate(Acquisition()))
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
                formatters={field: CustomJSHover(args=args, code=READ_OUT)},
            )
        )

    def follow(self, gate: ShownGate) -> None:
        """Set the gate."""
        if gate == self._gate:
            return
        self._gate = gate
        along = {name: scale(name, gate) for name in UNITS}
        # Not as an argument: with those that are models, Bokeh would go through the whole page.
        self._renderer.tags = [
            {n: [each.origin, each.step, each.decimals] for n, each in along.items()}
        ]
