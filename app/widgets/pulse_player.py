"""Player of a histogram that fills pulse by pulse, in the browser alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import param

from app.widgets.component import Component, script
from core.studies.pulses import Pulses


class PulsePlayer(Component):
    """Buttons and keys that add pulses to a histogram.

    All photons are sent once. The browser writes each pulse into the sources of the figure, which
    is drawn with the next frame; the server is not involved.
    """

    times = param.Bytes(default=b"", doc="float32 times of the photons in bins, pulse by pulse.")
    ends = param.Bytes(default=b"", doc="int32 index of the photon after each pulse's last one.")
    probability = param.Bytes(default=b"", doc="float32 probability that a pulse fires in a bin.")
    models = param.Dict(
        default={}, doc="Bokeh's names of the sources of the layers and of the range of counts."
    )

    _esm = script("pulse_player.js")
    _stylesheets: ClassVar = [Path(__file__).with_name("pulse_player.css")]

    def follow(self, layers: Mapping[str, Any], counts: Any) -> None:
        """Fill the sources of layers by name, over a range of counts."""
        self.models = {name: each.id for name, each in {**layers, "counts": counts}.items()}

    def show(self, item: Pulses) -> None:
        """Send other photons."""
        self.param.update(
            times=item.times.astype("<f4").tobytes(),
            ends=item.ends.astype("<i4").tobytes(),
            probability=item.probability.astype("<f4").tobytes(),
        )
