"""Probability that there is a surface at each of several delays of a pixel.

The posterior (`core.inference.posterior`) knows one surface: of two in a pixel, it gives the weaker
one no probability. Here, surfaces that are likelier than not are accepted one after the other, the
likeliest first. The fluxes of those accepted and the background are fitted, and the likelihood
ratio of one more echo to none is averaged over its signal and its delay: uniform over the gate, but
for one pulse around each accepted surface. Its prior probability is one half.
"""

from __future__ import annotations

import numpy as np

from core.acquisition import Floats
from core.capture import Capture
from core.inference.likelihood import Conditions, log_likelihood_ratio, rate_and_n_armed
from core.inference.posterior import TOLERANCE_BINS, same_echo_bins, tolerance_probability_at

_LIKELY = 0.5
_FITTING_STEPS = 60
_SIGNALS = 2.0 ** -np.arange(8)  # of one more echo, relative to all photons of the pixel
_LEAST_RATE = 1e-12


def surface_probabilities(capture: Capture, row: int, col: int, bins: Floats) -> Floats:
    """Probability of a surface within `TOLERANCE_BINS` of each delay (n,), shape (n,).

    Parameters
    ----------
    capture : Capture
    row, col : int
    bins : ndarray, shape (n,)
        Delays in fractional bins, at least `same_echo_bins` apart.
    """
    alone = tolerance_probability_at(capture, row, col, bins)
    probability = alone.copy()
    histogram = capture.cube[row, col].astype(float)
    windows = np.abs(np.arange(histogram.size) - bins[:, np.newaxis]) <= TOLERANCE_BINS
    left = list(range(bins.size))
    accepted: list[int] = []
    while left and probability[left].max() >= _LIKELY:
        likeliest = left.pop(int(probability[left].argmax()))
        log_ratio = _log_ratio(capture, histogram, accepted)
        accepted.append(int(np.where(windows[likeliest], log_ratio, -np.inf).argmax()))
        log_ratio = _log_ratio(capture, histogram, accepted)
        whole = np.logaddexp(0.0, np.logaddexp.reduce(log_ratio))
        alone[windows[:, accepted[-1]]] = 0.0  # probability of the surface just accepted
        for i in left:
            within = np.logaddexp.reduce(log_ratio[windows[i]], initial=-np.inf)
            probability[i] = max(alone[i], float(np.exp(within - whole)))
    return probability


def _log_ratio(capture: Capture, histogram: Floats, accepted: list[int]) -> Floats:
    """Log likelihood ratio of one more echo in each bin to none, with its prior, shape (bin,)."""
    acquisition, pulse, n_pulses = capture.acquisition, capture.pulse, capture.gated_pulses
    bins = np.arange(histogram.size)
    rate, armed = rate_and_n_armed(histogram, n_pulses)
    delays = np.array(accepted, float)
    echoes = pulse.bin_probability(delays, histogram.size, acquisition.bin_width_s)
    shares = np.concatenate([np.full((1, histogram.size), 1 / histogram.size), echoes])
    explained = _explained(histogram, armed, shares, n_pulses is not None)
    signal, background = _SIGNALS * rate.sum(), explained.sum()
    conditions = Conditions(acquisition, pulse, n_pulses, signal, background, contrast=1.0)
    histograms = np.broadcast_to(histogram, (_SIGNALS.size, histogram.size))
    log = log_likelihood_ratio(histograms, conditions, explained)
    is_apart = (np.abs(bins - delays[:, np.newaxis]) >= same_echo_bins(capture)).all(axis=0)
    prior = np.log(_SIGNALS.size * np.maximum(np.count_nonzero(is_apart), 1))
    return np.where(is_apart, np.logaddexp.reduce(log, axis=0) - prior, -np.inf)


def _explained(histogram: Floats, armed: Floats, shares: Floats, is_first: bool) -> Floats:
    """Fit the photons per bin of background and echoes by expectation and maximisation.

    A pulse that fires in a bin of rate ``λ`` holds ``λ / (1 - exp(-λ))`` photons there on average.

    Parameters
    ----------
    histogram, armed : ndarray, shape (bin,)
        Counts, and armed pulses before each bin.
    shares : ndarray, shape (component, bin)
        Share of the photons of background and echoes in each bin.
    is_first : bool
        Whether a pulse fires only once.
    """
    exposure = np.maximum(shares @ armed, _LEAST_RATE)
    flux = np.full(len(shares), histogram.sum() / exposure.sum())
    for _ in range(_FITTING_STEPS):
        rate = np.maximum(flux @ shares, _LEAST_RATE)
        photons = histogram * (rate / -np.expm1(-rate) if is_first else 1.0)
        flux = flux * (shares @ (photons / rate)) / exposure
    return np.asarray(np.maximum(flux @ shares, _LEAST_RATE))
