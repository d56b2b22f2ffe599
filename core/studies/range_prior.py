"""Hidden range prior of a method: where its estimates lie without an echo, and what it finds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse, pulses_sent
from core.capture import Capture
from core.estimators import ESTIMATORS
from core.inference import TOLERANCE_BINS
from core.studies.outputs import Plot
from core.tracking import TrackingParameters, tracking_signals
from core.trigger import rate_per_bin, trigger_probability

GROUPS = 20
"""Groups of bins, and positions of the echo, along the gate."""

Simulated = Callable[[float], Capture]
"""Returns a capture whose pixels all see a surface at a range in metres, or none at NaN."""


def range_prior(simulated: Simulated, method: str, settings: Any) -> Plot:
    """Plot the share of estimates without an echo along the gate, and of echoes found there.

    Raises
    ------
    ValueError
        If the method needs what such captures do not have.
    """
    empty = simulated(math.nan)
    acquisition = empty.acquisition
    n_bins = acquisition.n_bins
    group = max(1, round(n_bins / GROUPS))
    places = np.arange(0, n_bins + 1, group, dtype=float)
    edges = np.array([0.0, *(places[1:] - group / 2), float(n_bins)])
    bins = _estimates(empty, method, settings)
    share = np.histogram(bins, edges)[0] / bins.size
    found, n_echoes = np.full(places.size, np.nan), 0
    for n, place in enumerate(places[places < n_bins]):
        capture = simulated(float(acquisition.bin_to_range_m(place)))
        error = np.abs(_estimates(capture, method, settings) - place)
        found[n], n_echoes = (error <= TOLERANCE_BINS).mean(), error.size
    return Plot(
        "range_prior",
        "Estimates with and without an echo",
        "Bin",
        "Share of pixels",
        places,
        {
            "estimates, no echo": share,
            "even": np.diff(edges) / n_bins,
            "echoes found": found,
        },
        note=_note(bins, places, found, n_echoes, n_bins),
    )


def _estimates(capture: Capture, method: str, settings: Any) -> Floats:
    return ESTIMATORS[method].delays(capture, settings)[0]


def densest(bins: Floats, n_bins: int) -> tuple[int, int, float]:
    """Return the fifth of the gate that holds most estimates: first bin, end, and share."""
    width = max(1, n_bins // 5)
    counts = np.histogram(bins, np.arange(n_bins + 1))[0]
    in_window = np.convolve(counts, np.ones(width), mode="valid")
    first = int(in_window.argmax())
    return first, first + width, float(in_window[first] / bins.size)


def _note(bins: Floats, places: Floats, found: Floats, n_echoes: int, n_bins: int) -> str:
    first, end, share = densest(bins, n_bins)
    middle, late = (int(np.abs(places - part * n_bins).argmin()) for part in (0.5, 0.8))
    return (
        f"Without an echo, {share:.1%} of {bins.size:,} estimates lie in bins {first} to {end} "
        f"({(end - first) / n_bins:.0%} if even): there, echoes are found by luck, "
        f"too. Of {n_echoes:,} echoes at bin {places[middle]:g}, {found[middle]:.1%} are found "
        f"within {TOLERANCE_BINS} bins, of those at bin {places[late]:g}, {found[late]:.1%}."
    )


def slow_start(
    settings: TrackingParameters, acquisition: Acquisition, flux: Flux, pulse: Pulse = Pulse()
) -> str:
    """Return how far the small scale begins below the histogram, and where it meets it.

    Computed for the expected histogram without an echo; empty if it begins within its noise.
    """
    n_pulses = pulses_sent(acquisition)
    rate = rate_per_bin(math.nan, 0.0, flux.background, pulse, acquisition)
    expected = trigger_probability(rate) * n_pulses
    small = tracking_signals(expected, settings, n_pulses).small
    gap = float(expected[0] - small[0])
    if gap <= math.sqrt(expected[0]):
        return ""
    meets = np.flatnonzero(small >= expected)
    where = f"meets it in bin {meets[0]}" if meets.size else "never meets it"
    return (
        f"The small scale begins {gap:.0f} counts below a histogram without an echo, and {where}: "
        "until then there is a residual without any echo."
    )
