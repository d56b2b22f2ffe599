"""Photons of single pulses, which fill a histogram one after the other."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.kernels.streams import uniforms

__all__ = ["Pulses", "photon_times"]

GRAIN = 1 / 64
"""Resolution of times in bins: float32 holds them without changing their bin."""


@dataclass(frozen=True, eq=False)
class Pulses:
    """Photons that arrive after each of several pulses; only the first one is recorded."""

    key: str
    title: str
    times: Floats
    """Times of the photons (photon,) in bins, pulse by pulse, in ascending order."""
    ends: NDArray[np.int32]
    """Index of the photon after the last one of each pulse (pulse,)."""
    probability: Floats
    """Probability that a pulse fires in each bin (bin,)."""
    note: str = ""

    @property
    def histogram(self) -> Floats:
        """Counts (bin,) of the first photons of all pulses."""
        begins = np.concatenate([[0], self.ends[:-1]])
        first = self.times[begins[begins < self.ends]]
        return np.bincount(first.astype(int), minlength=self.probability.size).astype(float)


def photon_times(rate: Floats, n_pulses: int, seed: int = 0) -> tuple[Floats, NDArray[np.int32]]:
    """Draw the photons of each pulse.

    Counted in expected photons, the distances between photons are exponentially distributed. The
    first photons are those of pixel 0 in `core.simulation.simulate` with the same seed. The later
    ones come from a random stream of each pulse, so that the first pulses are the same for any
    number of pulses.

    Parameters
    ----------
    rate : ndarray, shape (bin,)
        Expected photons per pulse and bin.
    n_pulses : int
        Pulses, at least 1.
    seed : int
        The same seed gives the same photons.

    Returns
    -------
    times, ends : ndarray
        Of `Pulses`.
    """
    before = np.concatenate([[0.0], np.cumsum(rate)])  # expected photons before each bin edge
    most = math.ceil(before[-1] + 8 * math.sqrt(before[-1])) + 20  # photons of any pulse
    key, streams = np.uint64(seed), np.arange(n_pulses + 1)
    first = uniforms(key, streams[:1], 0, n_pulses).T  # stream 0 is that of the simulation
    distances = -np.log1p(-np.hstack([first, uniforms(key, streams[1:], 0, most)]))
    arrived = np.cumsum(distances, axis=1)
    is_photon = arrived < before[-1]
    exact = np.interp(arrived[is_photon], before, np.arange(before.size))
    times = np.minimum(np.floor(exact / GRAIN) * GRAIN, rate.size - GRAIN)
    return times, np.cumsum(is_photon.sum(axis=1), dtype=np.int32)
