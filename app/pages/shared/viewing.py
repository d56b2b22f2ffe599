"""The field of view that stands in an empty field."""

from __future__ import annotations

from app.model.state import Viewing
from app.model.store import Answer
from app.widgets.controls import SettingsPanel


def show_own_width(panel: SettingsPanel[Viewing], answer: Answer) -> None:
    """Show the field of view for which an empty field stands, and whether it is a guess."""
    field = panel.controls["field_of_view_deg"]
    field.substitute = answer.own_field_of_view_deg
    field.empty = "guess" if answer.is_width_guessed(Viewing()) else ""
