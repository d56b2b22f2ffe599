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

from core.acquisition import Floats
from core.capture import Capture
from core.inference.further_echo import further_echo_log_odds, probability_within
from core.inference.posterior import TOLERANCE_BINS, same_echo_bins

LIKELY = 0.5
"""Probability from which a surface is accepted."""


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
        log_ratio = _log_odds(capture, histogram, [])
    while is_likely:
        likeliest = int(np.where(left, likely, -1.0).argmax())
        left[likeliest] = False
        accepted[likeliest] = int(np.where(windows[likeliest], log_ratio, -np.inf).argmax())
        left_of_one[windows[:, accepted[likeliest]]] = 0.0  # that of the one accepted
        log_ratio = _log_odds(capture, histogram, list(accepted.values()))
        likely = probability_within(log_ratio, windows)
        probability[left] = np.maximum(left_of_one, likely)[left]
        is_likely = likely[left].max(initial=0.0) >= LIKELY
    if len(accepted) > 1:
        for i in accepted:
            others = [delay for j, delay in accepted.items() if j != i]
            found = probability_within(_log_odds(capture, histogram, others), windows[i : i + 1])
            probability[i] = max(probability[i], found[0])
    return probability


def _log_odds(capture: Capture, histogram: Floats, accepted: list[int]) -> Floats:
    """Log odds of one more echo in each bin to none, shape (bin,)."""
    delays = np.array(accepted, float)[np.newaxis]
    apart_bins = same_echo_bins(capture)
    return np.asarray(further_echo_log_odds(capture, histogram[np.newaxis], delays, apart_bins)[0])
