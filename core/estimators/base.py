"""What all estimators share: signature, calibration of the lag, confidence, "no target"."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.deprecation import renamed
from core.inference.flux import flux_model_of
from core.inference.flux_model import FluxModel
from core.inference.likelihood import Conditions
from core.inference.neighbours import patches, pooled_at, pooled_in
from core.inference.posterior import tolerance_probability
from core.parameters import Number
from core.trigger import drawn, rate_per_bin, trigger_probability


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
        Probability that there is a surface within 3 bins of the answer, by the exact first-photon
        likelihood and the light that the capture itself tells of (`core.inference.posterior`):
        among pixels told 0.9, nine in ten are right, whichever estimator answers. 0 where `valid`
        is False.
    valid : ndarray of bool
        Whether there is an answer.
    """

    range_m: Floats
    bin: Floats
    score: Floats
    confidence: Floats
    valid: NDArray[np.bool_]


FALSE_ALARM = Number("False alarms", 1e-3, 1.0, log=True, least=1e-3, most=1.0)
"""Share of the pixels without an echo that may be answered; 1 answers all of them."""

NULL_SIDE = 256
"""Rows and columns of the echo-free image on which a detection threshold is found."""


class Calibration(NamedTuple):
    """What an estimator knows of all pixels of an image before it ranges one of them."""

    lag_bins: float
    """`Estimator.lag_bins`."""
    least_score: float | None
    """`Estimator.threshold`; None where every pixel is answered."""


@dataclass(frozen=True)
class Estimator:
    """One entry of the registry.

    Parameters
    ----------
    title : str
        As shown to people.
    parameters : type
        Frozen dataclass of its settings.
    curve : callable
        ``(histogram, conditions, parameters) -> score``, both of shape (..., bin): the score of
        each bin, larger where an echo is more plausible.
    locate : callable, optional
        ``(capture, light, parameters) -> (position_bin, score)``, each of shape (row, col), NaN
        where there is none: a quicker way to the largest of the curve, or a finer one.
    reach : callable, optional
        ``parameters -> pixels``, odd: rows and columns of the neighbourhood whose counts are added
        before `curve` sees them.
    first_bin : callable, optional
        ``parameters -> bin`` before which the estimator gives no answer.
    finds_delay : bool
        Whether positions are delays of the surface already, with no lag to be calibrated.
    flux_model : callable
        ``capture -> FluxModel`` that the estimator is told; raises ``ValueError`` where it is not
        known.
    reconstructed : str
        Where the original was not available: from what the method was reconstructed.
    null_side : int
        Rows and columns of the echo-free image on which a detection threshold is found.
    undoes_pile_up : bool
        Whether the estimator takes counts for first photons and undoes that early ones hide later
        ones, where the number of pulses is known.
    spares : callable
        ``capture -> sentence``: what it leaves out of its model since the capture's pulses do not
        tell it, at less cost; empty where nothing.
    whole_image : bool
        Whether a pixel's answer depends on pixels beyond its `reach`, so that no part of an image
        can be ranged without the rest.
    """

    title: str
    parameters: type[Any]
    curve: Callable[[Floats, Conditions, Any], Floats]
    locate: Callable[[Capture, FluxModel, Any], tuple[Floats, Floats]] | None = None
    reach: Callable[[Any], int] = lambda _: 1
    first_bin: Callable[[Any], int] = lambda _: 0
    finds_delay: bool = False
    flux_model: Callable[[Capture], FluxModel] = flux_model_of
    reconstructed: str = ""
    null_side: int = NULL_SIDE
    undoes_pile_up: bool = False
    spares: Callable[[Capture], str] = lambda _: ""
    whole_image: bool = False

    light = renamed("flux_model")

    def __call__(
        self, capture: Capture, parameters: Any, false_alarm: float | None = None
    ) -> RangeImage:
        """Range every pixel of a capture.

        Parameters
        ----------
        capture : Capture
        parameters : object
            Of type `Estimator.parameters`.
        false_alarm : float, optional
            Answer only where the score exceeds what this share of pixels without an echo shows;
            every pixel is answered where None or 1.

        Raises
        ------
        ValueError
            If `false_alarm` is not within the bounds of `FALSE_ALARM`.
        """
        return self.ranged(capture, parameters, self.calibration(capture, parameters, false_alarm))

    def remark(self, capture: Capture) -> str:
        """What the estimator leaves out for a capture; empty where nothing."""
        said = [self.spares(capture)]
        if self.undoes_pile_up and capture.gated_pulses is None:
            every = "the capture holds all photons, none hides another"
            why = every if capture.detection == "all" else "the number of pulses is not known"
            said.append(f"no pile-up is undone: {why}")
        return "; ".join(filter(None, said))

    def calibration(
        self, capture: Capture, parameters: Any, false_alarm: float | None = None
    ) -> Calibration:
        """What is to be known of a capture, or of a sample of it, before it is ranged."""
        if false_alarm is not None:
            FALSE_ALARM.check("false_alarm", false_alarm)
        least = None
        if false_alarm is not None and false_alarm < 1:
            least = self.threshold(capture, parameters, false_alarm)
        lag = 0.0 if self.finds_delay else self.lag_bins(capture, parameters)
        return Calibration(lag, least)

    def ranged(self, capture: Capture, parameters: Any, calibration: Calibration) -> RangeImage:
        """Range every pixel of a capture, or of a part of one."""
        bins, score = self._delays(capture, parameters, calibration)
        return RangeImage(
            range_m=capture.acquisition.bin_to_range_m(bins),
            bin=bins,
            score=score,
            confidence=tolerance_probability(capture, bins),
            valid=np.isfinite(bins),
        )

    def delays(
        self, capture: Capture, parameters: Any, false_alarm: float | None = None
    ) -> tuple[Floats, Floats]:
        """`RangeImage.bin` and `RangeImage.score` alone: the estimator without what it is worth."""
        return self._delays(capture, parameters, self.calibration(capture, parameters, false_alarm))

    def _delays(
        self, capture: Capture, parameters: Any, calibration: Calibration
    ) -> tuple[Floats, Floats]:
        position, score = self._best(capture, self.flux_model(capture), parameters)
        if calibration.least_score is not None:
            position = np.where(score > calibration.least_score, position, np.nan)
        delay = np.clip(position - calibration.lag_bins, 0.0, capture.acquisition.n_bins)
        return delay, score

    def curves(self, capture: Capture, row: int, col: int, parameters: Any) -> Floats:
        """The score of each bin for one pixel, shape (bin,)."""
        flux, reach = self.flux_model(capture), self.reach(parameters)
        around = pooled_at(capture.cube, row, col, reach)
        given = conditions_of(capture, flux, reach)
        here = np.s_[row : row + 1, col : col + 1]
        conditions = given._replace(signal=given.signal[here], background=given.background[here])
        one = around[np.newaxis, np.newaxis].astype(float)
        return np.asarray(self.curve(one, conditions, parameters)[0, 0])

    def threshold(self, capture: Capture, parameters: Any, false_alarm: float) -> float:
        """The score that a share `false_alarm` of pixels without an echo exceeds.

        Found on an image that sees the capture's own background and nothing else.
        """
        whole = tuple(_whole(self.null_side, size) for size in capture.shape)
        some = np.s_[: whole[0], : whole[1]]
        cube = _null_cube(capture)[some].copy()
        null = Capture(cube, capture.acquisition, capture.pulse, detection=capture.detection)
        flux = self.flux_model(capture).of_pixels(_null_pixels(capture)[some])
        _, score = self._best(null, flux, parameters)
        return float(np.quantile(score, 1 - false_alarm))

    def lag_bins(self, capture: Capture, parameters: Any) -> float:
        """How far behind the surface's delay a noise-free echo adds most to the score.

        Echoes as strong as the capture's own, over its own background, are put at all fractions of
        a bin at some places of the gate; their median lag is the calibration. It moves a little
        with the strength of echo and background, which is why it is not a constant.

        Returns
        -------
        float
            Lag in bins; 0 where no echo can be found at all (every bin excluded, say).
        """
        n_bins = capture.acquisition.n_bins
        given = conditions_of(capture, self.flux_model(capture), self.reach(parameters))
        given = given._replace(
            signal=np.asarray(given.signal.mean()), background=np.asarray(given.background.mean())
        )
        first = max(self.first_bin(parameters), 0.1 * n_bins)
        places = np.round(np.linspace(first, 0.9 * n_bins, 8))
        onset = (places[:, np.newaxis] + np.arange(8) / 8).ravel()
        # Not the largest score but the largest that the echo adds: noise-free, a falling background
        # is still there, and where an echo is weak it would take the scores near it for the echo's.
        no_echo = _expected(onset[:1], given._replace(signal=np.zeros(())))
        without = self.curve(no_echo, given, parameters)
        most, at = np.empty(onset.size), np.empty(onset.size, np.intp)
        at_once = max(1, _AT_ONCE // n_bins)
        for first in range(0, onset.size, at_once):
            some = slice(first, first + at_once)
            added = self.curve(_expected(onset[some], given), given, parameters) - without
            most[some], at[some] = added.max(axis=1), added.argmax(axis=1)
        found = most > 0
        if not found.any():
            return 0.0
        return float(np.median(at[found] - onset[found]))

    def _best(self, capture: Capture, flux: FluxModel, parameters: Any) -> tuple[Floats, Floats]:
        """Bin and value of the largest score, each of shape (row, col)."""
        locate = self.locate or self._largest
        position, score = locate(capture, flux, parameters)
        seen = capture.counts > 0
        return np.where(seen, position, np.nan), np.where(seen, score, 0.0)

    def _largest(self, capture: Capture, flux: FluxModel, parameters: Any) -> tuple[Floats, Floats]:
        reach = self.reach(parameters)
        given = conditions_of(capture, flux, reach)
        position, score = np.empty((2, *capture.shape))
        for patch in patches(capture.cube.shape, _AT_ONCE):
            cube = pooled_in(capture.cube, patch, reach)
            # A few rows at a time: temporaries beyond the cache cost more than their arithmetic.
            rows_at_once = max(1, _IN_CACHE // cube[0].size)
            for first in range(0, len(cube), rows_at_once):
                rows = slice(first, first + rows_at_once)
                signal, background = given.signal[patch][rows], given.background[patch][rows]
                some = given._replace(signal=signal, background=background)
                curve = self.curve(cube[rows].astype(float), some, parameters)
                position[patch][rows] = curve.argmax(axis=2)
                score[patch][rows] = curve.max(axis=2)
        return position, score


def conditions_of(capture: Capture, flux: FluxModel, reach: int = 1) -> Conditions:
    """What an estimator knows of a capture's histograms, `reach` x `reach` of them added."""
    n_pulses = capture.gated_pulses
    more = 1 if n_pulses else reach * reach  # photons are counted per pixel where pulses are not
    signal, background = flux.typical_signal, flux.typical_background
    return Conditions(
        capture.acquisition,
        capture.pulse,
        n_pulses * reach * reach if n_pulses else None,
        signal * more,
        background * more,
        flux.contrast,
        flux.pile_up,
    )


def _expected(onset_bin: Floats, given: Conditions) -> Floats:
    """Expected counts of echoes at some delays, shape (delay, bin)."""
    signal = np.full(onset_bin.size, given.signal)
    rate = rate_per_bin(onset_bin, signal, float(given.background), given.pulse, given.acquisition)
    return rate if given.n_pulses is None else trigger_probability(rate) * given.n_pulses


_AT_ONCE = 2**20  # float64 numbers of a temporary: 8 MiB
_IN_CACHE = 2**16
_PATCH = 64  # rows and columns that stay together, for what looks at neighbours


def _whole(side: int, size: int) -> int:
    """About `side` rows or columns: as many as whole patches of an image of `size` have."""
    patch = min(_PATCH, size)
    return max(1, round(side / patch)) * patch


@cached_per_capture
def _null_pixels(capture: Capture) -> NDArray[np.intp]:
    """Pixels of the capture, in patches drawn at random, whose background an echo-free image sees.

    Flat indices, shape (row, col).
    """
    rows, cols = capture.shape
    # A large gate's image would not fit: fewer pixels then, and a coarser threshold.
    side = min(NULL_SIDE, math.isqrt(2**23 // capture.acquisition.n_bins))
    high, wide = min(_PATCH, rows), min(_PATCH, cols)
    down, across = _whole(side, rows) // high, _whole(side, cols) // wide
    rng = np.random.default_rng(0)
    top = rng.integers(rows - high + 1, size=(down, 1, across, 1))
    left = rng.integers(cols - wide + 1, size=(down, 1, across, 1))
    row = top + np.arange(high)[:, np.newaxis, np.newaxis]
    col = left + np.arange(wide)
    return np.asarray((row * cols + col).reshape(down * high, across * wide))


@cached_per_capture
def _null_cube(capture: Capture) -> NDArray[np.unsignedinteger]:
    """Counts of pixels that see the capture's background alone, shape (row, col, bin)."""
    rng = np.random.default_rng(1)
    n_bins, n_pulses = capture.acquisition.n_bins, capture.gated_pulses
    pixels = _null_pixels(capture)
    background = flux_model_of(capture).of_pixels(pixels).typical_background
    cubes = []
    rows_at_once = max(1, _AT_ONCE // (pixels.shape[1] * n_bins))
    for first in range(0, len(pixels), rows_at_once):
        rate = background[first : first + rows_at_once, :, np.newaxis] / n_bins
        cubes.append(drawn(np.repeat(rate, n_bins, axis=2), n_pulses, rng))
    return np.concatenate(cubes)
