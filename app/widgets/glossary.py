"""The glossary as a dialog, and text whose terms open it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import panel_material_ui as pmui
import param

from app.model.glossary import ANCHOR, glossary, linked
from app.widgets.component import Component, script

DOTTED = {f"& a[href^='{ANCHOR}']": {"color": "inherit", "textDecoration": "underline dotted"}}


class Glossary(Component):
    """A dialog that opens at a term when a link to its entry is followed, anywhere on the page."""

    anchor = param.String(default=ANCHOR, doc="Beginning of the links.")
    terms = param.List(default=[], doc="Key, name, symbol, unit, synonyms and meaning of each.")

    _esm = script("glossary.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("glossary.css")]

    def __init__(self, **params: Any) -> None:
        terms = [
            [each.key, each.name, each.symbol, each.unit, ", ".join(each.synonyms), each.meaning]
            for each in glossary()
        ]
        super().__init__(terms=terms, **params)


def explained(source: str, sx: dict[str, Any] | None = None, **options: Any) -> pmui.Typography:
    """Return formatted text with dotted terms that open the glossary."""
    return pmui.Typography(linked(source), sx={**DOTTED, **(sx or {})}, **options)
