"""The address of the page as a QR code."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import param

from app.widgets.component import Component, script
from core.checks import require

MOST_CHARACTERS = 600
"""Longest address: the code of a longer one has more dots than a phone can read from a screen."""


class QrCode(Component):
    """A button that shows the address of the page as a QR code, in a dialog.

    The address omits presenter mode and slide, so that it opens the lesson itself.
    """

    asked = param.List(default=["", 0], doc="Address, and when the button was pressed.")
    image = param.List(default=["", 0], doc="The code as the address of an image, and that time.")
    problem = param.String(default="", doc="Why there is no code.")

    _esm = script("qr_code.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("qr_code.css")]

    @param.depends("asked", watch=True)
    def _draw(self) -> None:
        address, when = self.asked
        try:
            image, problem = qr_image(address), ""
        except ValueError as error:
            image, problem = "", str(error)
        self.param.update(problem=problem, image=[image, when])


def qr_image(address: str) -> str:
    """Return the QR code of an address as the address of an SVG image.

    Raises
    ------
    ValueError
        If the address is too long.
    """
    import segno  # noqa: PLC0415 - rarely needed

    fits = len(address) <= MOST_CHARACTERS
    require("link", f"{address[:40]}…", fits, f"at most {MOST_CHARACTERS} characters for a QR code")
    return str(segno.make_qr(address).svg_data_uri(scale=8, border=4, light="#fff"))
