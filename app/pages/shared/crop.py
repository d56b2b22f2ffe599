"""Controls of the box to which the 3D cloud and its files are cropped."""

from __future__ import annotations

from functools import partial

from app.model.colors import shown
from app.model.state import REGION, Crop
from app.model.store import Answer
from app.pages.session import Session
from app.widgets.cards import part
from app.widgets.controls import Sentence, SettingsPanel
from core.geometry import WHOLE, Box

TITLE = "Crop the cloud"
NO_REGION = "No region is selected: drag one on the map of Inspect."


class CropSection:
    """A part of the sidebar that folds.

    Parameters
    ----------
    session : Session

    Attributes
    ----------
    settings : SettingsPanel
    note : Sentence
        How much is inside the box.
    part : Part
    """

    def __init__(self, session: Session) -> None:
        self._session, self._is_on_screen, state = session, False, session.state
        self.settings = SettingsPanel(Crop(), partial(setattr, state, "crop"))
        self.note = Sentence(live=True, sizing_mode="stretch_width", margin=(0, 8, 8, 8))
        is_open = state.crop != Crop()
        self.part = part(TITLE, self.settings.layout, self.note, is_open=is_open)
        state.param.watch(lambda *_: self.refresh(), ["crop", "region", "viewing"])

    def show(self, is_on_screen: bool) -> None:
        """Come on screen, or leave it."""
        self._is_on_screen = is_on_screen
        self.refresh()

    def refresh(self) -> None:
        """Show the box and how much is inside."""
        if not self._is_on_screen:
            return
        session, state = self._session, self._session.state
        needs_region = state.crop.pixels == REGION and not state.region
        with session.tasks.hold():
            self.settings.show(state.crop)
            inside = _inside(session.answer, state.viewing.least_confidence, state.box)
            self.note.text = NO_REGION if needs_region else inside


def _inside(answer: Answer, least_confidence: float, box: Box) -> str:
    """Return how many of the estimates that are shown are inside a box."""
    if box == WHOLE:
        return "The cloud shows the whole scene."
    n_shown, n_inside = (int(shown(answer, least_confidence, b).sum()) for b in (WHOLE, box))
    return f"{n_inside:,} of {n_shown:,} points are inside. Only these are shown and saved."
