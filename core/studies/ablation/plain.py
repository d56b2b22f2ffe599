"""One echo over uniform background and nothing else: what absent parts are compared with.

It is `core.simulate.triggered_by_each_edge` with every part left out of its code.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.scene import PARTS, Scene, without
from core.simulation import add_echo, triggered_by_each_edge
from core.studies.ablation.corrections import time_ratio
from core.studies.outputs import Table


def plain_triggered(scene: Scene, acquisition: Acquisition, flux: Flux, pulse: Pulse) -> Floats:
    """Probability to have fired before each bin edge, shape (pixel, n_bins + 1)."""
    onset_bin = np.ravel(acquisition.range_m_to_bin(scene.range_m))
    signal = np.where(np.isfinite(onset_bin), flux.signal, 0.0)
    before = np.empty((onset_bin.size, acquisition.n_bins + 1))
    before[:] = flux.background * np.linspace(0.0, 1.0, acquisition.n_bins + 1)
    add_echo(onset_bin, signal, pulse, acquisition.bin_width_s, before)
    np.expm1(np.negative(before, out=before), out=before)
    return np.negative(before, out=before)


def bare(scene: Scene) -> Scene:
    """The scene with every part absent."""
    for part in PARTS:
        scene = without(scene, part)
    return scene


def table(scene: Scene, acquisition: Acquisition, flux: Flux, pulse: Pulse) -> Table:
    """What absent parts cost: the time of the model over that of the plain one, and whether the
    numbers are the same."""
    given = (bare(scene), acquisition, flux, pulse)
    ratio = time_ratio(
        partial(triggered_by_each_edge, *given), partial(plain_triggered, *given), 41
    )
    same = np.array_equal(triggered_by_each_edge(*given), plain_triggered(*given))
    told = f"{ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}]"
    return Table(
        "absent",
        "Absent parts cost nothing",
        ("all parts absent, against code without them", "time", "same bits"),
        ((", ".join(PARTS.values()), told, "yes" if same else "NO"),),
    )
