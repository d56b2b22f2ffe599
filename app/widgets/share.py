"""Buttons that share the current view: as a Python script and as a link."""

from __future__ import annotations

from collections.abc import Callable
from io import StringIO
from typing import Any

import panel as pn
import panel_material_ui as pmui

from app.widgets.cards import button
from app.widgets.component import until_session_ends
from app.widgets.controls import Sentence

SCRIPT_FILE = "firstphoton.py"

TITLE = "Python script of this view"

UNDO = "The browser's Back and Forward, or Ctrl+Z and Ctrl+Y, undo and redo changes."

# Browsers refuse the clipboard to pages that came over plain HTTP from another machine.
COPY = """
navigator.clipboard.writeText({text}).then(
  () => {{ status.data.text = "{what} copied." }},
  () => {{ status.data.text = "The browser refused: select the text and copy it." }},
)
"""

# MUI returns the focus to the outermost component, when the dialog has faded (225 ms).
RETURN_FOCUS = """
const button = Bokeh.index.find_one(opener)?.shadow_el.querySelector("button")
if (!source.open) setTimeout(() => button.focus(), 300)
"""

CODE = """
.note { overflow: auto; max-height: 60vh; padding: 10px 12px; border-radius: 4px; white-space: pre;
  border: 1px solid var(--mui-palette-divider, #d5dbe2); user-select: text;
  font: 12px/1.5 ui-monospace, "DejaVu Sans Mono", Menlo, Consolas, monospace; }
"""


class Share:
    """Buttons that show the script of the current view in a dialog, and copy its link.

    Parameters
    ----------
    script : callable
        Returns the script of the current view.
    """

    def __init__(self, script: Callable[[], str]) -> None:
        self._script = script
        self._dialog: pmui.Dialog | None = None
        self._code = Sentence(stylesheets=[CODE], sizing_mode="stretch_width", margin=0)
        help = "Python script: show one that computes this view."
        self._open = button("Python script", help, self._show)
        link, status = _copy_button(
            "Copy link", "Copy link: it restores this view.", "location.href", "Link"
        )
        buttons = pn.Row(self._open, link, margin=0, styles={"gap": "8px"})
        undo = Sentence(text=UNDO, margin=(6, 0, 0, 0))
        self.layout = pn.Column(buttons, status, undo, margin=8)

    def _show(self) -> None:
        self._code.text = self._script()
        if self._dialog is not None:
            self._dialog.open = True
            return
        # Made on demand: few users open it. It is open when it is added, since the browser loses a
        # change between the first drawing of a component and its subscription to changes.
        self._dialog = self._make_dialog()
        self.layout.append(self._dialog)

    def _make_dialog(self) -> pmui.Dialog:
        copy, status = _copy_button(
            "Copy", "Copy the script.", "code.data.text", "Script", code=self._code
        )
        save = pmui.FileDownload(
            callback=lambda: StringIO(self._code.text),
            filename=SCRIPT_FILE,
            label="Download",
            variant="outlined",
            size="small",
            margin=0,
        )
        dialog = pmui.Dialog(
            Sentence(
                text="It needs only the package core and gives the same estimates bit for bit."
            ),
            self._code,
            pn.Row(copy, save, status, margin=(8, 0), styles={"gap": "8px"}),
            open=True,
            title=TITLE,
            title_variant="h6",
            show_close_button=True,
            close_on_click=True,  # by the Escape key, too
            width_option="md",
            sizing_mode="stretch_width",
        )
        until_session_ends(dialog.jscallback(open=RETURN_FOCUS, args={"opener": self._open}))
        return dialog


def _copy_button(
    label: str, help: str, text: str, what: str, **args: Any
) -> tuple[pmui.Button, Sentence]:
    """Return a button that copies a JavaScript expression, and the status line that confirms it."""
    made, status = button(label, help, lambda: None), Sentence(live=True)
    copy = COPY.format(text=text, what=what)
    until_session_ends(made.js_on_click(args | {"status": status}, copy))
    return made, status
