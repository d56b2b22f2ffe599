"""Kernel density estimate of the trigger times of a neighbourhood of pixels.

The estimate is the maximum of the density, a Gaussian of standard deviation h at each trigger
(Rosenblatt 1956, Parzen 1962). The time of a trigger is only known to its bin, so that the kernel
is averaged over the bin and h may be less than a bin. With ``n_i`` triggers in bin i, the density
at the middle of bin k is ::

    f_k = Σ_i n_i [ Φ((k - i + 1/2) / h) - Φ((k - i - 1/2) / h) ]     triggers per bin

The paper compares its method with a "neighbourhood KDE" and states no bandwidth: pooling of 3 x 3
pixels and the bandwidth are reconstructions. Pile-up is not corrected, so that at a low SBR the
front of the gate is denser than any echo, the more so the more pixels are pooled. Pooling and
density take 14 ns per pixel and bin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Floats
from core.estimators.base import Estimator
from core.estimators.filters import correlate
from core.inference.likelihood import Conditions
from core.parameters import Choice, Number, Settings, Zone, parameter

WINDOW_SIZE = {"1x1": 1, "3x3": 3, "5x5": 5}
"""Rows and columns of each neighbourhood."""


def bandwidth_spec(symbol: str, too_wide_bins: float) -> Number:
    """Return the specification of a bandwidth that is doubtful from `too_wide_bins`."""
    why = "The kernel is so wide that the background before the echo exceeds it."
    zone = Zone(too_wide_bins, 100.0, why)
    return Number(
        symbol,
        0.1,
        3.0,
        log=True,
        unit="bins",
        merge_power=0,  # a kernel narrower than a bin would not smooth
        least=0.01,
        most=100.0,
        doubtful=(zone,),
    )


@dataclass(frozen=True)
class KdeParameters(Settings):
    """Settings of the density estimate."""

    neighbourhood: str = parameter(
        "3x3",
        Choice("Neighbourhood", tuple(WINDOW_SIZE)),
        "Pixels whose triggers are pooled.",
    )
    bandwidth_bins: float = parameter(
        0.4,
        bandwidth_spec("h", 2.0),
        "Standard deviation of the Gaussian at each trigger.",
    )


def kernel_taps(bandwidth_bins: float) -> Floats:
    """Density at whole bins from a trigger, averaged over its bin; shape (odd,)."""
    half = math.ceil(5 * bandwidth_bins)  # all but one in 2 million
    edges = np.arange(-half, half + 2) - 0.5
    return np.diff(scipy.special.ndtr(edges / bandwidth_bins))


def _curve(histogram: Floats, conditions: Conditions, parameters: KdeParameters) -> Floats:
    """``f_k`` of the module's docstring."""
    return correlate(histogram, kernel_taps(parameters.bandwidth_bins))


ESTIMATOR = Estimator(
    "Kernel density of the neighbourhood",
    KdeParameters,
    _curve,
    window_size=lambda parameters: WINDOW_SIZE[parameters.neighbourhood],
    reconstructed="its name in the paper, which does not state neighbourhood and bandwidth",
)
