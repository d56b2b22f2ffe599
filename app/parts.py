"""Pieces that pages are put together from: cards, folding parts, lists and rows of choices."""

from __future__ import annotations

from typing import Any

import panel as pn
import panel_material_ui as pmui

CARD = """
:host { flex: 1 1 0 !important; min-height: 0; overflow: hidden; border-radius: 8px;
  border: 1px solid var(--mui-palette-divider, #d5dbe2);
  background: var(--mui-palette-background-paper, #fff); }
@media (max-width: 900px) { :host { flex: none !important; height: 330px !important; } }
"""


def select(label: str, options: Any, value: str, help: str) -> pmui.Select:
    """A list to choose one of."""
    return pmui.Select(
        label=label,
        options=options,
        value=value,
        description=help,
        size="small",
        sizing_mode="stretch_width",
        margin=(8, 8, 4, 8),
    )


def choice(help: str, parameter: Any) -> pmui.RadioButtonGroup:
    """A row of buttons of which one is pressed."""
    return pmui.RadioButtonGroup.from_param(
        parameter, label="", description=help, size="small", margin=(4, 6, 0, 6)
    )


def part(title: str, *content: Any, is_open: bool = True) -> pmui.Card:
    """A part of the sidebar that folds."""
    return pmui.Card(
        *content,
        title=title,
        title_variant="subtitle2",
        collapsed=not is_open,
        variant="outlined",
        sizing_mode="stretch_width",
        margin=(4, 6),
    )


def card(*content: Any) -> pn.Column:
    """A framed picture."""
    return pn.Column(*content, stylesheets=[CARD], sizing_mode="stretch_both", margin=0)
