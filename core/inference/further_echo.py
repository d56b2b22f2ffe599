"""Likelihood ratio of one more echo in a pixel, given those that are accepted.

The fluxes of the accepted echoes and the background are fitted, and the likelihood ratio of one
more echo, whose photons are taken from the background, to none is computed for several signals and
for each bin. How often a pixel with as many surfaces has one more, and of which signal, is
estimated from a sample of the pixels.
"""

from __future__ import annotations

import numpy as np
import scipy  # loads a submodule when it is first used
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.inference.flux import flux_model_of
from core.inference.likelihood import (
    Conditions,
    log_likelihood_ratio,
    log_rate_ratio,
    rate_and_n_armed,
)
from core.inference.posterior import same_echo_bins

_FITTING_STEPS = 60
_LEAST_RATE = 1e-12
_N_LEVELS = 8
"""Signals of one more echo, each half the one before."""
_BRIGHT = 0.9  # quantile of the pixels' photons; half of it is the strongest of these signals
_SAMPLE = 64
"""Most pixels from which it is estimated how often there is one more echo."""
_SAMPLE_NUMBERS = 2**20
"""Most bins of their echoes that are evaluated, so that long gates and pulses take no longer."""
_PRIOR_SHARE = np.array([0.5, *np.full(_N_LEVELS, 0.5 / _N_LEVELS)])
"""Share of the pixels without one more echo, and with one of each signal, before any is seen."""
_PRIOR_PIXELS = _N_LEVELS
"""Weight of `_PRIOR_SHARE`, in pixels: half a pixel at each level."""
_LEARNING_STEPS = 50


def further_echo_log_odds(
    capture: Capture, histograms: Floats, delays: Floats, apart_bins: float
) -> Floats:
    """Log odds of one more echo in each bin to none.

    Parameters
    ----------
    capture : Capture
    histograms : ndarray, shape (pixel, bin)
    delays : ndarray, shape (pixel, surface)
        Surfaces that are accepted, in bins.
    apart_bins : float
        Least distance from them.

    Returns
    -------
    ndarray, shape (pixel, bin)
    """
    log = _log_ratios(capture, histograms, delays, apart_bins)
    share = _level_shares(capture, delays.shape[1])
    weight = np.log(share[1:] / share[0])[:, np.newaxis]
    return np.asarray(np.logaddexp.reduce(log + weight, axis=1))


def probability_within(log_odds: Floats, windows: NDArray[np.bool_]) -> Floats:
    """Probability of one more echo in windows of the gate.

    Parameters
    ----------
    log_odds : ndarray, shape (..., bin)
        As `further_echo_log_odds` returns them.
    windows : ndarray, shape (n, bin)
        One of each pixel, or several of one pixel.

    Returns
    -------
    ndarray, shape (n,)
    """
    whole = np.logaddexp(0.0, np.logaddexp.reduce(log_odds, axis=-1))
    inside = np.logaddexp.reduce(np.where(windows, log_odds, -np.inf), axis=-1)
    return np.asarray(np.exp(inside - whole))


@cached_per_capture
def _level_shares(capture: Capture, n_accepted: int) -> Floats:
    """Estimate how many pixels with as many surfaces have one more, of each of `_levels`.

    By variational inference from a sample of the pixels, which leaves levels that no pixel needs
    little more than their share in the prior (Corduneanu & Bishop 2001, "Variational Bayesian model
    selection for mixture distributions"). The likeliest shares would credit the noise of pixels to
    the faintest levels, which no pixel distinguishes from no echo.

    Returns
    -------
    ndarray, shape (1 + level,)
        Share of the pixels without one more echo, and with each.
    """
    if n_accepted == 0:  # of these, the posterior is known
        return _PRIOR_SHARE
    histograms, delays = _sample(capture, n_accepted)
    prior = _PRIOR_PIXELS * _PRIOR_SHARE
    log = _log_ratios(capture, histograms, delays, same_echo_bins(capture))
    log = np.logaddexp.reduce(log, axis=2)
    log = np.concatenate([np.zeros((len(log), 1)), log], axis=1)
    likelihood, count = np.exp(log - log.max(axis=1, keepdims=True)), prior
    for _ in range(_LEARNING_STEPS):
        posterior = likelihood * np.exp(scipy.special.digamma(count))
        posterior /= posterior.sum(axis=1, keepdims=True)
        count = posterior.sum(axis=0) + prior
    return np.asarray(count / count.sum())


@cached_per_capture
def _levels(capture: Capture) -> Floats:
    """Return signals of one more echo in photons per pulse, shape (level,)."""
    rate, _ = rate_and_n_armed(_sample(capture, 0)[0], capture.gated_pulses)
    return np.asarray(np.quantile(rate.sum(axis=1), _BRIGHT) / 2.0 ** np.arange(1, _N_LEVELS + 1))


@cached_per_capture
def _sample(capture: Capture, n_accepted: int) -> tuple[Floats, Floats]:
    """Return histograms (pixel, bin) of pixels with as many surfaces, and their delays in bins."""
    if n_accepted == 0:
        n_bins = capture.acquisition.n_bins
        at_most = min(_SAMPLE, max(1, _SAMPLE_NUMBERS // (n_bins * capture.echo_bins)))
        some = np.random.default_rng(0).permutation(np.flatnonzero(capture.counts))[:at_most]
        return capture.cube.reshape(-1, n_bins)[some].astype(float), np.empty((some.size, 0))
    histograms, delays = _sample(capture, n_accepted - 1)
    log = further_echo_log_odds(capture, histograms, delays, same_echo_bins(capture))
    has_more = np.logaddexp.reduce(log, axis=1) >= 0.0
    delays = np.concatenate([delays, log.argmax(axis=1)[:, np.newaxis]], axis=1)
    return histograms[has_more], delays[has_more]


def _log_ratios(capture: Capture, histograms: Floats, delays: Floats, apart_bins: float) -> Floats:
    """Log likelihood ratio of one more echo of each of `_levels` in each bin to none.

    Parameters
    ----------
    capture : Capture
    histograms, delays, apart_bins
        As for `further_echo_log_odds`.

    Returns
    -------
    ndarray, shape (pixel, level, bin)
        Plus the log probability of the bin, if there is such an echo.
    """
    acquisition, n_pulses, n_bins = capture.acquisition, capture.gated_pulses, histograms.shape[1]
    shape = flux_model_of(capture).relative_background
    flat = np.broadcast_to(shape / n_bins, (len(histograms), 1, n_bins))
    echoes = capture.pulse.bin_probability(delays, n_bins, acquisition.bin_width_s)
    flux = _fitted_flux(histograms, np.concatenate([flat, echoes], axis=1), n_pulses)
    signal, least = _levels(capture), 0.5 / (n_pulses or 1)  # half a count
    # The photons of one more echo are taken from the background.
    background = np.maximum(flux[:, :1] - np.append(0.0, signal), least)
    rate = background[..., np.newaxis] / n_bins * shape
    rate += np.vecmat(flux[:, 1:], echoes)[:, np.newaxis]
    rest, counts = rate[:, 1:], np.broadcast_to(histograms[:, np.newaxis], rate[:, 1:].shape)
    conditions = Conditions(
        acquisition, capture.pulse, n_pulses, signal, background[:, 1:], contrast=1.0
    )
    log = log_likelihood_ratio(counts, conditions, rest)
    log += log_rate_ratio(counts, n_pulses, rest, rate[:, :1])[..., np.newaxis]
    distance = np.abs(np.arange(n_bins) - delays[..., np.newaxis])
    is_apart = (distance >= apart_bins).all(axis=1, keepdims=True)
    prior = np.log(np.maximum(is_apart.sum(axis=2, keepdims=True), 1))
    return np.where(is_apart, log - prior, -np.inf)


def _fitted_flux(histograms: Floats, components: Floats, n_pulses: int | None) -> Floats:
    """Fit the photons of background and echoes by expectation and maximisation.

    A pulse that fires in a bin of rate ``λ`` holds ``λ / (1 - exp(-λ))`` photons there on average.

    Parameters
    ----------
    histograms : ndarray, shape (pixel, bin)
    components : ndarray, shape (pixel, component, bin)
        Share of the photons of background and echoes in each bin.
    n_pulses : int or None
        As `Conditions.n_pulses`.

    Returns
    -------
    ndarray, shape (pixel, component)
    """
    armed = rate_and_n_armed(histograms, n_pulses)[1]
    exposure = np.maximum(np.matvec(components, armed), _LEAST_RATE)
    flux = np.broadcast_to(
        (histograms.sum(axis=1) / exposure.sum(axis=1))[:, np.newaxis], exposure.shape
    )
    for _ in range(_FITTING_STEPS):
        rate = np.maximum(np.vecmat(flux, components), _LEAST_RATE)
        photons = histograms * (1.0 if n_pulses is None else rate / -np.expm1(-rate))
        flux = flux * np.matvec(components, photons / rate) / exposure
    return np.asarray(flux)
