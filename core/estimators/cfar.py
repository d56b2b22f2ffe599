"""Cell-averaging CFAR: ratio of each bin to the noise around it (Finn & Johnson 1968).

With the histogram smoothed by a Gaussian, ``x_k``, and the training cells ``T_k``, which lie on
either side of a guard around bin k, the score is ::

    x_k / (1 + mean of x over T_k)

so that the slow decay of first-photon histograms cancels. Near the ends of the gate only training
cells within the gate are averaged. The count added to the noise is not part of the original method:
without it a single photon late in the gate, where few are left, exceeds an echo of dozens, which
costs a quarter of the right estimates at an SBR of 0.03. The filters take 20 ns per pixel and bin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from core.acquisition import Floats
from core.estimators.base import Estimator
from core.estimators.filters import correlate
from core.inference.likelihood import Conditions
from core.parameters import Number, Settings, parameter


@dataclass(frozen=True)
class CfarParameters(Settings):
    """Settings of the CFAR."""

    smoothing_bins: float = parameter(
        1.0,
        Number("Smoothing", 0.0, 3.0, unit="bins", least=0.0, most=100.0),
        "Standard deviation of the Gaussian that smooths the histogram; 0 for no smoothing.",
    )
    guard_bins: int = parameter(
        3,
        Number("Guard", 0, 10, whole=True, unit="bins", least=0, most=1000),
        "Bins on either side that the echo may fill and that are excluded from the noise.",
    )
    training_bins: int = parameter(
        8,
        Number("Training", 1, 30, whole=True, unit="bins", least=1, most=10_000),
        "Bins beyond the guard, on either side, whose mean is the noise.",
    )


def _curve(histogram: Floats, conditions: Conditions, parameters: CfarParameters) -> Floats:
    """``x_k / (1 + mean of x over T_k)``; see the module's docstring."""
    smooth = correlate(histogram, gaussian_taps(parameters.smoothing_bins))
    around = training_taps(parameters.guard_bins, parameters.training_bins)
    total = correlate(smooth, around)
    cells = correlate(np.ones(histogram.shape[-1]), around)
    return np.asarray(smooth / (1.0 + total / np.maximum(cells, 1.0)))


def gaussian_taps(sigma_bins: float) -> Floats:
    """Gaussian at whole bins up to 4 standard deviations, of sum 1; shape (odd,)."""
    half = math.ceil(4 * sigma_bins)
    if half == 0:
        return np.ones(1)
    with np.errstate(over="ignore"):  # a Gaussian narrower than a bin
        taps = np.exp(-0.5 * (np.arange(-half, half + 1) / sigma_bins) ** 2)
    return np.asarray(taps / taps.sum())


def training_taps(guard_bins: int, training_bins: int) -> Floats:
    """1 for training cells, 0 for the guard and the cell under test; shape (odd,)."""
    side, guard = np.ones(training_bins), np.zeros(2 * guard_bins + 1)
    return np.concatenate([side, guard, side])


ESTIMATOR = Estimator("Cell-averaging CFAR", CfarParameters, _curve)
