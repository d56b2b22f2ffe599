"""Maximum likelihood for Poisson counts: what "MLE" most often means in this field.

Exact where photons are rare and every one of them is counted. It knows nothing of the pile-up, and
at a low SBR the front of the gate wins.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from core.acquisition import Floats
from core.estimators.base import Estimator
from core.estimators.filters import correlate, echo_shape
from core.inference.likelihood import Conditions


@dataclass(frozen=True)
class LogMatchedFilterParameters:
    """The log-matched filter has no settings: pulse, signal and background are the capture's."""


def _curve(
    histogram: Floats, conditions: Conditions, parameters: LogMatchedFilterParameters
) -> Floats:
    """``Σ_k n_k ln(1 + S p(k - d) / b)`` at each bin's beginning d, of the image's mean S and b.

    It is ``Σ_k n_k ln(b + S p(k - d))`` less what no echo would give.
    """
    echo, first = echo_shape(conditions)
    n_bins = conditions.acquisition.n_bins
    return correlate(histogram, np.log1p(conditions.contrast * n_bins * echo), first)


ESTIMATOR = Estimator("Log-matched filter (Poisson MLE)", LogMatchedFilterParameters, _curve)
