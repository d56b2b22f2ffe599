"""All that is known of one pixel."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy  # loads a submodule when it is first used

from core.acquisition import Floats
from core.capture import Capture, cached_per_capture
from core.checks import require
from core.deprecation import renamed
from core.estimators import ESTIMATORS, RangeImage, settings_of
from core.inference.faults import Verdict, verdict
from core.inference.likelihood import rate_and_n_armed
from core.inference.posterior import posterior_of
from core.inspection.flux import METHOD, estimate_flux
from core.inspection.profile import FluxEstimate

MOST_CANDIDATES = 5


@dataclass(frozen=True)
class Candidate:
    """A place where the surface may be: a peak of an estimator's score."""

    bin: float
    """Delay in fractional bins, the estimator's lag removed."""
    range_m: float
    score: float
    relative: float
    """Score over that of the best candidate; 1 for that one."""
    probability: float
    """That there is a surface within 3 bins of it (`core.inference.posterior`)."""


@dataclass(frozen=True, eq=False)
class PixelReport:
    """All that is known of one pixel, or of a region's pixels added to one."""

    row: int
    col: int
    counts: Floats
    """Detections in each bin, shape (bin,)."""
    rate: Floats
    """Photons per pulse in each bin with the pile-up undone (Coates 1968), shape (bin,). The counts
    themselves where that cannot be done: photons that hide none, or pulses that are not known."""
    rate_unit: str
    """``"photons per pulse"``, or ``"photons"``."""
    method: str
    """Key of `core.ESTIMATORS`."""
    curve: Floats
    """The estimator's score of each bin, its lag not removed; shape (bin,)."""
    lag_bins: float
    """How far behind the surface's delay the score is largest."""
    answer_bin: float
    """The range image's answer; NaN where it has none."""
    answer_m: float
    confidence: float
    candidates: tuple[Candidate, ...]
    """The best peaks of the score, best first; none where the pixel is empty."""
    find_flux: Callable[[], FluxEstimate] = field(repr=False)
    """Finds `flux`."""
    flux_unit: str
    """``"photons per pulse"``, or ``"photons"``."""
    flux_method: str
    """How they are found."""
    verdict: Verdict
    """Whether the pixel is hot or dead."""

    light = renamed("flux")
    light_unit = renamed("flux_unit")
    light_method = renamed("flux_method")
    find_light = renamed("find_flux")

    @cached_property
    def flux(self) -> FluxEstimate:
        """Signal, background and their ratio, with 95 % intervals, in photons per pulse where the
        pulses are known. Found when first asked for: it takes longer than all else."""
        return self.find_flux()


def pixel_report(
    capture: Capture,
    image: RangeImage,
    row: int,
    col: int,
    method: str = "tracking",
    settings: Any = None,
) -> PixelReport:
    """All that is known of one pixel.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        The capture's, by this method and these settings.
    row, col : int
    method : str
        A key of `core.ESTIMATORS`.
    settings : object, optional
        The method's own settings; its defaults where None.

    Raises
    ------
    ValueError
        If there is no such pixel, or the method or its settings are not known.
    """
    rows, cols = capture.shape
    inside = 0 <= row < rows and 0 <= col < cols
    require("row, col", (row, col), inside, f"a pixel of {rows} rows and {cols} columns")
    settings = settings_of(method, settings)
    counts = capture.cube[row, col].astype(float)
    curve = ESTIMATORS[method].curves(capture, row, col, settings)
    lag = lag_bins(capture, method, settings)

    def find_flux() -> FluxEstimate:
        found = estimate_flux(counts, capture.acquisition, capture.pulse, capture.gated_pulses)
        return found.of(capture)

    return PixelReport(
        row=row,
        col=col,
        counts=counts,
        rate=rate_and_n_armed(counts, capture.gated_pulses)[0],
        rate_unit="photons" if capture.gated_pulses is None else "photons per pulse",
        method=method,
        curve=curve,
        lag_bins=lag,
        answer_bin=float(image.bin[row, col]),
        answer_m=float(image.range_m[row, col]),
        confidence=float(image.confidence[row, col]),
        candidates=_candidates(capture, row, col, curve, lag),
        find_flux=find_flux,
        flux_unit=flux_unit(capture),
        flux_method=METHOD,
        verdict=verdict(capture, row, col),
    )


def flux_unit(capture: Capture) -> str:
    """In which light is told: ``"photons per pulse"``, or ``"photons"`` without known pulses."""
    return "photons" if capture.acquisition.n_pulses is None else "photons per pulse"


@cached_per_capture
def lag_bins(capture: Capture, method: str, settings: Any) -> float:
    """Return the estimator's lag, in bins; see `Estimator.lag_bins`."""
    estimator = ESTIMATORS[method]
    return 0.0 if estimator.finds_delay else estimator.lag_bins(capture, settings)


def _candidates(
    capture: Capture, row: int, col: int, curve: Floats, lag_bins: float
) -> tuple[Candidate, ...]:
    if not capture.counts[row, col]:
        return ()
    peaks = scipy.signal.find_peaks(np.pad(curve, 1, constant_values=-np.inf))[0] - 1
    peaks = peaks[curve[peaks] > 0]
    peaks = peaks[np.argsort(-curve[peaks], kind="stable")][:MOST_CANDIDATES]
    if not peaks.size:
        return ()
    bins = np.clip(peaks - lag_bins, 0.0, capture.acquisition.n_bins)
    near = posterior_of(capture).tolerance_probability[row, col]
    probability = np.clip(np.interp(bins, np.arange(near.size), near), 0.0, 1.0)
    range_m = capture.acquisition.bin_to_range_m(bins)
    score = curve[peaks]
    columns = (bins, range_m, score, score / score[0], probability)
    return tuple(Candidate(*map(float, each)) for each in zip(*columns, strict=True))
