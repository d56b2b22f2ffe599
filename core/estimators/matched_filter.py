"""Correlation of the histogram with the pulse.

The best linear filter for an echo in *uniform* white noise. First-photon histograms are not
uniform: without correction of pile-up the maximum lies at the front of the gate, and at a low SBR
this filter is worse than the peak of the histogram.
"""

from __future__ import annotations

from core.acquisition import Floats
from core.estimators.base import Estimator, NoParameters
from core.estimators.filters import correlate, echo_shape
from core.inference.likelihood import Conditions


def _curve(histogram: Floats, conditions: Conditions, parameters: NoParameters) -> Floats:
    """``Σ_k n_k p(k - d)`` at each bin's beginning d."""
    return correlate(histogram, *echo_shape(conditions))


ESTIMATOR = Estimator("Matched filter", NoParameters, _curve)
