"""Maximum likelihood for Poisson counts, the usual "MLE" in this field.

Exact if photons are rare and all of them are counted. It does not model pile-up: at a low SBR the
maximum lies at the front of the gate.
"""

from __future__ import annotations

import numpy as np

from core.acquisition import Floats
from core.estimators.base import Estimator, NoParameters
from core.estimators.filters import correlate, echo_shape
from core.inference.likelihood import Conditions


def _curve(histogram: Floats, conditions: Conditions, parameters: NoParameters) -> Floats:
    """``Σ_k n_k ln(1 + S p(k - d) / b)`` at each bin's beginning d, with the image's mean S and b.

    This is the difference of ``Σ_k n_k ln(b + S p(k - d))`` to its value without an echo.
    """
    echo, first = echo_shape(conditions)
    n_bins = conditions.acquisition.n_bins
    return correlate(histogram, np.log1p(conditions.contrast * n_bins * echo), first)


ESTIMATOR = Estimator("Log-matched filter (Poisson MLE)", NoParameters, _curve)
