"""Kernel density estimate of the trigger times, those of the neighbours included.

The density of the triggers of a neighbourhood of pixels, a Gaussian of standard deviation h at each
(Rosenblatt 1956, Parzen 1962), and its highest place. A trigger's time is known to its bin only,
and may be any within: the kernel is averaged over the bin, so that h may be less than a bin. With
``n_i`` triggers in bin i, the density at the middle of bin k is ::

    f_k = Σ_i n_i [ Φ((k - i + 1/2) / h) - Φ((k - i - 1/2) / h) ]     triggers per bin

The paper compares itself with a "neighbourhood KDE" and prints no bandwidth: pooling 3 x 3 pixels
and the bandwidth are reconstructions. Nothing is done about the pile-up, so that at a low SBR the
front of the gate is denser than any echo, and the more so the more pixels are pooled. Pooling and
density take 14 ns a pixel and bin.
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
from core.parameters import Choice, Number, Zone, check_fields, parameter

REACH = {"1x1": 1, "3x3": 3, "5x5": 5}
"""Neighbourhoods by name, and their rows and columns."""


@dataclass(frozen=True)
class KdeParameters:
    """Settings of the density estimate.

    Raises
    ------
    ValueError
        If a value lies outside its bounds.
    """

    neighbourhood: str = parameter(
        "3x3",
        Choice("Neighbourhood", tuple(REACH)),
        "Pixels whose triggers are taken together.",
    )
    bandwidth_bins: float = parameter(
        0.4,
        Number(
            "h",
            0.1,
            3.0,
            log=True,
            unit="bins",
            least=0.01,
            most=100.0,
            doubtful=(
                Zone(2.0, 100.0, "So wide a kernel drowns the echo in the background before it."),
            ),
        ),
        "Standard deviation of the Gaussian that stands for each trigger.",
    )

    def __post_init__(self) -> None:
        check_fields(self)


def kernel_taps(bandwidth_bins: float) -> Floats:
    """Density at whole bins' distance from a trigger, averaged over its bin; shape (odd,)."""
    half = math.ceil(5 * bandwidth_bins)  # beyond five standard deviations lies one in 2 million
    edges = np.arange(-half, half + 2) - 0.5
    return np.diff(scipy.special.ndtr(edges / bandwidth_bins))


def _curve(histogram: Floats, conditions: Conditions, parameters: KdeParameters) -> Floats:
    """``f_k`` of the module's docstring."""
    taps = kernel_taps(parameters.bandwidth_bins)
    return correlate(histogram, taps, -(taps.size // 2))


ESTIMATOR = Estimator(
    "Kernel density of the neighbourhood",
    KdeParameters,
    _curve,
    reach=lambda parameters: REACH[parameters.neighbourhood],
    reconstructed="its name in the paper: neighbourhood and bandwidth are not printed",
)
