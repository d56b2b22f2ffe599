"""A button that zooms the plots of a pixel to the echo."""

from __future__ import annotations

import math

from bokeh.models import Range1d

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
SMALL = {"fontSize": "11px", "padding": "0 6px", "minHeight": "18px", "lineHeight": "18px"}


class EchoZoom:
    """A button for the corner of a histogram.

    Parameters
    ----------
    bins : Range1d
        The axis along the gate of the plots.

    Attributes
    ----------
    button : pmui.Button
        Enabled where there is an estimate.
    """

    def __init__(self, bins: Range1d) -> None:
        self._bins, self._ends = bins, (0.0, 1.0)
        self.button = button(LABEL, HELP, self._toggle)
        self.button.param.update(
            variant="text",
            min_height=18,
            styles=PLACE,
            sx=SMALL,
            disabled=True,
        )

    def follow(self, capture: Capture, *at_bins: float) -> None:
        """Zoom to all estimates at positions of the gate that is shown; NaN stands for none."""
        views = [echo_view(capture, each) for each in at_bins if not math.isnan(each)]
        self.button.disabled = not views
        if views:
            starts, ends = zip(*views, strict=True)
            self._ends = min(starts), max(ends)

    def _toggle(self) -> None:
        """Zoom to the estimates; if that is shown, to the whole gate."""
        bins, (start, end) = self._bins, self._ends
        if (bins.start, bins.end) == (start, end):
            start, end = bins.reset_start, bins.reset_end
        bins.update(start=start, end=end)
