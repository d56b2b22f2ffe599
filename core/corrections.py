"""Corrections that estimators make, and captures prepared so that they do not."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from core.acquisition import Pulse
from core.capture import Capture
from core.checks import require
from core.inference.flux import detailed_flux_prior_of, flux_prior_over

__all__ = ["CORRECTIONS", "moments_s", "without_correction"]

CORRECTIONS = {
    "pile_up": "pile-up",
    "pulse_shape": "shape of the pulse",
    "signal_levels": "levels of signal",
}
"""Effects that estimators correct for, by key."""


def without_correction(capture: Capture, correction: str) -> Capture:
    """Return the same counts for an estimator that does not make a correction.

    Without ``pile_up`` counts are taken for multi-detection data; without ``signal_levels`` all
    pixels have the mean level; without ``pulse_shape`` the pulse is a Gaussian of the same mean and
    width.

    Raises
    ------
    ValueError
        If `correction` is not a key of `CORRECTIONS`.
    """
    require("correction", correction, correction in CORRECTIONS, " or ".join(CORRECTIONS))
    if correction == "pile_up":
        all_photons = replace(capture, detection="all", flux_prior=None)
        # Or the fewer photons late in the gate would be taken for a background that falls.
        shape = detailed_flux_prior_of(capture).background_shape
        return replace(all_photons, flux_prior=flux_prior_over(all_photons, shape))
    if correction == "pulse_shape":
        mean_s, sigma_s = moments_s(capture.pulse)
        # The time zero of a Gaussian is its centre, so the gate opens earlier after it.
        gate_delay_s = capture.acquisition.gate_delay_s - mean_s
        acquisition = replace(capture.acquisition, gate_delay_s=gate_delay_s)
        pulse = Pulse.gaussian(sigma_s)
        return replace(capture, acquisition=acquisition, pulse=pulse, flux_prior=None)
    return replace(capture, flux_prior=detailed_flux_prior_of(capture).with_one_level())


def moments_s(pulse: Pulse) -> tuple[float, float]:
    """Return mean and standard deviation of the photons' time in seconds after time zero."""
    longest = len(pulse.samples) + 40.0
    edge_s = np.linspace(-longest, longest, 2**16) * pulse.tau_s
    share, middle_s = np.diff(pulse.cdf(edge_s)), (edge_s[1:] + edge_s[:-1]) / 2
    mean_s = float(share @ middle_s)
    return mean_s, math.sqrt(float(share @ (middle_s - mean_s) ** 2))
