"""Matched filter on counts whose pile-up is undone (Coates 1968).

The corrected rate of bin k is known to ``sqrt(λ / A_k)`` only, A_k pulses being armed, so that bins
count in proportion to A_k: the score is the weighted least-squares amplitude of an echo over its
standard deviation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.acquisition import Floats
from core.estimators.base import Estimator
from core.estimators.filters import correlate, echo_shape
from core.posterior import Conditions, rate_and_armed


@dataclass(frozen=True)
class CoatesParameters:
    """The Coates matched filter has no settings: pulse and pulses sent are the capture's."""


def _curve(histogram: Floats, conditions: Conditions, parameters: CoatesParameters) -> Floats:
    """``Σ_k A_k (λ_k - λ) p(k - d) / sqrt(λ Σ_k A_k p(k - d)²)`` at each bin's beginning d."""
    echo, first = echo_shape(conditions)
    rate, armed = rate_and_armed(histogram, conditions.n_pulses)
    mean = np.maximum(rate.mean(axis=-1, keepdims=True), np.finfo(float).tiny)
    amplitude = correlate(armed * (rate - mean), echo, first)
    # Where next to no pulse is armed an echo cannot show: one pulse keeps the ratio finite.
    spread = np.sqrt(mean * np.maximum(correlate(armed, echo**2, first), 1.0))
    return np.asarray(amplitude / spread)


ESTIMATOR = Estimator(
    "Coates correction, matched filter", CoatesParameters, _curve, undoes_pile_up=True
)
