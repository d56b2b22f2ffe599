"""The tracking differentiator: its scales (lesson 4) and its settings (lesson 5)."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.estimators import ESTIMATORS
from core.inference.flux import flux_model_of
from core.metrics import restoration_degree
from core.studies import range_prior
from core.studies.lessons.bench import SIDE, Bench, captured, centres, flat_target
from core.studies.outputs import Plot
from core.studies.paper.figures import in_whole_bins, pixel_signals
from core.tracking import TrackingParameters, Weight, common_weight

ALPHAS = tuple(np.geomspace(0.1, 30, 16).tolist())
"""Strengths of the weight at which the car is estimated."""

T_NS = tuple(range(0, 80, 4))
"""First bins in which the residual may peak, for which the car is estimated."""

WEIGHTS: tuple[Weight, ...] = ("cubic", "exponential")


def both_scales(bench: Bench) -> Plot:
    """Plot the two scales of a pixel with an echo."""
    return _signals(bench, bench.onset_bin)


def both_scales_without_echo(bench: Bench) -> Plot:
    """Plot the two scales of a pixel without an echo."""
    return _signals(bench, math.nan)


def _signals(bench: Bench, onset_bin: float) -> Plot:
    plot = pixel_signals(onset_bin, bench.tracking, bench.flux, seed=bench.seed)
    return _named(plot, bench)


def _named(plot: Plot, bench: Bench) -> Plot:
    """Return a plot whose title has the preset, since plots of two are shown side by side."""
    return replace(plot, title=f"{plot.title}, {bench.preset}")


@lru_cache(maxsize=16)
def estimates_without_echo(bench: Bench) -> Plot:
    """Plot where estimates lie in pixels without an echo, and which echoes are found."""

    def simulated(range_m: float) -> Capture:
        return flat_target(bench, range_m, 2 * SIDE)

    return _named(range_prior.range_prior(simulated, "tracking", bench.tracking), bench)


def share_without_echo(bench: Bench, first: float, end: float) -> float:
    """Share of the estimates in pixels without an echo that lie in some bins, by simulation."""
    bins = ESTIMATORS["tracking"].delays(flat_target(bench, math.nan, 64), bench.tracking)[0]
    return float(((bins >= first) & (bins < end)).mean())


def weight_along_gate(bench: Bench) -> Plot:
    """Plot the cubic and the exponential weight, each over its largest value."""
    curves = {}
    for weight in WEIGHTS:
        settings = TrackingParameters(weight=weight, alpha=bench.alpha)
        values = common_weight(bench.acquisition.n_bins, settings)
        curves[f"{weight} weight"] = values / values.max()
    return Plot(
        "weight_along_gate",
        f"Weight of each bin, α = {bench.alpha:.3g}",
        "Bin (1 ns)",
        "Weight, over its largest value",
        centres(bench),
        curves,
        note="Cubic: α (k/N)³, as printed. Exponential: exp(α (k/N)³). k is the bin, N their "
        "number; before T_n = 20 the weight is 0.",
    )


def pixels_moved(bench: Bench) -> Plot:
    """Plot the share of the car's pixels whose echo α moves, for both weights."""
    capture, base = captured("car", bench), ALPHAS[0]
    return Plot(
        "pixels_moved",
        f"Pixels of the car that move from α = {base:g}",
        "α",
        "Share of pixels",
        np.array(ALPHAS),
        {
            f"{weight} weight": np.array([_share_moved(capture, weight, base, a) for a in ALPHAS])
            for weight in WEIGHTS
        },
        {"α": bench.alpha},
        "The bin in which signal times weight is largest. All other settings are the recommended "
        "ones.",
        x_is_log=True,
    )


def found_by_t_n(bench: Bench) -> Plot:
    """Plot the share of the car's pixels that are found, against T_n."""
    capture = captured("car", bench)
    truth_bin = capture.acquisition.range_m_to_bin(np.asarray(capture.truth_range_m))
    return Plot(
        "found_by_t_n",
        "Pixels of the car within 3 bins",
        "T_n, first bin in which an echo may lie",
        "Share of pixels",
        np.array(T_NS, float),
        {"found": np.array([_share_found(capture, t_n) for t_n in T_NS])},
        note=f"The car stands in bins {np.nanmin(truth_bin):.0f} to {np.nanmax(truth_bin):.0f}.",
    )


@cached_per_capture
def _share_found(capture: Capture, t_n: int) -> float:
    settings = replace(in_whole_bins("recommended"), t_n=t_n)
    found_m = capture.acquisition.bin_to_range_m(
        ESTIMATORS["tracking"].delays(capture, settings)[0]
    )
    tolerance_m = 3 * capture.acquisition.bin_length_m
    return restoration_degree(found_m, np.asarray(capture.truth_range_m), tolerance_m)


@cached_per_capture
def _positions(capture: Capture, weight: Weight, alpha: float) -> Floats:
    """Return the bin of the largest weighted residual of each target pixel, (pixel,)."""
    settings = replace(in_whole_bins("recommended"), weight=weight, alpha=alpha)
    position, _ = ESTIMATORS["tracking"].positions(capture, flux_model_of(capture), settings)
    return np.asarray(position[np.isfinite(np.asarray(capture.truth_range_m))])


def _share_moved(capture: Capture, weight: Weight, alpha: float, to: float) -> float:
    before, after = (_positions(capture, weight, each) for each in (alpha, to))
    return float((before != after).mean())


def share_moved(bench: Bench, alpha: float, to: float) -> float:
    """Share of the car's pixels whose bin another α changes, with the exponential weight."""
    return _share_moved(captured("car", bench), "exponential", alpha, to)


def share_moved_by_cubic(bench: Bench, alpha: float, to: float) -> float:
    """Share of the car's pixels whose bin another α changes, with the printed weight."""
    return _share_moved(captured("car", bench), "cubic", alpha, to)
