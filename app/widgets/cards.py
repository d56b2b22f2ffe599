"""Pieces that pages are put together from: cards, folding parts, lists and rows of choices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import panel as pn
import panel_material_ui as pmui
import param

BREAK_PX = 900
"""Of a page: less, and its parts follow each other. A page of more parts has another."""


def unrolled(break_px: int, height: str = "auto") -> str:
    """Style of a part that keeps a height of its own where parts follow each other."""
    kept = f"height: {height} !important; max-height: none !important; flex: none !important;"
    return f"@media (max-width: {break_px}px) {{ :host {{ {kept} }} }}"


def board(least_px: int, rest_px: int, break_px: int) -> str:
    """Style of two columns that fill a laptop's screen, but for what stands around them."""
    return f"""
:host {{ display: grid !important; grid-template: minmax(0, 1fr) / minmax(0, 2fr) minmax(0, 3fr);
  gap: 10px; flex: none !important; height: max({least_px}px, calc(100vh - {rest_px}px)) !important;
}}
@media (max-width: {break_px}px) {{
  :host {{ display: flex !important; flex-direction: column; height: auto !important;
    max-height: none !important; }}
}}
"""


def column(gap_px: int, break_px: int) -> str:
    """Style of one of these columns."""
    return f"""
:host {{ display: flex !important; flex-direction: column; gap: {gap_px}px; height: 100%;
  min-height: 0; min-width: 0; }}
{unrolled(break_px)}
"""


# Heights of small widgets, kept free from the start: the browser draws them one by one after the
# plots, which would make room, and be painted anew, for each.
FIELD_PX, SELECT_PX, BUTTON_PX, CHOICE_PX = 37, 32, 34, 36

CARD = """
:host { flex: 1 1 0 !important; min-height: 0; overflow: hidden; border-radius: 8px;
  border: 1px solid var(--mui-palette-divider, #d5dbe2);
  background: var(--mui-palette-background-paper, #fff); }
""" + unrolled(BREAK_PX, "330px")


def select(label: str, options: Any, value: str, help: str) -> pmui.Select:
    """A list to choose one of."""
    return pmui.Select(
        label=label,
        options=options,
        value=value,
        description=help,
        size="small",
        min_height=SELECT_PX,
        sizing_mode="stretch_width",
        margin=(8, 8, 4, 8),
    )


def choice(help: str, parameter: Any) -> pmui.RadioButtonGroup:
    """A row of buttons of which one is pressed."""
    return pmui.RadioButtonGroup.from_param(
        parameter,
        label="",
        description=help,
        size="small",
        min_height=CHOICE_PX,
        margin=(4, 6, 0, 6),
    )


def button(
    label: str, help: str, act: Callable[[], None], margin: int | tuple[int, ...] = 0
) -> pmui.Button:
    """A small button."""
    made = pmui.Button(
        label=label,
        description=help,
        variant="outlined",
        size="small",
        min_height=BUTTON_PX,
        margin=margin,
    )
    made.on_click(lambda _: act())
    return made


class Part(pmui.Card):
    """A part of the sidebar that folds."""

    # Headers of what is in it: there are none, but of each Panel would ask all kinds of panes
    # whether they can show it. To answer, one loads the whole of VTK.
    _headers = param.List(default=[], item_type=object)


def part(title: str, *content: Any, is_open: bool = True, is_shown: bool = True) -> Part:
    """A part of the sidebar that folds; the browser gets its content once it is to be seen."""
    made = Part(
        title=title,
        title_variant="subtitle2",
        collapsed=not is_open,
        visible=is_shown,
        variant="outlined",
        sizing_mode="stretch_width",
        margin=(4, 6),
    )

    def fill(*_: Any) -> None:
        if made.visible and not made.collapsed and not made.objects:
            made.extend(content)

    made.param.watch(fill, ["collapsed", "visible"])
    fill()
    return made


def card(*content: Any) -> pn.Column:
    """A framed picture."""
    return pn.Column(*content, stylesheets=[CARD], sizing_mode="stretch_both", margin=0)
