"""Correlation of the histogram with the pulse.

The best linear filter for an echo in *uniform* white noise. First-photon histograms are not that:
without correction for the pile-up the front of the gate wins, and at a low SBR this is worse than
the plain peak.
"""

from __future__ import annotations

from dataclasses import dataclass

from core.acquisition import Floats
from core.estimators.base import Estimator
from core.estimators.filters import correlate, echo_shape
from core.inference.likelihood import Conditions


@dataclass(frozen=True)
class MatchedFilterParameters:
    """The matched filter has no settings: the pulse is the capture's."""


def _curve(
    histogram: Floats, conditions: Conditions, parameters: MatchedFilterParameters
) -> Floats:
    """``Σ_k n_k p(k - d)`` at each bin's beginning d."""
    return correlate(histogram, *echo_shape(conditions))


ESTIMATOR = Estimator("Matched filter", MatchedFilterParameters, _curve)
