"""Posterior predictive check: the counts that the model expects of some pixels, bin by bin.

Delays and fluxes are drawn from the posterior of each pixel as in `core.inference.fit`. Given the
pulses still armed, the counts of a bin are binomial (Poisson if all photons are counted); those of
several pixels are added, and distributions are averaged over the draws.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture
from core.inference.fit import drawn_residuals, in_parts, quantile_residuals

_DRAWS = 400  # at least, of the sum of all pixels
_NUMBERS = 2**21  # counts that are drawn; fewer draws in a long gate
_ENDS = 0.025, 0.975


class Predictive(NamedTuple):
    """Counts of some pixels, added up, beside those that the model expects; (bin,) each."""

    counts: Floats
    expected: Floats
    """Mean of the counts that the model expects of the pulses still armed."""
    low: Floats
    """Lower end of the band that holds 95 % of such counts."""
    high: Floats
    residual: Floats
    """Randomized quantile residual in standard deviations: normal if the model holds."""


def predictive_of(capture: Capture, pixels: NDArray[np.intp]) -> Predictive:
    """Predict the counts of pixels given as flat indices (pixel,), at least one."""
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    n_counts = max(1, min(_DRAWS, _NUMBERS // n_bins))
    expected = _expected(capture, pixels, -(-n_counts // pixels.size))
    counts = capture.cube.reshape(-1, n_bins)[pixels].sum(axis=0, dtype=float)
    rng = np.random.default_rng(0)
    if n_pulses is None:
        armed, rate = None, expected
        drawn = rng.poisson(np.resize(expected, (n_counts, n_bins)))
    else:
        armed = n_pulses * pixels.size - np.cumsum(counts) + counts
        fires = np.divide(expected, armed, out=np.zeros_like(expected), where=armed > 0)
        fires = np.minimum(fires, np.nextafter(1.0, 0.0))
        rate = -np.log1p(-fires)
        drawn = rng.binomial(armed.astype(np.int64), np.resize(fires, (n_counts, n_bins)))
    low, high = np.quantile(drawn, _ENDS, axis=0, method="inverted_cdf").astype(float)
    residual = quantile_residuals(counts, armed, rate, rng.uniform(size=n_bins))
    return Predictive(counts, expected.mean(axis=0), low, high, residual)


def _expected(capture: Capture, pixels: NDArray[np.intp], n_draws: int) -> Floats:
    """Draw the expected counts of all pixels together, shape (draw, bin)."""
    n_bins = capture.acquisition.n_bins
    expected = np.zeros((n_draws, n_bins))
    every = np.arange(n_draws * pixels.size)
    for some in in_parts(capture, every):
        draw, at = np.divmod(some, pixels.size)
        found = drawn_residuals(capture, pixels[at], pixels[at] + draw * capture.counts.size)
        np.add.at(expected, draw, found.expected)
    return expected
