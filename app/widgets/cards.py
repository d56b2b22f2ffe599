"""Building blocks of pages: cards, folding parts of the sidebar, lists and buttons."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import panel as pn
import panel_material_ui as pmui
import param

BREAK_PX = 900
"""Width of a page below which its parts are stacked."""


def unrolled(break_px: int, height: str = "auto") -> str:
    """Return the style of a part that keeps its own height where parts are stacked."""
    kept = f"height: {height} !important; max-height: none !important; flex: none !important;"
    return f"@media screen and (max-width: {break_px}px) {{ :host {{ {kept} }} }}"


def board(least_px: int, rest_px: int, break_px: int) -> str:
    """Return the style of two columns that fill the screen except for the last `rest_px`."""
    return f"""
:host {{ display: grid !important; grid-template: minmax(0, 1fr) / minmax(0, 2fr) minmax(0, 3fr);
  gap: 10px; flex: none !important;
  height: max({least_px}px, calc(var(--window-height, 100vh) - {rest_px}px)) !important; }}
@media screen and (max-width: {break_px}px) {{
  :host {{ display: flex !important; flex-direction: column; height: auto !important;
    max-height: none !important; }}
}}
"""


def column(gap_px: int, break_px: int) -> str:
    """Return the style of one of these columns."""
    return f"""
:host {{ display: flex !important; flex-direction: column; gap: {gap_px}px; height: 100%;
  min-height: 0; min-width: 0; }}
{unrolled(break_px)}
"""


def steady(share: int, break_px: int) -> str:
    """Return the style of a card that has `share` % of its column, whatever is said below it."""
    return (
        f"@media screen and (min-width: {break_px + 1}px) {{ "
        f":host {{ flex: 0 1 {share}% !important; }} }}"
    )


# Heights of small widgets, reserved from the start: the browser draws them one by one after the
# plots, which would be resized and painted again for each.
FIELD_PX, SELECT_PX, BUTTON_PX, CHOICE_PX = 37, 32, 34, 36

CARD = """
:host { flex: 1 1 0 !important; min-height: 0; overflow: hidden; border-radius: 8px;
  border: 1px solid var(--mui-palette-divider, #d5dbe2);
  background: var(--mui-palette-background-paper, #fff); }
""" + unrolled(BREAK_PX, "330px")


def typed(field: Any) -> str:
    """Return the text of a field; Enter arrives before the value that it completes."""
    return str(field.value_input if isinstance(field, pmui.TextInput) else field.value)


def select(label: str, options: Any, value: str, help: str) -> pmui.Select:
    """Return a list from which to choose one option."""
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
    """Return a row of buttons of which one is pressed."""
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
    """Return a small button."""
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


# After a change of the mode, a part's own background follows late, when its text has changed.
PART = {
    "color": "var(--mui-palette-text-primary)",
    "backgroundColor": "transparent",
    "& .MuiCardHeader-action .MuiIconButton-root": {"color": "inherit"},
}


class Part(pmui.Card):
    """A part of the sidebar that folds."""

    # There are no headers. Panel would ask all panes whether they can show one, which loads VTK.
    _headers = param.List(default=[], item_type=object)


Holder = TypeVar("Holder", bound=pn.layout.ListLike)


def sent_when_visible(holder: Holder) -> Holder:
    """Take the content out of a hidden column or a folded part until it is first visible.

    The browser takes as long to draw what is hidden as what is shown.
    """
    content = list(holder.objects)
    holder.clear()
    filled_when_visible(holder, lambda: content)
    return holder


def filled_when_visible(holder: pn.layout.ListLike, make: Callable[[], Sequence[Any]]) -> None:
    """Make the content of a column or a part that folds when it is first visible."""

    def fill(*_: Any) -> None:
        is_visible = holder.visible and not getattr(holder, "collapsed", False)
        if is_visible and not holder.objects:
            holder.extend(make())

    holder.param.watch(fill, ["collapsed", "visible"] if "collapsed" in holder.param else "visible")
    fill()


def part(title: str, *content: Any, is_open: bool = True, is_shown: bool = True) -> Part:
    """Return a part of the sidebar that folds; its content is sent when it is first visible."""
    made = Part(
        *content,
        title=title,
        title_variant="subtitle2",
        collapsed=not is_open,
        visible=is_shown,
        variant="outlined",
        sx=PART,
        sizing_mode="stretch_width",
        margin=(4, 6),
    )
    return sent_when_visible(made)


def arriving(*parts: Any) -> pn.Column:
    """Return a column of parts, each of which is sent when it is first visible."""
    made = pn.Column(sizing_mode="stretch_width", margin=0)

    def send(*_: Any) -> None:
        sent = [each for each in parts if each.visible or each in made.objects]
        if len(sent) > len(made.objects):
            made.objects = sent

    for each in parts:
        each.param.watch(send, "visible")
    send()
    return made


def card(*content: Any) -> pn.Column:
    """Return a framed picture."""
    return pn.Column(*content, stylesheets=[CARD], sizing_mode="stretch_both", margin=0)
