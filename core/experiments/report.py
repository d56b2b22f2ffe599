"""Plots, pictures and tables as files, and all of them on one page that needs no network."""

from __future__ import annotations

import csv
import html
import io
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from core.experiments.items import Item, Pictures, Plot, Table, as_text

_STYLES = ("-", "--", "-.", ":")
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
    """Write each item's data (CSV) and picture (PNG), and one page with everything.

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
            picture = _draw(item)
            (folder / f"{item.key}.png").write_bytes(picture)
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
        columns = (item.x_label, *item.curves)
        _csv(folder / f"{item.key}.csv", columns, zip(item.x, *item.curves.values(), strict=True))
    else:
        rows = (
            (name, row, col, value)
            for name, image in item.images.items()
            for (row, col), value in np.ndenumerate(image)
        )
        _csv(folder / f"{item.key}.csv", ("image", "row", "col", item.label), rows)


def _csv(path: Path, columns: Sequence[str], rows: Any) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


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


def _draw(item: Plot | Pictures) -> bytes:
    figure = _plotted(item) if isinstance(item, Plot) else _pictured(item)
    buffer = io.BytesIO()
    # Without the date of its making the same data give the same file.
    figure.savefig(buffer, format="png", dpi=110, metadata={"Software": None})
    return buffer.getvalue()


def _plotted(plot: Plot) -> Figure:
    figure = Figure(figsize=(10, 5), layout="constrained")
    axes = figure.add_subplot()
    for i, (name, curve) in enumerate(plot.curves.items()):
        axes.plot(plot.x, curve, label=name, color=f"C{i % 10}", linestyle=_STYLES[i // 10])
    for i, (name, place) in enumerate(plot.marks.items()):
        if np.isfinite(place):
            axes.axvline(place, label=name, color="black", linestyle=_STYLES[1 + i % 3])
    axes.set(title=plot.title, xlabel=plot.x_label, ylabel=plot.y_label)
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
