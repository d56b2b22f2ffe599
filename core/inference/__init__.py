"""Inference from photon counts: signal and background fluxes, posterior, limits of a pixel."""

from core.inference.fit import (
    SMALL,
    Fit,
    fit_in,
    fit_of,
    fit_p_values,
    fit_p_values_of,
    has_fit,
    share_below,
)
from core.inference.flux import detailed_flux_prior_of, flux_model_of, flux_prior_of
from core.inference.flux_model import FluxModel, FluxPrior
from core.inference.intervals import (
    RangeInterval,
    pixel_range_intervals,
    range_interval,
    range_intervals,
)
from core.inference.likelihood import Conditions, log_likelihood_ratio, rate_and_n_armed
from core.inference.posterior import (
    TOLERANCE_BINS,
    Posterior,
    has_posterior,
    least_loss,
    most_likely,
    posterior_of,
    tolerance_probability,
)
from core.inference.predictive import Predictive, predictive_of
from core.inference.returns import FALSE_RETURN, MOST_RETURNS, Returns

__all__ = [
    "FALSE_RETURN",
    "MOST_RETURNS",
    "SMALL",
    "TOLERANCE_BINS",
    "Conditions",
    "Fit",
    "FluxModel",
    "FluxPrior",
    "Posterior",
    "Predictive",
    "RangeInterval",
    "Returns",
    "detailed_flux_prior_of",
    "fit_in",
    "fit_of",
    "fit_p_values",
    "fit_p_values_of",
    "flux_model_of",
    "flux_prior_of",
    "has_fit",
    "has_posterior",
    "least_loss",
    "log_likelihood_ratio",
    "most_likely",
    "pixel_range_intervals",
    "posterior_of",
    "predictive_of",
    "range_interval",
    "range_intervals",
    "rate_and_n_armed",
    "share_below",
    "tolerance_probability",
]
