"""A button that zooms the plots of a pixel to the echo."""

from __future__ import annotations

import math

from app.plots.gate_cut import GateCut
from app.widgets.cards import button
from core import Capture
from core.inspection import echo_view

LABEL = "Zoom to echo"
HELP = (
    "Zoom to echo: all plots show a few pulse widths around the estimate. Press it again, or "
    "double-tap a plot, to show the whole gate."
)
# Below the title, beside the label of the upper axis.
PLACE = {"position": "absolute", "top": "12px", "right": "26px", "z-index": "3"}
# Else as narrow as the button, since that is positioned.
TOOLTIP = ".MuiTooltip-tooltip { width: 230px; max-width: 230px; }"
SMALL = {"fontSize": "11px", "padding": "0 6px", "minHeight": "18px", "lineHeight": "18px"}


class EchoZoom:
    """A button for the corner of a histogram.

    Parameters
    ----------
    cut : GateCut
        The axis along the gate of the plots.

    Attributes
    ----------
    button : pmui.Button
        Enabled where there is an estimate.
    """

    def __init__(self, cut: GateCut) -> None:
        self._ends = (0.0, 1.0)
        self.button = button(LABEL, HELP, lambda: cut.toggle_zoom(*self._ends))
        self.button.param.update(
            variant="text",
            min_height=18,
            styles=PLACE,
            stylesheets=[TOOLTIP],
            sx=SMALL,
            disabled=True,
        )

    def follow(self, capture: Capture, at_bin: float) -> None:
        """Zoom to an estimate at a position of the gate that is shown; none if it is NaN."""
        self.button.disabled = math.isnan(at_bin)
        if not self.button.disabled:
            self._ends = echo_view(capture, at_bin)
