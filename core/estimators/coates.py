"""Matched filter on rates with pile-up corrected (Coates 1968).

The corrected rate of bin k has a standard deviation of ``sqrt(λ / A_k)`` with A_k armed pulses, so
that bins are weighted with A_k: the score is the weighted least-squares amplitude of an echo over
its standard deviation. Where the background varies over the gate (`core.inference.background`), the
rate to expect is ``λ w_k``, and the weight is ``A_k / w_k``. If the pulses do not resolve pile-up
(`core.inference.resolution`), counts are used as rates and all pulses as armed, which takes half
the time.
"""

from __future__ import annotations

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.estimators.base import Estimator, NoParameters
from core.estimators.filters import correlate, echo_shape
from core.inference.flux import flux_prior_of
from core.inference.likelihood import Conditions, rate_and_n_armed


def _curve(histogram: Floats, conditions: Conditions, parameters: NoParameters) -> Floats:
    """``Σ_k A_k (λ_k - λ) p(k - d) / sqrt(λ Σ_k A_k p(k - d)²)`` at each bin's beginning d.

    With ``A_k / w_k`` and ``λ w_k`` for ``A_k`` and ``λ`` in the numerator, and ``A_k / w_k`` in
    the denominator, over a background of shape w.
    """
    echo, first = echo_shape(conditions)
    n_pulses = conditions.n_pulses
    if conditions.pile_up or n_pulses is None:
        rate, armed = rate_and_n_armed(histogram, n_pulses)
    else:
        rate, armed = histogram / n_pulses, np.full(histogram.shape[-1], float(n_pulses))
    mean = np.maximum(rate.mean(axis=-1, keepdims=True), np.finfo(float).tiny)
    expected = mean
    if (shape := conditions.background_shape) is not None:
        expected, armed = mean * shape, armed / shape
    amplitude = correlate(armed * (rate - expected), echo, first)
    # At least one armed pulse keeps the ratio finite.
    spread = np.sqrt(mean * np.maximum(correlate(armed, echo**2, first), 1.0))
    return np.asarray(amplitude / spread)


def _omits(capture: Capture) -> str:
    if flux_prior_of(capture).pile_up or capture.gated_pulses is None:
        return ""
    return "Coates undoes no pile-up: too few pulses fire for one photon to hide another"


ESTIMATOR = Estimator(
    "Coates correction, matched filter",
    NoParameters,
    _curve,
    undoes_pile_up=True,
    omits=_omits,
)
