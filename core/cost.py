"""Working memory and time of an estimate, predicted from its shape before anything is computed.

Working memory is the peak allocation of an estimate, without the cube itself. It has terms that
grow with the counts (the blocks of `core.kernels.blocks` and the table of the posterior), with the
pixels (images of a few float64 each) and with the gate (`core.inference.posterior` holds a table of
all levels and delays of a few pixels), and buffers of fixed size. Time is that of one thread. The
constants are measured; ``python -m core.studies.performance.costs`` repeats the measurement and
compares it with the prediction. Both are right within a factor of 3 for the shapes listed there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import psutil

from core.capture import Capture
from core.checks import require
from core.inference.flux import DEPTH_SAMPLE, LEVELS, SAMPLE
from core.inference.likelihood import lanes_of, sampled_numbers
from core.inference.posterior import TOLERANCE_BINS, has_posterior
from core.kernels.blocks import LANES

__all__ = [
    "Cost",
    "cost_of",
    "n_groups_of",
    "needs",
    "predicted",
    "predicted_fit_time",
    "predicted_flux_time",
    "predicted_interval_time",
    "predicted_returns_time",
    "require_memory",
]

REMEDY = (
    "crop the gate, merge bins or keep fewer pixels (core.reductions), or range the file in parts "
    "(core.open_capture, core.estimate_large)"
)

_UNCHECKED_BYTES = 2**26  # not worth a query of the free memory

_FIXED_BYTES = 12e6
_PIXEL_BYTES = 120.0  # range image and flux model
_SAMPLE_COUNT_BYTES = 6.0
_NULL_COUNT_BYTES = 12.0

_FIXED_S = 0.01
_PIXEL_S = 0.4e-6
_ENTRY_S, _LANE_S, _TAP_S = 4e-9, 40e-9, 0.15e-9  # per level and delay; per row of lanes
_REFINED_S, _REFINED_BYTES = 2e-9, 40.0  # of a pixel: per squared tap; images in blocks
_LEARNED_S = 30e-9  # per level and delay of the sample, for all steps of the maximisation
_ECHO_S = 25e-9  # per bin of an expected echo
_NULL_S = 60e-9
_FEW_PIXELS = 24  # whose fluxes are estimated one by one (`core.inspection.mean_flux`)
_FLUX_S, _MIXTURE_S = 20e-6, 5e-6  # per bin of a pixel
_FIT_S, _FIT_BYTES = 0.5e-6, 80_000_000  # per bin of a pixel; of the pixels tested at once
_INTERVAL_S, _INTERVAL_BYTES = 6e-6, 50_000_000  # per bin near an estimate; of pixels at once
_RETURN_S, _RETURN_BYTES, _RETURN_DRAWN = 2e-6, 16.0, 2**13  # per bin of a pixel; those drawn
_MOVING_S = 2e-9  # per velocity, count, and group of pulses or tap
_MOVING_INTERVALS = 8.0  # time of intervals of moving surfaces over that of others
_WINDOW_ECHOES = 4  # width of nearly all of an echo, in `Capture.echo_bins`
_ECHOES = 64  # noise-free echoes of the lag calibration
_USUAL_LEVELS = 4  # signal levels of a capture


@dataclass(frozen=True)
class Cost:
    """Memory and time of an estimate.

    Parameters
    ----------
    working_bytes : int
        Peak memory in bytes, without the capture.
    seconds : float
        Time on one thread.
    """

    working_bytes: int
    seconds: float


@dataclass(frozen=True)
class _Rates:
    """Memory and time of a method, without the posterior."""

    count_s: float
    pixel_s: float = 0.0
    pixel_bytes: float = 0.0
    fixed_bytes: float = 0.0
    count_bytes: float = 0.0
    sampled_bytes: float = 0.0
    finds_delay: bool = False


_USUAL = _Rates(25e-9)
_RATES = {
    "tracking": _Rates(5e-9, 0.5e-6, 40.0),
    "peak": _Rates(2e-9),
    "shi": _Rates(40e-9),
    "chi": _Rates(60e-9, 1e-6, 170.0, 40e6),
    "unmixing": _Rates(200e-9, 5e-6, 300.0, 130e6, finds_delay=True),
    "image_posterior": _Rates(300e-9, 20e-6, 500.0, 60e6, 24.0, 70.0, finds_delay=True),
    "likelihood": _Rates(0.0, 0.3e-6, 40.0, finds_delay=True),
    "velocity": _Rates(0.0, 0.3e-6, 40.0, finds_delay=True),
    "oracle": _Rates(0.0, 0.3e-6, 60.0, finds_delay=True),
}


def predicted(
    shape: tuple[int, int, int],
    method: str,
    settings: Any = None,
    *,
    false_alarm: float | None = None,
    n_taps: int = 16,
    n_groups: int = 0,
    posterior_is_cached: bool = False,
) -> Cost:
    """Predict working memory and time of `core.estimate`.

    Parameters
    ----------
    shape : tuple of int
        Rows, columns and bins.
    method, settings, false_alarm
        As for `core.estimate`.
    n_taps : int
        Bins that an echo fills (`core.Pulse.taps`).
    n_groups : int
        Groups of pulses in order, in which "velocity" looks for motion.
    posterior_is_cached : bool
        Whether the posterior of the capture has been computed.

    Returns
    -------
    Cost
    """
    rows, cols, n_bins = shape
    n_pixels, rates = rows * cols, _RATES.get(method, _USUAL)
    n_counts, levels = n_pixels * n_bins, LEVELS + 1
    n_sampled = min(n_pixels, SAMPLE)
    entry_s = _ENTRY_S + _TAP_S * n_taps
    steps = 0
    if method in ("likelihood", "oracle"):
        steps = 2 if settings is None else settings.steps_per_bin
    elif method == "velocity":
        steps = 2

    n_bytes = _FIXED_BYTES + rates.fixed_bytes * min(1.0, n_counts / 1e6)
    n_bytes += (_PIXEL_BYTES + rates.pixel_bytes) * n_pixels + rates.count_bytes * n_counts
    n_bytes += rates.sampled_bytes * min(n_pixels, DEPTH_SAMPLE) * n_bins
    seconds = _FIXED_S + (_PIXEL_S + rates.pixel_s) * n_pixels + rates.count_s * n_counts
    lanes = lanes_of(levels, n_bins)
    if not posterior_is_cached:
        learned = min(sampled_numbers(levels, n_bins), n_sampled * levels * n_bins)
        table = 4 * lanes * levels * n_bins * min(1.0, n_pixels / 4)
        sampled = _SAMPLE_COUNT_BYTES * min(n_pixels, DEPTH_SAMPLE) * n_bins
        n_bytes += 4 * n_counts + max(table, 4 * learned + sampled)
        seconds += _LEARNED_S * learned
        seconds += (entry_s + _LANE_S / lanes) * n_bins * levels * _filled(n_sampled, lanes)
        seconds += (entry_s + _LANE_S / lanes) * n_bins * _USUAL_LEVELS * _filled(n_pixels, lanes)
    if method == "tracking" or steps or (not posterior_is_cached and lanes == LANES):
        n_bytes += 2 * n_bins * _filled(n_pixels, LANES)
    if method == "tracking" and (settings is None or settings.refine == "likelihood"):
        n_bytes += _REFINED_BYTES * n_pixels
        seconds += _REFINED_S * n_taps**2 * n_pixels
    if steps:
        n_bytes += _REFINED_BYTES * n_pixels
        lanes = lanes_of(_USUAL_LEVELS, n_bins * steps)
        n_bytes += 8 * lanes * _USUAL_LEVELS * n_bins * steps
        n_entries = n_bins * steps * _USUAL_LEVELS * _filled(n_pixels, lanes)
        seconds += (entry_s + _LANE_S / lanes) * n_entries
    if not rates.finds_delay:
        n_bytes += 8 * 8 * min(_ECHOES * n_bins, max(2**20, n_bins))
        seconds += _ECHOES * n_bins * (_ECHO_S + rates.count_s)
    if false_alarm not in (None, 1):
        n_null = n_bins * max(min(n_pixels, 64 * 64), 2**23 // n_bins)
        n_bytes += _NULL_COUNT_BYTES * n_null
        seconds += (_NULL_S + rates.count_s) * n_null
    if method == "velocity" and n_groups:
        n_velocities = 2 * (24 if settings is None else settings.most_bins) + 1
        n_bytes += (4 * n_groups + 16) * n_counts + 40 * n_velocities * n_pixels
        seconds += _MOVING_S * n_velocities * (n_groups + n_taps) * n_counts
    return Cost(int(n_bytes), seconds)


def predicted_flux_time(n_pixels: int, n_bins: int) -> Cost:
    """Predict memory and time of flux intervals (`core.inspection`) of a pixel, region or capture.

    Parameters
    ----------
    n_pixels, n_bins : int

    Returns
    -------
    Cost
    """
    if n_pixels < _FEW_PIXELS:
        return Cost(int(80e6 + 160 * n_bins * n_pixels), _FLUX_S * n_pixels * n_bins)
    n_sampled = min(n_pixels, SAMPLE)
    n_bytes = 20e6 + 4 * n_pixels * n_bins + _SAMPLE_COUNT_BYTES * n_sampled * n_bins
    return Cost(int(n_bytes), _MIXTURE_S * n_sampled * n_bins)


def predicted_fit_time(n_pixels: int, n_bins: int) -> Cost:
    """Predict memory and time of the goodness of fit (`core.inference.fit_p_values`) of pixels."""
    return Cost(_FIT_BYTES, _FIT_S * n_pixels * n_bins)


def predicted_interval_time(n_pixels: int, echo_bins: int, is_moving: bool = False) -> Cost:
    """Predict memory and time of range intervals (`core.range_intervals`) of pixels.

    Parameters
    ----------
    n_pixels : int
        Pixels with an estimate.
    echo_bins : int
        Bins that an echo fills (`Capture.echo_bins`).
    is_moving : bool
        Whether the image has velocities of the surfaces.
    """
    n_bins = _WINDOW_ECHOES * echo_bins + 2 * max(TOLERANCE_BINS, echo_bins) + 1
    factor = _MOVING_INTERVALS if is_moving else 1.0
    return Cost(_INTERVAL_BYTES, factor * _INTERVAL_S * n_bins * n_pixels)


def predicted_returns_time(n_pixels: int, n_bins: int) -> Cost:
    """Predict memory and time of the returns of pixels (`core.with_returns`), those drawn too."""
    n_counts = n_pixels * n_bins
    seconds = _RETURN_S * (n_counts + _RETURN_DRAWN * n_bins)
    return Cost(int(_FIXED_BYTES + _RETURN_BYTES * n_counts), seconds)


def _filled(n_pixels: int, lanes: int) -> int:
    """Round up to whole blocks."""
    return -(-n_pixels // lanes) * lanes


def cost_of(
    capture: Capture, method: str, settings: Any = None, false_alarm: float | None = None
) -> Cost:
    """Predict working memory and time of an estimate of a capture; see `predicted`."""
    rows, cols, n_bins = capture.cube.shape
    taps = capture.pulse.tap_bins(n_bins, capture.acquisition.bin_width_s)
    return predicted(
        (rows, cols, n_bins),
        method,
        settings,
        false_alarm=false_alarm,
        n_taps=len(taps),
        n_groups=n_groups_of(capture),
        posterior_is_cached=has_posterior(capture),
    )


def n_groups_of(capture: Capture) -> int:
    """Return the number of groups of pulses that a capture keeps, 0 for none."""
    return 0 if capture.groups is None else len(capture.groups.counts)


def require_memory(
    capture: Capture, method: str, settings: Any = None, false_alarm: float | None = None
) -> None:
    """Refuse an estimate that needs more working memory than the machine has free.

    Raises
    ------
    ValueError
        If it does.
    """
    needed = cost_of(capture, method, settings, false_alarm).working_bytes
    if needed > _UNCHECKED_BYTES:
        free = psutil.virtual_memory().available
        accepted = f"at most {free / 1e9:.2f} GB, which are free: {REMEDY}"
        name = needs(capture.cube.shape, method)
        require(name, f"{needed / 1e9:.2f} GB", needed <= free, accepted)


def needs(shape: tuple[int, ...], what: str) -> str:
    """Return how errors call the working memory of a computation."""
    rows, cols, n_bins = shape
    return f"working memory of {what!r} for {rows} x {cols} pixels of {n_bins} bins"
