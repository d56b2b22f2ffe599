"""Plots, pictures and tables as files, and all of them on one page that needs no network."""

from __future__ import annotations

import html
import io
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import LogLocator, NullFormatter

from core.studies.outputs import Item, Pictures, Plot, Scatter, Table, as_csv, as_text

_STYLES = ("-", "--", "-.", ":")
_MARKERS = ("o", "s", "^", "v", "D", "P", "X")
_ENDS = ("", ", low", ", high")
_LONGEST_FINE = 1e4  # of a logarithmic axis that has numbers between its powers of ten
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
div.table {{ overflow-x: auto; }}
table {{ border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums; }}
th, td {{ padding: 3px 10px; text-align: right; border-bottom: 1px solid #d9dee5;
  white-space: nowrap; }}
th {{ position: sticky; top: 0; background: #f2f5f8; }}
td.word {{ text-align: left; white-space: normal; min-width: 9em; }}
</style></head><body>
<h1>{title}</h1>
{body}
</body></html>
"""


def write(items: Sequence[Item], folder: Path, title: str, introduction: Sequence[str]) -> Path:
    """Write each item's data (CSV) and picture (PNG, curves as SVG, too), and one page with all.

    Returns
    -------
    path
        The page, ``index.html``; it holds its pictures itself.
    """
    folder.mkdir(parents=True, exist_ok=True)
    parts = [f"<p>{html.escape(paragraph)}</p>" for paragraph in introduction]
    for item in items:
        parts.append(f'<h2 id="{item.key}">{html.escape(item.title)}</h2>')
        _write_csv(item, folder)
        if isinstance(item, Table):
            parts.append(_table(item))
        else:
            figure = _draw(item)
            picture = _saved(figure, "png")
            (folder / f"{item.key}.png").write_bytes(picture)
            if not isinstance(item, Pictures):
                (folder / f"{item.key}.svg").write_bytes(_saved(figure, "svg"))
            source = f"data:image/png;base64,{b64encode(picture).decode()}"
            parts.append(f'<figure><img src="{source}" alt="{html.escape(item.title)}"></figure>')
        if item.note:
            parts.append(f'<p class="note">{html.escape(item.note)}</p>')
    page = folder / "index.html"
    page.write_text(_PAGE.format(title=html.escape(title), body="\n".join(parts)), encoding="utf-8")
    return page


def _write_csv(item: Item, folder: Path) -> None:
    if isinstance(item, Table):
        _csv(folder / f"{item.key}.csv", item.columns, item.rows)
    elif isinstance(item, Plot):
        curves = dict(item.curves)
        for name, (low, high) in item.bands.items():
            curves |= {f"{name}, low": low, f"{name}, high": high}
        columns = (item.x_label, *curves)
        _csv(folder / f"{item.key}.csv", columns, zip(item.x, *curves.values(), strict=True))
    elif isinstance(item, Scatter):
        ends = [f"{label}{end}" for label in (item.x_label, item.y_label) for end in _ENDS]
        places = (
            (name, *place)
            for name, (x, y) in item.groups.items()
            for place in zip(*x, *y, strict=True)
        )
        _csv(folder / f"{item.key}.csv", ("group", *ends), places)
    else:
        rows = (
            (name, row, col, value)
            for name, image in item.images.items()
            for (row, col), value in np.ndenumerate(image)
        )
        _csv(folder / f"{item.key}.csv", ("image", "row", "col", item.label), rows)


def _csv(path: Path, columns: Sequence[str], rows: Any) -> None:
    path.write_text(as_csv(columns, rows), encoding="utf-8", newline="")


def _table(table: Table) -> str:
    head = "".join(_cell("th", name, False) for name in table.columns)
    rows = (
        "<tr>"
        + "".join(_cell("td", as_text(value), isinstance(value, str)) for value in row)
        + "</tr>"
        for row in table.rows
    )
    return f'<div class="table"><table><tr>{head}</tr>{"".join(rows)}</table></div>'


def _cell(tag: str, text: str, is_word: bool) -> str:
    attribute = ' class="word"' if is_word else ""
    return f"<{tag}{attribute}>{html.escape(text)}</{tag}>"


def _draw(item: Plot | Scatter | Pictures) -> Figure:
    if isinstance(item, Plot):
        figure = _plotted(item)
    else:
        figure = _scattered(item) if isinstance(item, Scatter) else _pictured(item)
    ConstrainedLayoutEngine().execute(figure)  # here, or each format would do it again
    figure.set_layout_engine("none")
    return figure


def _saved(figure: Figure, format: str) -> bytes:
    """The same bytes for the same data: no date, and identifiers that do not change."""
    buffer = io.BytesIO()
    told = {"png": {"Software": None}, "svg": {"Date": None, "Creator": "firstphoton"}}
    with rc_context({"svg.hashsalt": "firstphoton", "svg.fonttype": "none"}):
        figure.savefig(buffer, format=format, dpi=110, metadata=told[format])
    return buffer.getvalue()


def _plotted(plot: Plot) -> Figure:
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(plot.curves.items()):
        axes.plot(plot.x, curve, label=name, color=f"C{i % 10}", linestyle=_STYLES[i // 10])
        if name in plot.bands:
            axes.fill_between(plot.x, *plot.bands[name], color=f"C{i % 10}", alpha=0.25, lw=0)
    for i, (name, place) in enumerate(plot.marks.items()):
        if np.isfinite(place):
            axes.axvline(place, label=name, color="black", linestyle=_STYLES[1 + i % 3])
    axes.set(title=plot.title, xlabel=plot.x_label, ylabel=plot.y_label)
    if plot.x_is_log:
        _log(axes, "x")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def _log(axes: Axes, which: Literal["x", "y"]) -> None:
    """A logarithmic axis with numbers as people write them."""
    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    low, high = axis.get_view_interval()
    is_long = low > 0 and high / low > _LONGEST_FINE
    subs, most = ((1,), 9) if is_long else ((1, 2, 5), 20)
    axis.set_major_locator(LogLocator(subs=subs, numticks=most))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _scattered(scatter: Scatter) -> Figure:
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
    # Numbers, told beside the picture: places of a front lie too close together for words.
    for i, (at_x, at_y, text) in enumerate(zip(line_x, line_y, texts, strict=True)):
        axes.annotate(f"{i + 1}", (at_x, at_y), (4, 4), textcoords="offset points")
        axes.plot([], [], " ", label=f"{i + 1}: {text}")
    _log(axes, "x")
    _log(axes, "y")
    axes.set(title=scatter.title, xlabel=scatter.x_label, ylabel=scatter.y_label)
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def _pictured(pictures: Pictures) -> Figure:
    across = min(4, len(pictures.images))
    down = -(-len(pictures.images) // across)
    figure = Figure(figsize=(2.9 * across + 1, 2.9 * down), layout="constrained")
    grid = figure.subplots(down, across, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    shown = None
    for axes, (name, image) in zip(grid.flat, pictures.images.items(), strict=False):
        shown = axes.imshow(
            image, vmin=pictures.low, vmax=pictures.high, cmap="viridis", interpolation="nearest"
        )
        axes.set_title(name, fontsize=10)
    if shown is not None:
        figure.colorbar(shown, ax=grid, label=pictures.label, shrink=0.7)
    return figure
