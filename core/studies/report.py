"""Write the items of a study as files, and all of them on one self-contained HTML page."""

from __future__ import annotations

import html
import io
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, NullFormatter

from core.io import OUTSIDE_COLOR, RangeColors, colors_of
from core.io.writers.picture import drawing, save_figure
from core.metrics import Interval
from core.studies.outputs import (
    Item,
    Pictures,
    Plot,
    Scatter,
    Table,
    as_csv,
    as_text,
    columns_and_rows,
)
from core.studies.pulses import Pulses

__all__ = ["picture", "write"]

_STYLES = ("-", "--", "-.", ":")
_MARKERS = ("o", "s", "^", "v", "D", "P", "X")
_DRAWN_PULSES, _COUNTED = 10, 4  # pulses to be counted by hand, and the counts that fit
_PRINTED_INCHES = (7.0, 3.2)  # on a sheet of A4, at the size of its text
_KEPT = "kept"  # what blank axes keep
_MAX_FINE_SPAN = 1e4  # longer logarithmic axes are labelled at powers of ten only
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
:root {{ color-scheme: light; }}
body {{ font: 16px/1.5 system-ui, sans-serif; color: #1c2430; background: #fff;
  max-width: 1180px; margin: 2rem auto; padding: 0 1rem; }}
h2 {{ margin-top: 3rem; }}
figure {{ margin: 0; }}
figure img {{ max-width: 100%; height: auto; }}
p.note {{ color: #4a5565; max-width: 75ch; }}
/* Wide tables take the width of the window, beyond that of the text. */
div.table {{ overflow-x: auto; width: max-content; min-width: 100%;
  max-width: calc(100vw - 2rem); margin-left: 50%; transform: translateX(-50%); }}
table {{ border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }}
th, td {{ padding: 3px 8px; text-align: right; border-bottom: 1px solid #d9dee5; }}
th {{ position: sticky; top: 0; background: #f2f5f8; }}
th:first-child, td.text {{ text-align: left; }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""


def write(items: Sequence[Item], folder: Path, title: str, introduction: Sequence[str]) -> Path:
    """Write each item as CSV and PNG, plots as SVG too, and one page with all of them.

    Returns
    -------
    path
        The page, ``index.html``, which embeds its images.
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = [f"<p>{html.escape(paragraph)}</p>" for paragraph in introduction]
    for item in items:
        text = as_csv(*columns_and_rows(item))
        (folder / f"{item.key}.csv").write_text(text, encoding="utf-8", newline="")
        parts.append(f'<h2 id="{item.key}">{html.escape(item.title)}</h2>')
        if isinstance(item, Table):
            parts.append(_html_table(item))
        else:
            kinds = ("png",) if isinstance(item, Pictures) else ("png", "svg")
            with drawing():
                figure = _drawn(item)
                _lay_out(figure)
                images = {kind: _saved(figure, kind) for kind in kinds}
            for kind, image in images.items():
                (folder / f"{item.key}.{kind}").write_bytes(image)
            source = f"data:image/png;base64,{b64encode(images['png']).decode()}"
            parts.append(f'<figure><img src="{source}" alt="{html.escape(item.title)}"></figure>')
        if item.note:
            parts.append(f'<p class="note">{html.escape(item.note)}</p>')
    page = folder / "index.html"
    page.write_text(_PAGE.format(title=html.escape(title), body="\n".join(parts)), encoding="utf-8")
    return page


def picture(item: Plot | Pictures | Pulses, is_blank: bool = False) -> str:
    """Return an item as the address of an image, which holds the image itself.

    With `is_blank`, axes alone are drawn, to sketch on; of pulses, also the photons.
    """
    kind, media = ("png", "png") if isinstance(item, Pictures) else ("svg", "svg+xml")
    with drawing():
        figure = _drawn(item)
        if isinstance(item, Plot):
            figure.set_size_inches(_PRINTED_INCHES)
            low, _ = figure.axes[0].get_ylim()
            figure.axes[0].set_ylim(bottom=min(low, 0.0))  # a constant does not fill the axis
        if is_blank:
            _erase(figure)
            if isinstance(item, Pulses):
                figure.axes[-1].set_ylim(0, _COUNTED)
        _lay_out(figure)
        image = _saved(figure, kind)
    return f"data:image/{media};base64,{b64encode(image).decode()}"


def _erase(figure: Figure) -> None:
    """Remove what is drawn on axes, but not what is to be kept."""
    for axes in figure.axes:
        for drawn in (*axes.lines, *axes.patches, *axes.collections, axes.get_legend()):
            if drawn is not None and drawn.get_gid() != _KEPT:
                drawn.remove()


def _html_table(table: Table) -> str:
    forms = [table.formats.get(name, "") for name in table.columns]
    lines = ["".join(f"<th>{html.escape(name)}</th>" for name in table.columns)]
    for row in table.rows:
        cells = zip(row, forms, strict=True)
        lines.append("".join(_html_cell(value, form) for value, form in cells))
    return f'<div class="table"><table><tr>{"</tr><tr>".join(lines)}</tr></table></div>'


def _html_cell(value: Any, form: str) -> str:
    attribute = ' class="text"' if isinstance(value, str) else ""
    text = html.escape(as_text(value, form))
    if isinstance(value, Interval):
        text = text.replace(", ", ",&nbsp;")  # only the value may stand on a line of its own
    return f"<td{attribute}>{text}</td>"


def _drawn(item: Plot | Scatter | Pictures | Pulses) -> Figure:
    if isinstance(item, Plot):
        return _draw_curves(item)
    if isinstance(item, Pulses):
        return _draw_pulses(item)
    return _draw_scatter(item) if isinstance(item, Scatter) else _draw_pictures(item)


def _lay_out(figure: Figure) -> None:
    """Lay a figure out once, instead of once per format."""
    ConstrainedLayoutEngine().execute(figure)
    figure.set_layout_engine("none")


def _saved(figure: Figure, kind: str) -> bytes:
    buffer = io.BytesIO()
    save_figure(figure, buffer, kind, 110, "firstphoton")
    return buffer.getvalue()


def _draw_curves(plot: Plot) -> Figure:
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(plot.curves.items()):
        axes.plot(plot.x, curve, label=name, color=f"C{i % 10}", linestyle=_STYLES[i // 10])
        if name in plot.bands:
            axes.fill_between(plot.x, *plot.bands[name], color=f"C{i % 10}", alpha=0.25, lw=0)
    for i, (name, position) in enumerate(plot.marks.items()):
        if np.isfinite(position):
            axes.axvline(position, label=name, color="black", linestyle=_STYLES[1 + i % 3])
    if plot.x_is_log:
        _log(axes, "x")
    _label(axes, plot)
    return figure


def _draw_pulses(item: Pulses) -> Figure:
    """Draw the photons of the first pulses above the histogram of the first photons of all."""
    figure = Figure(figsize=(7, 4.6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    drawn = np.split(item.times, item.ends[:_DRAWN_PULSES])[:-1]
    for pulse, times in enumerate(drawn, 1):
        row = np.full(times.size, pulse)
        above.scatter(times, row, 40, facecolors="none", edgecolors="black", gid=_KEPT)
        above.scatter(times[:1], row[:1], 40, color="C1")
    above.set(title=f"Photons of {len(drawn)} pulses", ylabel="Pulse")
    above.set_ylim(len(drawn) + 0.7, 0.3)  # the first one above
    above.set_yticks(range(1, len(drawn) + 1))
    bins = np.arange(item.probability.size) + 0.5
    below.bar(bins, item.histogram, 1.0, color="C7")
    below.set(xlabel="Bin (1 ns)", ylabel="Counts", xlim=(0, item.probability.size))
    for axes in (above, below):
        axes.grid(alpha=0.3)
    return figure


def _label(axes: Axes, item: Plot | Scatter) -> None:
    axes.set(title=item.title, xlabel=item.x_label, ylabel=item.y_label)
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def _log(axes: Axes, which: Literal["x", "y"]) -> None:
    """Make an axis logarithmic, with plain numbers as labels."""
    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    is_long = low > 0 and high / low > _MAX_FINE_SPAN
    subs, numticks = ((1,), 9) if is_long else ((1, 2, 5), 20)
    axis.set_major_locator(LogLocator(subs=subs, numticks=numticks))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _draw_scatter(scatter: Scatter) -> Figure:
    figure = Figure(figsize=(12, 7), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, (x, y)) in enumerate(scatter.groups.items()):
        axes.errorbar(
            x[0],
            y[0],
            xerr=np.abs(x[1:] - x[0]),
            yerr=np.abs(y[1:] - y[0]),
            fmt=_MARKERS[i % len(_MARKERS)],
            color=f"C{i % 10}",
            markerfacecolor=f"C{i}" if i < 10 else "white",
            label=name,
            markersize=5,
            elinewidth=0.5,
        )
    line_x, line_y, texts = scatter.line
    if len(texts):
        axes.step(line_x, line_y, "k", where="post", lw=1, label=scatter.line_label, zorder=1)
    # Points are numbered and named in the legend: they lie too close together for names.
    for i, (at_x, at_y, text) in enumerate(zip(line_x, line_y, texts, strict=True)):
        axes.annotate(f"{i + 1}", (at_x, at_y), (4, 4), textcoords="offset points")
        axes.plot([], [], " ", label=f"{i + 1}: {text}")
    _log(axes, "x")
    _log(axes, "y")
    _label(axes, scatter)
    return figure


def _draw_pictures(pictures: Pictures) -> Figure:
    across = min(4, len(pictures.images))
    down = -(-len(pictures.images) // across)
    figure = Figure(figsize=(2.9 * across + 1, 2.9 * down), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    scale = Normalize(pictures.low, pictures.high)
    colors = ListedColormap(colors_of(RangeColors().color_map)).with_extremes(
        under=OUTSIDE_COLOR, over=OUTSIDE_COLOR
    )
    for axes, (name, image) in zip(grid.flat, pictures.images.items(), strict=False):
        axes.imshow(image, norm=scale, cmap=colors, interpolation="nearest")
        axes.set_title(name, fontsize=10)
    mappable = ScalarMappable(scale, colors)
    figure.colorbar(mappable, ax=grid, label=pictures.label, shrink=0.7, extend="both")
    return figure
