"""The bar of presenter mode: its keys, its buttons and the place in the lesson."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import param

from app.widgets.component import Component, script


class SlideBar(Component):
    """Keys and buttons that change the slide; the browser handles full screen and blank screen.

    Space sends ``firstphoton:play`` to the document, which a `PulsePlayer` on screen follows.
    """

    place = param.String(default="", doc="Place in the lesson, read out by screen readers.")
    digits = param.List(default=[], item_type=str, doc="Digits that open lessons.")
    is_narrow = param.Boolean(
        default=False, doc="Whether the window is that of a phone; set in the browser."
    )
    pressed = param.List(
        default=["", 0], doc="``back``, ``next``, ``reveal``, ``end`` or a digit, and when."
    )

    _esm = script("slide_bar.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("slide_bar.css")]
