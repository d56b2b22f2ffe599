"""Kernels of the simulation: expected photons of echoes, and draws of first photons."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from core.kernels.parallel import COMPILED
from core.kernels.streams import DRAWN_UNITS, integer_at, pixel_key, uniform_at

_GAMMA, _GAUSSIAN, _MEASURED = range(3)
SHAPE_CODES = {"gamma": _GAMMA, "gaussian": _GAUSSIAN, "measured": _MEASURED}
_SQRT_HALF = math.sqrt(0.5)
_CELLS = 256  # of a guide table
_CELL = np.uint64(DRAWN_UNITS // _CELLS)


@njit(**COMPILED)
def _arrived(t, shape, share):  # type: ignore[no-untyped-def]
    """`Pulse.cdf` at `t` time constants; `share` holds the values at the samples if measured."""
    if shape == _GAUSSIAN:
        return 0.5 * math.erfc(-t * _SQRT_HALF)
    if t <= 0.0:
        return 0.0
    if shape == _GAMMA:
        return 1.0 - (1.0 + t) * math.exp(-t)
    if t >= share.size - 1:
        return 1.0
    below = int(t)
    return share[below] + (t - below) * (share[below + 1] - share[below])


@njit(**COMPILED)
def add_echo_photons(first, end, onset_bin, signal, bin_taus, shape, share, before):  # type: ignore[no-untyped-def]
    """Add the expected photons of each pixel's echo before each bin edge to `before`."""
    n_edges = before.shape[1]
    for pixel in range(first, end):
        onset = onset_bin[pixel]
        if not math.isfinite(onset):
            continue
        early = _arrived(-onset * bin_taus, shape, share)  # before the gate opened
        arrived = early
        for edge in range(n_edges):
            # Monotonic in spite of rounding, which matters for tiny bins.
            arrived = max(arrived, _arrived((edge - onset) * bin_taus, shape, share))
            before[pixel, edge] += signal[pixel] * (arrived - early)


@njit(**COMPILED)
def fill_probability(first, end, photons):  # type: ignore[no-untyped-def]
    """Replace expected photons (pixel, edge) by the probability of any."""
    for pixel in range(first, end):
        for edge in range(photons.shape[1]):
            photons[pixel, edge] = -math.expm1(-photons[pixel, edge])


@njit(**COMPILED, inline="always")
def _draw_pixel(fired_by, begin, end, key, guide, counts):  # type: ignore[no-untyped-def]
    """Add the first-photon draws of the pulses from `begin` to before `end` to `counts`.

    The last element of `counts` counts "no trigger".

    ``fired_by[k]`` is the probability of a trigger by the end of bin k, in `DRAWN_UNITS`; its last
    element, above all draws, ends every search. The guide table holds the bin of the lowest number
    in each of its cells, found by counting the ends of bins in each cell.
    """
    guide[:] = 0
    for each in range(fired_by.size - 1):
        guide[(fired_by[each] + _CELL - np.uint64(1)) // _CELL] += np.uint32(1)
    for cell in range(guide.size - 1):
        guide[cell + 1] += guide[cell]
    for pulse in range(begin, end):
        drawn = integer_at(key, pulse)
        k = np.uint64(guide[drawn // _CELL])
        # A step without a branch settles nearly every draw; a mispredicted branch costs five.
        k += np.uint64(fired_by[k] <= drawn)
        while fired_by[k] <= drawn:
            k += np.uint64(1)
        counts[k] += 1


@njit(**COMPILED)
def draw_pulses(first, end, triggered, first_pulse, end_pulse, seed, cube):  # type: ignore[no-untyped-def]
    """Add first-photon counts (pixel, bin) of the pulses `first_pulse` to before `end_pulse`."""
    n_bins = cube.shape[1]
    for pixel in range(first, end):
        fired_by = np.full(n_bins + 1, np.uint64(2 * DRAWN_UNITS))
        for k in range(n_bins):
            within = min(max(triggered[pixel, 1 + k], 0.0), 1.0)  # rounding may lead beyond
            fired_by[k] = np.uint64(math.ceil(within * DRAWN_UNITS))
        guide, counts = np.empty(_CELLS + 1, np.uint32), np.zeros(n_bins + 1, np.int64)
        key = pixel_key(seed, pixel)
        _draw_pixel(fired_by, first_pulse, end_pulse, key, guide, counts)
        for k in range(n_bins):
            cube[pixel, k] += counts[k]


@njit(**COMPILED)
def fire_once(first, end, photons, n_pulses, seed, fired):  # type: ignore[no-untyped-def]
    """Assign photons to pulses at random and keep the first photon of each pulse."""
    _, cols, n_bins = photons.shape
    for row in range(first, end):
        for col in range(cols):
            key = pixel_key(seed, row * cols + col)
            armed, draw = n_pulses, 0
            for k in range(n_bins):
                for _ in range(photons[row, col, k]):
                    if uniform_at(key, draw) * n_pulses < armed:
                        fired[row, col, k] += 1
                        armed -= 1
                    draw += 1
