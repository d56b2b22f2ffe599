"""Figures 5 and 6: how pile-up lowers the peak of an echo that arrives late."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Acquisition, Floats, Flux, Pulse
from core.scene import Scene
from core.simulation import simulate
from core.studies.outputs import Plot
from core.trigger import rate_per_bin, trigger_probability

N_PULSES = 1000
GATE = Acquisition(n_pulses=N_PULSES)
ONSETS = np.arange(20, 100)
"""Bins of the target; the bins before them hold noise alone."""

LEAST_P = 0.05
"""p-value at or above which a curve is reported to fit."""

_N_NOISE = 19  # bins at the front of the gate whose mean is Figure 5b


def figure_5b(flux: Flux) -> Plot:
    """Plot the mean trigger frequency of the noise before the target, against the target's bin."""
    frequency, expected = _frequencies(flux)
    noise, mean = (each[:, :_N_NOISE].mean(axis=1) for each in (frequency, expected))
    # Bins of one pulse exclude each other, so that their sum is binomial, too.
    total = mean * _N_NOISE
    half = 1.96 * np.sqrt(total * (1 - total) / N_PULSES) / _N_NOISE
    return Plot(
        "figure_5b",
        f"Figure 5b: noise in the first {_N_NOISE} bins (SBR {flux.sbr:g})",
        "Bin of the target",
        "Mean trigger frequency",
        ONSETS.astype(float),
        {"simulated": noise, "expected (Eq. 1)": mean},
        note="The band holds 95 % of the simulated values. Noise does not depend on the target.",
        bands={"expected (Eq. 1)": (mean - half, mean + half)},
    )


def figure_6(flux: Flux) -> Plot:
    """Plot the trigger frequency at the target's peak against its bin, and fits of this curve.

    The paper fits an exponential, concludes that the weight should grow exponentially, and prints
    the cubic weight of Eq. 13, whose reciprocal is also fitted here. By Eq. 1 the peak falls
    with the probability that a pulse is still armed, which is exponential in the target's bin.
    """
    frequency, expected = _frequencies(flux)
    share = Pulse().bin_probability(ONSETS.astype(float), GATE.n_bins, GATE.bin_width_s)
    at_peak = np.arange(ONSETS.size), share.argmax(axis=1)
    peak, mean = frequency[at_peak], expected[at_peak]
    sd = np.sqrt(mean * (1 - mean) / N_PULSES)
    fits = {
        "expected (Eq. 1)": (mean, 0),
        "exponential": (_fitted(_exponential, peak, (float(peak[0]), 0.01)), 2),
        "reciprocal of the cubic weight": (_fitted(_reciprocal_cubic, peak, (0.1,)), 1),
    }
    verdicts = "; ".join(
        f"{name} {_verdict(((peak - curve) / sd) ** 2, n_fitted)}"
        for name, (curve, n_fitted) in fits.items()
    )
    armed = GATE.n_bins / flux.background
    return Plot(
        "figure_6",
        f"Figures 5a and 6: trigger frequency at the target's peak (SBR {flux.sbr:g})",
        "Bin of the target",
        "Trigger frequency",
        ONSETS.astype(float),
        {"simulated": peak, **{name: curve for name, (curve, _) in fits.items()}},
        note="Squared deviation per degree of freedom, about 1 for the right curve: "
        f"{verdicts}. The probability that a pulse is still armed falls by 1/e in {armed:.3g} "
        "bins.",
    )


def _frequencies(flux: Flux) -> tuple[Floats, Floats]:
    """Return simulated and expected trigger frequencies (target, bin), a target at each bin."""
    scene = Scene(GATE.bin_to_range_m(ONSETS[np.newaxis].astype(float)))
    counts = simulate(scene, GATE, flux, Pulse(), seed=0).cube[0]
    rate = rate_per_bin(ONSETS.astype(float), flux.signal, flux.background, Pulse(), GATE)
    return counts / N_PULSES, trigger_probability(rate)


def _verdict(squares: Floats, n_fitted: int) -> str:
    """Return the reduced chi-square of a fit, and whether chance exceeds it in 5 % of cases."""
    free, total = squares.size - n_fitted, float(squares.sum())
    fits = scipy.stats.chi2.sf(total, free) >= LEAST_P
    return f"{total / free:.3g} ({'fits' if fits else 'does not fit'})"


def _fitted(curve: Callable[..., Floats], values: Floats, start: tuple[float, ...]) -> Floats:
    """Return the least-squares fit of a curve to a value at each bin of the target."""
    found, _ = scipy.optimize.curve_fit(curve, ONSETS, values, start)
    return curve(ONSETS, *found)


def _exponential(onset: Floats, first: float, decay: float) -> Floats:
    return np.asarray(first * np.exp(-decay * (onset - ONSETS[0])))


def _reciprocal_cubic(onset: Floats, last: float) -> Floats:
    return np.asarray(last * (GATE.n_bins / onset) ** 3)
