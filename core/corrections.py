"""What an estimator takes into account of a capture besides place and strength of an echo."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from core.acquisition import Pulse
from core.capture import Capture
from core.checks import require
from core.inference.flux import detailed_flux_prior_of

__all__ = [
    "CORRECTIONS",
    "moments_s",
    "without_correction",
]

CORRECTIONS = {
    "pile_up": "pile-up",
    "pulse_shape": "shape of the pulse",
    "signal_levels": "levels of signal",
}
"""What an estimator corrects for, in words."""


def without_correction(capture: Capture, correction: str) -> Capture:
    """The same counts for an estimator that does not make it.

    Without pile-up all photons count; without levels of signal, their mean is that of all pixels;
    and without its shape the pulse is a Gaussian of the same mean and width.

    Raises
    ------
    ValueError
        If there is no correction of that name.
    """
    require("correction", correction, correction in CORRECTIONS, " or ".join(CORRECTIONS))
    if correction == "pile_up":
        return replace(capture, detection="all", flux_prior=None)
    if correction == "pulse_shape":
        mean_s, sigma_s = moments_s(capture.pulse)
        # A Gaussian's time zero is its centre: the gate opens that much earlier after it.
        gate_delay_s = capture.acquisition.gate_delay_s - mean_s
        acquisition = replace(capture.acquisition, gate_delay_s=gate_delay_s)
        pulse = Pulse.gaussian(sigma_s)
        return replace(capture, acquisition=acquisition, pulse=pulse, flux_prior=None)
    return replace(capture, flux_prior=detailed_flux_prior_of(capture).with_one_level())


def moments_s(pulse: Pulse) -> tuple[float, float]:
    """Mean and standard deviation of a photon's time, in seconds after time zero."""
    longest = len(pulse.samples) + 40.0
    edge_s = np.linspace(-longest, longest, 2**16) * pulse.tau_s
    share, middle_s = np.diff(pulse.cdf(edge_s)), (edge_s[1:] + edge_s[:-1]) / 2
    mean_s = float(share @ middle_s)
    return mean_s, math.sqrt(float(share @ (middle_s - mean_s) ** 2))
