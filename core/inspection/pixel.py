"""Report on one pixel."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.checks import require_pixel
from core.deprecation import renamed
from core.estimators import ESTIMATORS, RangeImage, settings_of
from core.estimators.base import Evidence
from core.estimators.shi import prominences
from core.inference.background import echo_window
from core.inference.faults import PixelVerdict, pixel_verdict
from core.inference.fit import Fit, fit_of
from core.inference.intervals import delay_range_interval, pixel_range_intervals
from core.inference.likelihood import rate_and_n_armed
from core.inference.posterior import (
    TOLERANCE_BINS,
    same_echo_bins,
    tolerance_probability_at,
)
from core.inference.returns import Returns
from core.inspection.flux import METHOD, estimate_flux
from core.inspection.profile import FluxEstimate, OldFluxNames
from core.inspection.surfaces import LIKELY, surface_probabilities
from core.metrics import Interval

MOST_CANDIDATES = 5
SEVERAL = "the echoes of other surfaces of the pixel count as neither signal nor background"
_FEWEST_BINS = 5  # of an echo in a plot around it


@dataclass(frozen=True)
class RangeCandidate:
    """A possible delay of the surface: a peak of an estimator's score, or of its log posterior.

    Peaks within one pulse, or 3 bins, of each other or of the estimate are one candidate, that of
    the highest score. Where the image has several returns of the pixel, each of them is one.
    """

    bin: float
    """Delay in fractional bins, corrected for the lag of the estimator; that of the estimate for
    the candidate that is the estimate."""
    range_m: float
    range_low_m: float
    """Lower limit of the 95 % interval of the range, if there is a surface within 3 bins, or within
    half the length of a longer pulse. Extended to `range_m`, except for the estimate."""
    range_high_m: float
    """Upper limit, likewise."""
    score: float
    relative: float
    """Score over that of the best candidate; 1 for that one."""
    probability: float
    """Probability of a surface within 3 bins, beside others where the pixel has several
    (`core.inspection.surfaces`); for the estimate that of the report, for returns theirs."""


@dataclass(frozen=True, eq=False)
class PixelReport(OldFluxNames):
    """Report on one pixel, or on the sum of the pixels of a region."""

    row: int
    col: int
    counts: Floats
    """Detections in each bin, shape (bin,)."""
    rate: Floats
    """Photons per pulse in each bin with pile-up corrected (Coates 1968), shape (bin,). The counts
    themselves for all photons or an unknown number of pulses."""
    rate_unit: str
    """``"photons per pulse"``, or ``"photons"``."""
    method: str
    """Key of `core.ESTIMATORS`."""
    curve: Floats
    """Score of each bin, not corrected for the lag, shape (bin,)."""
    evidence: Evidence | None
    """Evidence of the pixel and of its neighbours, for the method "image_posterior" and estimates
    that are judged by it; None for others, and where neighbours have no influence."""
    lag_bins: float
    """Distance from the delay of the surface to the maximum of the score."""
    answer_bin: float
    """Delay in the range image; NaN without an estimate."""
    answer_m: float
    """Range in the range image, likewise."""
    confidence: float
    """Probability of a surface within 3 bins of the estimate. That of the range image, or more
    where the pixel has several surfaces, of which the image knows one."""
    interval_68_m: Interval
    """Estimate with the 68 % interval of the range of the surface (`core.range_interval`)."""
    interval_95_m: Interval
    """Estimate with the 95 % interval, likewise."""
    candidates: tuple[RangeCandidate, ...]
    """Highest peaks of the score, in descending order; empty without detections."""
    surfaces_bin: tuple[float, ...]
    """Delays of the candidates that are likelier than not. The first is the surface whose signal
    `flux` states: the estimate if it is one of them, otherwise that of the highest score."""
    find_flux: Callable[[], FluxEstimate] = field(repr=False)
    """Function that estimates `flux`."""
    find_fit: Callable[[], Fit] = field(repr=False)
    """Function that returns whether the model describes the capture, or the region."""
    longest_echo_bins: int = field(repr=False)
    """Bins after a delay that an echo fills which is similar to the pulse, but longer."""
    flux_unit: str
    """``"photons per pulse"``, or ``"photons"``."""
    flux_method: str
    """Method by which the fluxes are estimated."""
    verdict: PixelVerdict
    """Whether the pixel is hot or dead."""

    find_light = renamed("find_flux")

    @cached_property
    def flux(self) -> FluxEstimate:
        """Signal, background and their ratio with 95 % intervals, estimated on first access.

        In photons per pulse if the number of pulses is known, otherwise in photons. With the pulse
        of the capture, as its estimates: one pixel does not show that another fits better, and the
        fit to all pixels (`CaptureReport.flux`) takes as long as an estimate. `RegionReport.pixel`
        uses the pulse that fits the pixels of the region.

        Where the pixel has several surfaces, the signal is that of the first of `surfaces_bin`; the
        echoes of the others count as neither signal nor background.
        """
        return self.find_flux()

    @property
    def _likely(self) -> list[RangeCandidate]:
        """Surfaces that are likelier than not."""
        return [each for each in self.candidates if each.probability >= LIKELY]

    @cached_property
    def may_be_one_echo(self) -> bool:
        """Whether several of `surfaces_bin` may be one echo that is longer than the pulse.

        If one has a lower score than another one shortly before it, as the tail of such an echo,
        and the echoes of the capture or region have another shape than the pulse (`Fit.pulse`),
        which is tested on first access.
        """
        in_order = sorted(self._likely, key=lambda each: each.bin)
        if not any(
            later.bin - earlier.bin < self.longest_echo_bins and later.score < earlier.score
            for earlier, later in pairwise(in_order)
        ):
            return False
        fit = self.find_fit()
        return fit.pulse in fit.failed

    @cached_property
    def surfaces_text(self) -> str:
        """Surfaces that are likelier than not, where they are and how sure that is, as text.

        Such as ``2 surfaces: 47.31 m (probability 0.99), 49.9 m (probability 0.95)``. Without
        probabilities where the surfaces `may_be_one_echo`: these assume the pulse.
        """
        likely, places = self._likely, []
        for each in sorted(likely, key=lambda each: each.range_m):
            interval = Interval(each.range_m, each.range_low_m, each.range_high_m)
            digits = 3 if interval.decimals is None else interval.decimals
            how_sure = "" if self.may_be_one_echo else f" (probability {each.probability:.2f})"
            places.append(f"{each.range_m:.{digits}f} m{how_sure}")
        noun = "surface" if len(places) == 1 else "surfaces"
        if self.may_be_one_echo:
            noun += ", or an echo longer than the pulse"
        return f"{len(places) or 'no'} {noun}" + (f": {', '.join(places)}" if places else "")

    @property
    def interval_text(self) -> str:
        """Range of the surface with its 95 % interval, as text; a dash without an estimate.

        Such as ``12.34 m ± 0.11 m (95 %)``: the middle of the interval and half its width, which
        has two significant digits.
        """
        low_m, high_m = self.interval_95_m.low, self.interval_95_m.high
        digits = self.interval_95_m.decimals
        if digits is None:
            return "–"
        half_m, middle_m = (high_m - low_m) / 2, (high_m + low_m) / 2
        return f"{middle_m:.{digits}f} m ± {half_m:.{digits}f} m (95 %)"


def pixel_report(
    capture: Capture,
    image: RangeImage,
    row: int,
    col: int,
    method: str = "tracking",
    settings: Any = None,
) -> PixelReport:
    """Report on one pixel.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        Estimate of the capture with this method and these settings; with returns, several of the
        pixel are candidates (`core.with_returns`). If it is judged by the posterior of the image
        (`core.judged_by_image`), so are the candidates.
    row, col : int
    method, settings
        As for `core.estimate`.

    Raises
    ------
    ValueError
        If there is no such pixel, or the method or its settings are unknown.
    """
    require_pixel(row, col, capture.shape)
    settings = settings_of(method, settings)
    counts = capture.cube[row, col].astype(float)
    curve = ESTIMATORS[method].curves(capture, row, col, settings)
    evidence = own = ESTIMATORS[method].evidence_at(capture, row, col)
    if own is None and image.made_by is not None and image.made_by.judged_by == "image":
        evidence = ESTIMATORS["image_posterior"].evidence_at(capture, row, col)
    lag = lag_bins(capture, method, settings)
    interval_68_m, interval_95_m = pixel_range_intervals(capture, image, row, col, (0.68, 0.95))
    scores = curve if own is None else np.log(np.maximum(own.posterior, np.finfo(float).tiny))
    candidates, confidence = _candidates(capture, image, row, col, scores, evidence, method, lag)
    answer_bin = float(image.bin[row, col])
    likely = [each.bin for each in candidates if each.probability >= LIKELY]
    surfaces_bin = tuple(sorted(likely, key=lambda at: at != answer_bin))
    return PixelReport(
        row=row,
        col=col,
        counts=counts,
        rate=rate_and_n_armed(counts, capture.gated_pulses)[0],
        rate_unit="photons" if capture.gated_pulses is None else "photons per pulse",
        method=method,
        curve=curve,
        evidence=evidence,
        lag_bins=lag,
        answer_bin=answer_bin,
        answer_m=float(image.range_m[row, col]),
        confidence=confidence,
        interval_68_m=interval_68_m,
        interval_95_m=interval_95_m,
        candidates=candidates,
        surfaces_bin=surfaces_bin,
        find_flux=partial(pixel_flux, capture, row, col, surfaces_bin),
        find_fit=partial(fit_of, capture),
        longest_echo_bins=echo_window(capture)[1],
        flux_unit=flux_unit(capture),
        flux_method=METHOD if len(surfaces_bin) < 2 else f"{METHOD}; {SEVERAL}",
        verdict=pixel_verdict(capture, row, col),
    )


def pixel_flux(capture: Capture, row: int, col: int, surfaces_bin: Sequence[float]) -> FluxEstimate:
    """Estimate the fluxes of one pixel with these surfaces as `PixelReport.flux`."""
    counts = capture.cube[row, col].astype(float)
    known = capture.acquisition, capture.pulse, capture.gated_pulses
    return estimate_flux(counts, *known, _other_echoes(capture, surfaces_bin)).of(capture)


def _other_echoes(capture: Capture, surfaces_bin: Sequence[float]) -> NDArray[np.bool_] | None:
    """Find the bins of all echoes but the first, except the middle 80 % of that one, (bin,).

    None without other surfaces, and if they leave no bin.
    """
    if len(surfaces_bin) < 2:
        return None
    n_bins, width_s = capture.acquisition.n_bins, capture.acquisition.bin_width_s
    echo, first = capture.pulse.taps(n_bins, width_s, 0.5)
    after = np.arange(n_bins) - np.floor(surfaces_bin)[:, np.newaxis]
    is_near = (after >= first - 1) & (after <= first + echo.size)
    begin, end = (surfaces_bin[0] + each_s / width_s for each_s in capture.pulse.span_s)
    bins = np.arange(n_bins)
    is_other = is_near[1:].any(axis=0) & ((bins + 1 <= begin) | (bins >= end))
    return None if is_other.all() else is_other


def flux_unit(capture: Capture) -> str:
    """Return the unit of fluxes: ``"photons"`` if the number of pulses is unknown."""
    return "photons" if capture.acquisition.n_pulses is None else "photons per pulse"


def echo_view(capture: Capture, at_bin: float) -> tuple[float, float]:
    """Return the ends of a plot of a few echoes around a delay, in bins within the gate."""
    half = 2 * max(capture.echo_bins, _FEWEST_BINS)
    return max(at_bin - half, 0.0), min(at_bin + half, float(capture.acquisition.n_bins))


@cached_per_capture
def lag_bins(capture: Capture, method: str, settings: Any) -> float:
    """Return `Estimator.lag_bins`, cached; 0 for an estimator without a lag."""
    estimator = ESTIMATORS[method]
    return 0.0 if estimator.finds_delay else estimator.lag_bins(capture, settings)


def _candidates(
    capture: Capture,
    image: RangeImage,
    row: int,
    col: int,
    curve: Floats,
    judge: Evidence | None,
    method: str,
    lag_bins: float,
) -> tuple[tuple[RangeCandidate, ...], float]:
    """Return the candidates and the probability of the estimate, whether it is one of them.

    Candidates are maxima of `curve`; their probabilities are by `judge`, or by the pixel alone.
    """
    estimate_bin, confidence = float(image.bin[row, col]), float(image.confidence[row, col])
    peaks = np.flatnonzero(prominences(np.pad(curve, 1, constant_values=-np.inf))) - 1
    # A signal far below the image's mean makes all scores of the likelihood negative.
    base = 0.0 if curve.max() > 0 else float(np.median(curve))
    peaks = peaks[curve[peaks] > base]
    peaks = peaks[np.argsort(-curve[peaks], kind="stable")]
    if not peaks.size or not capture.counts[row, col]:
        return (), confidence
    bins = np.clip(peaks - lag_bins, 0.0, capture.acquisition.n_bins)
    width_bins = same_echo_bins(capture)
    is_estimate = np.abs(bins - estimate_bin) < width_bins
    # A refined estimate may have moved farther; it began at the highest peak.
    is_moved = ESTIMATORS[method].refine is not None and math.isfinite(estimate_bin)
    if is_estimate.any() or is_moved:
        bins[is_estimate.argmax()] = estimate_bin
    returns = _several(image, row, col)
    if returns is not None:  # found together: the score of one surface may not show both
        at = np.round(returns.bin + lag_bins).astype(int).clip(0, curve.size - 1)
        bins, peaks = np.append(returns.bin, bins), np.append(at, peaks)
    n_returns = 0 if returns is None else len(returns)
    kept = _apart(bins, width_bins, n_returns)
    kept.sort(key=lambda i: -curve[peaks[i]])
    bins, score = bins[kept], curve[peaks[kept]]
    of_one = (
        tolerance_probability_at(capture, row, col, bins)
        if judge is None
        else _mass_around(judge.posterior, bins)
    )
    probability = surface_probabilities(capture, row, col, bins, of_one)
    if returns is not None:
        probability[np.argsort(kept)[:n_returns]] = returns.confidence
    is_estimate = bins == estimate_bin
    if judge is not None or ESTIMATORS[method].confidence is not None:  # more than the pixel knows
        probability[is_estimate] = confidence
    elif is_estimate.any():
        confidence = float(probability[is_estimate][0])
    range_m = capture.acquisition.bin_to_range_m(bins)
    low_m, high_m = delay_range_interval(capture, image, row, col, bins)
    # The score of another method may have its maximum where the posterior has none.
    low_m = np.where(is_estimate, low_m, np.minimum(low_m, range_m))
    high_m = np.where(is_estimate, high_m, np.maximum(high_m, range_m))
    relative = (score - base) / (score[0] - base)
    columns = (bins, range_m, low_m, high_m, score, relative, probability)
    found = tuple(RangeCandidate(*map(float, each)) for each in zip(*columns, strict=True))
    return found, confidence


def _mass_around(by_bin: Floats, bins: Floats) -> Floats:
    """Add probabilities (bin,) within `TOLERANCE_BINS` of delays (n,) in fractional bins."""
    up_to, edges = np.cumsum(np.append(0.0, by_bin)), np.arange(by_bin.size + 1)
    low, high = (np.interp(bins + side, edges, up_to) for side in (-TOLERANCE_BINS, TOLERANCE_BINS))
    return np.asarray(high - low)


def _several(image: RangeImage, row: int, col: int) -> Returns | None:
    """Return the returns of a pixel, if they were looked for and there are several."""
    found = None if image.returns is None else image.returns.at(row, col)
    return None if found is None or len(found) < 2 else found


def _apart(bins: Floats, width_bins: float, n_first: int) -> list[int]:
    """Return the indices of the first delays, and of others a width from all before them."""
    kept = list(range(n_first))
    for i, delay in list(enumerate(bins))[n_first:]:
        if np.all(np.abs(bins[kept] - delay) >= width_bins):
            kept.append(i)
        if len(kept) == MOST_CANDIDATES:
            break
    return kept
