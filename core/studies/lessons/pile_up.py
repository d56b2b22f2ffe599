"""First photons, exposure and the correction of pile-up (lessons 1 to 3)."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from core.acquisition import Floats
from core.estimators import ESTIMATORS, estimate
from core.inference import TOLERANCE_BINS
from core.inference.likelihood import rate_and_n_armed
from core.inference.limits import best_exposure, right_bin_probability
from core.metrics import restoration_degree
from core.studies.lessons.bench import PULSE, SIDE, Bench, captured, centres, flat_target, rate_of
from core.studies.outputs import Pictures, Plot
from core.studies.pulses import Pulses, photon_times
from core.trigger import trigger_probability

EXPOSURES = tuple(np.geomspace(0.01, 10, 13).tolist())
"""Factors on signal and background at which accuracy is shown."""

MOST_PULSES = 1000
"""Pulses that are shown one by one."""


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


def pulse_by_pulse(bench: Bench) -> Pulses:
    """Show the photons of each pulse, and the histogram that their first photons fill."""
    rate, n_pulses = rate_of(bench), min(bench.n_pulses, MOST_PULSES)
    return Pulses(
        "pulse_by_pulse",
        "One pulse, and the histogram so far",
        *photon_times(rate, n_pulses, bench.seed),
        trigger_probability(rate),
        f"{rate.sum():.3g} photons per pulse arrive on average. The first one is recorded; the "
        "later ones, hollow, are not.",
    )


def first_photons(bench: Bench) -> Plot:
    """Plot the first photons of all pulses, which are all that is recorded."""
    capture = flat_target(bench, float(bench.acquisition.bin_to_range_m(bench.onset_bin)))
    rate = rate_of(bench)
    echo = f", echo at bin {bench.onset_bin}" if bench.signal else ""
    return Plot(
        "first_photons",
        f"First photons of {bench.n_pulses:,} pulses{echo}",
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
        f"The car at a signal of {bench.flux.signal:.3g} photons per pulse",
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
        f"A flat target, {SIDE} × {SIDE} pixels. Signal {bench.signal:g} at an exposure of 1. The "
        "limit is approximate, for one pixel with known fluxes and depths anywhere in the gate.",
        x_is_log=True,
    )


@lru_cache(maxsize=16)
def _accuracy(bench: Bench) -> dict[str, Floats]:
    """Return the share of pixels that each method finds, and its limit, at each exposure."""
    gate, onset = bench.acquisition, bench.onset_bin
    range_m = float(gate.bin_to_range_m(onset))
    settings = {"tracking": bench.tracking, "likelihood": ESTIMATORS["likelihood"].parameters()}
    shares: dict[str, list[float]] = {name: [] for name in (*settings, "limit")}
    for exposure in EXPOSURES:
        at = replace(bench, exposure=exposure)
        flux = at.flux
        capture = flat_target(at, range_m, SIDE)
        for method, each in settings.items():
            error = np.abs(ESTIMATORS[method].delays(capture, each)[0] - onset)
            shares[method].append(float((error <= TOLERANCE_BINS).mean()))
        limit = right_bin_probability(onset, flux.signal, flux.background, PULSE, gate)
        shares["limit"].append(float(limit))
    return {name: np.array(values) for name, values in shares.items()}


def corrected(bench: Bench) -> Plot:
    """Plot the histogram of a pixel without an echo, or its rate with pile-up undone."""
    counts = flat_target(bench, math.nan).cube[0, 0].astype(float)
    is_on = bench.correction == "on"
    armed = share_armed(bench, bench.acquisition.n_bins)
    return Plot(
        "corrected",
        "Photons per armed pulse, pile-up undone" if is_on else "First photons per pulse",
        "Bin (1 ns)",
        "Photons per pulse and bin",
        centres(bench),
        {"histogram": _measured(counts, bench), "photons that arrive": rate_of(bench)},
        note=f"One pixel, {bench.n_pulses:,} pulses, no echo. At the end of the gate, {armed:.0%} "
        "of the pulses are still armed.",
    )


def noise_along_gate(bench: Bench) -> Plot:
    """Plot the standard deviation of the rate in each bin, with and without the correction."""
    on, off = (_noise(replace(bench, correction=each)) for each in ("on", "off"))
    return Plot(
        "noise_along_gate",
        "Noise of each bin",
        "Bin (1 ns)",
        "Photons per pulse and bin",
        centres(bench),
        {"correction on": on, "correction off": off},
        note=f"Standard deviation over {_NOISY_PIXELS**2:,} pixels, which are alike and differ "
        "only by chance.",
    )


_NOISY_PIXELS = 64  # rows and columns


def _measured(counts: Floats, bench: Bench) -> Floats:
    """Return photons per pulse from counts (..., bin), with or without the correction."""
    if bench.correction == "on":
        return rate_and_n_armed(counts, bench.n_pulses)[0]
    return counts / bench.n_pulses


@lru_cache(maxsize=16)
def _noise(bench: Bench) -> Floats:
    """Return the standard deviation of `_measured` over pixels, in each bin."""
    counts = flat_target(bench, math.nan, _NOISY_PIXELS).cube.astype(float)
    return np.asarray(_measured(counts, bench).std(axis=(0, 1)))


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


def noise_ratio(bench: Bench, bin: float, over: float) -> float:
    """Noise of the corrected rate in one bin, over that in another."""
    noise = _noise(replace(bench, correction="on"))
    return float(noise[round(bin)] / noise[round(over)])


def noise_ratio_of_counts(bench: Bench, bin: float, over: float) -> float:
    """Noise of the counts in one bin, over that in another."""
    noise = _noise(replace(bench, correction="off"))
    return float(noise[round(bin)] / noise[round(over)])


def armed_ratio(bench: Bench, bin: float, over: float) -> float:
    """Pulses that are armed in one bin, over those in another."""
    return share_armed(bench, bin) / share_armed(bench, over)
