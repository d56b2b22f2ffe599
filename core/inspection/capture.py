"""Report on a capture as a whole, with the gate and T_n that its echoes suggest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture, cached_per_capture
from core.inference.faults import outlier_pixels
from core.inference.posterior import TOLERANCE_BINS
from core.inspection.maps import likeliest
from core.inspection.mean_flux import METHOD, estimate_mean_flux
from core.inspection.pixel import flux_unit, lag_bins
from core.inspection.profile import FluxEstimate, OldFluxNames
from core.tracking import START_BINS, TrackingParameters


@dataclass(frozen=True)
class Suggestion:
    """Settings suggested by the echoes of the capture."""

    gate: tuple[int, int]
    """First bin and end of the window with the echoes, in bins of the capture. First-photon data
    are not cut in front, which would cost pulses (`core.reductions.cut_gate`)."""
    why_gate: str
    t_n: int
    """First bin in which the tracking residual may peak, in bins of the whole gate."""
    why_t_n: str


@dataclass(frozen=True, eq=False)
class CaptureReport(OldFluxNames):
    """Report on a capture as a whole."""

    histogram: NDArray[np.int64]
    """Counts of all pixels together, shape (bin,)."""
    flux: FluxEstimate
    """Mean signal (PPP) and background of all pixels, and their ratio, with 95 % intervals."""
    flux_unit: str
    """``"photons per pulse"``, or ``"photons"``."""
    flux_method: str
    """Method by which the fluxes are estimated."""
    n_hot: int | None
    """Hot pixels; None if the image is too narrow to find them."""
    n_dead: int | None
    """Dead pixels, likewise."""
    suggestion: Suggestion


def capture_report(capture: Capture) -> CaptureReport:
    """Report on a capture as a whole; the first call takes as long as an estimate."""
    faulty = outlier_pixels(capture)
    return CaptureReport(
        histogram=aggregate(capture),
        flux=estimate_mean_flux(capture),
        flux_unit=flux_unit(capture),
        flux_method=METHOD,
        n_hot=None if faulty is None else int(np.count_nonzero(faulty.hot)),
        n_dead=None if faulty is None else int(np.count_nonzero(faulty.dead)),
        suggestion=suggestion(capture),
    )


@cached_per_capture
def aggregate(capture: Capture) -> NDArray[np.int64]:
    """Counts of all pixels together, shape (bin,)."""
    return np.asarray(capture.cube.sum(axis=(0, 1), dtype=np.int64))


_CONFIDENT = 0.9
_FEWEST = 10  # confident estimates
_MARGIN_BINS = 3 * START_BINS


class _Echoes(NamedTuple):
    """Delays of confident estimates, in bins."""

    first: float
    last: float
    n_found: int


@cached_per_capture
def _echoes(capture: Capture) -> _Echoes | None:
    """Find the first and last delay; None if there are too few confident estimates.

    Leaves out as many estimates as are expected to be wrong, half of them at each end.
    """
    delay, probability = likeliest(capture)
    sure = probability >= _CONFIDENT
    count = int(np.count_nonzero(sure))
    if count < _FEWEST:
        return None
    found = np.sort(delay[sure])
    wrong = math.ceil(float((1 - probability[sure]).sum()) / 2)
    return _Echoes(float(found[wrong]), float(found[-1 - wrong]), count)


@cached_per_capture
def suggestion(capture: Capture) -> Suggestion:
    """Suggest gate and T_n, with a reason in a sentence each."""
    n_bins, echoes = capture.acquisition.n_bins, _echoes(capture)
    if echoes is None:
        why = f"Fewer than {_FEWEST} estimates are confident: the delays of echoes are unknown."
        t_n = min(_MARGIN_BINS, n_bins - 1)
        return Suggestion((0, n_bins), why, t_n, f"{why} The differentiators need {t_n} bins.")
    lag = lag_bins(capture, "tracking", TrackingParameters())
    echo, tap = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s, 0.5)
    between = f"in bins {echoes.first:.0f} to {echoes.last:.0f}"
    where = f"The {echoes.n_found:,} confident estimates lie {between}"
    end = min(math.ceil(echoes.last) + tap + echo.size + _MARGIN_BINS, n_bins)
    if capture.gated_pulses is not None:
        # A cut in front loses pulses, a different number in each pixel.
        first, side = 0, "after them; a cut in front would lose the pulses that fired there"
    else:
        first = max(math.floor(echoes.first) + min(tap, 0) - TOLERANCE_BINS - _MARGIN_BINS, 0)
        side = "on either side"
    why = f"{where}; a margin of {_MARGIN_BINS} bins lets the differentiators settle {side}."
    if (first, end) == (0, n_bins):
        why = f"{where}; with a margin of {_MARGIN_BINS} bins this is the whole gate."
    t_n = max(math.floor(echoes.first + lag) - TOLERANCE_BINS, 0)
    return Suggestion(
        (first, end),
        why,
        t_n,
        f"{where}: peaks more than {TOLERANCE_BINS} bins before them are noise.",
    )
