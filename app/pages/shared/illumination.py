"""The controls of a simulation: signal, background and their ratio, two of which are free."""

from __future__ import annotations

import panel as pn
import param

from app.model.state import HELD, Illumination, State
from app.widgets.cards import part, select
from app.widgets.controls import Knob, SettingsPanel
from core.parameters import Number

MORE = "More simulation settings"

_BACKGROUND = Number(
    "Background", 0.01, 1000.0, log=True, least=0.0, open_below=True, unit="per pulse"
)
_BACKGROUND_HELP = (
    "Background photons detected per pulse over the gate: signal over SBR. A move changes the SBR."
)
_HELD_HELP = (
    "What stays when the signal moves: the background, as if targets were brighter, or the SBR, as "
    "if the exposure were longer."
)


class IlluminationPanel(SettingsPanel[Illumination]):
    """The controls of `State.light`.

    Attributes
    ----------
    background : Knob
    held : pmui.Select
        What stays when the signal moves.
    """

    def __init__(self, state: State) -> None:
        super().__init__(Illumination(), self._change)
        self._state = state
        self.background = Knob.of(_BACKGROUND, Illumination().flux.background, _BACKGROUND_HELP)
        self.background.param.watch(self._change_background, "value")
        self.held = select("When the signal moves, keep", list(HELD), state.held, _HELD_HELP)
        self.held.link(state, value="held", bidirectional=True)

    @property
    def layout(self) -> pn.Column:
        """All controls; those of the fluxes first, and those that are rarely used folded."""
        sbr, signal, pulses, seed = self.controls.values()
        shown = (signal, self.background, sbr, pulses, self.doubts)
        is_open = self._state.held != HELD[0] or self._state.light.seed != Illumination().seed
        rare = part(MORE, self.held, seed, is_open=is_open)
        return pn.Column(*shown, rare, sizing_mode="stretch_width", margin=0)

    def show(self, settings: Illumination) -> None:
        """Set every control without reporting a change."""
        super().show(settings)
        self.background.value = settings.flux.background

    def _change(self, settings: Illumination) -> None:
        before = self._state.light
        # Without signal there is no background that an SBR could state.
        if self._state.held == "background" and 0 < settings.ppp != before.ppp > 0:
            settings = settings.with_background(before.flux.background)
        self._state.light = settings

    def _change_background(self, event: param.parameterized.Event) -> None:
        light = self._state.light
        if event.new == light.flux.background:
            return  # set by `show`
        try:
            _BACKGROUND.check("Background", event.new)
            self._state.light = light.with_background(event.new)
        except ValueError as error:
            self.doubts.text = str(error)
