"""The controls of a simulation: signal, background and their ratio, two of which are free."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

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

    With a photon budget they show its flux; moving one of signal, background and SBR ends it.

    Parameters
    ----------
    state : State
    shown : callable, optional
        Returns the illumination that the controls show, by default that of the state.

    Attributes
    ----------
    background : Knob
    held : pmui.Select
        What stays when the signal moves.
    """

    def __init__(self, state: State, shown: Callable[[], Illumination] | None = None) -> None:
        super().__init__(Illumination(), self._change)
        self._state = state
        self._shown = shown or (lambda: state.light)
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
        self.background.value = _five_digits(settings.flux.background)

    def _change(self, settings: Illumination) -> None:
        before, state = self._shown(), self._state
        if state.budget is not None and settings.flux == before.flux:
            state.light = replace(state.light, n_pulses=settings.n_pulses, seed=settings.seed)
            return
        # Without signal there is no background that an SBR could state.
        if state.held == "background" and 0 < settings.ppp != before.ppp > 0:
            settings = settings.with_background(before.flux.background)
        state.param.update(light=settings, budget=None)

    def _change_background(self, event: param.parameterized.Event) -> None:
        light = self._shown()
        if event.new == _five_digits(light.flux.background):
            return  # set by `show`
        try:
            _BACKGROUND.check("Background", event.new)
            self._state.param.update(light=light.with_background(event.new), budget=None)
        except ValueError as error:
            self.doubts.text = str(error)


def _five_digits(value: float) -> float:
    return float(f"{value:.5g}")
