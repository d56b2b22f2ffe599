"""Report on a region: its pixels one by one, and their sum."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture
from core.checks import require
from core.estimators import RangeImage, estimate, with_returns
from core.inference.fit import Fit, fit_in
from core.inference.posterior import same_echo_bins
from core.inspection.mean_flux import METHOD, mean_flux_of, selected_pixels
from core.inspection.pixel import PixelReport, flux_unit, pixel_flux, pixel_report
from core.inspection.profile import FluxEstimate, OldFluxNames


@dataclass(frozen=True, eq=False)
class RegionReport(OldFluxNames):
    """Report on a region.

    The sum of the histograms is that of one pixel with all the pulses, provided that the pixels see
    the same surface with the same fluxes. Otherwise `pixel` holds several surfaces, and its signal
    and background are not those of any pixel.
    """

    n_pixels: int
    summed: Capture
    """Sum of the histograms, shape (1, 1, bin), and of the pulses."""
    image: RangeImage
    """Estimate of the sum, shape (1, 1), with two returns if it shows two surfaces."""
    pixel: PixelReport
    """Report on the sum; its fluxes are with the pulse that fits the echoes of the region."""
    share_answered: float
    """Share of the pixels with an estimate."""
    median_m: float
    """Median of the estimates; NaN without any."""
    spread_m: float
    """Half the range of the middle 68 % of the estimates; NaN without any."""
    mean_confidence: float
    mean_counts: float
    flux: FluxEstimate
    """Mean signal and background of the pixels, and their ratio, with 95 % intervals."""
    flux_unit: str
    flux_method: str
    fit: Fit
    """Whether the model behind every confidence describes the pixels."""


def region_report(
    capture: Capture,
    image: RangeImage,
    mask: NDArray[np.bool_],
    method: str = "tracking",
    settings: Any = None,
) -> RegionReport:
    """Report on a region.

    Parameters
    ----------
    capture : Capture
    image : RangeImage
        Estimate of the capture with this method and these settings.
    mask : ndarray of bool, shape (row, col)
        Pixels of the region, at least one.
    method, settings
        As for `core.estimate`.

    Raises
    ------
    ValueError
        If the region is empty or of another shape, or the method or its settings are unknown.
    """
    require("mask", f"shape {mask.shape}", mask.shape == capture.shape, f"{capture.shape}")
    n_pixels = int(np.count_nonzero(mask))
    require("region", f"{n_pixels} pixels", n_pixels > 0, "one that contains the centre of a pixel")
    own, summed = selected_pixels(capture, mask), _summed(capture, mask)
    of_sum = _ranged(summed, method, settings)
    mean_flux = mean_flux_of(own)
    fitted = replace(summed, pulse=mean_flux.pulse)
    pixel = pixel_report(summed, of_sum, 0, 0, method, settings)
    fit = fit_in(capture, np.flatnonzero(mask))
    pixel = replace(
        pixel,
        find_flux=partial(pixel_flux, fitted, 0, 0, pixel.surfaces_bin),
        find_fit=lambda: fit,
    )
    range_m = image.range_m[mask & image.valid]
    low_m, median_m, high_m = (
        np.quantile(range_m, [0.16, 0.5, 0.84]) if range_m.size else np.full(3, np.nan)
    )
    return RegionReport(
        n_pixels=n_pixels,
        summed=summed,
        image=of_sum,
        pixel=pixel,
        share_answered=range_m.size / n_pixels,
        median_m=float(median_m),
        spread_m=float(high_m - low_m) / 2,
        mean_confidence=float(image.confidence[mask].mean()),
        mean_counts=float(capture.counts[mask].mean()),
        flux=mean_flux.image,
        flux_unit=flux_unit(own),
        flux_method=METHOD,
        fit=fit,
    )


def _ranged(summed: Capture, method: str, settings: Any) -> RangeImage:
    """Estimate the sum with two returns, unless these may be one surface that slopes.

    Within the region a slope widens its echo, and two returns closer than an echo fit it better. Of
    two returns, the estimate is the one that the method finds, not the stronger one.
    """
    alone = estimate(summed, method, settings)
    found = with_returns(summed, alone)
    assert found.returns is not None
    bins = found.returns.bin
    if bins.size < 2:
        return found
    if np.ptp(bins) < same_echo_bins(summed):
        return alone
    nearest = np.abs(bins - alone.bin.item()).argmin()
    return replace(
        found,
        range_m=found.returns.range_m[nearest].reshape(1, 1),
        bin=bins[nearest].reshape(1, 1),
        confidence=found.returns.confidence[nearest].reshape(1, 1),
    )


def _summed(capture: Capture, mask: NDArray[np.bool_]) -> Capture:
    """Return the sum of the pixels of the region, and of their pulses."""
    total = capture.cube[mask].sum(axis=0, dtype=np.int64)
    require("counts", int(total.max()), int(total.max()) < 2**32, "a region of sums below 2**32")
    n_pulses, n_pixels = capture.acquisition.n_pulses, int(np.count_nonzero(mask))
    return replace(
        capture,
        cube=total.astype(np.uint32)[np.newaxis, np.newaxis],
        acquisition=replace(capture.acquisition, n_pulses=n_pulses and n_pulses * n_pixels),
        **capture.images(lambda _: None),
        source=f"{capture.source}; {n_pixels} pixels added",
        flux_prior=None,
        stated_flux=None,
        groups=None,
    )
