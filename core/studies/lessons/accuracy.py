"""Share of right estimates, and calibration of their confidence (lessons 6 to 8)."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Acquisition, Floats, Flux
from core.capture import Capture, cached_per_capture
from core.estimators import ESTIMATORS, estimate
from core.metrics import reliability, wilson
from core.scene import uniform
from core.studies.lessons.bench import PULSE, SIDE, Bench, captured
from core.studies.methods.calibration import confidence_and_right
from core.studies.outputs import Plot
from core.studies.paper.figures import RECOMMENDED, found_by_place
from core.studies.tradeoff.acquisition import pulses_by_theory, theory
from core.studies.tradeoff.surrogate import Simulation
from core.studies.trials import Method, default_methods, score

PULSES = (50, 100, 200, 300, 400, 600, 850, 1200, 2000)
"""Pulses for which random depths are simulated."""

PLACES = tuple(np.arange(0.0, 100.0, 5.0).tolist())
"""Bins of the echo for which flat targets are simulated."""

THRESHOLDS = np.linspace(0.0, 0.98, 50)

COMPARED = [
    RECOMMENDED,
    *(each for each in default_methods() if each.name in ("peak", "coates", "likelihood")),
]

_SIDE = 48  # rows and columns of images with random depths
_LIKELIHOOD = Method("likelihood", "likelihood", ESTIMATORS["likelihood"].parameters())


# -- Pulses ----------------------------------------------------------------------------------------


def accuracy_by_pulses(bench: Bench) -> Plot:
    """Plot the share of random depths that is found against the number of pulses."""
    known, found, band = _accuracy(replace(bench, n_pulses=1))
    return Plot(
        "accuracy_by_pulses",
        f"Random depths found within 3 bins, SBR {bench.flux.sbr:.2g}",
        "Pulses",
        "Share of pixels",
        np.array(PULSES, float),
        {"theory, flux known": known, "likelihood": found},
        {"pulses": bench.n_pulses},
        f"With {bench.n_pulses:,} pulses, {theory(_random_depths(bench)):.1%} by theory. "
        f"Likelihood: {_SIDE} × {_SIDE} simulated pixels at each point, with the 95 % interval of "
        "their share.",
        {"likelihood": band},
        x_is_log=True,
    )


@lru_cache(maxsize=8)
def _accuracy(bench: Bench) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """Return the shares found by theory and by the likelihood, and the interval of the latter."""
    simulation = _random_depths(bench)
    known, shares = [], []
    for n_pulses in PULSES:
        each = simulation.with_pulses(n_pulses)
        known.append(theory(each))
        counted = score(each.capture(bench.seed), _LIKELIHOOD)
        shares.append(wilson(counted.restored[-1], counted.targets))
    value, low, high = np.array([(each.value, each.low, each.high) for each in shares]).T
    return np.array(known), value, (low, high)


def _random_depths(bench: Bench) -> Simulation:
    return Simulation("uniform", uniform(_SIDE), bench.acquisition, bench.flux, PULSE)


@lru_cache(maxsize=32)
def pulses_for(bench: Bench, share: float) -> float:
    """Pulses with which a share of random depths is found, by theory."""
    return pulses_by_theory(_random_depths(bench), share)


def pulses_ratio(bench: Bench, share: float, over: float) -> float:
    """Pulses with which a share is found, over those for another share, by theory."""
    return pulses_for(bench, share) / pulses_for(bench, over)


# -- Place in the gate -----------------------------------------------------------------------------


def found_along_gate(bench: Bench) -> Plot:
    """Plot the share of pixels that each method finds on flat targets along the gate."""
    return Plot(
        "found_along_gate",
        f"Pixels found within 3 bins, SBR {bench.flux.sbr:.2g}",
        "Bin of the echo",
        "Share of pixels",
        np.array(PLACES),
        _found(bench.acquisition, bench.flux, bench.seed),
        {"echo's onset": bench.onset_bin},
        f"Flat targets of {SIDE} × {SIDE} pixels, one at each fifth bin. The paper's "
        "car stands in bins 45 to 70.",
    )


@lru_cache(maxsize=8)
def _found(acquisition: Acquisition, flux: Flux, seed: int) -> dict[str, Floats]:
    return found_by_place(acquisition, flux, COMPARED, PLACES, SIDE, seed)


def place_of_half(bench: Bench) -> float:
    """Bin of the echo beyond which the peak is right in less than half of the pixels."""
    falling = np.minimum.accumulate(_found(bench.acquisition, bench.flux, bench.seed)["peak"])
    return float(np.interp(0.5, falling[::-1], PLACES[::-1]))


# -- Confidence ------------------------------------------------------------------------------------


def reliability_diagram(bench: Bench) -> Plot:
    """Plot the share of right estimates against their confidence, in tenths of confidence."""
    confidence, right = _judged(captured("uniform", bench))
    tenths = reliability(confidence, right)
    stated = np.array([each.confidence for each in tenths])
    value, low, high = np.array([(t.right.value, t.right.low, t.right.high) for t in tenths]).T
    counts = ", ".join(f"{each.count:,}" for each in tenths)
    return Plot(
        "reliability_diagram",
        f"Right estimates by confidence, SBR {bench.flux.sbr:.2g}",
        "Confidence, mean of a tenth",
        "Share right within 3 bins",
        stated,
        {"right": value, "calibrated": stated},
        {"least confidence": bench.least_confidence},
        "Random depths, by the likelihood. Estimates in each tenth, in ascending order: "
        f"{counts}. Band: 95 % interval of the share.",
        {"right": (low, high)},
    )


def kept_by_confidence(bench: Bench) -> Plot:
    """Plot how many estimates a threshold of confidence keeps, and how many of them are right."""
    confidence, right = _judged(captured("uniform", bench))
    kept = confidence >= THRESHOLDS[:, np.newaxis]
    return Plot(
        "kept_by_confidence",
        "Estimates that a threshold keeps",
        "Least confidence",
        "Share",
        THRESHOLDS,
        {
            "right, of those kept": (kept & right).sum(axis=1) / kept.sum(axis=1),
            "kept": kept.mean(axis=1),
        },
        {"least confidence": bench.least_confidence},
        f"At {bench.least_confidence:.2f}, {share_kept(bench, bench.least_confidence):.1%} are "
        "kept.",
    )


@cached_per_capture
def _judged(capture: Capture) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the confidence of the likelihood's estimates, and whether each is right."""
    return confidence_and_right(capture, estimate(capture, "likelihood"))


def share_kept(bench: Bench, least: float) -> float:
    """Share of the estimates with a confidence of at least `least`."""
    return float((_judged(captured("uniform", bench))[0] >= least).mean())


def share_right(bench: Bench, least: float) -> float:
    """Share of right estimates, of those with a confidence of at least `least`."""
    confidence, right = _judged(captured("uniform", bench))
    return float(right[confidence >= least].mean())
