"""What all estimators share: signature, calibration of the lag, strength of evidence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtr

from core.acquisition import Floats
from core.capture import Capture
from core.parallel import COMPILED
from core.trigger import rate_per_bin, trigger_probability


@dataclass(frozen=True, eq=False)
class RangeImage:
    """An estimator's answer; every field has shape (row, col).

    Parameters
    ----------
    range_m : ndarray of float
        Range of the surface in metres; NaN where `valid` is False.
    bin : ndarray of float
        The echo's delay in fractional bins, the estimator's own lag removed; NaN likewise.
    score : ndarray of float
        The estimator's score at its answer; its unit is the estimator's own.
    confidence : ndarray of float
        Probability that noise alone would nowhere in the gate have shown as large an excess over
        its neighbourhood as the answer does, in [0, 1]; 0 where `valid` is False.
    valid : ndarray of bool
        Whether there is an answer.
    """

    range_m: Floats
    bin: Floats
    score: Floats
    confidence: Floats
    valid: NDArray[np.bool_]


@dataclass(frozen=True)
class Estimator:
    """One entry of the registry.

    Parameters
    ----------
    title : str
        As shown to people.
    parameters : type
        Frozen dataclass of its settings.
    locate : callable
        ``(capture, parameters) -> (position_bin, score)``, each of shape (row, col): the bin of the
        best score, NaN where there is none.
    curve : callable
        ``(histogram, parameters, n_pulses) -> score``, shape (..., bin): the same score for every
        bin.
    first_bin : callable
        ``parameters -> bin`` before which the estimator gives no answer.
    """

    title: str
    parameters: type[Any]
    locate: Callable[[Capture, Any], tuple[Floats, Floats]]
    curve: Callable[[Floats, Any, int | None], Floats]
    first_bin: Callable[[Any], int]

    def __call__(self, capture: Capture, parameters: Any) -> RangeImage:
        """Range every pixel of a capture."""
        position, score = self.locate(capture, parameters)
        lag = self.lag_bins(capture, parameters)
        bins = np.clip(position - lag, 0.0, capture.acquisition.n_bins)
        valid = np.isfinite(bins)
        return RangeImage(
            range_m=capture.acquisition.bin_to_range_m(bins),
            bin=bins,
            score=score,
            confidence=_confidence(capture, bins),
            valid=valid,
        )

    def lag_bins(self, capture: Capture, parameters: Any) -> float:
        """How far behind the surface's delay the best score of a noise-free echo lies.

        Echoes as strong as the capture's own, over its own background, are put at all fractions of
        a bin at some places of the gate; their median lag is the calibration. It moves a little
        with the strength of echo and background, which is why it is not a constant.

        Returns
        -------
        float
            Lag in bins; 0 where no echo can be found at all (every bin excluded, say).
        """
        acquisition, (signal, background) = capture.acquisition, capture.typical_flux
        n_bins, n_pulses = acquisition.n_bins, capture.armed_pulses
        first = max(self.first_bin(parameters), 0.1 * n_bins)
        places = np.round(np.linspace(first, 0.9 * n_bins, 8))
        onset = (places[:, np.newaxis] + np.arange(8) / 8).ravel()
        rate = rate_per_bin(
            onset, np.full(onset.size, signal), background, capture.pulse, acquisition
        )
        expected = rate if n_pulses is None else trigger_probability(rate) * n_pulses
        score = self.curve(expected, parameters, n_pulses)
        since_onset = np.arange(n_bins) - onset[:, np.newaxis]
        reach = 10 + 3 * capture.echo_bins
        score = np.where((np.abs(since_onset) <= reach) & (score > 0), score, 0.0)
        found = score.max(axis=1) > 0
        if not found.any():
            return 0.0
        return float(np.median(score.argmax(axis=1)[found] - onset[found]))


def _confidence(capture: Capture, onset_bin: Floats) -> Floats:
    """`RangeImage.confidence` of answers at `onset_bin` (row, col)."""
    begin_s, _ = capture.pulse.span_s
    width = capture.echo_bins
    begin = np.floor(onset_bin + begin_s / capture.acquisition.bin_width_s)
    first = np.where(np.isfinite(begin), begin, -1).astype(np.int64)
    z = np.empty(first.shape)
    _excess(capture.cube, first, width, capture.armed_pulses or 0, z)
    places = capture.acquisition.n_bins / width
    return np.where(np.isfinite(onset_bin), ndtr(z) ** places, 0.0)


_FLANK = 3  # windows' widths on either side that tell the background


@njit(**COMPILED)
def _excess(cube, first, width, n_pulses, z):  # type: ignore[no-untyped-def]
    """Standard deviations by which a window's counts exceed what its flanks let expect.

    A bin is expected to count in proportion to the pulses still armed; `n_pulses` of 0 means that
    all of them always are. The square root of a Poisson count has a standard deviation of 1/2
    whatever its mean (Anscombe 1948), also where counts are few.
    """
    rows, cols, n_bins = cube.shape
    for row in range(rows):
        for col in range(cols):
            begin = min(max(first[row, col], 0), n_bins)
            end = min(begin + width, n_bins)
            low, high = max(begin - _FLANK * width, 0), min(end + _FLANK * width, n_bins)
            fired = 0.0
            for k in range(low):
                fired += cube[row, col, k]
            inside, outside, armed_inside, armed_outside = 0.0, 0.0, 0.0, 0.0
            for k in range(low, high):
                count = float(cube[row, col, k])
                armed = n_pulses - fired if n_pulses > 0 else 1.0
                if begin <= k < end:
                    inside += count
                    armed_inside += armed
                else:
                    outside += count
                    armed_outside += armed
                fired += count
            expected = outside * armed_inside / armed_outside if armed_outside > 0 else 0.0
            z[row, col] = 2.0 * (math.sqrt(inside + 0.375) - math.sqrt(expected + 0.375))
