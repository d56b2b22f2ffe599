"""Views and checks of lessons: named functions of one simulated pixel or image.

A lesson names them (`VIEWS`, `CHECKS`); nothing in its text is evaluated.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.capture import Capture
from core.checks import require
from core.effects import Falloff
from core.estimators import ESTIMATORS, estimate
from core.inference.limits import best_exposure, right_bin_probability
from core.metrics import restoration_degree
from core.parameters import Choice, Number, Settings, parameter
from core.scene import PAPER_GATE, Scene, car
from core.simulation import simulate
from core.studies import range_prior
from core.studies.outputs import Pictures, Plot
from core.studies.paper.figures import pixel_signals
from core.tracking import PRESETS, TrackingParameters
from core.trigger import rate_per_bin, trigger_probability

__all__ = [
    "CHECKS",
    "NEED_SIGNAL",
    "PLOTS",
    "VIEWS",
    "Bench",
    "arguments_of",
    "require_signal",
]

PULSE = Pulse()
EXPOSURES = tuple(np.geomspace(0.01, 10, 13).tolist())
"""Factors on signal and background at which accuracy is shown."""

_SIDE = 24  # rows and columns of flat targets
_BENCH_RANGE_M = 50.0  # of the surface that the fluxes of a bench belong to


@dataclass(frozen=True)
class Bench(Settings):
    """Everything that a lesson can set, over the paper's gate of 100 bins of 1 ns."""

    signal: float = parameter(
        0.1041,
        Number("Signal", 0.001, 10.0, log=True, least=0.0, most=1e3, unit="per pulse"),
        "Signal photons per pulse (PPP), if the detector were always armed.",
    )
    background: float = parameter(
        1.735,
        Number("Background", 0.05, 20.0, log=True, least=1e-3, most=1e3, unit="per pulse"),
        "Background photons per pulse over the gate, if the detector were always armed.",
    )
    exposure: float = parameter(
        1.0,
        Number("Exposure", 0.01, 10.0, log=True, least=1e-3, most=100.0),
        "Factor on signal and background: below 1 a filter, above 1 a longer exposure.",
    )
    onset_bin: int = parameter(
        50, Number("Bin of the echo", 0, 99, whole=True, least=0, most=99), "Where the echo begins."
    )
    n_pulses: int = parameter(
        1000,
        Number("Pulses", 10, 8000, log=True, whole=True, least=1, most=50_000),
        "Pulses per pixel.",
    )
    preset: str = parameter(
        "recommended",
        Choice("Preset", tuple(PRESETS)),
        "Settings of the tracking differentiator: recommended, or the paper's literal equations.",
    )

    @property
    def acquisition(self) -> Acquisition:
        """The gate, with these pulses."""
        return replace(PAPER_GATE, n_pulses=self.n_pulses)

    @property
    def flux(self) -> Flux:
        """Signal and background with this exposure.

        Raises
        ------
        ValueError
            Without a signal: an SBR of 0 does not define the background.
        """
        require("signal", self.signal, self.signal > 0, "a number above 0")
        return Flux(self.exposure * self.signal, self.signal / self.background)

    @property
    def tracking(self) -> TrackingParameters:
        """Settings of the preset."""
        return PRESETS[self.preset]


def _rate(bench: Bench) -> Floats:
    """Return photons per pulse and bin, of an always armed detector."""
    signal, background = (bench.exposure * each for each in (bench.signal, bench.background))
    rate = rate_per_bin(bench.onset_bin, signal, background, PULSE, bench.acquisition)
    return np.asarray(rate, np.float64)


def _captured(bench: Bench, range_m: float, side: int = 1) -> Capture:
    """Simulate a flat target; NaN stands for none. Without a signal there is none, either."""
    if bench.signal:
        flux = bench.flux
    else:  # the background is all that a scene without a surface returns
        range_m, flux = math.nan, Flux(bench.exposure * bench.background, 1.0)
    scene = Scene(np.full((side, side), range_m))
    return simulate(scene, bench.acquisition, flux, PULSE)


def _centres(bench: Bench) -> Floats:
    return np.arange(bench.acquisition.n_bins, dtype=float) + 0.5


# -- Views -----------------------------------------------------------------------------------------


def light(bench: Bench) -> Plot:
    """Plot the photons that arrive in each bin."""
    return Plot(
        "light",
        "Photons that arrive, of all pulses",
        "Bin (1 ns)",
        "Photons",
        _centres(bench),
        {"photons that arrive": bench.n_pulses * _rate(bench)},
        note="What a detector that is always armed would count, on average.",
    )


def first_photons(bench: Bench) -> Plot:
    """Plot the first photons of all pulses, which are all that is recorded."""
    capture = _captured(bench, float(bench.acquisition.bin_to_range_m(bench.onset_bin)))
    rate = _rate(bench)
    return Plot(
        "first_photons",
        f"First photons of {bench.n_pulses:,} pulses",
        "Bin (1 ns)",
        "Counts",
        _centres(bench),
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
    rate = _rate(bench)
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
    scene = car()
    acquisition = replace(scene.acquisition, n_pulses=bench.n_pulses)
    capture = simulate(scene, acquisition, bench.flux, PULSE)
    found_m = estimate(capture, "tracking", bench.tracking).range_m
    found_m = np.where(np.isfinite(scene.range_m), found_m, np.nan)
    degree = restoration_degree(found_m, scene.range_m, 3 * acquisition.bin_length_m)
    low, high = float(np.nanmin(scene.range_m)), float(np.nanmax(scene.range_m))
    return Pictures(
        "car_image",
        f"The car at PPP {bench.flux.signal:.3g}",
        "Range (m)",
        {"truth": scene.range_m, f"{degree:.1%} within 3 bins": found_m},
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
        f"A flat target, {_SIDE} × {_SIDE} pixels. PPP {bench.signal:g} at an exposure of 1. The "
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
        capture = _captured(at, range_m, _SIDE)
        for method in ("tracking", "likelihood"):
            settings = bench.tracking if method == "tracking" else None
            settings = settings or ESTIMATORS[method].parameters()
            error = np.abs(ESTIMATORS[method].delays(capture, settings)[0] - onset)
            shares[method].append(float((error <= 3).mean()))
        limit = right_bin_probability(onset, flux.signal, flux.background, PULSE, gate)
        shares[LIMIT].append(float(limit))
    return {name: np.array(values) for name, values in shares.items()}


LIMIT = "limit"


def both_scales(bench: Bench) -> Plot:
    """Plot the two scales of a pixel with an echo."""
    return pixel_signals(bench.onset_bin, bench.tracking, bench.flux)


def both_scales_without_echo(bench: Bench) -> Plot:
    """Plot the two scales of a pixel without an echo."""
    return pixel_signals(math.nan, bench.tracking, bench.flux)


@lru_cache(maxsize=16)
def estimates_without_echo(bench: Bench) -> Plot:
    """Plot where estimates lie in pixels without an echo, and which echoes are found."""

    def simulated(range_m: float) -> Capture:
        return _captured(bench, range_m, 2 * _SIDE)

    return range_prior.range_prior(simulated, "tracking", bench.tracking)


def fluxes_by_range(bench: Bench) -> Plot:
    """Plot signal and background of a surface that is moved away, both as the bench has at 50 m."""
    range_m = np.geomspace(40.0, 400.0, 60)
    signal = bench.exposure * bench.signal * Falloff(_BENCH_RANGE_M).transmission(range_m)
    return Plot(
        "fluxes_by_range",
        "Signal and background of a surface against its range",
        "Range (m)",
        "Photons per pulse",
        range_m,
        {
            "signal": signal,
            "background": np.full(range_m.size, bench.exposure * bench.background),
        },
        {"50 m": _BENCH_RANGE_M},
        "A surface that fills the pixel, in sunlight. The background is that of the whole gate.",
        x_is_log=True,
    )


PLOTS: Mapping[str, Callable[[Bench], Plot]] = {
    each.__name__: each
    for each in (
        light,
        first_photons,
        still_armed,
        accuracy_by_exposure,
        both_scales,
        both_scales_without_echo,
        estimates_without_echo,
        fluxes_by_range,
    )
}
"""Views on which a prediction can be drawn."""

VIEWS: Mapping[str, Callable[[Bench], Plot | Pictures]] = {**PLOTS, "car_image": car_image}
"""Views that a lesson can name."""


# -- Checks ----------------------------------------------------------------------------------------


def share_armed(bench: Bench, bin: float) -> float:
    """Share of pulses that are still armed at the beginning of a bin."""
    return float(np.exp(-_rate(bench)[: round(bin)].sum()))


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


def share_without_echo(bench: Bench, first: float, end: float) -> float:
    """Share of the estimates in pixels without an echo that lie in some bins, by simulation."""
    bins = ESTIMATORS["tracking"].delays(_captured(bench, math.nan, 64), bench.tracking)[0]
    return float(((bins >= first) & (bins < end)).mean())


def share_of_gate(bench: Bench, first: float, end: float) -> float:
    """Share of the gate between two bins."""
    return (end - first) / bench.acquisition.n_bins


def signal_at(bench: Bench, range_m: float) -> float:
    """Signal of the surface at another range than 50 m."""
    share = Falloff(_BENCH_RANGE_M).transmission(np.array(range_m))
    return float(bench.exposure * bench.signal * share)


def number(bench: Bench, value: float) -> float:
    """Return a number as it is, for a hint."""
    return value


CHECKS: Mapping[str, Callable[..., float]] = {
    each.__name__: each
    for each in (
        share_armed,
        share_fired,
        best_attenuation,
        sbr,
        share_without_echo,
        share_of_gate,
        signal_at,
        number,
    )
}
"""Functions that compute the answer to a question of a lesson, or a typical wrong one."""


def arguments_of(name: str) -> list[str]:
    """Return the names of the arguments of a check, besides the bench.

    Raises
    ------
    ValueError
        If there is no such check.
    """
    require("check", name, name in CHECKS, " or ".join(map(repr, CHECKS)))
    return list(inspect.signature(CHECKS[name]).parameters)[1:]


NEED_SIGNAL = frozenset(
    each.__name__
    for each in (
        accuracy_by_exposure,
        best_attenuation,
        both_scales,
        both_scales_without_echo,  # names the SBR
        car_image,
    )
)
"""Views and checks that raise ``ValueError`` without a signal."""


def require_signal(name: str, bench: Bench) -> None:
    """Raise ``ValueError`` if a view or check needs a signal and the bench has none."""
    accepted = bench.signal > 0 or name not in NEED_SIGNAL
    require("signal", bench.signal, accepted, f"a number above 0, which {name!r} needs")
