"""Cost of absent parts: the simulation's model against code that has no parts at all."""

from __future__ import annotations

from functools import partial

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.scene import PARTS, Scene, without
from core.simulation import add_echo, cumulative_trigger_probability
from core.studies.outputs import Table
from core.studies.timing import time_ratio
from core.trigger import to_probability


def plain_triggered(scene: Scene, acquisition: Acquisition, flux: Flux, pulse: Pulse) -> Floats:
    """Return the probability of a trigger before each bin edge, shape (pixel, n_bins + 1).

    `core.simulation.cumulative_trigger_probability` for one echo over uniform background, without
    the code of any part.
    """
    onset_bin = np.ravel(acquisition.range_m_to_bin(scene.range_m))
    signal = np.where(np.isfinite(onset_bin), flux.signal, 0.0)
    before = np.empty((onset_bin.size, acquisition.n_bins + 1))
    before[:] = flux.background * np.linspace(0.0, 1.0, acquisition.n_bins + 1)
    add_echo(onset_bin, signal, pulse, acquisition.bin_width_s, before)
    to_probability(before)
    return before


def table(scene: Scene, acquisition: Acquisition, flux: Flux, pulse: Pulse) -> Table:
    """Return the time of the model over that of the plain code, and whether results are equal."""
    given = (without(scene, *PARTS), acquisition, flux, pulse)
    ratio = time_ratio(
        partial(cumulative_trigger_probability, *given), partial(plain_triggered, *given), 41
    )
    same = np.array_equal(cumulative_trigger_probability(*given), plain_triggered(*given))
    columns = ("absent parts", "time, ratio to code without them", "bit for bit equal")
    row = (", ".join(PARTS.values()), ratio, "yes" if same else "NO")
    return Table("absent", "Cost of absent parts", columns, (row,), formats={columns[1]: ".3f"})
