"""Report on a capture as a whole, with the gate and T_n that its echoes suggest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from core.capture import Capture, cached_per_capture
from core.inference.background import peaks_inside, shape_text
from core.inference.faults import outlier_pixels
from core.inference.flux import flux_prior_of
from core.inference.posterior import TOLERANCE_BINS
from core.inspection.echoes import CONFIDENT, FEWEST, echoes_of
from core.inspection.mean_flux import METHOD, MeanFlux, mean_flux_of
from core.inspection.pixel import flux_unit, lag_bins
from core.inspection.profile import FluxEstimate, OldFluxNames
from core.metrics import Interval
from core.tracking import START_BINS, TrackingParameters
from core.typesetting import interval_text, three_digits


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


class StatedFluxCheck(NamedTuple):
    """Flux that the file states, and the estimate of the same."""

    name: str
    """``"signal"``, ``"background"`` or ``"sbr"``."""
    unit: str
    stated: float
    estimate: Interval
    """Mean of all pixels, with its 95 % interval."""

    @property
    def difference(self) -> float:
        """Estimate minus statement."""
        return self.estimate.value - self.stated


@dataclass(frozen=True, eq=False)
class CaptureReport(OldFluxNames):
    """Report on a capture as a whole."""

    histogram: NDArray[np.int64]
    """Counts of all pixels together, shape (bin,)."""
    flux: FluxEstimate
    """Mean signal (PPP) and background of all pixels, and their ratio, with 95 % intervals. Pixels
    without an echo count as having no signal."""
    target_flux: FluxEstimate
    """Likewise of a target pixel, one with an echo: the PPP and SBR that a simulation is given."""
    echo_free_background: Interval | None
    """Background in the bins before and after all echoes, likewise over the whole gate; None if
    there are too few such bins. Where it contradicts the fluxes, their intervals include it."""
    flux_remark: str
    """Whether the background is confirmed by bins without echoes, how long the echoes are where
    they differ from the pulse, and how the background varies over the gate if it does."""
    flux_unit: str
    """``"photons per pulse"``, or ``"photons"``."""
    flux_method: str
    """Method by which the fluxes are estimated."""
    n_hot: int | None
    """Hot pixels; None if the image is too narrow to find them."""
    n_dead: int | None
    """Dead pixels, likewise."""
    suggestion: Suggestion
    stated: tuple[StatedFluxCheck, ...]
    """Mean fluxes that the file states, next to the estimates; empty if it states none."""


def capture_report(capture: Capture) -> CaptureReport:
    """Report on a capture as a whole; the first call takes as long as an estimate."""
    faulty, found = outlier_pixels(capture), mean_flux_of(capture)
    return CaptureReport(
        histogram=aggregate(capture),
        flux=found.image,
        target_flux=found.target,
        echo_free_background=found.free and found.free.background,
        flux_remark=_flux_remark(capture, found),
        flux_unit=flux_unit(capture),
        flux_method=METHOD,
        n_hot=None if faulty is None else int(np.count_nonzero(faulty.hot)),
        n_dead=None if faulty is None else int(np.count_nonzero(faulty.dead)),
        suggestion=suggestion(capture),
        stated=_stated(capture, found.image),
    )


def _stated(capture: Capture, estimated: FluxEstimate) -> tuple[StatedFluxCheck, ...]:
    """Compare the fluxes that a file states with estimates of the image."""
    if capture.stated_flux is None:
        return ()
    in_all = estimated.scaled(capture.acquisition.n_pulses or 1)
    units = FluxEstimate._fields, ("photons", "photons", "")
    return tuple(
        StatedFluxCheck(name, unit, stated, getattr(in_all, name))
        for name, unit in zip(*units, strict=True)
        if (stated := getattr(capture.stated_flux, name)) is not None
    )


def _flux_remark(capture: Capture, found: MeanFlux) -> str:
    """Return how far the fluxes can be trusted, in sentences."""
    begin_s, end_s = capture.pulse.span_s
    fitted_begin_s, fitted_end_s = found.pulse.span_s
    unit = flux_unit(capture)
    wide = three_digits((fitted_end_s - fitted_begin_s) / (end_s - begin_s))
    if found.free is None:
        remark = "Too few bins are known to be free of echoes to check the background."
    else:
        dark = "The darkest bins give" if found.is_darkest else "Bins without echoes give"
        remark = (
            f"{dark} a background of {_text(found.free.background)} {unit}, the likelihood of all "
            f"bins {_text(found.model.background)}: "
        )
        remark += (
            "they disagree, and the intervals include both. Pixels may see several surfaces, the "
            "background may vary along the gate, or echoes have another shape than the pulse."
            if found.is_contradicted
            else "they agree."
        )
    if found.pulse != capture.pulse:
        remark += f" The echoes are {wide} times as long as the pulse, which does not fit."
    if (shape := flux_prior_of(capture).background_shape) is not None:
        remark += f" According to bins without echoes, {shape_text(shape)}; estimates allow for it."
        if peaks_inside(shape):
            remark += " Further surfaces at many depths would look the same."
    return remark


def _text(found: Interval) -> str:
    return interval_text(found.value, found.low, found.high)


@cached_per_capture
def aggregate(capture: Capture) -> NDArray[np.int64]:
    """Counts of all pixels together, shape (bin,)."""
    return np.asarray(capture.cube.sum(axis=(0, 1), dtype=np.int64))


_MARGIN_BINS = 3 * START_BINS
_SURE = f"estimates of the likelihood with a confidence of {CONFIDENT:g} or more"
"""Names the method: the estimates on screen may be those of another one."""


@cached_per_capture
def suggestion(capture: Capture) -> Suggestion:
    """Suggest gate and T_n, with a reason in a sentence each."""
    n_bins, echoes = capture.acquisition.n_bins, echoes_of(capture)
    if echoes is None:
        why = f"Fewer than {FEWEST} {_SURE}: the delays of echoes are unknown."
        t_n = min(_MARGIN_BINS, n_bins - 1)
        return Suggestion((0, n_bins), why, t_n, f"The differentiators need {t_n} bins to settle.")
    lag = lag_bins(capture, "tracking", TrackingParameters())
    echo, tap = capture.pulse.taps(n_bins, capture.acquisition.bin_width_s, 0.5)
    ends = f"{echoes.first:.0f}", f"{echoes.last:.0f}"
    bins = f"bin {ends[0]}" if ends[0] == ends[1] else f"bins {ends[0]} to {ends[1]}"
    where = f"The {echoes.n_found:,} {_SURE} lie in {bins}"
    end = min(math.ceil(echoes.last) + tap + echo.size + _MARGIN_BINS, n_bins)
    if capture.gated_pulses is not None:
        # A cut in front loses pulses, a different number in each pixel.
        first, side = 0, "after them; a cut in front would lose the pulses that fired there"
    else:
        first = max(math.floor(echoes.first) + min(tap, 0) - TOLERANCE_BINS - _MARGIN_BINS, 0)
        side = "on either side"
    why = f"{where}; a margin of {_MARGIN_BINS} bins lets filters settle {side}."
    if (first, end) == (0, n_bins):
        why = f"{where}; with a margin of {_MARGIN_BINS} bins this is the whole gate."
    t_n = max(math.floor(echoes.first + lag) - TOLERANCE_BINS, 0)
    return Suggestion(
        (first, end),
        why,
        t_n,
        f"Peaks more than {TOLERANCE_BINS} bins before the {_SURE} are noise.",
    )
