"""Probability that there is a surface at each of several delays of a pixel.

The posterior (`core.inference.posterior`) knows one surface: of two in a pixel, it gives the weaker
one no probability. Here, surfaces that are likelier than not are accepted one after the other, the
likeliest first. The fluxes of those accepted and the background are fitted, and the likelihood
ratio of one more echo, whose photons are taken from the background, to none is averaged over its
signal and its delay. Its delay is uniform over the gate, but for one pulse around each accepted
surface. How often a pixel with as many surfaces has one more, and of which signal, is estimated
from a sample of the pixels. At the end, each accepted surface is tested given the others.

Reliability. Simulated pixels see a surface of 12 to 60 photons and, in none, half or all of them,
another of 0.2 to 0.7 times as many, 3 to 90 bins behind it; the background is 10 to 60 photons,
recorded as first photons or all. Share of the candidates of a probability that are within
`TOLERANCE_BINS` of a surface, and their number:

=======  ==========  ==========  ==========  ==========  ===========  ===========
Second   0.1 to 0.3  0.3 to 0.5  0.5 to 0.7  0.7 to 0.9  0.9 to 0.98  above 0.98
=======  ==========  ==========  ==========  ==========  ===========  ===========
in none  0.00 (18)   0.00 (5)    0.00 (2)                1.00 (1)     1.00 (959)
in half  0.13 (83)   0.30 (20)   0.60 (15)   0.67 (15)   0.87 (15)    1.00 (1364)
in all   0.34 (62)   0.50 (12)   0.73 (22)   0.86 (22)   0.95 (22)    1.00 (1788)
=======  ==========  ==========  ==========  ==========  ===========  ===========
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
from core.inference.posterior import TOLERANCE_BINS, same_echo_bins

LIKELY = 0.5
"""Probability from which a surface is accepted."""

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


def surface_probabilities(
    capture: Capture, row: int, col: int, bins: Floats, of_one: Floats
) -> Floats:
    """Probability of a surface within `TOLERANCE_BINS` of each delay (n,), shape (n,).

    Parameters
    ----------
    capture : Capture
    row, col : int
    bins : ndarray, shape (n,)
        Delays in fractional bins, at least `same_echo_bins` apart.
    of_one : ndarray, shape (n,)
        The probabilities if the pixel has at most one surface.
    """
    left_of_one, probability, likely = of_one.copy(), of_one.copy(), of_one
    histogram = capture.cube[row, col].astype(float)
    windows = np.abs(np.arange(histogram.size) - bins[:, np.newaxis]) <= TOLERANCE_BINS
    left = np.ones(bins.size, bool)
    accepted: dict[int, int] = {}  # delay in bins of each accepted candidate
    # At first, two surfaces share the probability of one.
    is_likely = likely.sum() >= LIKELY
    if is_likely:
        log_ratio = _log_ratio(capture, histogram, [])
    while is_likely:
        likeliest = int(np.where(left, likely, -1.0).argmax())
        left[likeliest] = False
        accepted[likeliest] = int(np.where(windows[likeliest], log_ratio, -np.inf).argmax())
        left_of_one[windows[:, accepted[likeliest]]] = 0.0  # that of the one accepted
        log_ratio = _log_ratio(capture, histogram, list(accepted.values()))
        likely = _within(log_ratio, windows)
        probability[left] = np.maximum(left_of_one, likely)[left]
        is_likely = likely[left].max(initial=0.0) >= LIKELY
    if len(accepted) > 1:
        for i in accepted:
            others = [delay for j, delay in accepted.items() if j != i]
            found = _within(_log_ratio(capture, histogram, others), windows[i : i + 1])
            probability[i] = max(probability[i], found[0])
    return probability


def _within(log_ratio: Floats, windows: NDArray[np.bool_]) -> Floats:
    """Probability of one more surface in each window (n, bin), shape (n,)."""
    whole = np.logaddexp(0.0, np.logaddexp.reduce(log_ratio))
    inside = np.logaddexp.reduce(np.where(windows, log_ratio, -np.inf), axis=1)
    return np.asarray(np.exp(inside - whole))


def _log_ratio(capture: Capture, histogram: Floats, accepted: list[int]) -> Floats:
    """Log odds of one more echo in each bin to none, shape (bin,)."""
    delays = np.array(accepted, float)[np.newaxis]
    log = _log_ratios(capture, histogram[np.newaxis], delays)[0]
    share = _level_shares(capture, len(accepted))
    return np.asarray(np.logaddexp.reduce(log + np.log(share[1:] / share[0])[:, np.newaxis]))


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
    log = np.logaddexp.reduce(_log_ratios(capture, histograms, delays), axis=2)
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
    share = _level_shares(capture, n_accepted - 1)
    weight = np.log(share[1:] / share[0])[:, np.newaxis]
    log = np.logaddexp.reduce(_log_ratios(capture, histograms, delays) + weight, axis=1)
    has_more = np.logaddexp.reduce(log, axis=1) >= 0.0
    delays = np.concatenate([delays, log.argmax(axis=1)[:, np.newaxis]], axis=1)
    return histograms[has_more], delays[has_more]


def _log_ratios(capture: Capture, histograms: Floats, delays: Floats) -> Floats:
    """Log likelihood ratio of one more echo of each of `_levels` in each bin to none.

    Parameters
    ----------
    capture : Capture
    histograms : ndarray, shape (pixel, bin)
    delays : ndarray, shape (pixel, surface)
        Surfaces that are accepted, in bins.

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
    is_apart = (distance >= same_echo_bins(capture)).all(axis=1, keepdims=True)
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
