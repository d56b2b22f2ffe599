"""The exact first-photon likelihood with true fluxes.

It bounds the figure of its rule (`core.estimators.likelihood`) for methods that look at single
pixels, if delays and background are uniform over the gate.
"""

from __future__ import annotations

import numpy as np

from core.capture import Capture, cached_per_capture
from core.estimators.base import Estimator
from core.estimators.likelihood import LikelihoodParameters, curve, locate
from core.inference.flux_model import FluxModel


@cached_per_capture
def true_flux_model(capture: Capture) -> FluxModel:
    """Return the true fluxes of a simulated capture.

    Raises
    ------
    ValueError
        If they are unknown.
    """
    if capture.signal is None or capture.background is None:
        raise ValueError(
            "method = 'oracle' needs the true signal and background, which only a simulated scene "
            "without further parts, such as fog, motion or a second surface, has: take "
            "'likelihood', which estimates them."
        )
    target = capture.signal[capture.signal > 0]
    # For a pixel without a target, a typical echo is assumed.
    typical = float(target.mean()) if target.size else 1.0
    signal = np.where(capture.signal > 0, capture.signal, typical)
    background = np.full(capture.shape, max(capture.background, 1e-12))
    return FluxModel(
        np.stack([np.zeros(capture.shape), signal]),
        np.stack([background, background]),
        np.array([0.0, 1.0]),
        np.ones(capture.acquisition.n_bins),
    )


ESTIMATOR = Estimator(
    "Oracle: likelihood with true fluxes",
    LikelihoodParameters,
    curve,
    locate,
    finds_delay=True,
    flux_model=true_flux_model,
    knows_flux=True,
    undoes_pile_up=True,
)
