"""First photons, exposure and the correction of pile-up (lessons 1 to 3)."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from core.acquisition import Floats
from core.estimators import ESTIMATORS, estimate
from core.inference.limits import best_exposure, right_bin_probability
from core.metrics import restoration_degree
from core.studies.lessons.bench import PULSE, SIDE, Bench, captured, centres, flat_target, rate_of
from core.studies.outputs import Pictures, Plot
from core.trigger import trigger_probability

EXPOSURES = tuple(np.geomspace(0.01, 10, 13).tolist())
"""Factors on signal and background at which accuracy is shown."""

LIMIT = "limit"


def light(bench: Bench) -> Plot:
    """Plot the photons that arrive in each bin."""
    return Plot(
        "light",
        "Photons that arrive, of all pulses",
        "Bin (1 ns)",
        "Photons",
        centres(bench),
        {"photons that arrive": bench.n_pulses * rate_of(bench)},
        note="What a detector that is always armed would count, on average.",
    )


def first_photons(bench: Bench) -> Plot:
    """Plot the first photons of all pulses, which are all that is recorded."""
    capture = flat_target(bench, float(bench.acquisition.bin_to_range_m(bench.onset_bin)))
    rate = rate_of(bench)
    return Plot(
        "first_photons",
        f"First photons of {bench.n_pulses:,} pulses",
        "Bin (1 ns)",
        "Counts",
        centres(bench),
        {
            "histogram": capture.cube[0, 0].astype(float),
            "expected": bench.n_pulses * trigger_probability(rate),
            "photons that arrive": bench.n_pulses * rate,
        },
        note=f"Background of {bench.exposure * bench.background:.3g} photons per pulse over the "
        "gate. Only the first photon of each pulse is counted.",
    )


def still_armed(bench: Bench) -> Plot:
    """Plot the share of pulses that have not fired yet."""
    rate = rate_of(bench)
    edges = np.arange(rate.size + 1.0)
    return Plot(
        "still_armed",
        "Pulses that have not fired yet",
        "Bin (1 ns)",
        "Share of pulses",
        edges,
        {"still armed": np.exp(-np.concatenate([[0.0], np.cumsum(rate)]))},
        note="In each bin, the armed pulses alone can count a photon.",
    )


def car_image(bench: Bench) -> Pictures:
    """Show the car by the tracking differentiator, next to its truth."""
    capture = captured("car", bench)
    truth_m = np.asarray(capture.truth_range_m)
    found_m = estimate(capture, "tracking", bench.tracking).range_m
    found_m = np.where(np.isfinite(truth_m), found_m, np.nan)
    degree = restoration_degree(found_m, truth_m, 3 * capture.acquisition.bin_length_m)
    low, high = float(np.nanmin(truth_m)), float(np.nanmax(truth_m))
    return Pictures(
        "car_image",
        f"The car at PPP {bench.flux.signal:.3g}",
        "Range (m)",
        {"truth": truth_m, f"{degree:.1%} within 3 bins": found_m},
        low - 0.5,
        high + 0.5,
        f"SBR {bench.flux.sbr:.3g}, {bench.n_pulses:,} pulses. Pixels without a target are blank.",
    )


def accuracy_by_exposure(bench: Bench) -> Plot:
    """Plot the share of pixels found on a flat target against the exposure, and its limit."""
    curves = _accuracy(replace(bench, exposure=1.0))
    return Plot(
        "accuracy_by_exposure",
        f"Pixels found within 3 bins, echo at bin {bench.onset_bin:g}",
        "Exposure (factor on signal and background)",
        "Share of pixels",
        np.array(EXPOSURES),
        curves,
        {"exposure": bench.exposure},
        f"A flat target, {SIDE} × {SIDE} pixels. PPP {bench.signal:g} at an exposure of 1. The "
        "limit is approximate, for one pixel with known fluxes and depths anywhere in the gate.",
        x_is_log=True,
    )


@lru_cache(maxsize=16)
def _accuracy(bench: Bench) -> dict[str, Floats]:
    """Return the share of pixels that each method finds, and its limit, at each exposure."""
    gate, onset = bench.acquisition, bench.onset_bin
    range_m = float(gate.bin_to_range_m(onset))
    shares: dict[str, list[float]] = {"tracking": [], "likelihood": [], LIMIT: []}
    for exposure in EXPOSURES:
        at = replace(bench, exposure=exposure)
        flux = at.flux
        capture = flat_target(at, range_m, SIDE)
        for method in ("tracking", "likelihood"):
            settings = bench.tracking if method == "tracking" else None
            settings = settings or ESTIMATORS[method].parameters()
            error = np.abs(ESTIMATORS[method].delays(capture, settings)[0] - onset)
            shares[method].append(float((error <= 3).mean()))
        limit = right_bin_probability(onset, flux.signal, flux.background, PULSE, gate)
        shares[LIMIT].append(float(limit))
    return {name: np.array(values) for name, values in shares.items()}


def share_armed(bench: Bench, bin: float) -> float:
    """Share of pulses that are still armed at the beginning of a bin."""
    return float(np.exp(-rate_of(bench)[: round(bin)].sum()))


def share_fired(bench: Bench, bin: float) -> float:
    """Share of pulses that have fired before a bin."""
    return 1 - share_armed(bench, bin)


def best_attenuation(bench: Bench) -> float:
    """Factor on signal and background that gives the most information on the delay."""
    flux = bench.flux
    return float(
        best_exposure(bench.onset_bin, flux.signal, flux.background, PULSE, bench.acquisition)
    )


def sbr(bench: Bench) -> float:
    """Signal over background."""
    return bench.signal / bench.background
